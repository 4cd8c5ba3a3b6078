"""The rate of the desired displacements of an axis, held against that of the record of its model."""

from math import inf, nan

from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.coverage import FASTER, faster, fastest_displacement

# A sample that is faster than the record counts this much, a slower one counts one back: from a sum of SUSTAINED on the
# path is faster. A single step is not.
FAST_COUNTS, SUSTAINED = 2, 10


class PathWatch:
    """Find out whether a path is faster than the record of `model`, None: not known; `beyond` says so, "" if not."""

    __slots__ = ("_count", "_known", "_last", "_limit", "_rate", "_seconds", "_way")

    def __init__(self, model: AxisModel | None = None) -> None:
        self._known = (fastest_displacement(model) if model else None) or inf
        self._limit = FASTER * self._known
        self._last, self._count = nan, 0
        self._way = self._seconds = self._rate = 0.0

    def sample(self, dt: float, y: float) -> None:
        """Take the next desired displacement `y` (m), `dt` (s) after the last one."""
        way = abs(y - self._last)
        self._last = y
        if way > self._limit * dt:
            self._count = min(self._count + FAST_COUNTS, SUSTAINED)
            self._way, self._seconds = self._way + way, self._seconds + dt
            if self._count == SUSTAINED and self._seconds:
                self._rate = max(self._rate, self._way / self._seconds)
        elif self._count:
            self._count -= 1
            if not self._count:
                self._way = self._seconds = 0.0

    @property
    def beyond(self) -> str:
        """Both rates in a sentence, "" while the path is not faster than the record."""
        return faster("the path", self._rate * 1e6, self._known * 1e6, "µm") if self._rate else ""
