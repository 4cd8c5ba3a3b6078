"""The latest readings of a signal, as arrays."""

import numpy as np

from slpi_ros.arrays import FloatArray


class LatestRows:
    """The latest rows of numbers, at most `most` of `width` each, the first one of which never decreases.

    Taking one costs the same however many there are, and the columns are no copies.
    """

    def __init__(self, most: int, width: int) -> None:
        self._most, self._columns = most, np.empty((width, 2 * most))
        self._first = self._end = 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._end - self._first

    @property
    def columns(self) -> FloatArray:
        """The rows as columns, shape (width, n), valid until the next change."""
        return self._columns[:, self._first : self._end]

    def append(self, *row: float) -> None:
        """Take a row; beyond `most` the oldest one is dropped."""
        if self._end == self._columns.shape[1]:
            kept = self.columns.copy()
            self._first, self._end = 0, kept.shape[1]
            self._columns[:, : self._end] = kept
        self._columns[:, self._end] = row
        self._end += 1
        self._first = max(self._first, self._end - self._most)

    def drop_before(self, first: float, fewest: int = 0) -> None:
        """Drop the rows whose first number is below `first`, but keep the latest `fewest`."""
        below = int(np.searchsorted(self.columns[0], first))
        self._first = max(self._first, min(self._first + below, self._end - fewest))

    def clear(self) -> None:
        """Drop all rows."""
        self._first = self._end = 0
