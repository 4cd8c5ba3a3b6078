"""What models leave of a record, over everything that an error may follow."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from slpi_ros.reports.chart import ERROR, VOLTAGE, Chart, Panel, Quantity
from slpi_ros.reports.colours import DESIRED
from slpi_ros.reports.motion import Motion
from slpi_ros.reports.thinning import thin_cloud
from slpi_ros.reports.views import Curve, focus

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SPEED = Quantity("speed of the voltage", "V/s", digits=".4~g")
SINCE = Quantity("time since the last turn or stop", "s", digits=".3~g", logarithmic=True)
FREQUENCY = Quantity("frequency", "Hz", digits=".4~g", logarithmic=True)
DENSITY = Quantity("spectral density", "nm/√Hz", 1e9, ".3~g", logarithmic=True)

# Classes over which means are taken, and the fewest samples of one that tells something.
_CLASSES, _FEWEST = 40, 5
# Parts that windows of a spectrum are cut into, and the finest spectrum.
_WINDOWS, _LONGEST_WINDOW = 8, 1 << 14
_SPECTRUM_POINTS = 400


def over_motion(v: FloatArray, curves: Sequence[Curve], parts: Sequence[Curve], motion: Motion) -> tuple[Chart, str]:
    """Draw errors over voltage and over its speed: samples, and their means where the voltage rises and falls.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    curves : sequence of Curve
        What is left.
    parts : sequence of Curve
        Of it; only their means are drawn.
    motion : Motion

    Returns
    -------
    Chart
    str
        How many samples lie beyond what is shown first, or "".
    """
    chart = Chart([Panel(VOLTAGE, ERROR), Panel(SPEED, ERROR)], height=430)
    ways = [np.flatnonzero(motion.speed > 0.0), np.flatnonzero(motion.speed < 0.0)]
    _add(chart, 0, v, curves, parts, lambda values: _joined([_means(v[way], values[way]) for way in ways]))
    speed = motion.speed
    _add(chart, 1, speed, curves, parts, lambda values: _means(speed, values, alike=True))
    return chart, focus(chart, (0, 1), [curve.values for curve in curves])


def over_rhythm(
    t: FloatArray, curves: Sequence[Curve], parts: Sequence[Curve], motion: Motion, noise: float
) -> tuple[Chart, str]:
    """Draw errors over the time since the last turn, and their spectra; as `over_motion`, with `noise` (m rms)."""
    chart = Chart([Panel(SINCE, ERROR), Panel(FREQUENCY, DENSITY)], height=430)
    later = np.flatnonzero(motion.since_turn > 0.0)
    since = motion.since_turn[later]
    chosen = [Curve(curve.name, curve.values[later], curve.colour) for curve in (*curves, *parts)]
    first, rest = chosen[: len(curves)], chosen[len(curves) :]
    _add(chart, 0, since, first, rest, lambda values: _means(since, values, alike=True))
    spectra = [_spectrum(t, curve.values) for curve in (*curves, *parts)]
    for curve, spectrum in zip((*curves, *parts), spectra, strict=True):
        chart.line(1, curve.name, *spectrum, curve.colour, width=1.2)
    heights = np.concatenate([height for _, height in spectra[: len(curves)]])
    if heights.size:
        chart.show(1, float(heights.min()) / 3.0, float(heights.max()) * 3.0)
    rate = _rate(t)
    if noise > 0.0 and rate > 0.0:
        ends = np.array([max(rate / t.size, 1e-9), rate / 2.0])
        chart.line(1, "noise floor", ends, np.full(2, noise * np.sqrt(2.0 / rate)), DESIRED, width=1.0)
    return chart, focus(chart, (0,), [curve.values for curve in curves])


def _add(
    chart: Chart,
    panel: int,
    x: FloatArray,
    curves: Sequence[Curve],
    parts: Sequence[Curve],
    means: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> None:
    """Add dots for curves, and above them the means of curves and parts."""
    for curve in curves:
        kept = thin_cloud(x, curve.values)
        chart.dots(panel, curve.name, x[kept], curve.values[kept], curve.colour, faint=True)
    for curve in (*curves, *parts):
        chart.line(panel, curve.name, *means(curve.values), curve.colour, width=2.2)


def _means(x: FloatArray, values: FloatArray, *, alike: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return where classes along `x`, shape (N,), lie, and their means, shape (M,); `alike`: of one size."""
    finite = np.isfinite(values)
    x, values = x[finite], values[finite]
    if x.size < _FEWEST:
        return np.empty(0), np.empty(0)
    edges = np.unique(np.quantile(x, np.linspace(0, 1, _CLASSES + 1))) if alike else np.linspace(x.min(), x.max(), 41)
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(edges.size - 2, 0))
    counts = np.bincount(which)
    enough = counts >= _FEWEST
    middle, mean = (np.bincount(which, weights=weights)[enough] / counts[enough] for weights in (x, values))
    return middle, mean


def _joined(lines: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Return lines as one, interrupted between them."""
    gap = np.array([np.nan])
    x, y = zip(*lines, strict=True)
    return np.concatenate([part for one in x for part in (one, gap)]), np.concatenate(
        [part for one in y for part in (one, gap)]
    )


def _rate(t: FloatArray) -> float:
    """Return the samples per second in the middle of all; 0 where there is none."""
    period = float(np.median(np.diff(t))) if t.size > 1 else 0.0
    return 1.0 / period if period > 0.0 else 0.0


def _spectrum(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (Hz) and amplitude densities (m/√Hz), shape (M,), by Welch's method."""
    rate, finite = _rate(t), np.isfinite(values)
    if not rate or np.count_nonzero(finite) < 2 * _WINDOWS:
        return np.empty(0), np.empty(0)
    even = np.interp(np.arange(t[0], t[-1], 1.0 / rate), t[finite], values[finite])
    window = int(np.clip(2 * even.size // _WINDOWS, 2 * _WINDOWS, min(even.size, _LONGEST_WINDOW)))
    frequency, power = signal.welch(even, rate, nperseg=window)
    frequency, power = frequency[1:], power[1:]
    # Evenly spread over the logarithm: a mean over many high frequencies, each low one by itself.
    edges = np.unique(np.geomspace(1, frequency.size, _SPECTRUM_POINTS).astype(np.int64)) - 1
    counts = np.diff(np.append(edges, frequency.size))
    return (
        np.add.reduceat(frequency, edges) / counts,
        np.sqrt(np.maximum(np.add.reduceat(power, edges) / counts, 1e-40)),
    )
