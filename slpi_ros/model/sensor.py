"""Known delay and lag of the sensor of an axis."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from math import exp, isfinite

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Effect, EffectContext, usual_step
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Uniform
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import UsageError
from slpi_ros.io.record import Record, first_step_back

# Longest delay and longest lag, seconds.
LONGEST = 1.0
# The slope of the readings is that of cubics fitted over one time constant of the lag, and at least over this many
# readings on either side. This undoes the lag of motions up to about ``2 / lag`` rad/s to one per cent.
BESIDE = 2
# A reading further from the mean of its neighbours than this many times the usual is left out of the slopes of others.
SPIKE = 15.0


@dataclass(frozen=True)
class Sensor:
    """Known timing of a sensor, which reads ``y(t) = z(t - delay)``, with ``lag dz/dt = x - z`` at the displacement x.

    Voltage and reading alone do not tell the timing of the sensor apart from that of the amplifier. Only what is known
    from elsewhere is given here: it is taken out of the readings, and not inverted into the stage.

    Parameters
    ----------
    delay, lag : float, seconds
        Time by which the readings are late, and time constant of the sensor's low-pass filter, each from 0 (default) to
        `LONGEST`; UsageError for any other.
    """

    delay: float = 0.0
    lag: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and 0.0 <= value <= LONGEST):
                raise UsageError(f"sensor {field.name} is {value} s; give a time from 0 to {LONGEST:g} s")

    def __bool__(self) -> bool:
        return bool(self.delay or self.lag)

    def describe(self) -> str:
        """Describe delay and lag."""
        return f"delay {self.delay * 1e3:.4g} ms, lag {self.lag * 1e3:.4g} ms"

    def apply(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """Return the readings, shape (N,), metres, for displacements `x` (m) at times `t` (s), at rest before."""
        around = EffectContext.since_start(t)
        if self.lag:
            x = Lag(self.lag).apply(x, around)
        return Delay(self.delay).apply(x, around) if self.delay else x

    def undo(self, t: FloatArray, y: FloatArray) -> FloatArray:
        """Return the displacements, shape (N,), metres, for readings `y` (m) at times `t` (s): the inverse of `apply`.

        A delay is undone by the reading nearest to ``t + delay``, moved to this time along its slope, and a lag by
        ``x = z + lag dz/dt``. Interpolation would lower the noise of the readings instead, by which models are judged.
        NaN where there is no reading, as at the end, which the sensor has not told yet.
        """
        known = np.isfinite(y)
        if not self or np.count_nonzero(known) < 2:
            return y
        late, near = t + self.delay, np.arange(t.size)
        if self.delay:
            near = np.clip(np.searchsorted(t, late), 1, t.size - 1)
            near -= late - t[near - 1] < t[near] - late
        ahead = late - t[near]
        slopes = _slopes(t, np.interp(t, t[known], _without_spikes(t[known], y[known])), self.lag)
        then = np.interp(late, t, slopes)
        x: FloatArray = y[near] + 0.5 * (then + slopes[near]) * ahead + self.lag * then
        x[np.abs(ahead) > usual_step(t)] = np.nan
        return x


# No delay and no lag.
IDEAL = Sensor()


class StreamingSensor:
    """The sensor of an axis for readings that come one by one: its timing, and its effects, which have no memory."""

    # A delay cannot be undone when the reading comes, and undoing a lag would amplify the noise of each reading. So, if
    # the sensor is `late`, the reading is compared with what it would be for the setpoint, or for the model: with a
    # `Sensed` signal.
    def __init__(self, timing: Sensor, effects: tuple[Effect, ...]) -> None:
        self.timing, self.late = timing, bool(timing)
        self._effects = [streaming for effect in effects if (streaming := effect.streaming())]

    def measure(self, x: float) -> float:
        """Return the reading (m) at the displacement `x` (m), without delay and lag."""
        for effect in self._effects:
            x = effect.forward(0.0, x)
        return x

    def correct(self, y: float) -> float:
        """Return the displacement (m) for the reading `y` (m), without delay and lag."""
        for effect in reversed(self._effects):
            y = effect.inverse(0.0, y)
        return y


class Sensed:
    """A displacement that is held between samples, as corrected readings of it would be: after lag and delay."""

    # If the stage is where the displacement is, at first at `displacement` (m), `at` is what `StreamingSensor.correct`
    # makes of the reading, while it moves too: with ``S`` the periodic error and ``L`` the lag, the reading is ``L S
    # x``, and both are ``S^-1 L S x``.
    __slots__ = ("_before", "_delay_ns", "_lag_ns", "_samples", "_sensor")

    def __init__(self, sensor: StreamingSensor, displacement: float) -> None:
        self._sensor = sensor
        self._delay_ns, self._lag_ns = int(sensor.timing.delay * 1e9), sensor.timing.lag * 1e9
        # Of each sample that is still to be sensed: time (ns), reading without lag, and reading just before it (m).
        self._samples: deque[tuple[int, float, float]] = deque()
        self.restart(displacement)

    def restart(self, displacement: float) -> None:
        """Forget all samples; the stage rests at `displacement` (m) before the next one."""
        self._samples.clear()
        self._before = self._sensor.measure(displacement)

    def hold(self, displacement: float, now_ns: int, early_ns: int = 0) -> None:
        """Set the displacement (m) from `early_ns` after `now_ns` (ns, not decreasing) on, instead of any later one."""
        samples, from_ns, goal = self._samples, now_ns + early_ns, self._sensor.measure(displacement)
        while samples and samples[-1][0] > from_ns:
            if samples[-1][1] == goal:
                return
            samples.pop()
        reading = self._after(samples[-1], from_ns) if samples else self._before
        samples.append((from_ns, goal, reading))
        self._drop(now_ns)

    def at(self, now_ns: int) -> float | None:
        """Return the corrected reading (m) at `now_ns` (ns); None if it refers to a time before the first sample."""
        sample = self._sensed(now_ns)
        return None if sample is None else self._sensor.correct(self._after(sample, now_ns - self._delay_ns))

    def span(self, now_ns: int) -> tuple[float, ...]:
        """Return `at`, preceded by the corrected reading (m) just before the sample that it tells of; () if None."""
        sample, correct = self._sensed(now_ns), self._sensor.correct
        return () if sample is None else (correct(sample[2]), correct(self._after(sample, now_ns - self._delay_ns)))

    def _sensed(self, now_ns: int) -> tuple[int, float, float] | None:
        """Return the sample of which the sensor tells at `now_ns` (ns), if any."""
        self._drop(now_ns)
        samples = self._samples
        return samples[0] if samples and samples[0][0] <= now_ns - self._delay_ns else None

    def _drop(self, now_ns: int) -> None:
        """Drop the samples before the one that is sensed at `now_ns` (ns)."""
        samples, sensed_ns = self._samples, now_ns - self._delay_ns
        while len(samples) > 1 and samples[1][0] <= sensed_ns:
            samples.popleft()

    def _after(self, sample: tuple[int, float, float], now_ns: int) -> float:
        """Return the reading (m) at `now_ns` (ns), not before the sample, without delay."""
        began_ns, goal, reading = sample
        return goal + (reading - goal) * exp(min(began_ns - now_ns, 0) / self._lag_ns) if self._lag_ns else goal


def corrected(record: Record, corrections: Mapping[str, Callable[[FloatArray, FloatArray], FloatArray]]) -> Record:
    """Return a record with corrected readings; `corrections` by axis (s, m): `AxisModel.correct`, `Sensor.undo`."""
    # One whose stamps step back is unchanged: what evaluates it refuses it. Axes that are not in the record are
    # ignored.
    own = [name for name in corrections if name in record.axes]
    if not own or first_step_back(record.time_ns) is not None:
        return record
    t = record.t
    right = {name: corrections[name](t, record.displacement[name]) for name in own}
    return replace(record, displacement={**record.displacement, **right})


def _slopes(t: FloatArray, y: FloatArray, lag: float) -> FloatArray:
    """Return the slope, shape (N,), m/s, of readings, shape (N,), by cubics fitted to the readings around each."""
    from scipy.signal import oaconvolve, savgol_coeffs

    grid = Uniform.over(t)
    if not grid.dt:
        return np.zeros_like(y)
    even = grid.on(y)
    beside = min(max(BESIDE, round(0.5 * lag / grid.dt)), (even.size - 1) // 2)
    if beside < BESIDE:
        return grid.off(np.gradient(even, grid.dt))
    weights = savgol_coeffs(2 * beside + 1, 3, deriv=1, delta=grid.dt)
    slopes = np.empty_like(even)
    slopes[beside : even.size - beside] = oaconvolve(even - even[0], weights, mode="valid")
    # At the ends that of the first and of the last cubic.
    place = np.arange(2 * beside + 1)
    for end, inner in ((slice(0, beside), place < beside), (slice(even.size - beside, None), place > beside)):
        window = even[: place.size] if end.start == 0 else even[-place.size :]
        cubic = np.polynomial.Polynomial.fit(place, window - even[0], 3)
        slopes[end] = cubic.deriv()(place[inner]) / grid.dt
    return grid.off(slopes)


def _without_spikes(t: FloatArray, y: FloatArray) -> FloatArray:
    """Return readings, shape (N,), metres, with the line between its neighbours for each single one far from it."""
    if y.size < 3:
        return y
    off = np.zeros_like(y)
    # Readings may be missing in between.
    apart = t[2:] - t[:-2]
    share = np.divide(t[1:-1] - t[:-2], apart, out=np.full(apart.size, 0.5), where=apart > 0.0)
    off[1:-1] = y[1:-1] - y[:-2] - share * (y[2:] - y[:-2])
    size = np.abs(off)
    # The neighbours of a spike are off by half as much.
    beside = np.maximum(np.append(size[1:], 0.0), np.append(0.0, size[:-1]))
    return np.where((size > SPIKE * float(np.median(size))) & (size > beside), y - off, y)
