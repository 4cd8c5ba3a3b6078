"""The page of a path that repeats: error over passes, over the path, its spectrum, and what is left."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import length
from slpi_ros.learning.axis_learner import AxisLearner
from slpi_ros.reports.chart import AFTER, BEFORE, DESIRED, DISPLACEMENT, NOISE, TIME, Chart, Panel, Quantity
from slpi_ros.reports.page import Page
from slpi_ros.workflows.learn import LearnedPass, LearnOutcome

FILE = "report.html"
PASS = Quantity("pass", "")
ERROR = Quantity("error, rms", "nm", 1e9, ".3~g", logarithmic=True)
DEVIATION = Quantity("measured - desired", "nm", 1e9, ".1f")
CORRECTION = Quantity("correction of the path", "nm", 1e9, ".1f")
FREQUENCY = Quantity("frequency", "Hz")
AMPLITUDE = Quantity("amplitude", "nm", 1e9, ".3~g", logarithmic=True)
# Least amplitude (m) that is drawn on a logarithmic axis, and passes in the table.
LEAST, MOST_ROWS = 1e-13, 60


def write_files(folder: Path, outcome: LearnOutcome) -> None:
    """Write the page into `folder`, atomically."""
    stage = outcome.learner.model.hardware_id
    page = Page("A path that repeats" + (f", stage {stage}" if stage else ""))
    page.contents(tuple(outcome.learner.axes))
    page.text(
        "The desired path is corrected from pass to pass. The error of a pass is measured - desired without the mean "
        "and the drift of the pass, which do not repeat and are given beside it; the absolute error includes both."
    )
    for name, axis in outcome.learner.axes.items():
        own = [each for each in outcome.passes if name in each.reports]
        page.heading(f"Axis {name}", name)
        last = axis.passes[-1]
        held = bool(axis.held)
        page.verdict(name, describe(name, axis), "warn" if held else "good", "held" if held else "")
        page.tiles({
            "first pass": length(axis.passes[0].error),
            "best pass": length(min((one.error for one in axis.passes if one.learned), default=math.nan)),
            "last pass": length(last.error),
            "absolute, last pass": length(last.absolute),
            "noise of a reading": length(axis.noise),
            "phases known below": f"{axis.bandwidth:.0f} Hz",
        })  # fmt: skip
        page.chart(f"{name}-passes", _over_passes(axis), "Error of every pass.")
        page.chart(
            f"{name}-path", _over_path(outcome, axis, own, name), "The path, its correction, first and last error."
        )
        page.chart(f"{name}-spectrum", _spectrum(axis, own, name), "Harmonics of the error, first and last pass.")
        page.section("Passes")
        page.table(*_table(axis))
    page.write(folder / FILE)


def describe(name: str, axis: AxisLearner) -> str:
    """Return what the passes have reached, in a sentence."""
    first, last = axis.passes[0], axis.passes[-1]
    return (
        f"axis {name}: pass {last.number}, error {length(last.error)} rms without its mean ({length(last.absolute)} "
        f"with it), first pass {length(first.error)}; limited by: {last.limited_by}"
    )


def _over_passes(axis: AxisLearner) -> Chart:
    chart = Chart([Panel(PASS, ERROR)], "column", 320)
    numbers = np.array([float(one.number) for one in axis.passes])
    errors = np.maximum(np.array([one.error for one in axis.passes]), LEAST)
    draw = chart.line if numbers.size > 1 else chart.dots
    draw(0, "error", numbers, errors, AFTER)
    if axis.noise > LEAST:
        chart.line(0, "noise", numbers, np.full(numbers.size, axis.noise), NOISE)
    unused = np.array([not one.learned for one in axis.passes])
    if unused.any():
        chart.dots(0, "not learned from", numbers[unused], errors[unused], BEFORE)
    return chart


def _over_path(outcome: LearnOutcome, axis: AxisLearner, own: Sequence[LearnedPass], name: str) -> Chart:
    t = outcome.learner.t - outcome.learner.t[0]
    chart = Chart([Panel(TIME, DISPLACEMENT), Panel(TIME, CORRECTION), Panel(TIME, DEVIATION, 1.2)], "column", 680)
    chart.thinned(0, "desired", t, axis.desired, DESIRED)
    chart.thinned(1, "next pass", t, axis.correction, AFTER)
    for label, one, colour in (("first", own[0], BEFORE), ("last", own[-1], AFTER)):
        chart.thinned(2, f"{label} pass here", t, one.errors[name], colour, width=1.0)
    return chart


def _spectrum(axis: AxisLearner, own: Sequence[LearnedPass], name: str) -> Chart:
    chart = Chart([Panel(FREQUENCY, AMPLITUDE)], "column", 340)
    size = axis.desired.size
    frequency = np.asarray(np.fft.rfftfreq(size, axis.dt)[1:], dtype=np.float64)
    for label, one, colour in (("first", own[0], BEFORE), ("last", own[-1], AFTER)):
        amplitude = np.maximum(_amplitudes(one.errors[name]), LEAST)
        chart.thinned(0, f"{label} pass here", frequency, amplitude, colour)
    return chart


def _amplitudes(error: FloatArray) -> FloatArray:
    return np.asarray(2.0 / error.size * np.abs(np.fft.rfft(np.nan_to_num(error)))[1:])


def _table(axis: AxisLearner) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    shown = axis.passes if len(axis.passes) <= MOST_ROWS else [*axis.passes[:10], *axis.passes[10 - MOST_ROWS :]]
    header = ("pass", "error, rms", "absolute", "mean", "drift", "left out", "how it was used")
    return header, [
        (
            str(one.number), length(one.error), length(one.absolute), length(one.offset), length(one.drift),
            str(one.bumps), one.reason or "learned from",
        )
        for one in shown
    ]  # fmt: skip
