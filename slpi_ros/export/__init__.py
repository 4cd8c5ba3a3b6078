"""The causal inverse of a stage as C source and as an FMU, from templates."""
