"""Readings of a sensor against the displacements that were expected: silent, stuck, inverted or noisy."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.arrays.latest_rows import LatestRows
from slpi_ros.compensator.monitor import Finding, Lasting, Rule, Silence
from slpi_ros.io.messages import SECOND_NS

# Fewest readings for a judgement, and for a slope with a delay; most readings that are kept.
FEWEST, FEWEST_SHIFTED, KEPT = 8, 4, 4096
# Standard deviation of a second difference, in those of the single values.
BEND = 6.0**0.5
# Share of a sum of squares below which its variance is the rounding of the arithmetic.
ROUNDING = 1e-12


@dataclass(frozen=True)
class FollowingLimits:
    """When readings do not follow what is expected: the slope of readings over expected displacements.

    As the sensor may be late, the largest slope over `shifts` delays of up to the share `late` of the readings counts.
    """

    stuck: float = 0.1  # below this slope,
    error: float = inf  # if its standard error is smaller than this
    inverted: float = -0.2  # below this slope,
    errors: float = 0.0  # and this many standard errors below zero
    late: float = 0.1
    shifts: int = 16


@dataclass(frozen=True)
class SensorLimits:
    """When a sensor is faulty; shares of the displacement range."""

    # The expected displacement has to move by this share, and by this many times the noise of the sensor.
    moved: float = 0.02
    moved_noises: float = 8.0
    noisy: float = 0.03  # scatter from sample to sample, rms
    lasts: float = 0.5  # share of the time looked at for which a fault has to last: the readings span as much already
    following: FollowingLimits = FollowingLimits()


def slopes(expected: FloatArray, reading: FloatArray, limits: FollowingLimits) -> Iterator[tuple[float, float]]:
    """Yield slope and standard error of readings over what is expected, shape (N,) each, for each delay of them."""
    x, y = expected - expected.mean(), reading - reading.mean()
    # Sums of the first so many values, so that a delay costs a single product.
    sum_x, sum_y, square_x, square_y = (np.append(0.0, np.cumsum(each)) for each in (x, y, x * x, y * y))
    latest = int(limits.late * x.size)
    for shift in sorted({round(share * latest) for share in np.linspace(0.0, 1.0, limits.shifts)}):
        count = x.size - shift
        if count < FEWEST_SHIFTED:
            continue
        early, late = float(sum_x[count]), float(sum_y[-1] - sum_y[shift])
        power = float(square_x[count]) - early * early / count
        if power <= ROUNDING * square_x[count]:
            continue
        product = float(x[:count] @ y[shift:]) - early * late / count
        left = float(square_y[-1] - square_y[shift]) - late * late / count - product * product / power
        left = max(left, ROUNDING * float(square_y[-1]))
        yield product / power, sqrt(left / max(count - 2, 1) / power)


def misfit(expected: FloatArray, reading: FloatArray, limits: FollowingLimits) -> tuple[str, float]:
    """Return "inverted", "stuck" or "" of readings, shape (N,) each, and the slope that says so."""
    slope, error = max(slopes(expected, reading, limits), default=(1.0, inf))
    if slope < limits.inverted and slope < -limits.errors * error:
        return "inverted", slope
    return ("stuck" if slope < limits.stuck and error <= limits.error else ""), slope


class SensorRule(Rule):
    """A sensor follows the displacements of the model for the output voltages; m, steady clock in ns.

    `fault_time` (s; 0: not judged) is the time without a reading, and the time looked at, in which a fault has to show.
    `span` is the displacement range, `noise` that of the sensor.
    """

    def __init__(self, span: float, noise: float = 0.0, limits: SensorLimits | None = None, axis: str = "") -> None:
        self.span, self.noise, self.axis = span, noise, axis
        self.fault_time = 0.0
        self.stale = 0.0  # age (s) of readings that come too late to be used; 0: none has come since the last good one
        self.excused = False  # whether the readings tell of an oscillation, which another rule judges
        self._limits = limits or SensorLimits()
        self._readings = LatestRows(KEPT, 3)  # ns, expected (m), reading (m)
        self._silence: Silence | None = None  # None: not yet awaited
        self._suspect = Lasting()

    def begin(self) -> None:
        """Start to watch: what was read before does not count, and readings are awaited from the next check on."""
        self._readings.clear()
        self._suspect.forget()
        self._silence, self.stale = None, 0.0

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Take a reading (m), and the displacement of the model (m) at that time."""
        if self._silence:
            self._silence.hear(now_ns)
        self._readings.append(now_ns, expected, reading)

    def check(self, now_ns: int) -> Finding | None:
        """Return the fault that has lasted for the fault time at `now_ns`; None without one."""
        if not self.fault_time:
            return None
        if self._silence is None:
            self._silence = Silence(now_ns, self._unheard)
        if reason := self._silence.beyond(self.fault_time, now_ns):
            return Finding("sensor", "silent", reason, self.axis)
        kind, reason = ("", "") if self.excused else self._look(now_ns)
        lasts = self._suspect.note(kind, now_ns, int(self._limits.lasts * self.fault_time * SECOND_NS))
        return Finding("sensor", kind, reason, self.axis) if lasts else None

    def _unheard(self, seconds: float) -> str:
        late = f"; what comes is stamped {self.stale:.2g} s ago, longer than measurement_timeout" if self.stale else ""
        return f"no measured_displacement for {seconds:.2g} s{late}"

    def _look(self, now_ns: int) -> tuple[str, str]:
        """Return the kind and the reason of the fault that the readings of the last fault time show; "" if none."""
        self._readings.drop_before(now_ns - int(self.fault_time * SECOND_NS))
        if len(self._readings) < FEWEST:
            return "", ""
        _, expected, reading = self._readings.columns
        limits, model = self._limits, float(np.ptp(expected))
        # Second differences remove what moves evenly.
        scatter, smooth = (float(np.std(np.diff(each, 2))) / BEND for each in (reading, expected))
        if scatter > limits.noisy * self.span + 2.0 * smooth:
            return "noisy", f"the reading scatters by {scatter * 1e9:.4g} nm rms"
        least = max(limits.moved * self.span, limits.moved_noises * self.noise)
        if model < least:
            return "", ""
        kind, slope = misfit(expected, reading, limits.following)
        if kind == "inverted":
            # Feedback answers a jump of the reading by moving against it, which looks like an inverted sensor.
            at = int(np.argmax(np.abs(np.diff(reading)))) + 1
            part = max((slice(at), slice(at, None)), key=lambda rows: float(np.ptp(expected[rows])))
            if np.ptp(expected[part]) >= least:
                kind, slope = misfit(expected[part], reading[part], limits.following)
        if kind == "inverted":
            return kind, f"the reading moves by {slope:.2g} m for each metre that the voltage moves; check its sign"
        moved = f"{np.ptp(reading) * 1e9:.3g} nm while the voltage moves it by {model * 1e9:.4g} nm"
        return kind, f"the reading stays within {moved}"
