"""What is noticed of an unknown stage during a drive: its stamps, its silence, and readings that it cannot have."""

from collections import deque
from dataclasses import dataclass, field
from math import inf, nan

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.arrays.latest_rows import LatestRows
from slpi_ros.compensator.monitor import Finding, Lasting, Rule, Silence
from slpi_ros.compensator.sensor_rule import BEND, FEWEST, KEPT, FollowingLimits, misfit, slopes
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

# This many states over this time (ns) show a fault; more of them with one stamp for longer than the last time.
STATES, LASTS_NS, STANDS_NS = 3, SECOND_NS // 10, 3 * SECOND_NS // 10
# A drive may be silent for this many of the longest interval of states before it; longer intervals (s) are silence.
INTERVALS, LONGEST_INTERVAL = 2.5, 5.0
# Cells of the voltage range in which displacements are known.
CELLS = 64
# Smallest standard error of a slope that counts, m/V.
TINY = 1e-18
# Readings that count, seconds; those of which the second differences show their noise.
READINGS_TIME, NOISE_READINGS = 10.0, 64
# Median of the absolute value of a normal value, in standard deviations.
NORMAL = 0.6745


@dataclass(frozen=True)
class RelationLimits:
    """When a displacement is none that the stage can have; shares of the voltage range and of the known range.

    `frozen` and `flipped` hold slopes over the known one; frozen are no readings near the ends of the range, where
    amplifier and sensor may saturate.
    """

    lag: float = 0.3  # s, displacements belong to the voltages reported in this time
    known_move: float = 0.1  # of the range that is moved before the relation is known
    known_errors: float = 8.0  # standard errors by which a slope is known
    steepest: float = 5.0  # slope beyond the known voltages, relative to the known one
    off: float = 0.35  # of the known range that a displacement may be off those at its voltage,
    off_noises: float = 8.0  # this many times the noise,
    off_quanta: float = 3.0  # and this many times the resolution
    window: float = 0.3  # s, shortest time for a slope,
    move: float = 0.1  # in which the voltage moves by this share
    ends: float = 0.2  # of the range, at both ends
    same: int = 10  # equal readings while the voltage moves by this share,
    same_move: float = 0.05  # unless they are the lowest or highest so far, or the resolution is coarse
    frozen: FollowingLimits = FollowingLimits(stuck=0.05, error=0.1, inverted=-inf, late=0.33, shifts=12)
    flipped: FollowingLimits = FollowingLimits(stuck=-inf, inverted=-0.25, errors=4.0, late=0.33, shifts=12)
    judged_ns: int = SECOND_NS // 40  # between two judgements of a slope


class StampRule(Rule):
    """The stamps of states go on, and stay within `jump` (s) of what they were from the clock before the drive."""

    def __init__(self, jump: float) -> None:
        self._jump = jump
        self._offset, self._offsets = nan, deque[float](maxlen=5)
        self._same, self._bad = Lasting(STATES + 1), Lasting(STATES)
        self._found = ""

    def begin(self) -> None:
        """Begin a drive."""
        self._same.forget()
        self._bad.forget()

    def stamp(self, stamp_ns: int, clock_ns: int, driving: bool, now_ns: int) -> None:
        """Take the stamp of a state, 0: none, and the time of the clock at its arrival."""
        if not stamp_ns:
            return
        offset = (stamp_ns - clock_ns) * 1e-9
        stands = self._same.note(str(stamp_ns), now_ns, STANDS_NS + 1)
        if not driving:
            self._offsets.append(offset)
            self._offset = float(np.median(self._offsets))
            return
        if self._offset != self._offset:
            self._offset = offset
        if stands:
            self._found = (
                f"the stamps of stage_state stand still over {self._same.seen} states, the last {-offset:.3g} s old; "
                "stamp each state with the time of its measurement"
            )
        elif self._bad.note("jumped" if abs(offset - self._offset) > self._jump else "", now_ns, LASTS_NS):
            # States that a busy computer reads late look as those of a clock that was set.
            busy = "" if offset > 0.0 else "; if this computer is busy, end other programs or lower the driver's rate"
            self._found = (
                f"the stamps of stage_state are {abs(offset):.3g} s {'ahead' if offset > 0.0 else 'old'}, "
                f"{abs(self._offset):.2g} s at the begin (limit {self._jump:g} s more); set the clock{busy}; repeat"
            )

    def check(self, now_ns: int) -> Finding | None:
        """Return what is wrong with the stamps."""
        return Finding("stamps", "wrong", self._found) if self._found else None


