"""What each effect would look like in a record, for all of them to compete."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from slpi_ros.diagnosis.explanation import Explanation, left_over
from slpi_ros.diagnosis.parameters import FASTEST_CREEP, MOST, plausible
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.effect import Effect
from slpi_ros.effects.hum import Hum
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.thermal_drift import ThermalDrift

FloatArray = NDArray[np.float64]


# Voltages are sorted into so many bins to find where the displacement stands still: below this share of the usual gain.
BINS, FLAT = 200, 0.35

# Relaxations with less than this share of the largest one are left out.
LEAST_SHARE = 0.02


@dataclass(frozen=True)
class Trial:
    """One form of an effect.

    Parameters
    ----------
    columns : ndarray, shape (N, k), metres
        What it would add, linear in k gains.
    effect : callable
        Returns the effect for gains of shape (k,), or None where they make none.
    positive : int
        Number of the last columns whose gains may not be negative; `effect` is given those alone, if there are any.
    """

    columns: FloatArray
    effect: Callable[[FloatArray], Effect | None]
    positive: int = 0


def _step(now: Explanation) -> float:
    return float(np.median(np.diff(now.evidence.t)))


def _delay(now: Explanation) -> Iterator[Trial]:
    dt = _step(now)
    for seconds in (-4.0 * dt, 0.5 * dt, 2.0 * dt, 8.0 * dt):
        columns = now.respond(Delay(seconds).apply(now.u, now.around)) - now.h
        yield Trial(columns[:, None], partial(_shifted, seconds))


def _shifted(seconds: float, gains: FloatArray) -> Effect:
    return Delay(float(gains[0]) * seconds)


def _lag(now: Explanation) -> Iterator[Trial]:
    dt = _step(now)
    for tau in (0.5 * dt, 2.0 * dt, 8.0 * dt, 32.0 * dt):
        columns = now.respond(Lag(tau).apply(now.u, now.around)) - now.h
        yield Trial(columns[:, None], partial(_lagging, tau))


def _lagging(tau: float, gains: FloatArray) -> Effect | None:
    return Lag(float(gains[0]) * tau) if gains[0] > 0 else None


def _creep(now: Explanation) -> Iterator[Trial]:
    t = now.evidence.t
    longest = float(t[-1] - t[0])
    shortest = max(10 * _step(now), FASTEST_CREEP)
    if not shortest < 0.5 * longest:
        return
    single = [np.array([tau]) for tau in np.geomspace(shortest, 0.5 * longest, 7)]
    graded = ((2, 0.1), (2, 0.5), (3, 0.3), (4, 0.7))
    several = [np.geomspace(shortest, slow * longest, count) for count, slow in graded]
    for taus in (*single, *several):
        creeping = [Creep((tau,), (1.0,)) for tau in taus.tolist()]
        columns = np.column_stack([one.apply(now.h, now.around) - now.h for one in creeping])
        before = left_over(creeping, now.evidence)

        def effect(g: FloatArray, taus: FloatArray = taus) -> Effect | None:
            seen = g > LEAST_SHARE * g.max()
            gains = np.minimum(g[seen], MOST["creep.gains"]).tolist()
            return Creep(tuple(taus[seen].tolist()), plausible(taus[seen], gains)) if g.max() > 0 else None

        yield Trial(np.column_stack([before, columns]), effect, positive=taus.size)


def _thermal_drift(now: Explanation) -> Iterator[Trial]:
    t = now.evidence.t
    for knots in (2, 3, 5, 8, 13):
        times = np.linspace(t[0], t[-1], knots)
        # The displacement at rest takes up a constant.
        hats = np.column_stack([np.interp(t, times, row) for row in np.eye(knots)[1:]])
        yield Trial(hats, partial(_drifting, times))


def _drifting(times: FloatArray, gains: FloatArray) -> Effect:
    return ThermalDrift(tuple(times.tolist()), (0.0, *gains.tolist()))


def _cross_coupling(now: Explanation) -> Iterator[Trial]:
    others = now.evidence.others
    if others:
        columns = np.column_stack(list(others.values()))
        yield Trial(columns, lambda g: CrossCoupling(dict(zip(others, g.tolist(), strict=True))))


def _hum(now: Explanation) -> Iterator[Trial]:
    t, residual = now.evidence.t, np.where(now.evidence.used, now.residual, 0.0)
    for frequency in _peaks(t, residual, 4, lowest=2.0):
        phase = 2 * np.pi * frequency * t
        columns = np.column_stack([np.sin(phase), np.cos(phase)])

        def effect(g: FloatArray, frequency: float = frequency) -> Effect:
            return Hum(frequency, float(np.hypot(*g)), float(np.arctan2(g[1], g[0])))

        yield Trial(columns, effect)


def _peaks(t: FloatArray, x: FloatArray, count: int, lowest: float) -> list[float]:
    """Return the frequencies (Hz) of the highest peaks in the spectrum of `x`, shape (N,), strongest first."""
    dt = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1], dt)
    even = np.interp(grid, t, x) * np.hanning(grid.size)
    size = 4 * scipy.fft.next_fast_len(grid.size)
    power = np.abs(np.fft.rfft(even, size)) ** 2
    f = np.fft.rfftfreq(size, dt)
    power[f < lowest] = 0.0
    # Against its surroundings: a line, not a hill.
    found = []
    for _ in range(count):
        k = int(np.argmax(power))
        if not power[k] > 0:
            break
        found.append(float(f[k]))
        power[max(0, k - 12) : k + 13] = 0.0
    return found


def _sensor_periodic(now: Explanation) -> Iterator[Trial]:
    used = now.evidence.used
    z, residual = now.h, now.residual
    width = float(np.ptp(z)) / 2**14
    low = float(z.min())
    bins = ((z[used] - low) / width).astype(np.int64)
    size = 2**16
    sums = np.bincount(bins, residual[used], size)[:size]
    counts = np.bincount(bins, minlength=size)[:size]
    mean = np.divide(sums, np.sqrt(counts), out=np.zeros(size), where=counts > 0)
    power = np.abs(np.fft.rfft(sums)) ** 2
    del mean
    frequency = np.fft.rfftfreq(size, width)
    power[(frequency < 1 / 2e-6) | (frequency > 1 / 50e-9)] = 0.0
    for _ in range(4):
        k = int(np.argmax(power))
        if not power[k] > 0:
            return
        period = 1.0 / float(frequency[k])
        power[max(0, k - 6) : k + 7] = 0.0
        phase = 2 * np.pi * z / period
        columns = np.column_stack([np.sin(phase), np.cos(phase)])

        def effect(g: FloatArray, period: float = period) -> Effect:
            amplitude = min(float(np.hypot(*g)), 0.9 * period / (2 * np.pi))
            return SensorPeriodic(period, amplitude, float(np.arctan2(g[1], g[0])))

        yield Trial(columns, effect)


def _resonance(now: Explanation) -> Iterator[Trial]:
    t, residual = now.evidence.t, np.where(now.evidence.used, now.residual, 0.0)
    dt = _step(now)
    highest = 0.45 / dt
    guesses = [f for f in _peaks(t, residual, 4, lowest=10.0) if f < highest]
    guesses += np.geomspace(20.0, highest, 10).tolist()
    for frequency in guesses:
        for damping in (0.02, 0.08):
            one = Resonance(frequency, damping)
            columns = one.apply(now.h, now.around) - now.h
            yield Trial(columns[:, None], partial(_ringing, one), positive=1)


def _ringing(one: Resonance, gains: FloatArray) -> Effect | None:
    return one if gains[0] > 0 else None


def _rate_dependence(now: Explanation) -> Iterator[Trial]:
    u, t = now.u, now.evidence.t
    reference = float(np.sqrt(np.mean(np.gradient(u, t) ** 2)))
    span = float(np.ptp(u))
    for exponent in (0.2, 0.5, 0.8):
        for transition in (0.01 * span, 0.04 * span, 0.12 * span):
            wider = RateDependence(1.0, 0.0, exponent, reference, transition)
            behind = RateDependence(0.0, 1e-6, exponent, reference, transition)
            columns = np.column_stack([one.apply(now.h, now.around) - now.h for one in (wider, behind)])

            def effect(g: FloatArray, behind: RateDependence = behind) -> Effect | None:
                return replace(behind, widening=float(g[0]), backlash=1e-6 * float(g[1])) if g.max() > 0 else None

            yield Trial(columns, effect, positive=2)


def _saturation(now: Explanation) -> Iterator[Effect]:
    """Yield what clips where the displacement stands still although the voltage goes on."""
    used, v = now.evidence.used, now.u
    low, high = float(v.min()), float(v.max())
    # Increments over a few samples stand out of the noise.
    every = max(1, round(np.ptp(v) / BINS / 4 / max(float(np.mean(np.abs(np.diff(v)))), 1e-12)))
    dv, dy = v[every:] - v[:-every], now.evidence.y[every:] - now.evidence.y[:-every]
    both = used[every:] & used[:-every]
    place = np.clip(((0.5 * (v[every:] + v[:-every]) - low) / (high - low) * BINS).astype(np.int64), 0, BINS - 1)
    moved = np.bincount(place[both], (dv**2)[both], BINS)
    gain = np.bincount(place[both], (dv * dy)[both], BINS) / np.maximum(moved, 1e-300)
    flat = (gain < FLAT * np.median(gain[moved > 0])) | (moved == 0)
    at_top, at_bottom = int(np.argmin(flat[::-1])), int(np.argmin(flat))
    width = (high - low) / BINS
    upper = high - at_top * width if at_top else np.inf
    lower = low + at_bottom * width if at_bottom else -np.inf
    if upper > lower and (at_top or at_bottom):
        for shift in (0.0, 0.5, -0.5):
            yield Saturation(lower + shift * width, upper - shift * width)


TRIALS: Mapping[str, Callable[[Explanation], Iterator[Trial | Effect]]] = {
    "delay": _delay,
    "lag": _lag,
    "saturation": _saturation,
    "rate_dependence": _rate_dependence,
    "creep": _creep,
    "resonance": _resonance,
    "cross_coupling": _cross_coupling,
    "thermal_drift": _thermal_drift,
    "sensor_periodic": _sensor_periodic,
    "hum": _hum,
}
