"""Seeded records of simulated stages in which effects are hidden, for the tests and the bench of diagnosis."""

from .nature import CONFUSABLE, NAMES, OWN
from .records import SIZES, Hidden, Truth, again, calibration_of, hide

__all__ = ["CONFUSABLE", "NAMES", "OWN", "SIZES", "Hidden", "Truth", "again", "calibration_of", "hide"]