class StateRule(Rule):
    """Valid states keep coming during a drive: within `timeout` (s), or as slowly as before the drive."""

    def __init__(self, timeout: float) -> None:
        self.refused = ""  # why the last state was not valid
        self.driving = False
        self._timeout, self._interval = timeout, 0.0
        self._silence = Silence(0, self._reason)

    def begin(self, now_ns: int) -> None:
        """Begin a drive."""
        self.driving = True
        self._silence.hear(now_ns)

    def hear(self, now_ns: int) -> None:
        """Take that a valid state has come."""
        since = self._silence.seconds(now_ns)
        if not self.driving and since < LONGEST_INTERVAL:
            self._interval = max(0.9 * self._interval, since)
        self._silence.hear(now_ns)

    def check(self, now_ns: int) -> Finding | None:
        """Return the silence during a drive."""
        reason = self._silence.beyond(max(self._timeout, INTERVALS * self._interval), now_ns) if self.driving else ""
        return Finding("states", "silent", reason) if reason else None

    def _reason(self, silent: float) -> str:
        rule = f": {self.refused}" if self.refused else ""
        return f"no valid stage_state for {silent:.2g} s (limit {self._timeout:g} s){rule}; check the driver"


@dataclass
class _Known:
    """Displacements of one axis by reported voltage, as seen so far in a run; slope in m/V, 0 while unknown."""

    limits: Limits
    low: FloatArray = field(default_factory=lambda: np.full(CELLS, inf))
    high: FloatArray = field(default_factory=lambda: np.full(CELLS, -inf))
    slope: float = 0.0
    noise: float = 0.0
    quantum: float = 0.0

    def cell(self, v: float) -> int:
        return min(max(int((v - self.limits.lower) / self.limits.span * CELLS), 0), CELLS - 1)

    def learn(self, v: float, y: float) -> None:
        at = self.cell(v)
        self.low[at], self.high[at] = min(self.low[at], y), max(self.high[at], y)

    def learn_noise(self, y: FloatArray) -> None:
        """Estimate noise and resolution (m) from the last readings."""
        scatter = float(np.median(np.abs(np.diff(y[-NOISE_READINGS:], 2)))) / (NORMAL * BEND)
        self.noise = scatter if not self.noise else min(max(self.noise, scatter), 4.0 * self.noise)
        steps = np.abs(np.diff(y))
        if 2 * np.count_nonzero(steps) < steps.size and steps.any():
            least = float(steps[steps > 0.0].min())
            self.quantum = min(self.quantum, least) if self.quantum else least

    def allowed(self, low: float, high: float, rule: RelationLimits) -> tuple[float, float]:
        """Return the lowest and highest displacement (m) at voltages from `low` to `high` (V)."""
        known = np.flatnonzero(self.low <= self.high)
        first, last = self.cell(low), self.cell(high)
        # Also the nearest known cells on both sides: one that is crossed fast holds no reading of its own.
        near = known[(known >= first) & (known <= last)].tolist()
        near += known[known < first][-1:].tolist() + known[known > last][:1].tolist()
        off = rule.off * (float(self.high[known].max()) - float(self.low[known].min()))
        off += rule.off_noises * self.noise + rule.off_quanta * self.quantum
        lowest, highest = float(self.low[near].min()) - off, float(self.high[near].max()) + off
        width = self.limits.span / CELLS
        beyond_up, beyond_down = max(last - int(known[-1]), 0) * width, max(int(known[0]) - first, 0) * width
        ways = (rule.steepest * self.slope * beyond_up, -rule.steepest * self.slope * beyond_down)
        return lowest + min(0.0, *ways), highest + max(0.0, *ways)


