"""Seeded records of simulated stages in which effects are hidden, for the tests and the bench of diagnosis."""

from .nature import CONFUSABLE, NAMES
from .records import SIZES, Hidden, Truth, calibration_of, hide

__all__ = ["CONFUSABLE", "NAMES", "SIZES", "Hidden", "Truth", "calibration_of", "hide"]
