"""Calibration of a stage by itself: from an unknown stage to a verified model with causes."""