class RelationRule(Rule):
    """The displacements of an unknown stage stay near those seen at the same voltage before, and follow the voltage.

    Nothing is known of the stage when a run begins. What its first moves show, the slope with its sign, the noise and
    the displacements at each voltage, bounds the rest of the run. Hysteresis, creep and drift fit in.
    """

    def __init__(self, limits: Limits, axis: str, rule: RelationLimits | None = None) -> None:
        self._axis, self._rule, self._known = axis, rule or RelationLimits(), _Known(limits)
        self._found: Finding | None = None  # the first
        # Time (s), reported voltage (V), displacement (m).
        self._readings = LatestRows(KEPT, 3)
        # Last displacement (m), how often it came, and the lowest and highest voltage (V) since.
        self._same: tuple[float, int, float, float] = (nan, 0, 0.0, 0.0)
        self._outside, self._misfit = Lasting(STATES), Lasting()
        self._judged_ns = 0

    @property
    def known(self) -> bool:
        """Whether the slope is known."""
        return self._known.slope != 0.0

    def begin(self) -> None:
        """Begin a drive; what was learned in earlier drives of the run stays."""
        self._readings.clear()
        self._outside.forget()
        self._misfit.forget()

    def check(self, now_ns: int) -> Finding | None:
        """Return the first thing that the stage cannot do."""
        return self._found

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Take a displacement (m), and the voltage (V) that is reported with it."""
        v, y, readings = expected, reading, self._readings
        now = now_ns * 1e-9
        readings.append(now, v, y)
        readings.drop_before(now - READINGS_TIME, FEWEST)
        self._count_same(v, y)
        if self.known and self._is_outside(y, now_ns):
            return
        self._known.learn(v, y)
        if len(readings) >= FEWEST and now_ns - self._judged_ns >= self._rule.judged_ns:
            self._judged_ns = now_ns
            self._judge_slope(now_ns)

    def _find(self, kind: str, reason: str) -> None:
        self._found = self._found or Finding("relation", kind, f"axis '{self._axis}' {reason}")

    def _count_same(self, v: float, y: float) -> None:
        """Find a reading that stands still to the last digit."""
        known, rule = self._known, self._rule
        last, count, low, high = self._same
        if y != last:
            self._same = y, 1, v, v
            return
        count, low, high = count + 1, min(low, v), max(high, v)
        self._same = y, count, low, high
        fine = known.noise and not known.quantum and known.low.min() < y < known.high.max()
        if fine and count >= rule.same and high - low > rule.same_move * known.limits.span:
            self._find(
                "frozen",
                f"reads {y * 1e6:.6g} µm in {count} states while the voltage moved by {high - low:.3g} V (limit "
                f"{rule.same_move * known.limits.span:.3g} V); check the sensor",
            )

    def _is_outside(self, y: float, now_ns: int) -> bool:
        """Return whether a displacement is not near the known ones at its voltage."""
        t, v, _ = self._readings.columns
        recent = v[min(int(np.searchsorted(t, now_ns * 1e-9 - self._rule.lag)), max(t.size - 2, 0)) :]
        low, high = self._known.allowed(float(recent.min()), float(recent.max()), self._rule)
        outside = "" if low <= y <= high else "outside"
        if self._outside.note(outside, now_ns, LASTS_NS):
            self._find(
                outside,
                f"reads {y * 1e6:.6g} µm at {recent[-1]:.4g} V, where {low * 1e6:.6g} to {high * 1e6:.6g} µm are "
                "possible after what it read before in this run; check the sensor",
            )
        return bool(outside)

    def _judge_slope(self, now_ns: int) -> None:
        t, v, y = self._readings.columns
        known, rule = self._known, self._rule
        known.learn_noise(y)
        if not self.known:
            self._learn_slope(t, v, y)
            return
        kind, slope, first = "", 0.0, -1
        for ends, limits in ((0.0, rule.flipped), (rule.ends, rule.frozen)):
            if not kind and (first := self._window(v, t, ends, rule.move)) >= 0:
                kind, slope = misfit(known.slope * v[first:], y[first:], limits)
        if self._misfit.note(kind, now_ns, LASTS_NS):
            moved = f"{np.ptp(y[first:]) * 1e6:.3g} µm while the voltage moved by {np.ptp(v[first:]):.3g} V"
            before = f"{known.slope * 1e6:.3g} µm/V before in this run"
            if kind == "stuck":
                self._find("frozen", f"does not follow any more: {moved}, {before}; check the sensor")
            else:
                found = f"{slope * known.slope * 1e6:.3g} µm/V"
                self._find("flipped", f"moves the wrong way, {found}, {before}; check the sign of the sensor")

    def _window(self, v: FloatArray, t: FloatArray, ends: float, move: float) -> int:
        """Return the first reading of the shortest window up to now in which the voltage moved enough; -1 if none."""
        limits, span = self._known.limits, self._known.limits.span
        inside = np.clip(v, limits.lower + ends * span, limits.upper - ends * span)[::-1]
        ranges = np.maximum.accumulate(inside) - np.minimum.accumulate(inside)
        enough = (ranges >= move * span) & (t[-1] - t[::-1] >= self._rule.window)
        enough[: FEWEST - 1] = False
        found = np.flatnonzero(enough)
        return int(v.size - 1 - found[0]) if found.size else -1

    def _learn_slope(self, t: FloatArray, v: FloatArray, y: FloatArray) -> None:
        rule = self._rule
        first = self._window(v, t, 0.0, rule.known_move)
        if first < 0:
            return
        slope, error, sign = surest_slope(v[first:], y[first:], rule.frozen)
        if slope > rule.known_errors * error and slope > 0.0:
            self._known.slope = sign * slope
            return
        first = self._window(v, t, 0.0, rule.ends + rule.move)
        if first < 0:
            return
        slope, error, _ = surest_slope(v[first:], y[first:], rule.frozen)
        if slope <= 3.0 * error or slope <= 0.0:
            self._find(
                "frozen",
                f"does not follow: {np.ptp(y[first:]) * 1e6:.3g} µm while the voltage moved by "
                f"{np.ptp(v[first:]):.3g} V; check the sensor and the order of the axes",
            )


def surest_slope(v: FloatArray, y: FloatArray, limits: FollowingLimits) -> tuple[float, float, float]:
    """Return size (m/V), standard error and sign of the slope that is largest in standard errors, over the delays."""
    # At the beginning of a motion a wrong delay can make a slope many times too large.
    found = slopes(v, y, limits)
    slope, error = max(found, key=lambda each: abs(each[0]) / max(each[1], TINY), default=(0.0, inf))
    return abs(slope), error, float(np.sign(slope))
