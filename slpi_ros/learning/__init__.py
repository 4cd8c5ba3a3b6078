"""Paths that repeat: the correction of the next pass from the last ones."""
