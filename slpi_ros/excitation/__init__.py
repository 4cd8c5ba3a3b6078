"""Voltage signals for the identification of a stage."""
