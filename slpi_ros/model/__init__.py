"""The model of a stage: hysteresis and effects of each axis, simulated, inverted, streamed and written down."""
