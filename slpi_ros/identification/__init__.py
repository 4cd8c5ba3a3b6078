"""Identification of a hysteresis model from one or several records."""
