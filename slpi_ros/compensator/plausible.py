"""What no piezo stage can have: a stroke or a noise that says that its positions are in another unit."""

from collections import deque
from math import isfinite, nan

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.monitor import Finding, Rule
from slpi_ros.compensator.sensor_rule import BEND, FEWEST
from slpi_ros.errors import length
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

# Strokes of piezo stages, and the least noise of their sensors; metres.
SHORTEST, LONGEST, QUIETEST = 100e-9, 2e-3, 1e-12
# Rounding of a digit.
ROUNDING = 1e-6
# Cells of the voltage range; a displacement may belong to any voltage of this time before it.
CELLS, LAG_NS = 64, 3 * SECOND_NS // 10
# Time between two judgements. Readings that are taken: at most one in this time; those of which the noise is told.
JUDGED_NS, PERIOD_NS, KEPT = SECOND_NS // 2, SECOND_NS // 50, 64
# Lower quartile of the absolute value of a normal value, in standard deviations: the stage may move most of the time.
QUARTILE = 0.3186


def implausible_stroke(stroke: float) -> str:
    """Return what is implausible about a stroke (m), "" if it may be one, or is not known (NaN)."""
    if stroke < SHORTEST:
        return f"a stroke of {length(stroke)} is below {length(SHORTEST)}"
    return f"a stroke of {length(stroke)} is above {length(LONGEST)}" if stroke > LONGEST else ""


def implausible_noise(y: FloatArray) -> str:
    """Return what is implausible about the noise of readings (m), shape (N,), in their order; "" if nothing is.

    Readings that repeat the one before tell nothing: a digit may be coarse, and the reading held until the next one.
    """
    y = y[np.isfinite(y)]
    steps = np.diff(y)
    fresh = np.concatenate((y[:1], y[1:][steps != 0.0]))
    if fresh.size < FEWEST:
        return ""
    noise = float(np.quantile(np.abs(np.diff(fresh, 2)), 0.25)) / (QUARTILE * BEND)
    # Less than their digit readings cannot show.
    noise = max(noise, float(np.abs(steps[steps != 0.0]).min()))
    return (
        f"a noise of {noise * 1e12:.2g} pm is below {QUIETEST * 1e12:g} pm"
        if noise < QUIETEST * (1.0 - ROUNDING)
        else ""
    )


def implausible(v: FloatArray, y: FloatArray, span: float = nan) -> str:
    """Return what is implausible about a record of one axis, voltages (V) and readings (m), shape (N,) each.

    `span` (V) is the range that the stroke is of, by default that of the record. Readings that do not follow the
    voltage tell no stroke.
    """
    known = np.isfinite(v) & np.isfinite(y)
    v, y = v[known], y[known]
    moved, power = (float(np.ptp(v)), float(np.var(v))) if v.size else (0.0, 0.0)
    found = implausible_noise(y)
    if power <= 0.0 or not np.ptp(y) > 0.0:
        return found
    slope = float(np.cov(v, y, bias=True)[0, 1]) / power
    # Half of what is left is noise or another motion: then it is no relation.
    follows = slope**2 * power > 0.5 * float(np.var(y))
    return (implausible_stroke(abs(slope) * (span if isfinite(span) else moved)) if follows else "") or found


class PlausibleRule(Rule):
    """The displacements of an axis are those of a stage, as far as its moves have shown its stroke within `limits`.

    `read` takes a displacement and the voltage that is reported with it. Of each part of the voltage range the lowest
    and highest displacement are kept, as it may be late, noisy, creeping, and of hysteresis: the stroke is found only
    where it is implausible with all of that. What was found stands until `begin`.
    """

    def __init__(self, limits: Limits, axis: str) -> None:
        self._limits, self.axis = limits, axis
        self.begin()

    def begin(self, travel: float = nan) -> None:
        """Begin anew: nothing is known of the stage but its own `travel` (m from end to end; NaN: neither is that)."""
        self._low, self._high = np.full(CELLS, np.inf), np.full(CELLS, -np.inf)
        self._first = np.zeros(CELLS, np.int64)  # ns, when a cell was known first
        self._known = np.zeros(CELLS, bool)  # for longer than the lag
        self._cells: deque[tuple[int, int]] = deque()  # ns, cells of the last reports
        self._recent: deque[float] = deque(maxlen=KEPT)
        self._digit, self._last, self._taken_ns = np.inf, nan, -PERIOD_NS
        self._judged_ns = -JUDGED_NS
        self._found = implausible_stroke(travel)

    def check(self, now_ns: int) -> Finding | None:
        """Return what is implausible."""
        if not self._found and now_ns - self._judged_ns >= JUDGED_NS:
            self._judged_ns = now_ns
            told = len(self._recent) == KEPT
            self._found = self._stroke() or (implausible_noise(np.array(self._recent)) if told else "")
        return Finding("units", "implausible", self._found, self.axis) if self._found else None

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Take a displacement (m), and the voltage (V) that is reported with it."""
        if now_ns - self._taken_ns < PERIOD_NS or not (isfinite(expected) and isfinite(reading)):
            return
        self._taken_ns = now_ns
        share = (expected - self._limits.lower) / self._limits.span
        self._cells.append((now_ns, min(max(int(share * CELLS), 0), CELLS - 1)))
        while now_ns - self._cells[0][0] > LAG_NS:
            self._cells.popleft()
        step, self._last = abs(reading - self._last), reading
        # The first, and one that repeats the one before, are not fresh.
        if not step > 0.0:
            return
        self._digit = min(self._digit, step)
        self._recent.append(reading)
        visited = [cell for _, cell in self._cells]
        at = slice(min(visited), max(visited) + 1)
        new = self._low[at] > self._high[at]
        self._first[at][new] = now_ns
        self._low[at], self._high[at] = np.minimum(self._low[at], reading), np.maximum(self._high[at], reading)
        self._known[at] |= now_ns - self._first[at] >= LAG_NS

    def _stroke(self) -> str:
        """Return what is implausible of the stroke, whatever it is within what is known."""
        cells = np.flatnonzero(self._known)
        if not cells.size:
            return ""
        low, high = self._low[cells], self._high[cells]
        if (moved := float(high.max() - low.min())) > LONGEST:
            return implausible_stroke(moved)
        parts = int(cells[-1] - cells[0])
        if parts < 2:
            return ""
        middle, spread = (low + high) / 2.0, (high - low) / 2.0
        rise, unsure = abs(float(middle[-1] - middle[0])), float(spread[-1] + spread[0]) + 2.0 * self._digit
        # Voltages lie anywhere within the width of a cell.
        most, least = (rise + unsure) * CELLS / (parts - 1), (rise - unsure) * CELLS / (parts + 1)
        return implausible_stroke(most if most < SHORTEST else max(least, SHORTEST))
