"""Causes that no effect of the package describes, hidden in the record of a stage that is otherwise without effects.

Each kind changes the reading of a stage of `hide`, or replaces the stage by another physics. The size is that of the
part which no rate-independent hysteresis explains, relative to the sensor noise.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from slpi_ros.io.record import Record

from . import foreign
from .drives import log_uniform
from .records import SIZES, hide
from .size import beyond_hysteresis

FloatArray = NDArray[np.float64]
# Change of the reading (m, (N,)) from a generator, times (s), voltages (V) and the reading (m), shape (N,) each.
Change = Callable[[np.random.Generator, FloatArray, FloatArray, FloatArray], FloatArray]

# Names of effects that are a fair description although the cause is another.
NEAR: dict[str, frozenset[str]] = {
    "thermal_relays": frozenset({"rate_dependence", "creep"}),
    "lagging_bouc_wen": frozenset({"lag"}),
    "power_law_drag": frozenset({"rate_dependence"}),
    "voltage_dependent_lag": frozenset({"lag"}),
    "wandering_delay": frozenset({"delay"}),
    "one_sided_creep": frozenset({"creep"}),
    "wandering_line": frozenset({"hum"}),
    "telegraph": frozenset({"steps"}),
    "random_walk": frozenset({"thermal_drift"}),
}


@dataclass(frozen=True)
class Unknown:
    """Record of axis ``x`` with a hidden cause, sensor noise (m rms), and size of the cause relative to it."""

    kind: str
    record: Record
    floor: float
    size: float


def _coloured(rng: np.random.Generator, t: FloatArray, low: float, high: float) -> FloatArray:
    """Return noise with frequencies from `low` to `high` (Hz) and an rms of 1."""
    spectrum = np.fft.rfft(rng.standard_normal(t.size))
    frequency = np.fft.rfftfreq(t.size, (t[-1] - t[0]) / (t.size - 1))
    spectrum[(frequency < low) | (frequency > high)] = 0.0
    x = np.fft.irfft(spectrum, t.size)
    return x / x.std()


def _vibration(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    return _coloured(rng, t, 4.0, log_uniform(rng, 15.0, 80.0))


def _random_walk(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    return np.cumsum(rng.standard_normal(t.size))


def _telegraph(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    flips = np.sort(rng.uniform(0.0, t[-1], int(rng.integers(6, 20))))
    return (np.searchsorted(flips, t) % 2).astype(float)


def _wandering_line(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    frequency = log_uniform(rng, 20.0, 90.0) * (1.0 + 0.05 * _coloured(rng, t, 0.0, 0.3))
    return np.sin(2 * np.pi * np.cumsum(frequency * np.gradient(t)))


def _power_law_drag(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    rate = np.gradient(v, t)
    return -np.sign(rate) * np.abs(rate) ** float(rng.uniform(0.3, 0.7))


def _voltage_dependent_lag(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    return -np.gradient(y, t) * (v / np.ptp(v)) ** 2


def _wandering_delay(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    return -np.gradient(y, t) * (1.0 + _coloured(rng, t, 0.0, 0.2))


def _one_sided_creep(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    dt, tau = float(np.median(np.diff(t))), log_uniform(rng, 0.5, 5.0)
    z = np.zeros_like(y)
    for k in range(1, y.size):
        z[k] = z[k - 1] * np.exp(-dt / tau) + max(y[k] - y[k - 1], 0.0)
    return -z


def _ageing_width(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    # The loops widen in the course of the record: what a straight line leaves of the hysteresis grows.
    return (t / t[-1]) * (y - np.polyval(np.polyfit(v, y, 3), v))


def _rough_screw(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    # An error of the sensor that is a random function of the displacement, finer than any loop model follows.
    places = np.linspace(y.min(), y.max(), 400)
    profile = gaussian_filter1d(rng.standard_normal(places.size), 2.0)
    return np.interp(y, places, profile)


def _coarse_amplifier(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    step = float(np.ptp(v)) / float(rng.integers(60, 250))
    return (np.round(v / step) * step - v) * float(np.ptp(y) / np.ptp(v))


def _heavy_tails(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    # Bumps of the table: rare, some tens of milliseconds long, of either sign.
    x, dt = np.zeros_like(t), float(np.median(np.diff(t)))
    for at in rng.integers(0, t.size, int(rng.integers(10, 40))):
        width = max(int(log_uniform(rng, 0.01, 0.1) / dt), 1)
        x[at : at + width] += float(rng.standard_t(3)) * np.hanning(width)[: t.size - at]
    return x


def _gain_by_rest(rng: np.random.Generator, t: FloatArray, v: FloatArray, y: FloatArray) -> FloatArray:
    # The sensitivity wanders randomly within seconds, as with a loose clamp.
    return (y - y[0]) * _coloured(rng, t, 0.0, 0.5)


CHANGES: Mapping[str, Change] = {
    "vibration": _vibration,
    "random_walk": _random_walk,
    "telegraph": _telegraph,
    "wandering_line": _wandering_line,
    "power_law_drag": _power_law_drag,
    "voltage_dependent_lag": _voltage_dependent_lag,
    "wandering_delay": _wandering_delay,
    "one_sided_creep": _one_sided_creep,
    "ageing_width": _ageing_width,
    "rough_sensor": _rough_screw,
    "coarse_amplifier": _coarse_amplifier,
    "bumps": _heavy_tails,
    "loose_clamp": _gain_by_rest,
}
STAGES: Mapping[str, foreign.Stage] = {
    "thermal_relays": foreign.ThermalRelays(),
    "maxwell_slip": foreign.MaxwellSlip(),
    "duhem": foreign.DuhemStage(),
    "lagging_bouc_wen": foreign.LaggingBoucWen(),
    "moving_preisach": foreign.MovingPreisach(),
}
KINDS = (*CHANGES, *STAGES)


def hide_unknown(kind: str, seed: int, samples: int = 40_000) -> Unknown:
    """Return a record with a cause of a kind of `KINDS`, drawn from a seed."""
    rng = np.random.default_rng([seed, KINDS.index(kind), 99])
    hidden = hide(seed, (), base="preisach", axes=1, samples=samples)
    record, clean, floor = hidden.record, hidden.reading["x"], hidden.floor["x"]
    t, v, noise = record.t, record.voltage["x"], record.displacement["x"] - clean
    if kind in STAGES:
        x = STAGES[kind].run(t, v, np.random.default_rng(seed))
        size = beyond_hysteresis(v, x) / floor
    else:
        change = CHANGES[kind](rng, t, v, clean)
        one = beyond_hysteresis(v, change)
        size = log_uniform(rng, *SIZES)
        x = clean + change * (size * floor / one)
    return Unknown(kind, replace(record, displacement={"x": x + noise}), floor, size)
