"""What readers see: the progress line, tables, pictures, and the paper's figures beside ours."""
