"""What a stage reports during a drive, held against the voltages that it is commanded, without a model of the stage."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, nan

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.amplifier import Amplifier
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

# A displacement beyond this is none in metres.
FARTHEST = 0.1
# Reported voltages may be late by this share of the longest silence that is allowed.
LATE = 0.6
# Time of one step of the watch that counts, seconds: a process that was held up has not heard what was said.
MOST_STEP = 0.05
# Stamps may depart from the clock by this more than at the begin, seconds; of a simulated clock by that.
JUMP, JUMP_SIMULATED = 0.5, 2.0
# This many states over this time (s), or for this time (s) nothing else, show a fault.
STATES, LASTS = 3, 0.1
# Displacements belong to the voltages reported in this time (s), the lag of the stage.
LAG = 0.3
# Share of the voltage range in one cell of the known relation; share of the range that is moved before it is known.
CELLS, KNOWN_MOVE = 64, 0.1
# A displacement may be off the known ones at its voltage by this share of their range, this many times the noise, and
# this many times the resolution.
OFF, OFF_NOISES, OFF_QUANTA = 0.35, 8.0, 3.0
# Steepest slope beyond the known voltages relative to the known one.
STEEPEST = 5.0
# A window of readings for a slope: shortest time (s), fewest readings, share of the range that the voltage moves.
WINDOW, FEWEST, MOVE = 0.3, 8, 0.1
# Share of the window that the sensor may be late, and number of shifts that are tried.
SHIFTED, SHIFTS = 0.33, 12
# Share of the range at both ends where an amplifier or a sensor may saturate.
ENDS = 0.2
# A reading that is the same this often while the voltage moves by this share of its range is frozen, unless it is the
# lowest or highest so far, or the resolution is coarse.
SAME, SAME_MOVE = 10, 0.05
# Slopes relative to the known one: of a frozen reading, and of one whose sign has changed. Multiple of its standard
# error by which a slope is known, and time (s) for which a slope shows a fault.
FROZEN, FLIPPED, KNOWN_ERRORS, PERSISTS = 0.05, -0.25, 8.0, 0.1
# Smallest standard error of a slope that counts, m/V.
TINY = 1e-18
KEPT = 4096
# Time between two judgements of a slope, seconds.
JUDGED = 0.03


@dataclass
class _Relation:
    """Displacements of one axis by reported voltage, as seen so far in a run; slope in m/V, 0 while unknown."""

    limits: Limits
    low: FloatArray = field(default_factory=lambda: np.full(CELLS, inf))
    high: FloatArray = field(default_factory=lambda: np.full(CELLS, -inf))
    slope: float = 0.0
    noise: float = 0.0
    quantum: float = 0.0
    # Last displacement (m), how often it came, and the lowest and highest voltage (V) since.
    same: tuple[float, int, float, float] = (nan, 0, 0.0, 0.0)
    seen: int = 0
    # Attended time (s), reported voltage (V), displacement (m).
    readings: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=KEPT))
    outside: int = 0
    outside_since: float = 0.0
    candidate: str = ""
    candidate_since: float = 0.0
    judged: float = 0.0

    @property
    def span(self) -> float:
        return self.limits.upper - self.limits.lower

    def cell(self, v: float) -> int:
        return min(max(int((v - self.limits.lower) / self.span * CELLS), 0), CELLS - 1)

    def allowed(self, low: float, high: float) -> tuple[float, float]:
        """Return the lowest and highest displacement (m) at voltages from `low` to `high` (V)."""
        known = np.flatnonzero(self.low <= self.high)
        first, last = self.cell(low), self.cell(high)
        # Also the nearest known cells on both sides: one that is crossed fast holds no reading of its own.
        near = known[(known >= first) & (known <= last)].tolist()
        near += known[known < first][-1:].tolist() + known[known > last][:1].tolist()
        off = OFF * (float(self.high[known].max()) - float(self.low[known].min()))
        off += OFF_NOISES * self.noise + OFF_QUANTA * self.quantum
        lowest, highest = float(self.low[near].min()) - off, float(self.high[near].max()) + off
        width = self.span / CELLS
        beyond_up, beyond_down = max(last - int(known[-1]), 0) * width, max(int(known[0]) - first, 0) * width
        ways = (STEEPEST * self.slope * beyond_up, -STEEPEST * self.slope * beyond_down)
        return lowest + min(0.0, *ways), highest + max(0.0, *ways)

    def learn(self, v: float, y: float) -> None:
        at = self.cell(v)
        self.low[at], self.high[at] = min(self.low[at], y), max(self.high[at], y)

    def window(self, v: FloatArray, t: FloatArray, zone: tuple[float, float], move: float) -> int:
        """Return the first reading of the shortest window up to now in which the voltage moved enough; -1 if none."""
        inside = np.clip(v, *zone)[::-1]
        ranges = np.maximum.accumulate(inside) - np.minimum.accumulate(inside)
        enough = (ranges >= move * self.span) & (t[-1] - t[::-1] >= WINDOW)
        enough[: FEWEST - 1] = False
        found = np.flatnonzero(enough)
        return int(v.size - 1 - found[0]) if found.size else -1


class DriveWatch:
    """Hold the states of a stage against the voltages of a drive. Times: steady clock, ns."""

    # Nothing is known of the stage when a run begins. What its first moves show, the slope with its sign, the noise and
    # the displacements at each voltage, bounds the rest of the run: a displacement has to be near those seen at the
    # same voltage before (by 35 % of their range, so that hysteresis, creep and drift fit in), and to follow the
    # voltage. Of the time between two calls at most 0.05 s count: a process that was held up does not take what it has
    # not read yet for silence. Reported voltages may be late by `timeout` (s), the longest time without a valid state.
    def __init__(
        self, axes: Sequence[str], limits: Sequence[Limits], timeout: float, *, simulated: bool = False
    ) -> None:
        self._axes, self._limits, self._timeout = tuple(axes), tuple(limits), timeout
        self._jump = JUMP_SIMULATED if simulated else JUMP
        self.fault = ""  # the first fault, with axis, value and limit
        self._relations = [_Relation(each) for each in limits]
        self._amplifiers = [Amplifier(each.upper - each.lower) for each in limits]
        for amplifier in self._amplifiers:
            amplifier.window_ns = int(LATE * timeout * SECOND_NS)
        self._now, self._last_ns = 0.0, -1
        self._heard, self._driving = 0.0, False
        self._offset, self._offsets = nan, deque[float](maxlen=5)
        self._stamp_ns, self._same, self._same_since, self._stamp_bad = 0, 0, 0.0, 0
        self._stamp_bad_since = 0.0
        self._interval, self._refused = 0.0, ""

    @property
    def known(self) -> bool:
        """Whether the slope of every axis is known."""
        return all(relation.slope for relation in self._relations)

    def begin(self, voltages: Sequence[float], now_ns: int) -> None:
        """Begin a drive from the given voltages (V); what was learned in earlier drives of the run stays."""
        self._attend(now_ns)
        self._driving, self._heard = True, self._now
        for amplifier, v in zip(self._amplifiers, voltages, strict=True):
            amplifier.begin(v, self._now_ns)
        self._stamp_bad = self._same = 0
        for relation in self._relations:
            relation.outside, relation.candidate = 0, ""
            relation.readings.clear()

    def end(self) -> None:
        """End a drive: states are taken, but not held against anything."""
        self._driving = False
        for amplifier in self._amplifiers:
            amplifier.forget_output()

    def command(self, voltages: Sequence[float], now_ns: int) -> None:
        """Take voltages (V) that are published."""
        self._attend(now_ns)
        for amplifier, v in zip(self._amplifiers, voltages, strict=True):
            amplifier.output(v, self._now_ns)

    def started_from(self, now_ns: int, since_ns: int) -> list[float] | None:
        """Return the voltages (V) at which the amplifier is, of reports awaited since `since_ns`; None if unknown."""
        late = int(self._now * SECOND_NS) - (now_ns - since_ns)
        found = [amplifier.found(self._now_ns, late) for amplifier in self._amplifiers]
        known = [v for v in found if v is not None]
        return known if len(known) == len(found) else None

    def refusal(self, v: Sequence[float], y: Sequence[float]) -> str:
        """Return which rule a state breaks, voltages `v` (V) and displacements `y` (m), with value and limit; or ""."""
        for axis, voltage, reading in zip(self._axes, v, y, strict=True):
            if not isfinite(voltage):
                return f"effort of axis '{axis}' is {voltage:g}; report its voltage in volts"
            if not isfinite(reading):
                return f"position of axis '{axis}' is {reading:g}; report its displacement in metres"
            if abs(reading) > FARTHEST:
                return (
                    f"position {reading:.4g} of axis '{axis}' is more than {FARTHEST:g} m; stage_state is in metres: "
                    "does the driver publish micrometres?"
                )
        return ""

    def state(self, stamp_ns: int, clock_ns: int, v: Sequence[float], y: Sequence[float], now_ns: int) -> bool:
        """Take a state with reported voltages (V) and displacements (m), NaN: not named; return whether it is valid."""
        self._attend(now_ns)
        self._refused = self.refusal(v, y)
        for amplifier, voltage in zip(self._amplifiers, v, strict=True):
            amplifier.report(voltage, self._now_ns)
        if self._refused:
            return False
        since = self._now - self._heard
        if not self._driving and since < 5.0:
            self._interval = max(0.9 * self._interval, since)
        self._heard = self._now
        self._check_stamp(stamp_ns, clock_ns)
        for axis, amplifier, relation, voltage, reading in zip(
            self._axes, self._amplifiers, self._relations, v, y, strict=True
        ):
            if self._driving and amplifier.foreign:
                self._found(f"axis '{axis}': {amplifier.foreign.removesuffix(', then call ~/arm')}")
            self._take(axis, relation, voltage, reading)
        return True

    def check(self, now_ns: int) -> str:
        """Return the first fault at `now_ns`, "" if there is none; call it a hundred times a second or so."""
        self._attend(now_ns)
        silent = self._now - self._heard
        if self._driving and silent > max(self._timeout, 2.5 * self._interval):
            rule = f": {self._refused}" if self._refused else ""
            self._found(f"no valid stage_state for {silent:.2g} s (limit {self._timeout:g} s){rule}; check the driver")
        return self.fault

    @property
    def refused(self) -> str:
        """Why the last state was not valid; "" if it was, or none has come."""
        return self._refused

    @property
    def _now_ns(self) -> int:
        return int(self._now * SECOND_NS)

    def _attend(self, now_ns: int) -> None:
        if self._last_ns >= 0:
            self._now += min(max(now_ns - self._last_ns, 0) * 1e-9, MOST_STEP)
        self._last_ns = max(now_ns, self._last_ns)

    def _found(self, fault: str) -> None:
        self.fault = self.fault or fault

    def _check_stamp(self, stamp_ns: int, clock_ns: int) -> None:
        if not stamp_ns:
            # Without stamps.
            return
        offset = (stamp_ns - clock_ns) * 1e-9
        if stamp_ns != self._stamp_ns:
            self._same, self._same_since, self._stamp_ns = 0, self._now, stamp_ns
        self._same += 1
        if not self._driving:
            self._offsets.append(offset)
            self._offset = float(np.median(self._offsets))
            return
        if self._offset != self._offset:
            self._offset = offset
        if self._same > STATES and self._now - self._same_since > 3.0 * LASTS:
            self._found(
                f"the stamps of stage_state stand still over {self._same} states, the last {-offset:.3g} s old; "
                "stamp each state with the time of its measurement"
            )
        if abs(offset - self._offset) <= self._jump:
            self._stamp_bad = 0
            return
        if not self._stamp_bad:
            self._stamp_bad_since = self._now
        self._stamp_bad += 1
        if self._stamp_bad >= STATES and self._now - self._stamp_bad_since >= LASTS:
            # States that a busy computer reads late look as those of a clock that was set.
            busy = "" if offset > 0.0 else "; if this computer is busy, end other programs or lower the driver's rate"
            self._found(
                f"the stamps of stage_state are {abs(offset):.3g} s {'ahead' if offset > 0.0 else 'old'}, "
                f"{abs(self._offset):.2g} s at the begin (limit {self._jump:g} s more); set the clock{busy}; repeat"
            )

    def _take(self, axis: str, relation: _Relation, v: float, y: float) -> None:
        readings = relation.readings
        readings.append((self._now, v, y))
        if not self._driving:
            return
        while len(readings) > FEWEST and self._now - readings[0][0] > 10.0:
            readings.popleft()
        relation.seen += 1
        self._count_same(axis, relation, v, y)
        if relation.slope and self._is_outside(axis, relation, y):
            return
        relation.learn(v, y)
        if len(readings) >= FEWEST and self._now - relation.judged >= JUDGED:
            relation.judged = self._now
            self._judge_slope(axis, relation)

    def _count_same(self, axis: str, relation: _Relation, v: float, y: float) -> None:
        """Find a reading that stands still to the last digit."""
        last, count, low, high = relation.same
        if y != last:
            relation.same = y, 1, v, v
            return
        count, low, high = count + 1, min(low, v), max(high, v)
        relation.same = y, count, low, high
        fine = relation.noise and not relation.quantum and relation.low.min() < y < relation.high.max()
        if fine and count >= SAME and high - low > SAME_MOVE * relation.span:
            self._found(
                f"axis '{axis}' reads {y * 1e6:.6g} µm in {count} states while the voltage moved by {high - low:.3g} V"
                f" (limit {SAME_MOVE * relation.span:.3g} V); check the sensor"
            )

    def _is_outside(self, axis: str, relation: _Relation, y: float) -> bool:
        """Return whether a displacement is not near the known ones at its voltage."""
        recent = [v for t, v, _ in list(relation.readings)[-2:]]
        for t, v, _ in reversed(relation.readings):
            if self._now - t > LAG:
                break
            recent.append(v)
        low, high = relation.allowed(min(recent), max(recent))
        if low <= y <= high:
            relation.outside = 0
            return False
        if not relation.outside:
            relation.outside_since = self._now
        relation.outside += 1
        if relation.outside >= STATES and self._now - relation.outside_since >= LASTS:
            self._found(
                f"axis '{axis}' reads {y * 1e6:.6g} µm at {recent[0]:.4g} V, where {low * 1e6:.6g} to "
                f"{high * 1e6:.6g} µm are possible after what it read before in this run; check the sensor"
            )
        return True

    def _judge_slope(self, axis: str, relation: _Relation) -> None:
        t, v, y = np.array(relation.readings).T
        if y.size < FEWEST:
            return
        step = np.abs(np.diff(y[-64:], 2))
        scatter = float(np.median(step)) / (0.6745 * 6.0**0.5)
        relation.noise = scatter if not relation.noise else min(max(relation.noise, scatter), 4.0 * relation.noise)
        steps = np.abs(np.diff(y))
        if 2 * np.count_nonzero(steps) < steps.size and steps.any():
            least = float(steps[steps > 0.0].min())
            relation.quantum = min(relation.quantum, least) if relation.quantum else least
        limits = relation.limits
        inner = (limits.lower + ENDS * relation.span, limits.upper - ENDS * relation.span)
        if not relation.slope:
            self._learn_slope(axis, relation, t, v, y)
            return
        candidate = ""
        first = relation.window(v, t, (limits.lower, limits.upper), MOVE)
        if first >= 0:
            slope, error = _slope(v[first:], y[first:], np.sign(relation.slope))
            if slope < FLIPPED * abs(relation.slope) and slope < -4.0 * error:
                candidate = "flipped"
        first = relation.window(v, t, inner, MOVE)
        if not candidate and first >= 0:
            slope, error = _slope(v[first:], y[first:], np.sign(relation.slope))
            if slope < FROZEN * abs(relation.slope) and error < 0.1 * abs(relation.slope):
                candidate = "frozen"
        if not candidate or candidate != relation.candidate:
            relation.candidate, relation.candidate_since = candidate, self._now
        if candidate and self._now - relation.candidate_since >= PERSISTS:
            moved = f"{np.ptp(y[first:]) * 1e6:.3g} µm while the voltage moved by {np.ptp(v[first:]):.3g} V"
            known = f"{relation.slope * 1e6:.3g} µm/V before in this run"
            if candidate == "frozen":
                self._found(f"axis '{axis}' does not follow any more: {moved}, {known}; check the sensor")
            else:
                found = f"{slope * np.sign(relation.slope) * 1e6:.3g} µm/V"
                self._found(f"axis '{axis}' moves the wrong way, {found}, {known}; check the sign of the sensor")

    def _learn_slope(self, axis: str, relation: _Relation, t: FloatArray, v: FloatArray, y: FloatArray) -> None:
        limits = relation.limits
        first = relation.window(v, t, (limits.lower, limits.upper), KNOWN_MOVE)
        if first < 0:
            return
        slope, error, sign = _surest_slope(v[first:], y[first:])
        if slope > KNOWN_ERRORS * error and slope > 0.0:
            relation.slope = sign * slope
            return
        first = relation.window(v, t, (limits.lower, limits.upper), ENDS + MOVE)
        if first < 0:
            return
        slope, error, _ = _surest_slope(v[first:], y[first:])
        if slope <= 3.0 * error or slope <= 0.0:
            self._found(
                f"axis '{axis}' does not follow: {np.ptp(y[first:]) * 1e6:.3g} µm while the voltage moved by "
                f"{np.ptp(v[first:]):.3g} V; check the sensor and the order of the axes"
            )


def _slope(v: FloatArray, y: FloatArray, sign: float) -> tuple[float, float]:
    """Return slope times sign (m/V) of displacements (m) over voltages (V), largest over delays, and standard error."""
    slopes = [(sign * slope, error) for slope, error in _slopes(v, y)]
    return max(slopes, key=lambda each: each[0], default=(0.0, inf))


def _surest_slope(v: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Return size (m/V), standard error and sign of the slope that is largest in standard errors, over the delays."""
    # At the beginning of a motion a wrong delay can make a slope many times too large.
    slope, error = max(_slopes(v, y), key=lambda each: abs(each[0]) / max(each[1], TINY), default=(0.0, inf))
    return abs(slope), error, float(np.sign(slope))


def _slopes(v: FloatArray, y: FloatArray) -> Iterator[tuple[float, float]]:
    """Yield slope (m/V) and standard error for delays of the displacement by up to `SHIFTED` of the readings."""
    latest = int(SHIFTED * v.size)
    for shift in sorted({round(share * latest) for share in np.linspace(0.0, 1.0, SHIFTS)}):
        early, late = v[: v.size - shift], y[shift:]
        if early.size < 4:
            continue
        centred = early - early.mean()
        power = float(centred @ centred)
        if power <= 0.0:
            continue
        rest = late - late.mean()
        slope = float(centred @ rest) / power
        left = rest - slope * centred
        error = float(np.sqrt(left @ left / max(early.size - 2, 1) / power))
        yield slope, error
