"""The voltage that the amplifier of an axis reports, held against the voltages that were output."""

from collections import deque
from dataclasses import dataclass
from math import isfinite
from statistics import median

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.monitor import Finding, Lasting, Rule
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import volts

# A start is the median of this many reports, to this many, of at most this age; of a slow driver, after this time, the
# latest one.
REPORTS, MOST_REPORTS, REPORT_AGE_NS, SLOW_NS = 3, 5, SECOND_NS // 5, SECOND_NS
# After this time a publisher that has never reported a finite voltage counts as none.
MUTE_NS = 3 * SECOND_NS
# Reports are compared with the voltages of this time, and of the settling time of the stage's effects.
BAND_NS = SECOND_NS // 5
# They may be off by this share of the voltage range.
TOLERATED_SHARE = 0.02
# This many reports over this time outside: the voltage is another one.
FOREIGN_REPORTS, FOREIGN_NS = 3, SECOND_NS // 10
# Reports are steady if they stay within the tolerance for this time; a rearming node waits longer.
STEADY_NS, REARM_NS = SECOND_NS // 5, SECOND_NS // 2
# A motion is seen between this many parts of the last second.
PARTS = 4
# Voltages are kept in pieces of this length.
PIECE_NS = SECOND_NS // 100
# A gain or an offset of the reports is one that explains this share of them, and of those while the voltage moved;
# fewest reports for that.
EXPLAINED, EXPLAINED_MOVING, FEWEST = 0.98, 0.9, 8
# They have followed a motion of this many tolerances. As long as there was none, a difference of up to this share of
# the range that is there from the start on is not judged.
MOVED, CONSTANT_SHARE = 5.0, 0.1
# Voltages between are those that are further than this share of the motion from its ends.
BETWEEN = 0.2
# Reports kept for that, and gains that are calibration.
KEPT, GAINS = 512, (0.05, 20.0)
# Differences of reports from which the noise is estimated: of steady voltages.
DIFFERENCES = 32
# Median of the absolute difference of two normal values, in standard deviations.
NORMAL_DIFFERENCE = 0.6745 * 2**0.5
# The same of the second difference of three.
NORMAL_BEND = 0.6745 * 6**0.5


@dataclass(frozen=True)
class Calibration:
    """Constant relation of a reported voltage to the voltage that was output (V): ``gain * voltage + offset``."""

    gain: float = 1.0
    offset: float = 0.0

    def voltage(self, reported: float) -> float:
        """Return the output voltage (V) for a reported one (V)."""
        return (reported - self.offset) / self.gain


@dataclass(frozen=True)
class VoltageLimits:
    """When reports contradict the voltages that were output, and what is said then."""

    share: float = TOLERATED_SHARE  # further off than this share of the voltage range,
    noises: float = 4.0  # and than this many times the noise of the reports,
    reports: int = FOREIGN_REPORTS  # this many of them
    lasts_ns: int = FOREIGN_NS  # over this time
    window_ns: int = BAND_NS  # for this time an output voltage may still be reported
    absurd: float = 1e4  # a report beyond this many ranges is none, in whatever unit
    calibrated: bool = True  # a constant gain or offset that explains the reports is calibration, and no contradiction
    reason: str = (  # of {reported} V, where {there}, the last time {last} V
        "stage_state reports {reported} V (effort), but {there}: somebody else moves the stage, its driver limits the "
        "voltage, or the report is wrong; find out which"
    )
    then: str = ", then call ~/arm"


