"""Models of the eleven effects other than hysteresis; each implements the `Effect` protocol."""
