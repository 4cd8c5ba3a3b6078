"""Excitation voltages of the records with hidden effects, composed of random sections of many kinds."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slpi_ros.excitation.drives import CALIBRATION, excite
from slpi_ros.excitation.legs import DriveSpec, Path

FloatArray = NDArray[np.float64]
Section = Callable[[Path, np.random.Generator, float], None]

# Limits of the speed, voltage ranges per second.
SLOWEST, FASTEST = 0.15, 4.0
# Smallest voltage change in records with one frequency, as a fraction of the range.
SMALLEST_MOVE = 0.1
# Fraction of records with an excitation of the package instead of random sections.
OWN_DRIVES = 0.25


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _move(path: Path, rng: np.random.Generator, to: float, slowest: float = SLOWEST, fastest: float = FASTEST) -> None:
    seconds = max(abs(to - path.at), 0.03) / log_uniform(rng, slowest, fastest)
    path.to(to, seconds, straight=bool(rng.random() < 0.4))


def _spent(path: Path) -> float:
    return sum(leg.seconds for leg in path.legs)


def varied(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Move to random levels at random speeds, with occasional holds."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        _move(path, rng, float(rng.uniform(0.0, 1.0)))
        if rng.random() < 0.2:
            path.hold(log_uniform(rng, 0.05, 1.5))


def tempos(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Run loops of random spans, each at several speeds."""
    for _ in range(2):
        low, high = np.sort(rng.uniform(0.0, 1.0, 2))
        high = min(max(high, low + 0.2), 1.0)
        for speed in rng.permutation(np.geomspace(0.3, FASTEST, 4)):
            straight, leg = bool(rng.random() < 0.5), (high - low) / speed
            for _ in range(max(1, round(seconds / 8 / (2 * leg)))):
                path.to(high, leg, straight=straight)
                path.to(low, leg, straight=straight)


