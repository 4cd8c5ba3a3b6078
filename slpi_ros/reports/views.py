"""The charts of models over a record: loops, time, voltage and what the record visited."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.reports.chart import DISPLACEMENT, ERROR, SAMPLES, TIME, VOLTAGE, Chart, Panel, Quantity
from slpi_ros.reports.colours import (
    COLOURS,
    ERROR_SCALE,
    MEASURED,
    SCALE,
    UNFITTED_MEASURED,
    UNFITTED_MODEL,
    UNFITTED_SHADE,
)
from slpi_ros.reports.motion import Motion
from slpi_ros.reports.thinning import LINE_POINTS, thin_cloud, thin_line

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

RISING, FALLING = COLOURS[3], COLOURS[0]
OPENED = Quantity("displacement less straight line", "µm", 1e6, ".4f")
BEGAN, NOW = Quantity("branch began at", "V", digits=".2f"), Quantity("voltage", "V", digits=".2f")

# In the legends.
UNFITTED = "not fitted"
# Points that show one way of a loop, cells on each side of the map, and classes of a histogram.
_POINTS_OF_RUN, _CELLS, _CLASSES = 25, 40, 80
# A line is interrupted where it would go on after so many of its steps, or in another record.
_PAUSE = 5.0
# A chart shows this inner part (percent) of the errors first, and so much more (share of it) on both sides.
_INNER, _AROUND = (0.25, 99.75), 0.35


@dataclass(frozen=True)
class Curve:
    """A signal over the samples of a record, shape (N,), metres, and how it is shown."""

    name: str
    values: FloatArray
    colour: str


def loops(
    v: FloatArray, y: FloatArray, models: Sequence[Curve], motion: Motion, fitted: Mask | None = None
) -> tuple[Chart, str]:
    """Draw displacement over voltage, and beside it without the straight line through it, so that the loops open.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y : ndarray, shape (N,), metres
        Measured.
    models : sequence of Curve
        What each says.
    motion : Motion
    fitted : ndarray of bool, shape (N,), optional
        All by default; others have colours of their own.

    Returns
    -------
    Chart
    str
        Which part of a long record is drawn, or "".
    """
    chart = Chart([Panel(VOLTAGE, DISPLACEMENT), Panel(VOLTAGE, OPENED)], height=470)
    kept, said = _some_runs(v, y, motion)
    gaps = np.isnan(kept)
    at = np.where(gaps, 0, kept).astype(np.int64)
    across = np.where(gaps, np.nan, v[at])
    fitted = np.ones(v.size, dtype=bool) if fitted is None else fitted
    line = _straight(v, np.where(fitted, y, np.nan))[at]
    curves = [(Curve("measured", y, MEASURED), 3.0), *((model, 1.1) for model in models)]
    if not fitted.all():
        colours = [UNFITTED_MEASURED, *(UNFITTED_MODEL for _ in models)]
        others = [
            (Curve(f"{one.name}, {UNFITTED}", one.values, colour), width)
            for (one, width), colour in zip(curves, colours, strict=True)
        ]
        _add_loops(chart, others, across, line, at, ~fitted)
    _add_loops(chart, curves, across, line, at, fitted)
    return chart, said


def _add_loops(
    chart: Chart,
    curves: Sequence[tuple[Curve, float]],
    across: FloatArray,
    line: FloatArray,
    at: NDArray[np.int64],
    chosen: Mask,
) -> None:
    """Add curves, each of a width, where they are `chosen`, over voltages `across`, and less the straight `line`."""
    for curve, width in curves:
        values = np.where(chosen, curve.values, np.nan)[at]
        chart.line(0, curve.name, across, values, curve.colour, width=width)
        chart.line(1, curve.name, across, values - line, curve.colour, width=width)


def _straight(v: FloatArray, y: FloatArray) -> FloatArray:
    """Return the straight line, shape (N,), metres, that is nearest to a displacement."""
    finite = np.isfinite(y)
    if not finite.any():
        return np.zeros_like(v)
    around = v - np.mean(v[finite])
    spread = float(around[finite] @ around[finite])
    slope = float(around[finite] @ y[finite]) / spread if spread > 0.0 else 0.0
    return np.asarray(np.mean(y[finite]) + slope * around)


def _some_runs(v: FloatArray, y: FloatArray, motion: Motion) -> tuple[FloatArray, str]:
    """Return samples that draw the loops, NaN between runs that do not follow each other, and a word on it."""
    count = motion.runs.size - 1
    most = LINE_POINTS // _POINTS_OF_RUN
    if count <= most:
        return thin_line(y, v).astype(np.float64), ""
    every = -(-count // most)
    samples = [
        [*(start + thin_line(y[start : stop + 1], v[start : stop + 1], most=_POINTS_OF_RUN)).tolist(), np.nan]
        for start, stop in zip(motion.runs[:-1:every].tolist(), motion.runs[1::every].tolist(), strict=True)
    ]
    return np.concatenate(samples), f"Of {count} ways from turn to turn every {every}th is drawn."


def over_time(
    t: FloatArray,
    y: FloatArray,
    models: Sequence[Curve],
    noise: float,
    parts: Sequence[Curve] = (),
    fitted: Mask | None = None,
) -> tuple[Chart, str]:
    """Draw displacement over time, and below what models leave of it.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
    y : ndarray, shape (N,), metres
        Measured.
    models : sequence of Curve
    noise : float, metres
        Shaded; 0 for none.
    parts : sequence of Curve
        Of what the first model leaves.
    fitted : ndarray of bool, shape (N,), optional
        All by default; others are shaded.

    Returns
    -------
    Chart
    str
        How many samples lie beyond what is shown first, or "".
    """
    chart = Chart([Panel(TIME, DISPLACEMENT), Panel(TIME, ERROR, 1.2)], "column", 540)
    for start, stop in _rows(np.zeros(t.size, dtype=bool) if fitted is None else ~fitted):
        for panel in (0, 1):
            chart.span(panel, UNFITTED, float(t[start]), float(t[stop]), UNFITTED_SHADE)
    left = [y - model.values for model in models]
    kept = thin_line(y, *left)
    chart.line(0, "measured", t[kept], y[kept], MEASURED, width=2.6)
    for model in models:
        chart.line(0, model.name, t[kept], model.values[kept], model.colour, width=1.0)
    first, *others = zip(models, left, strict=True)
    chart.line(1, first[0].name, t[kept], first[1][kept], first[0].colour, width=0.8)
    # Parts lie on what they are parts of, and below what is left without them.
    for part in parts:
        some = thin_line(part.values, most=LINE_POINTS // 2)
        chart.line(1, part.name, t[some], part.values[some], part.colour, width=1.1)
    for model, error in others:
        chart.line(1, model.name, t[kept], error[kept], model.colour, width=0.8)
    chart.band(1, noise)
    return chart, focus(chart, (1,), left)


def _rows(chosen: Mask) -> list[tuple[int, int]]:
    """Return the first sample of each row of those that are `chosen`, shape (N,), and the one after it, if any."""
    steps = np.diff(np.pad(chosen, 1).astype(np.int8))
    first, after = np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)
    return list(zip(first.tolist(), np.minimum(after, chosen.size - 1).tolist(), strict=True))


def over_voltage(v: FloatArray, left: FloatArray, motion: Motion, noise: float, fitted: Mask) -> tuple[Chart, str]:
    """Draw what is left, shape (N,), metres, over voltage (V), by direction; and how often it comes where `fitted`."""
    chart = Chart([Panel(VOLTAGE, ERROR, 3.0), Panel(SAMPLES, ERROR, 1.0)], height=420)
    for name, colour, chosen in (
        (UNFITTED, UNFITTED_MEASURED, ~fitted),
        ("rising", RISING, fitted & (motion.speed > 0.0)),
        ("falling", FALLING, fitted & (motion.speed < 0.0)),
    ):
        part = np.flatnonzero(chosen)
        part = part[thin_cloud(v[part], left[part])]
        if part.size:
            chart.dots(0, name, v[part], left[part], colour)
    chart.band(0, noise)
    histogram(chart, 1, Curve("fitted samples", left[fitted], MEASURED))
    return chart, focus(chart, (0, 1), [left], fitted)


def held_out(t: FloatArray, models: Sequence[Curve], noise: float) -> tuple[Chart, str]:
    """Draw errors on blocks left out, each of `models` being one, over time (s), and their histograms."""
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


def histogram(chart: Chart, panel: int, curve: Curve) -> None:
    """Add how often each value comes, as an outline."""
    x = curve.values[np.isfinite(curve.values)]
    if not x.size:
        return
    low, high = float(x.min()), float(x.max())
    inner = float(np.subtract(*np.percentile(x, _INNER[::-1])))
    classes = int(np.clip(np.ceil(_CLASSES * (high - low) / inner), 1, 10 * _CLASSES)) if inner > 0.0 else 1
    width = max((high - low) / classes, 1e-12)
    counts, edges = np.histogram(x, np.linspace(low - width, high + width, classes + 3))
    chart.steps(panel, curve.name, edges, counts.astype(np.float64), curve.colour)


def coverage(v: FloatArray, left: FloatArray, motion: Motion) -> Chart:
    """Draw how many samples of what is left (m; NaN counts nowhere) lie where on the surface of branches, and its rms.

    The surface is that of all voltages `v`, shape (N,), which say where branches began.
    """
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
    """Show first where nearly all of the `chosen` errors, shape (N,) each, metres, are; say how many are not there."""
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
    return f"{beyond} samples{each} lie beyond what is shown first; double-click shows all."
