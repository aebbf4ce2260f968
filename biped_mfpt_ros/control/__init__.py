"""Low-level controllers: hybrid zero dynamics, sliding mode, and the paper's parameter sets."""
