"""The model of a stage: hysteresis and effects of each axis; simulation, inversion, streaming and file format."""
