"""Models of the effects other than hysteresis; each implements the `Effect` protocol."""
