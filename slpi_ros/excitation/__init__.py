"""Voltages that drive a stage so that it can be identified."""
