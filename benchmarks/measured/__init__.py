"""Measured records of public repositories, the methods that are compared on them, and the table of errors."""
