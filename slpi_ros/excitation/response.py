"""Drive for the frequency response: odd multisines with random phases about several biases."""

from collections.abc import Sequence
from math import inf

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.excitation.drives import Drive, generator
from slpi_ros.excitation.legs import DriveSpec

# Biases, as shares of the voltage range, and periods at each: the first ones are of the transient.
BIASES, PERIODS, TRANSIENT = (0.25, 0.5, 0.75), 6, 2
# Share of the time for the moves between biases.
MOVES = 0.1
# Peak of a multisine over the voltage range; highest frequency over the rate; phases that are tried.
PEAK, HIGHEST, TRIED = 0.04, 0.4, 20
# Lines have one amplitude up to this share of the rate, and one slew rate above.
FLAT = 0.02
# Of so many odd lines in a row one is left out, by chance: what appears there comes from others.
GROUP = 4
# Fewest excited lines.
FEWEST = 20
WHY = (
    "Small multisines about three biases, of odd frequencies with random phases, some left out: the response, its "
    "noise, and what the hysteresis adds to it are told apart."
)


def excited_lines(count: int, rng: np.random.Generator) -> FloatArray:
    """Return the excited lines of a period: odd ones up to `count`, without one of each `GROUP` in a row."""
    odd = np.arange(1, count + 1, 2)
    groups = [odd[k : k + GROUP] for k in range(0, odd.size - GROUP + 1, GROUP)]
    return np.concatenate([np.delete(group, rng.integers(1, GROUP)) for group in groups] or [odd])


def response_drive(
    axes: Sequence[str], low: float, high: float, slew: float, duration: float, rate: float, seed: int = 0
) -> Drive:
    """Return the voltages (V), one axis after the other in `duration` (s) at `rate` (Hz), within `slew` (V/s; 0: none).

    UsageError if the time is too short, the limits are none, or the seed is negative.
    """
    spec = DriveSpec(low, high, duration, rate, slew)
    each = int(spec.steps // len(axes))
    size = int(each * (1.0 - MOVES) / (len(BIASES) * PERIODS))
    if size * HIGHEST < 2 * FEWEST:
        raise UsageError(
            f"drive: {duration:g} s at {rate:g} Hz are too short for the frequency response; give "
            f"{2 * FEWEST / HIGHEST * len(BIASES) * PERIODS * len(axes) / (1.0 - MOVES) / rate:.2g} s or more"
        )
    voltage = {}
    for number, axis in enumerate(axes):
        rng = generator(seed, number)
        voltage[axis] = np.full(spec.steps + 1, low)
        own = _one(spec, each, size, rng)
        voltage[axis][number * each + 1 : number * each + 1 + own.size] = own
    return Drive(np.arange(spec.steps + 1) / rate, voltage, dict.fromkeys(axes, spec), WHY)


def _one(spec: DriveSpec, each: int, size: int, rng: np.random.Generator) -> FloatArray:
    """Return the voltages (V) of one axis, from the lowest voltage and back."""
    rest = each - len(BIASES) * PERIODS * size
    ways = np.diff((0.0, *BIASES, 0.0))
    steps = np.maximum((np.abs(ways) / np.abs(ways).sum() * rest).astype(int), 1)
    fastest = spec.slew_limit or inf
    wave = _multisine(spec, size, rng)
    parts, at = [], spec.low
    for k, share in enumerate((*BIASES, 0.0)):
        to = spec.low + share * spec.span + (wave[0] if k < len(BIASES) else 0.0)
        way = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps[k] + 1) / steps[k])
        if abs(to - at) * np.pi / 2.0 / steps[k] * spec.rate > fastest:
            raise UsageError(f"drive: moves of {abs(to - at):.3g} V are too fast for {fastest:g} V/s; give more time")
        parts.append(at + (to - at) * way)
        if k < len(BIASES):
            parts.append(spec.low + share * spec.span + np.tile(wave, PERIODS))
        at = float(parts[-1][-1])
    return np.concatenate(parts)


def _multisine(spec: DriveSpec, size: int, rng: np.random.Generator) -> FloatArray:
    """Return a period (V, (size,)), of the phases with the smallest peak, as large as peak and slew limit allow."""
    lines, best = excited_lines(int(HIGHEST * size), rng), np.empty(0)
    for _ in range(TRIED):
        spectrum = np.zeros(size // 2 + 1, dtype=complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size)) / (1.0 + lines / (FLAT * size))
        wave = np.fft.irfft(spectrum, size)
        if not best.size or np.abs(wave).max() < np.abs(best).max():
            best = wave
    largest = PEAK * spec.span / np.abs(best).max()
    fastest = np.abs(np.diff(best, append=best[0])).max() * spec.rate
    return np.asarray(best * min(largest, (spec.slew_limit or inf) / fastest))
