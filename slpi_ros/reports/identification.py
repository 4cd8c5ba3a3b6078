"""The page of an identification: the record, the model, its held-out error and its residual."""

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
from slpi_ros.reports import views
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
    held_out: Mapping[str, CrossValidationReport] | None = None,
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
    held_out : mapping of axis name to CrossValidationReport, optional
        Held-out errors, for the tables.
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
        told = (held_out or {}).get(name)
        page.heading(f"Axis {name}", name)
        page.verdict(name, *_verdict(name, axis, told))
        page.tiles(_figures(axis, told))
        if told is not None:
            _show_held_out(page, name, told)
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


def _verdict(name: str, axis: AxisModel, held_out: CrossValidationReport | None) -> tuple[str, Severity]:
    """Return a sentence on the held-out error, and its severity."""
    quality = axis.quality
    error, floor = quality.held_out_rms, quality.floor_rms
    noise, floor_is = "the sensor noise", f"the sensor noise is {_nm(floor)} rms"
    beside = ""
    if held_out is not None:
        error, floor = held_out.overall.rms, held_out.floor.rms
        noise, floor_is = "that floor", f"the repeatability floor is {_nm(floor)} rms"
        if np.isfinite(held_out.overall.classical_rms) and held_out.kind != CLASSICAL:
            beside = f" Classical PI: {_nm(held_out.overall.classical_rms)}."
    share = f"{error / _stroke(axis):.3%}" if _stroke(axis) > 0.0 else "?"
    said = f"Axis {name}: the held-out error is {_nm(error)} rms ({share} of the stroke)"
    if not floor > 0.0:
        return f"{said}; the record shows no noise to compare with.{beside}", "warn"
    if error <= _NOISE_ONLY * floor:
        return f"{said}; {floor_is}, so hardly anything but noise is left.{beside}", "good"
    said = f"{said}; {floor_is}, and the error is {error / floor:.1f} times {noise}."
    if error <= _MORE_THAN_NOISE * floor:
        return said + beside, "warn"
    return f"{said} 'slpi diagnose' looks for the cause.{beside}", "bad"


def _figures(axis: AxisModel, held_out: CrossValidationReport | None) -> dict[str, str]:
    quality = axis.quality
    if held_out:
        figures = {
            "held-out error, rms": _nm(held_out.overall.rms),
            "repeatability floor, rms": _nm(held_out.floor.rms),
            "classical PI there, rms": _nm(held_out.overall.classical_rms),
        }
    else:
        figures = {
            "held-out error, rms": _nm(quality.held_out_rms),
            "sensor noise, rms": _nm(quality.floor_rms),
            "samples fitted": f"{quality.samples:,}",
        }
    return figures | {
        "maximum error where fitted": _nm(quality.maximum),
        "stroke": f"{_stroke(axis) * 1e6:.4g} µm",
        "of the model covered": f"{quality.covered:.0%}",
    }


def _stroke(axis: AxisModel) -> float:
    low, high = axis.displacement_range
    return high - low


def _nm(metres: float) -> str:
    return f"{metres * 1e9:.1f} nm" if np.isfinite(metres) else "none"


def _findings(record: Record, name: str, start: float | None, stop: float | None) -> list[Finding]:
    """Return the findings on a record; the reason where it cannot be assessed."""
    try:
        return findings(assess(record, name, start=start, stop=stop))
    except SlpiError as error:
        return [Finding("stop", str(error))]


def _show_held_out(page: Page, name: str, held_out: CrossValidationReport) -> None:
    """Add the table and the chart of held-out errors."""
    page.section("Held-out errors")
    floor = held_out.floor
    groups = {
        "by loop level": held_out.by_level,
        "by region": held_out.by_region,
        "by speed": held_out.by_speed,
    }
    rows: list[Sequence[str] | str] = [_row(held_out.overall, floor.rms)]
    for what, parts in groups.items():
        rows += [what, *(_row(part, floor.rms) for part in parts)]
    page.table(
        ("", "samples", "rms (nm)", "times the floor", "maximum (nm)", "classical PI, rms (nm)", "PI / model"),
        rows,
        best=0,
        caption="Free-run, on blocks left out of the fit; the classical PI model on the same blocks. "
        f"Floor: {_nm(floor.rms)} rms, {floor.source}.",
    )
    curves = [Curve(held_out.kind, -held_out.error, AFTER)]
    if held_out.kind != CLASSICAL and np.isfinite(held_out.classical).any():
        curves.insert(0, Curve("classical PI", -held_out.classical, BEFORE))
    chart, said = views.held_out(held_out.t, curves, floor.rms)
    page.chart(
        f"{name}-held-out",
        chart,
        f"Measured - model, each block predicted by a fit without it, and the histogram. {said}",
    )


def _row(part: Slice, floor: float) -> list[str]:
    times = f"{part.rms / floor:.2f}" if floor > 0.0 else ""
    classical = f"{part.classical_rms * 1e9:.1f}" if np.isfinite(part.classical_rms) else "-"
    ratio = f"{part.classical_rms / part.rms:.1f}" if np.isfinite(part.classical_rms) and part.rms > 0.0 else "-"
    rms, largest = f"{part.rms * 1e9:.1f}", f"{part.maximum * 1e9:.1f}"
    return [part.name, f"{part.samples:,}", rms, times, largest, classical, ratio]


def _part(t: FloatArray, fitted: Mask) -> str:
    """Return a sentence on which samples were fitted."""
    if not fitted.any():
        return "Nothing of this record was fitted."
    first, last = t[fitted][[0, -1]].tolist()
    return (
        f"Fitted were the samples from {first:.6g} s to {last:.6g} s, of {t[0]:.6g} s to {t[-1]:.6g} s. The others are "
        f"drawn as '{views.UNUSED}'; no figure, no histogram and no map counts them. Voltage before the part that "
        "was fitted still moves the memory."
    )


def _show(page: Page, name: str, traces: _Traces, noise: float) -> None:
    """Add the charts of one axis."""
    t, v, y, fitted = traces.t, traces.v, traces.y, traces.fitted
    motion, left = Motion.of(t, v), y - traces.simulated
    models = [Curve("model", traces.simulated, AFTER)]
    page.section("The record and the model, free-run from its start")
    loops, said = views.loops(v, y, models, motion, fitted)
    beside = "Displacement over voltage; beside it displacement - the straight line through it, so that the loops open."
    page.chart(f"{name}-loops", loops, f"{beside} {said}")
    over_time, said = views.over_time(t, y, models, noise, fitted=fitted)
    page.chart(f"{name}-time", over_time, f"Over time; the grey band is plus and minus the noise. {said}")
    page.section("Measured - model")
    over_voltage, said = views.over_voltage(v, left, motion, noise, fitted)
    how = "Over rising and falling voltage, and the histogram."
    page.chart(f"{name}-residual", over_voltage, f"{how} {said}")
    page.chart(
        f"{name}-coverage",
        views.coverage(v, np.where(fitted, left, np.nan), motion),
        "Fitted samples by the voltage at which their branch began and their own voltage, and the rms error there. "
        "Branches above the diagonal rise, those below it fall. White: no data; there the model extrapolates smoothly.",
    )
