"""The reversal-memory engine and the hysteresis models that define branch shapes for it."""
