"""Simulated records with hidden effects, drawn from a seed, for the tests and the benchmarks of the diagnosis."""

from .nature import CONFUSABLE, NAMES, OWN
from .records import SIZES, Hidden, Truth, again, calibration_of, hide

__all__ = ["CONFUSABLE", "NAMES", "OWN", "SIZES", "Hidden", "Truth", "again", "calibration_of", "hide"]
