"""The turning-point engine and the hysteresis models that are shapes on it."""
