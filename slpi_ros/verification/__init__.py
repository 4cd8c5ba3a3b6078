"""Verification of models on records that they were not identified from, and of compensated paths."""
