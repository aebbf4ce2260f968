"""Long tests of what the pipeline promises: many faults, many inputs, many meshes."""