class _Pieces(deque[list[float]]):
    """Number, lowest and highest value (V) of pieces of time."""

    def add(self, low: float, high: float, now_ns: int) -> bool:
        """Take values from `low` to `high` at `now_ns`; return whether a piece has begun."""
        number = now_ns // PIECE_NS
        last = self[-1] if self else None
        if last is None or last[0] != number:
            self.append([number, low, high])
            return True
        if low < last[1]:
            last[1] = low
        if high > last[2]:
            last[2] = high
        return False

    def since(self, oldest_ns: int) -> list[list[float]]:
        """Return the pieces from that of a time on."""
        return [each for each in self if each[0] >= oldest_ns // PIECE_NS]


class Amplifier(Rule):
    """Reports of the voltage of one axis: where it starts, and the rule that nobody else moves it. Steady clock, ns.

    The rule holds each report against the voltages that were output within `window_ns`, once `begin` has said where the
    axis is; within its `limits` (as shares of `span`, V) and `slack` (V) they agree.
    """

    def __init__(self, span: float, limits: VoltageLimits | None = None, axis: str = "") -> None:
        self.span, self.limits, self.axis = span, limits or VoltageLimits(), axis
        self.slack = 0.0  # V, by which reports may be off besides
        self.calibration = Calibration()  # the relation of reports to voltages that was found
        self.foreign = ""  # how the reports contradict the voltages that were output; "" while they agree
        self.window_ns = self.limits.window_ns
        self._reports: deque[tuple[int, float]] = deque(maxlen=64)  # ns, V
        self._outputs = _Pieces()
        # For longer than the last reports of a fast driver last.
        self._levels = _Pieces(maxlen=2 * REARM_NS // PIECE_NS)
        self._last: float | None = None
        self._pairs: deque[tuple[float, float, float]] = deque(maxlen=KEPT)  # time (ns), output and report (V)
        self._differences: deque[float] = deque(maxlen=DIFFERENCES)
        self._outside = Lasting(self.limits.reports)
        self._begun_ns = self._output_ns = 0

    def check(self, now_ns: int) -> Finding | None:
        """Return how the reports contradict the voltages that were output; it stands until `begin`."""
        return Finding("voltage", "foreign", self.foreign, self.axis) if self.foreign else None

    # Reports

    @property
    def latest(self) -> float | None:
        """Latest reported voltage, volts; None before the first."""
        return self._reports[-1][1] if self._reports else None

    @property
    def scatter(self) -> float:
        """Difference (V) between a report and a voltage that the noise of the reports may make."""
        if len(self._differences) == DIFFERENCES:
            return self.limits.noises * median(self._differences) / NORMAL_DIFFERENCE
        # Of steady voltages there are too few yet: second differences of the last reports, which even motion is not in.
        # Uneven motion is, which must not pass for noise.
        bends = np.abs(np.diff([v for _, v in self._reports][-DIFFERENCES:], 2))
        noise = self.limits.noises * float(np.median(bends)) / NORMAL_BEND if bends.size else 0.0
        return min(noise, self.limits.share * self.span)

    def tolerance(self, gain: float = 1.0) -> float:
        """Return the largest difference (V) of an output voltage from a report, over its gain, that means nothing."""
        return max(self.limits.share * self.span, self._noise / gain) + self.slack

    @property
    def _noise(self) -> float:
        """What the noise of the reports may make of a steady voltage, in volts of the reports; 0 if not known yet."""
        return self.scatter if len(self._differences) == DIFFERENCES else 0.0

    @property
    def silent(self) -> bool:
        """Whether reports have stopped while the output goes on."""
        return bool(self._reports) and self._output_ns - self._reports[-1][0] > SLOW_NS

    def report(self, voltage: float, now_ns: int) -> None:
        """Take a reported voltage (V) that arrived at `now_ns`; one that is not finite or absurd is no report."""
        if not (isfinite(voltage) and abs(voltage) <= self.limits.absurd * self.span):
            return
        before = self.latest
        self._reports.append((now_ns, voltage))
        self._levels.add(voltage, voltage, now_ns)
        if self._last is None or self.foreign:
            return
        low, high = self._band(now_ns)
        if before is not None and high == low:
            self._differences.append(abs(voltage - before))
        self._pairs.append((now_ns, self._last, voltage))
        there, tolerance = self.calibration.voltage(voltage), self.tolerance(self.calibration.gain)
        outside = "" if low - tolerance <= there <= high + tolerance else "outside"
        if self._outside.note(outside, now_ns, self.limits.lasts_ns):
            self._judge(low, high, voltage)

    def output(self, voltage: float, now_ns: int) -> None:
        """Take a voltage (V) that is output at `now_ns`."""
        last = voltage if self._last is None else self._last
        self._last = voltage
        if voltage == last and self._outputs:
            return
        if voltage != last:
            self._output_ns = now_ns
        low, high = (last, voltage) if last < voltage else (voltage, last)
        if self._outputs.add(low, high, now_ns):
            oldest = (now_ns - self.window_ns) // PIECE_NS
            while self._outputs[0][0] < oldest:
                self._outputs.popleft()

    # Where it is

    def found(self, now_ns: int, since_ns: int) -> float | None:
        """Return the voltage (V) at which the axis starts, by reports since `since_ns`; None if more are needed."""
        recent = [v for t, v in list(self._reports)[-MOST_REPORTS:] if now_ns - t <= REPORT_AGE_NS]
        if len(recent) >= REPORTS:
            return self.calibration.voltage(median(recent))
        if now_ns - since_ns >= SLOW_NS and self._reports and self._reports[-1][0] >= since_ns - SLOW_NS:
            return self.calibration.voltage(self._reports[-1][1])
        return None

    def steady(self, now_ns: int, for_ns: int = STEADY_NS) -> float | None:
        """Return the voltage (V) that the last reports agree on for `for_ns`; None if there is none."""
        last = list(self._reports)[-REPORTS:]
        if len(last) < REPORTS:
            return None
        # A slow driver reports less often.
        longest_ns = max(REPORT_AGE_NS, REPORTS * (last[-1][0] - last[0][0]) // (REPORTS - 1))
        if now_ns - last[-1][0] > min(longest_ns, SLOW_NS):
            return None
        levels = self._levels.since(now_ns - for_ns + PIECE_NS - 1)
        oldest_ns = min([last[0][0], *(number * PIECE_NS for number, _, _ in levels)])
        values = [v for _, v in last] + [v for _, low, high in levels for v in (low, high)]
        if now_ns - oldest_ns < for_ns * 0.9 or max(values) - min(values) > 2.0 * self.tolerance():
            return None
        recent = [v for t, v in self._reports if now_ns - t <= for_ns]
        return self.calibration.voltage(median(recent or [v for _, v in last]))

    def moves(self, now_ns: int) -> bool:
        """Return whether the reports of the last second went from one voltage to another, by more than they vary."""
        middles = [0.5 * (low + high) for _, low, high in self._levels.since(now_ns - 2 * REARM_NS)]
        if len(middles) < PARTS * REPORTS:
            return False
        parts = np.array_split(middles, PARTS)
        went = float(np.ptp([np.median(part) for part in parts]))
        return went > max(self.tolerance(), *(float(np.ptp(part)) for part in parts))

    def begin(self, voltage: float, now_ns: int) -> None:
        """Continue from a voltage (V) that is known to be there; what was output before no longer counts."""
        self.forget_output()
        self.foreign, self._begun_ns = "", now_ns
        self._outputs.clear()
        self._pairs.clear()
        self.output(voltage, now_ns)

    def forget_output(self) -> None:
        """Compare no reports until the next `begin`: nothing is being output."""
        self._last = None
        self._outside.forget()

    def _band(self, now_ns: int) -> tuple[float, float]:
        """Return the lowest and highest voltage (V) that was in force within the window."""
        assert self._last is not None
        # The voltage at the begin of a piece is in it: that before the oldest piece of the window is, too.
        pieces = self._outputs.since(now_ns - self.window_ns)
        lows, highs = ([each[place] for each in pieces] for place in (1, 2))
        return min([self._last, *lows]), max([self._last, *highs])

    def _judge(self, low: float, high: float, reported: float) -> None:
        """Find the calibration that explains the reports, or state that the voltage is another one."""
        found, followed = self._explained() if self.limits.calibrated else (None, False)
        if found and followed:
            self.calibration = found
            self._outside.forget()
            return
        if found and max(low - reported, reported - high) <= CONSTANT_SHARE * self.span:
            # So far from the start on, and little: motion will tell.
            return
        there = f"{volts(low)} V was output" if high - low < 1e-6 else f"{volts(low)} to {volts(high)} V were output"
        last = volts(self._last or 0.0)
        self.foreign = self.limits.reason.format(reported=volts(reported), there=there, last=last) + self.limits.then

    def _explained(self) -> tuple[Calibration | None, bool]:
        """Return a constant gain or offset that explains all reports, and whether they have followed a motion."""
        # The reports may be late by up to the window. Gain and offset at once are none: any two voltages lie on a line.
        times, given, reported = np.array(self._pairs).T
        explained: list[tuple[float, float, Calibration, bool]] = []
        for late in np.arange(0.0, self.window_ns, PIECE_NS):
            used = times - late - 2.0 * PIECE_NS >= self._begun_ns
            if np.count_nonzero(used) < FEWEST:
                break
            early = times[used] - late
            # The report may be of any voltage since the one before.
            ends = np.array([np.interp(early - since, times, given) for since in (0.0, PIECE_NS, 2.0 * PIECE_NS)])
            low, high, r = ends.min(axis=0), ends.max(axis=0), reported[used]
            middle = ends[1]
            power = float(middle @ middle)
            moved = np.abs(middle - middle[-1]) > self.tolerance()
            for found in (
                Calibration(1.0, float(np.median(r - middle))),
                Calibration(float(middle @ r) / power if power > 0.0 else 0.0),
            ):
                if not GAINS[0] <= found.gain <= GAINS[1]:
                    continue
                v, tolerance = (r - found.offset) / found.gain, self.tolerance(found.gain)
                near = (low - tolerance <= v) & (v <= high + tolerance)
                share = float(near.mean())
                if share < EXPLAINED or (moved.any() and float(near[moved].mean()) < EXPLAINED_MOVING):
                    continue
                error = float(np.abs(found.gain * middle + found.offset - r).mean())
                explained.append((-share, error, found, self._followed(middle, r, v, found.gain)))
        return min(explained, key=lambda each: each[:2])[2:] if explained else (None, False)

    def _followed(self, middle: FloatArray, r: FloatArray, v: FloatArray, gain: float) -> bool:
        """Return whether reports `r` (V), voltages `v` by a gain, have followed a motion of the outputs `middle`."""
        span, moved = float(np.ptp(middle)), float(np.ptp(r))
        # Noise divided by a small gain is no motion.
        if min(span, moved / gain) < MOVED * self.tolerance() or moved < MOVED * self._noise:
            return False
        # At the voltages between, too: a jump of somebody else beside a move of this node is no gain.
        between = np.abs(middle - 0.5 * (middle.min() + middle.max())) < (0.5 - BETWEEN) * span
        along = np.abs(v - middle) < BETWEEN * span
        return bool(np.count_nonzero(between) >= REPORTS and along[between].mean() >= EXPLAINED_MOVING)
