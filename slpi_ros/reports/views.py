"""Charts of models and a record: displacement and residual (measured - model) over voltage, time, speed, frequency."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import signal

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.arrays.rates import slopes
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.identification.design_matrix import Walk
from slpi_ros.identification.drive import hold_band, resting, smallest_turn
from slpi_ros.identification.signal_statistics import digit, noise
from slpi_ros.reports.chart import (
    AFTER,
    COLOURS,
    DESIRED,
    DISPLACEMENT,
    ERROR,
    ERROR_SCALE,
    LINE_POINTS,
    MEASURED,
    SAMPLES,
    SCALE,
    TIME,
    UNUSED_MEASURED,
    UNUSED_MODEL,
    UNUSED_SHADE,
    VOLTAGE,
    Chart,
    Panel,
    Quantity,
    over_time,
    sequences,
    thin_cloud,
    thin_line,
)
from slpi_ros.reports.page import Page

RISING, FALLING = COLOURS[3], COLOURS[0]
OPENED = Quantity("deviation from linearity", "µm", 1e6, ".4f")
BEGAN, NOW = Quantity("last reversal voltage", "V", digits=".2f"), Quantity("voltage", "V", digits=".2f")
SPEED = Quantity("speed of the voltage", "V/s", digits=".4~g")
SINCE = Quantity("time since the last reversal or stop", "s", digits=".3~g", logarithmic=True)
FREQUENCY = Quantity("frequency", "Hz", digits=".4~g", logarithmic=True)
DENSITY = Quantity("spectral density", "nm/√Hz", 1e9, ".3~g", logarithmic=True)
LOOPS = "Displacement over voltage, and its deviation from a straight-line fit."
# Legend entry of samples that were not fitted.
UNUSED = "not used"

# Number of samples on either side from which the speed is computed.
_REACH = 3
# Distance from a reversal (share of the voltage range) at which the voltage is considered stopped.
_ARRIVED = 1e-3
_FEWEST_ARRIVALS = 5
# Number of points per branch, of cells per side of the map, and of histogram bins.
_POINTS_OF_RUN, _CELLS, _HISTOGRAM_CLASSES = 25, 40, 80
# Lines are interrupted at gaps longer than this multiple of the sampling period.
_PAUSE = 5.0
# Initial view: central percentage of the errors, and margin on both sides (share of that range).
_INNER, _AROUND = (0.25, 99.75), 0.35
# Number of classes for means, and smallest number of samples per class.
_CLASSES, _FEWEST = 40, 5
# Number of Welch windows per record, longest window, and number of points drawn of a spectrum.
_WINDOWS, _LONGEST_WINDOW, _SPECTRUM_POINTS = 8, 1 << 14, 400


@dataclass(frozen=True)
class Motion:
    """Speed, reversals and branches of a voltage signal, by sample, (N,)."""

    speed: FloatArray  # V/s, negative: falling
    since_turn: FloatArray  # s, since the last reversal or stop of the voltage
    branch_from: FloatArray  # V, at the start of the hysteresis branch
    runs: IntArray  # (M + 1,), reversals with the first and the last sample

    @classmethod
    def of(cls, t: FloatArray, v: FloatArray) -> "Motion":
        """Return the motion of a finite voltage `v`, shape (N,), volts, over time `t`, shape (N,), seconds."""
        if v.size < _FEWEST_ARRIVALS or not np.ptp(v) > 0.0:
            return cls(np.zeros(v.size), t - t[:1], v.copy(), np.array([0, max(v.size - 1, 0)]))
        noise_rms = noise(v, t)
        runs = reversals(v, smallest_turn(v, noise_rms))
        rests, _ = resting(t, v, hold_band(v, noise_rms, digit(v)))
        stops = np.unique(np.concatenate([[0], runs, _arrivals(v, runs), rests]))
        last = stops[np.searchsorted(stops, np.arange(v.size), side="right") - 1]
        branch_from = Walk.along(_monotone_between(v, runs), symmetric_rest=False, primed=False).v_origin
        return cls(slopes(t, v, _REACH), t - t[last], branch_from, runs)


def _arrivals(v: FloatArray, runs: IntArray) -> IntArray:
    """Return the index of the sample at which the voltage first reaches its final value between two reversals."""
    near = _ARRIVED * float(np.ptp(v))
    return np.array(
        [start + int(np.argmax(np.abs(v[start : stop + 1] - v[stop]) <= near)) for start, stop in pairwise(runs)],
        dtype=np.int64,
    )


def _monotone_between(v: FloatArray, runs: IntArray) -> FloatArray:
    """Return the voltage, made monotone between reversals."""
    clean = v.copy()
    for start, stop in pairwise(runs):
        further = np.maximum if v[stop] > v[start] else np.minimum
        clean[start : stop + 1] = further.accumulate(clean[start : stop + 1])
    return clean


@dataclass(frozen=True)
class Series:
    """A signal over the samples of a record, shape (N,), metres, with its name and colour."""

    name: str
    values: FloatArray
    colour: str


def show_model(
    page: Page,
    name: str,
    t: FloatArray,
    v: FloatArray,
    y: FloatArray,
    simulated: FloatArray,
    noise: float,
    fitted: Mask,
) -> Motion:
    """Add the charts of a model on a record, (N,): loops, time, and residual over voltage; return the motion."""
    # `name` is the first part of the charts' names; `noise` (m) is the half-width of the shaded noise band, 0: none.
    motion, models = Motion.of(t, v), [Series("model", simulated, AFTER)]
    chart, said = loops(v, y, models, motion, fitted)
    page.chart(f"{name}-loops", chart, f"{LOOPS} {said}")
    chart, said = model_over_time(t, y, models, noise, fitted=fitted)
    unused = "" if fitted.all() else f" Shaded: {UNUSED}."
    page.chart(f"{name}-time", chart, f"Over time; the grey band is plus or minus the repeatability.{unused} {said}")
    chart, said = over_voltage(v, y - simulated, motion, noise, fitted)
    how = "Measured - model over rising and falling voltage, and the histogram."
    page.chart(f"{name}-residual", chart, f"{how} {said}")
    return motion


def loops(
    v: FloatArray, y: FloatArray, models: Sequence[Series], motion: Motion, fitted: Mask | None = None
) -> tuple[Chart, str]:
    """Draw displacement over voltage, and its deviation from a straight line; samples not `fitted` in other colours."""
    # The text is a note on the share of branches that are drawn of a long record, or "".
    chart = Chart([Panel(VOLTAGE, DISPLACEMENT), Panel(VOLTAGE, OPENED)], height=470)
    kept, said = _some_runs(v, y, motion)
    gaps = np.isnan(kept)
    at = np.where(gaps, 0, kept).astype(np.int64)
    across = np.where(gaps, np.nan, v[at])
    fitted = np.ones(v.size, dtype=bool) if fitted is None else fitted
    line = _straight(v, np.where(fitted, y, np.nan))[at]
    curves = [(Series("measured", y, MEASURED), 3.0), *((model, 1.1) for model in models)]
    if not fitted.all():
        colours = [UNUSED_MEASURED, *(UNUSED_MODEL for _ in models)]
        others = [
            (Series(f"{one.name}, {UNUSED}", one.values, colour), width)
            for (one, width), colour in zip(curves, colours, strict=True)
        ]
        _add_loops(chart, others, across, line, at, ~fitted)
    _add_loops(chart, curves, across, line, at, fitted)
    return chart, said


def _add_loops(
    chart: Chart,
    curves: Sequence[tuple[Series, float]],
    across: FloatArray,
    line: FloatArray,
    at: IntArray,
    chosen: Mask,
) -> None:
    """Add curves with line widths at the `chosen` samples over `across`, and their deviation from `line`."""
    for curve, width in curves:
        values = np.where(chosen, curve.values, np.nan)[at]
        chart.line(0, curve.name, across, values, curve.colour, width=width)
        chart.line(1, curve.name, across, values - line, curve.colour, width=width)


def _straight(v: FloatArray, y: FloatArray) -> FloatArray:
    """Return the least-squares line of displacement over voltage, shape (N,), metres."""
    finite = np.isfinite(y)
    if not finite.any():
        return np.zeros_like(v)
    around = v - np.mean(v[finite])
    spread = float(around[finite] @ around[finite])
    slope = float(around[finite] @ y[finite]) / spread if spread > 0.0 else 0.0
    return np.asarray(np.mean(y[finite]) + slope * around)


def _some_runs(v: FloatArray, y: FloatArray, motion: Motion) -> tuple[FloatArray, str]:
    """Return the sample indices to be drawn, with NaN between non-adjacent branches, and a note if some are omitted."""
    count = motion.runs.size - 1
    most = LINE_POINTS // _POINTS_OF_RUN
    if count <= most:
        return thin_line(y, v).astype(np.float64), ""
    every = -(-count // most)
    samples = [
        [*(start + thin_line(y[start : stop + 1], v[start : stop + 1], most=_POINTS_OF_RUN)).tolist(), np.nan]
        for start, stop in zip(motion.runs[:-1:every].tolist(), motion.runs[1::every].tolist(), strict=True)
    ]
    return np.concatenate(samples), f"Of {count} branches one in {every} is drawn."


def model_over_time(
    t: FloatArray,
    y: FloatArray,
    models: Sequence[Series],
    noise: float,
    parts: Sequence[Series] = (),
    fitted: Mask | None = None,
) -> tuple[Chart, str]:
    """Draw displacement and residuals of models over time, with the `parts` of the first; not `fitted` is shaded."""
    # `noise` (m) is the half-width of the shaded band, 0: none. The text is a note on the number of samples outside the
    # initial view, or "".
    chart = over_time(ERROR)
    first, after = sequences(np.zeros(t.size, dtype=bool) if fitted is None else ~fitted)
    for start, stop in zip(t[first].tolist(), t[np.minimum(after, t.size - 1)].tolist(), strict=True):
        for panel in (0, 1):
            chart.span(panel, UNUSED, start, stop, UNUSED_SHADE)
    left = [y - model.values for model in models]
    kept = thin_line(y, *left)
    chart.line(0, "measured", t[kept], y[kept], MEASURED, width=2.6)
    for model in models:
        chart.line(0, model.name, t[kept], model.values[kept], model.colour, width=1.0)
    (model, error), *others = zip(models, left, strict=True)
    chart.line(1, model.name, t[kept], error[kept], model.colour, width=0.8)
    # Drawn above the total residual and below the smaller residuals.
    for part in parts:
        some = thin_line(part.values, most=LINE_POINTS // 2)
        chart.line(1, part.name, t[some], part.values[some], part.colour, width=1.1)
    for model, error in others:
        chart.line(1, model.name, t[kept], error[kept], model.colour, width=0.8)
    chart.band(1, noise)
    return chart, focus(chart, (1,), left)


def over_voltage(v: FloatArray, left: FloatArray, motion: Motion, noise: float, fitted: Mask) -> tuple[Chart, str]:
    """Draw a residual, shape (N,), metres, over voltage (V), by direction, and the histogram of `fitted` samples."""
    chart = Chart([Panel(VOLTAGE, ERROR, 3.0), Panel(SAMPLES, ERROR, 1.0)], height=420)
    for name, colour, chosen in (
        (UNUSED, UNUSED_MEASURED, ~fitted),
        ("rising", RISING, fitted & (motion.speed > 0.0)),
        ("falling", FALLING, fitted & (motion.speed < 0.0)),
    ):
        part = np.flatnonzero(chosen)
        part = part[thin_cloud(v[part], left[part])]
        if part.size:
            chart.dots(0, name, v[part], left[part], colour)
    chart.band(0, noise)
    histogram(chart, 1, Series("used samples", left[fitted], MEASURED))
    return chart, focus(chart, (0, 1), [left], fitted)


def held_out(t: FloatArray, models: Sequence[Series], noise: float) -> tuple[Chart, str]:
    """Draw held-out residuals of `models` over time (s), and their histograms."""
    chart = Chart([Panel(TIME, ERROR, 3.0), Panel(SAMPLES, ERROR, 1.0)], height=420)
    steps = np.abs(np.diff(t))
    gaps = 1 + np.flatnonzero(steps > _PAUSE * np.median(steps) if steps.size else steps)
    for model in models:
        kept = thin_line(model.values)
        breaks = np.unique(np.searchsorted(kept, gaps))
        when, error = (np.insert(signal[kept], breaks, np.nan) for signal in (t, model.values))
        chart.line(0, model.name, when, error, model.colour, width=0.9)
        histogram(chart, 1, model)
    chart.band(0, noise)
    return chart, focus(chart, (0, 1), [model.values for model in models])


def histogram(chart: Chart, panel: int, curve: Series) -> None:
    """Add a histogram as an outline."""
    x = curve.values[np.isfinite(curve.values)]
    if not x.size:
        return
    low, high = float(x.min()), float(x.max())
    inner = float(np.subtract(*np.percentile(x, _INNER[::-1])))
    classes = np.ceil(_HISTOGRAM_CLASSES * (high - low) / inner) if inner > 0.0 else 1.0
    classes = int(np.clip(classes, 1, 10 * _HISTOGRAM_CLASSES))
    width = max((high - low) / classes, 1e-12)
    counts, edges = np.histogram(x, np.linspace(low - width, high + width, classes + 3))
    chart.steps(panel, curve.name, edges, counts.astype(np.float64), curve.colour)


def coverage(v: FloatArray, left: FloatArray, motion: Motion) -> Chart:
    """Draw the number of samples with a finite residual `left` (m) on the Everett plane, and their rms residual."""
    # The plane covers the range of the voltages `v`, shape (N,); a point is a pair of branch start and present voltage.
    chart = Chart([Panel(BEGAN, NOW), Panel(BEGAN, NOW)], height=490)
    low, high = float(v.min()), float(v.max())
    edges = np.linspace(low, high, _CELLS + 1) if high > low else np.array([low - 0.5, low + 0.5])
    known = np.isfinite(left)
    where = (v[known], motion.branch_from[known])
    counts, squares = (
        np.asarray(np.histogram2d(*where, [edges, edges], weights=weights)[0]) for weights in (None, left[known] ** 2)
    )
    samples = np.where(counts > 0.0, counts, np.nan)
    chart.cells(0, edges, samples, SAMPLES, SCALE)
    chart.cells(1, edges, np.sqrt(squares / samples), Quantity("error, rms", "nm", 1e9, ".1f"), ERROR_SCALE)
    return chart


def focus(chart: Chart, panels: Sequence[int], errors: Sequence[FloatArray], chosen: Mask | slice = slice(None)) -> str:
    """Zoom to nearly all of the `chosen` errors, shape (N,) each, metres; return a note on those outside."""
    values = np.concatenate([error[chosen][np.isfinite(error[chosen])] for error in errors])
    if not values.size:
        return ""
    low, high = (float(x) for x in np.percentile(values, _INNER))
    low, high = low - _AROUND * (high - low), high + _AROUND * (high - low)
    beyond = max(int(np.count_nonzero((error < low) | (error > high))) for error in errors)
    if not beyond or not high > low:
        return ""
    for panel in panels:
        chart.show(panel, low, high)
    each = " of each" if len(errors) > 1 else ""
    return f"{beyond} samples{each} lie outside the initial view; double-click shows all."


def over_motion(v: FloatArray, curves: Sequence[Series], parts: Sequence[Series], motion: Motion) -> tuple[Chart, str]:
    """Draw residuals over voltage (V) and its speed, with their means, and those of `parts`, for each direction."""
    # The text is a note on the number of samples outside the initial view, or "".
    chart = Chart([Panel(VOLTAGE, ERROR), Panel(SPEED, ERROR)], height=430)
    ways = [np.flatnonzero(motion.speed > 0.0), np.flatnonzero(motion.speed < 0.0)]
    _add(chart, 0, v, curves, parts, lambda values: _joined([_means(v[way], values[way]) for way in ways]))
    speed = motion.speed
    _add(chart, 1, speed, curves, parts, lambda values: _means(speed, values, alike=True))
    return chart, focus(chart, (0, 1), [curve.values for curve in curves])


def over_frequency(
    t: FloatArray, curves: Sequence[Series], parts: Sequence[Series], motion: Motion, noise: float
) -> tuple[Chart, str]:
    """Draw residuals over the time since the last reversal, and their spectra; `noise` (m rms) that of the sensor."""
    chart = Chart([Panel(SINCE, ERROR), Panel(FREQUENCY, DENSITY)], height=430)
    later = np.flatnonzero(motion.since_turn > 0.0)
    since = motion.since_turn[later]
    chosen = [Series(curve.name, curve.values[later], curve.colour) for curve in (*curves, *parts)]
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
        chart.line(1, "sensor noise", ends, np.full(2, noise * np.sqrt(2.0 / rate)), DESIRED, width=1.0)
    return chart, focus(chart, (0,), [curve.values for curve in curves])


def _add(
    chart: Chart,
    panel: int,
    x: FloatArray,
    curves: Sequence[Series],
    parts: Sequence[Series],
    means: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> None:
    for curve in curves:
        kept = thin_cloud(x, curve.values)
        chart.dots(panel, curve.name, x[kept], curve.values[kept], curve.colour, faint=True)
    for curve in (*curves, *parts):
        chart.line(panel, curve.name, *means(curve.values), curve.colour, width=2.2)


def _means(x: FloatArray, values: FloatArray, *, alike: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return the means of `x` and `values` by class of `x`, shape (M,) each; `alike`: classes of equal sample count."""
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
    """Return the lines concatenated, with NaN between them."""
    x, y = (np.concatenate([np.append(line, np.nan) for line in each]) for each in zip(*lines, strict=True))
    return x, y


def _rate(t: FloatArray) -> float:
    """Return the median sampling rate, hertz; 0 if it is undefined."""
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
    # Averages over classes of equal width on a logarithmic axis.
    edges = np.unique(np.geomspace(1, frequency.size, _SPECTRUM_POINTS).astype(np.int64)) - 1
    counts = np.diff(np.append(edges, frequency.size))
    return (
        np.add.reduceat(frequency, edges) / counts,
        np.sqrt(np.maximum(np.add.reduceat(power, edges) / counts, 1e-40)),
    )
