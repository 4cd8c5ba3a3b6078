"""The page of an identification: what was measured, what the model makes of it, and what is left."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import SlpiError
from slpi_ros.identification.cross_validation import CLASSICAL, CrossValidationReport, Slice
from slpi_ros.identification.record_quality import Finding, assess, findings
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports import views as charts
from slpi_ros.reports.chart import AFTER, BEFORE
from slpi_ros.reports.page import Page, Severity
from slpi_ros.reports.text import describe_axis
from slpi_ros.reports.views import Curve, Motion

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Held-out errors up to so many times the noise are noise; from the other one on there is something to be found.
_NOISE_ONLY, _MORE_THAN_NOISE = 1.5, 3.0


@dataclass(frozen=True)
class _Traces:
    """One axis: time (s), voltage (V), displacement as measured and as simulated (m), and what was fitted."""

    t: FloatArray
    v: FloatArray
    y: FloatArray
    simulated: FloatArray
    fitted: Mask


def write_report(
    folder: Path,
    record: Record,
    model: StageModel,
    *,
    truth: Mapping[str, CrossValidationReport] | None = None,
    found: Mapping[str, Sequence[Finding]] | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> Path:
    """Write ``report.html`` into `folder` and return its path.

    Parameters
    ----------
    folder : Path
        Made if need be.
    record : Record
        What the model is shown on; of several bags the first.
    model : StageModel
    truth : mapping of axis name to HeldOutTruth, optional
        Errors on blocks left out, for the tables.
    found : mapping of axis name to sequence of Finding, optional
        The quality of the record; found anew by default.
    start, stop : float, seconds, optional
        The part of the record that was fitted, as for `slpi_ros.identify`; the rest is drawn, but counts nowhere.

    Raises
    ------
    SlpiError
        If it cannot be written, or the record does not hold the model's axes.
    """
    page = Page(f"Model of {record.source}")
    page.contents(tuple(model.axes))
    for name in model.axes:
        record.require_axis(name)
    driven = np.logical_and.reduce([np.isfinite(record.voltage[name]) for name in model.axes])
    t = record.t[driven]
    fitted = (t >= (-np.inf if start is None else start)) & (t < (np.inf if stop is None else stop))
    simulated = model.simulate(t, {name: record.voltage[name][driven] for name in model.axes})
    for name, axis in model.axes.items():
        told = (truth or {}).get(name)
        page.heading(f"Axis {name}", name)
        page.verdict(name, *_verdict(name, axis, told))
        page.tiles(_figures(axis, told))
        if told is not None:
            _show_truth(page, name, told)
        page.section("The model")
        page.lines(describe_axis(axis))
        page.section("The record")
        page.findings(_findings(record, name, start, stop) if found is None else found.get(name, ()))
        if not fitted.all():
            page.text(_part(t, fitted))
        if t.size:
            floor = told.floor.rms if told else axis.quality.floor_rms
            v, y = record.voltage[name][driven], record.displacement[name][driven]
            _show(page, name, _Traces(t, v, y, simulated[name], fitted), floor)
        else:
            page.text("The record holds no voltage of this axis: there is nothing to draw.")
    path = folder / "report.html"
    page.write(path)
    return path


def _verdict(name: str, axis: AxisModel, truth: CrossValidationReport | None) -> tuple[str, Severity]:
    """Say in a sentence how good the model is."""
    quality = axis.quality
    error, floor = quality.held_out_rms, quality.floor_rms
    noise, floor_is = "the sensor noise", f"the sensor noise is {_nm(floor)} rms"
    beside = ""
    if truth is not None:
        error, floor = truth.overall.rms, truth.floor.rms
        noise, floor_is = "that floor", f"the record repeats itself to {_nm(floor)} rms"
        if np.isfinite(truth.overall.classical_rms) and truth.kind != CLASSICAL:
            beside = f" Classical PI: {_nm(truth.overall.classical_rms)}."
    share = f"{error / _stroke(axis):.3%}" if _stroke(axis) > 0.0 else "?"
    said = f"Axis {name}: on blocks left out of the fit the model is off by {_nm(error)} rms ({share} of the stroke)"
    if not floor > 0.0:
        return f"{said}; the record shows no noise to compare with.{beside}", "warn"
    if error <= _NOISE_ONLY * floor:
        return f"{said}; {floor_is}, so hardly anything else is left.{beside}", "good"
    said = f"{said}; {floor_is}, and the error is {error / floor:.1f} times {noise}."
    if error <= _MORE_THAN_NOISE * floor:
        return said + beside, "warn"
    return f"{said} 'slpi diagnose' looks for the cause.{beside}", "bad"


def _figures(axis: AxisModel, truth: CrossValidationReport | None) -> dict[str, str]:
    quality = axis.quality
    if truth:
        figures = {
            "error on blocks left out, rms": _nm(truth.overall.rms),
            "repeatability floor, rms": _nm(truth.floor.rms),
            "classical PI there, rms": _nm(truth.overall.classical_rms),
        }
    else:
        figures = {
            "error on blocks left out, rms": _nm(quality.held_out_rms),
            "sensor noise, rms": _nm(quality.floor_rms),
            "samples fitted": f"{quality.samples:,}",
        }
    return figures | {
        "largest error where fitted": _nm(quality.maximum),
        "stroke": f"{_stroke(axis) * 1e6:.4g} µm",
        "of the model seen": f"{quality.covered:.0%}",
    }


def _stroke(axis: AxisModel) -> float:
    low, high = axis.displacement_range
    return high - low


def _nm(metres: float) -> str:
    return f"{metres * 1e9:.1f} nm" if np.isfinite(metres) else "none"


def _findings(record: Record, name: str, start: float | None, stop: float | None) -> list[Finding]:
    """Return what is found about the record; a reason where it is good for nothing."""
    try:
        return findings(assess(record, name, start=start, stop=stop))
    except SlpiError as error:
        return [Finding("stop", str(error))]


def _show_truth(page: Page, name: str, truth: CrossValidationReport) -> None:
    """Add the tables of errors on blocks left out, and the errors themselves."""
    page.section("Errors where the model was not fitted")
    floor = truth.floor
    groups = {
        "by loop level": truth.by_level,
        "by region": truth.by_region,
        "by speed": truth.by_speed,
    }
    rows: list[Sequence[str] | str] = [_row(truth.overall, floor.rms)]
    for what, parts in groups.items():
        rows += [what, *(_row(part, floor.rms) for part in parts)]
    page.table(
        ("", "samples", "rms (nm)", "times the floor", "largest (nm)", "classical PI, rms (nm)", "PI / model"),
        rows,
        best=0,
        caption="Free-run on blocks left out of the fit, the classical PI model on the same ones. "
        f"Floor: {_nm(floor.rms)} rms, {floor.source}.",
    )
    curves = [Curve(truth.kind, -truth.error, AFTER)]
    if truth.kind != CLASSICAL and np.isfinite(truth.classical).any():
        curves.insert(0, Curve("classical PI", -truth.classical, BEFORE))
    chart, said = charts.held_out(truth.t, curves, floor.rms)
    page.chart(f"{name}-held-out", chart, f"Each block as predicted without it, and how often each error comes. {said}")


def _row(part: Slice, floor: float) -> list[str]:
    times = f"{part.rms / floor:.2f}" if floor > 0.0 else ""
    classical = f"{part.classical_rms * 1e9:.1f}" if np.isfinite(part.classical_rms) else "-"
    ratio = f"{part.classical_rms / part.rms:.1f}" if np.isfinite(part.classical_rms) and part.rms > 0.0 else "-"
    rms, largest = f"{part.rms * 1e9:.1f}", f"{part.maximum * 1e9:.1f}"
    return [part.name, f"{part.samples:,}", rms, times, largest, classical, ratio]


def _part(t: FloatArray, fitted: Mask) -> str:
    """Say which samples were fitted."""
    if not fitted.any():
        return "Nothing of this record was fitted."
    first, last = t[fitted][[0, -1]].tolist()
    return (
        f"Fitted were the samples from {first:.6g} s to {last:.6g} s, of {t[0]:.6g} s to {t[-1]:.6g} s. The others are "
        f"drawn as '{charts.UNFITTED}'; no figure, no histogram and no map counts them. Voltage before the part that "
        "was fitted still moves the memory."
    )


def _show(page: Page, name: str, traces: _Traces, noise: float) -> None:
    """Add the charts of one axis."""
    t, v, y, fitted = traces.t, traces.v, traces.y, traces.fitted
    motion, left = Motion.of(t, v), y - traces.simulated
    models = [Curve("model", traces.simulated, AFTER)]
    page.section("The record and the model, free-run from its start")
    loops, said = charts.loops(v, y, models, motion, fitted)
    beside = "Displacement over voltage; beside it without the straight line through it, so that the loops open."
    page.chart(f"{name}-loops", loops, f"{beside} {said}")
    over_time, said = charts.over_time(t, y, models, noise, fitted=fitted)
    page.chart(f"{name}-time", over_time, f"Over time; the grey band is plus and minus the noise. {said}")
    page.section("What the model leaves")
    over_voltage, said = charts.over_voltage(v, left, motion, noise, fitted)
    how = "Over voltage, where it rises and where it falls, and how often each value comes."
    page.chart(f"{name}-residual", over_voltage, f"{how} {said}")
    page.chart(
        f"{name}-coverage",
        charts.coverage(v, np.where(fitted, left, np.nan), motion),
        "What was fitted: from which voltage a branch began, and where on it the fitted samples lie. Branches above "
        "the diagonal rise, those below it fall. Where it is white nothing was fitted: there the model only continues "
        "smoothly.",
    )