def peaks(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Move to the upper end of the range at random speeds, and back to the lower end or to a random level."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        _move(path, rng, float(rng.uniform(0.9, 1.0)))
        if rng.random() < 0.3:
            path.hold(log_uniform(rng, 0.05, 0.5))
        _move(path, rng, float(rng.choice([rng.uniform(0.0, 0.08), rng.uniform(0.1, 0.85)])))


def holds(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Move quickly to random levels and hold them for random times."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        _move(path, rng, float(rng.uniform(0.0, 1.0)), 1.0, FASTEST)
        path.hold(log_uniform(rng, 0.3, 6.0))


def steps(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Make small steps, each followed by a hold until the oscillation has decayed."""
    step, pause = log_uniform(rng, 0.004, 0.06), rng.uniform(0.15, 0.5)
    end = _spent(path) + seconds
    while _spent(path) < end:
        _move(path, rng, float(rng.uniform(0.1, 0.9)))
        for _ in range(int(rng.integers(2, 6))):
            way = 1.0 if path.at + step < 0.98 and rng.random() < 0.5 else -1.0
            path.to(max(path.at + way * step, 0.0), float(rng.uniform(0.0, 0.004)), straight=True)
            path.hold(pause)


def ramps(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Move up and down in slow linear ramps."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        to = float(rng.uniform(0.6, 1.0) if path.at < 0.5 else rng.uniform(0.0, 0.4))
        path.to(to, abs(to - path.at) / log_uniform(rng, 0.1, 0.5), straight=True)


def nests(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Run nested loops of decreasing span about random levels."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        centre, left = rng.uniform(0.2, 0.8), 1.0
        while left > 0.05:
            _move(path, rng, centre + (1.0 - centre) * left, 0.4, 2.5)
            _move(path, rng, centre - centre * left, 0.4, 2.5)
            left *= rng.uniform(0.5, 0.85)


def bursts(path: Path, rng: np.random.Generator, seconds: float) -> None:
    """Run bursts of fast loops, each followed by a hold and slow moves."""
    end = _spent(path) + seconds
    while _spent(path) < end:
        low, high = rng.uniform(0.0, 0.2), rng.uniform(0.7, 1.0)
        leg = (high - low) / rng.uniform(0.5 * FASTEST, FASTEST)
        for _ in range(max(1, round(rng.uniform(0.1, 0.25) * seconds / (2 * leg)))):
            path.to(high, leg)
            path.to(low, leg)
        _move(path, rng, float(rng.uniform(0.5, 1.0)))
        path.hold(float(rng.uniform(0.05, 0.15)) * seconds)
        for _ in range(2):
            _move(path, rng, float(rng.uniform(0.0, 1.0)), 0.1, 0.5)


# Sections that a record must contain so that an effect can be distinguished from others.
NEEDED: dict[str, tuple[Section, ...]] = {
    "delay": (tempos, varied),
    "lag": (tempos, varied),
    "slew": (tempos, varied),
    "saturation": (peaks,),
    "rate_dependence": (tempos, varied),
    "creep": (holds,),
    "contact": (varied, nests),
    "resonance": (steps,),
    "gain_drift": (varied,),
    "cross_coupling": (varied,),
    "thermal_drift": (varied,),
    "sensor_periodic": (ramps,),
    "hum": (holds,),
    "steps": (varied,),
    "self_heating": (bursts,),
}
_ANY: tuple[Section, ...] = (varied, nests, tempos, peaks, holds)


def drive(spec: DriveSpec, effects: tuple[str, ...], rng: np.random.Generator) -> FloatArray:
    """Draw the voltages of one axis, starting and ending at the lowest voltage.

    Parameters
    ----------
    spec : DriveSpec
    effects : tuple of str
        Effects that the record must make visible.

    Returns
    -------
    ndarray, shape (spec.steps + 1,), volts
    """
    single = [effect for effect in effects if effect != "cross_coupling"]
    if len(single) == 1 and rng.random() < OWN_DRIVES:
        return _own(spec, single[0], int(rng.integers(2**31)))
    sections = list(dict.fromkeys(section for effect in effects for section in NEEDED[effect]))
    sections += [_ANY[index] for index in rng.choice(len(_ANY), 2 if len(sections) < 2 else 1, replace=False)]
    shares = rng.dirichlet(np.full(len(sections), 8.0)) * 0.9 * spec.duration
    path = Path()
    path.hold(float(rng.uniform(0.1, 1.0)))
    for to in (1.0, 0.0, 1.0, 0.0):
        _move(path, rng, to, 0.6, 1.5)
    for index in rng.permutation(len(sections)):
        sections[index](path, rng, float(shares[index]))
    path.to(0.0, 1.0)
    path.hold(0.2)
    return path.voltages(spec)


def one_frequency(spec: DriveSpec, frequency: float, rng: np.random.Generator) -> FloatArray:
    """Draw voltages of one axis, shape (spec.steps + 1,), in moves of equal duration: a full loop, then random loops.

    Parameters
    ----------
    spec : DriveSpec
    frequency : float, hertz
        Two moves take one period, as nearly as the duration allows.
    """
    path, half = Path(), 0.5 / frequency
    for _ in range(max(round(spec.duration * frequency), 3)):
        path.to(float(rng.uniform(path.at + SMALLEST_MOVE, 1.0)) if path.legs else 1.0, half)
        path.to(float(rng.uniform(0.0, path.at - SMALLEST_MOVE)) if len(path.legs) > 1 else 0.0, half)
    return path.voltages(spec)


def wandering(spec: DriveSpec, to: float, rng: np.random.Generator) -> FloatArray:
    """Draw voltages of one axis, shape (spec.steps + 1,), from rest via random levels to a fraction of the range."""
    path = Path()
    varied(path, rng, 0.8 * spec.duration)
    path.to(to, 0.1 * spec.duration)
    path.hold(float(rng.uniform(0.0, 0.2)) * spec.duration)
    return path.voltages(spec)


def _own(spec: DriveSpec, effect: str, seed: int) -> FloatArray:
    """Return the calibration excitation followed by the excitation for an effect, each for half of the time."""
    first = spec.steps // 2
    limits = {"voltage_min": spec.low, "voltage_max": spec.high, "rate": spec.rate, "seed": seed}
    calibration = excite(duration=first / spec.rate, drive=CALIBRATION, **limits)
    made = excite(duration=(spec.steps - first) / spec.rate, drive=effect, **limits)
    return np.concatenate([calibration.voltage["x"], made.voltage["x"][1:]])
