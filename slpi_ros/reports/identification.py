"""The page of an identification: the record, the model, its held-out error and its residual."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import SlpiError, length
from slpi_ros.identification.cross_validation import CLASSICAL, CrossValidationReport, Slice
from slpi_ros.identification.held_readings import corrected_fresh
from slpi_ros.identification.record_quality import Finding, assess, findings
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import ABOVE_NOISE, AxisModel
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports import views
from slpi_ros.reports.chart import AFTER, BEFORE
from slpi_ros.reports.page import Page, Severity
from slpi_ros.reports.text import describe_axis
from slpi_ros.reports.views import Series

# From held-out errors of this multiple of the noise on, diagnosis is advised.
_MORE_THAN_NOISE = 3.0


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
    """Write ``report.html`` on the first record of a model into `folder`, created if missing, and return its path."""
    # `found` are the findings on the quality of the record, by axis, by default determined from it; only the fitted
    # part, `start` to `stop` (s), is evaluated, the rest is drawn.
    page = Page(f"Model of {record.source}")
    page.contents(tuple(model.axes))
    for name in model.axes:
        record.require_axis(name)
    # What is known of the sensor is taken out: errors are those of the stage.
    record = corrected_fresh(record, model.corrections)
    driven = np.logical_and.reduce([np.isfinite(record.voltage[name]) for name in model.axes])
    t = record.t[driven]
    fitted = (t >= (-np.inf if start is None else start)) & (t < (np.inf if stop is None else stop))
    simulated = model.stage_only.simulate(t, {name: record.voltage[name][driven] for name in model.axes})
    for name, axis in model.axes.items():
        told = (held_out or {}).get(name)
        page.heading(f"Axis {name}", name)
        page.verdict(name, *_verdict(axis, told))
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
            floor = told.repeatability.rms if told else axis.quality.floor_rms
            v, y = record.voltage[name][driven], record.displacement[name][driven]
            page.section("Model and measurement")
            motion = views.show_model(page, name, t, v, y, simulated[name], floor, fitted)
            page.chart(
                f"{name}-coverage",
                views.coverage(v, np.where(fitted, y - simulated[name], np.nan), motion),
                "Number of fitted samples by start voltage of the branch and present voltage, and the rms error. "
                "Rising branches are above the diagonal, falling ones below. Empty: no data, the model extrapolates.",
            )
        else:
            page.text("The record contains no voltage of this axis: there are no charts.")
    path = folder / "report.html"
    page.write(path)
    return path


def _verdict(axis: AxisModel, held_out: CrossValidationReport | None) -> tuple[str, Severity]:
    """Return a sentence on the held-out error, and its severity."""
    quality = axis.quality
    error, floor = quality.held_out_rms, quality.floor_rms
    noise, told = "the sensor noise", f"the sensor noise is {length(floor)} rms"
    beside = ""
    if held_out is not None:
        error, floor = held_out.overall.rms, held_out.repeatability.rms
        noise, told = "the repeatability", f"the repeatability is {length(floor)} rms"
        if np.isfinite(held_out.overall.classical_rms) and held_out.kind != CLASSICAL:
            beside = f" Classical PI: {length(held_out.overall.classical_rms)}."
    share = f"{error / _stroke(axis):.3%}" if _stroke(axis) > 0.0 else "?"
    said = f"The held-out error is {length(error)} rms ({share} of the stroke)"
    if not floor > 0.0:
        return f"{said}; the record has no noise for comparison.{beside}", "warn"
    if error <= ABOVE_NOISE * floor:
        return f"{said}; {told}, so the error is close to the noise.{beside}", "good"
    said = f"{said}; {told}, and the error is {error / floor:.1f} times {noise}."
    if error <= _MORE_THAN_NOISE * floor:
        return said + beside, "warn"
    return f"{said} 'slpi diagnose' finds the cause.{beside}", "bad"


def _figures(axis: AxisModel, held_out: CrossValidationReport | None) -> dict[str, str]:
    quality = axis.quality
    if held_out:
        figures = {
            "held-out error, rms": length(held_out.overall.rms),
            "repeatability, rms": length(held_out.repeatability.rms),
            "classical PI held-out, rms": length(held_out.overall.classical_rms),
        }
    else:
        figures = {
            "held-out error, rms": length(quality.held_out_rms),
            "sensor noise, rms": length(quality.floor_rms),
            "samples fitted": f"{quality.samples:,}",
        }
    return figures | {
        "maximum error of the fit": length(quality.maximum),
        "stroke": f"{_stroke(axis) * 1e6:.4g} µm",
        "model covered": f"{quality.covered:.0%}",
    }


def _stroke(axis: AxisModel) -> float:
    low, high = axis.displacement_range
    return high - low


def _findings(record: Record, name: str, start: float | None, stop: float | None) -> list[Finding]:
    """Return the findings on a record, or the reason why it cannot be assessed."""
    try:
        return findings(assess(record, name, start=start, stop=stop))
    except SlpiError as error:
        return [Finding("stop", str(error))]


def _show_held_out(page: Page, name: str, held_out: CrossValidationReport) -> None:
    page.section("Held-out errors")
    floor = held_out.repeatability
    groups = {"by loop level": held_out.by_level, "by region": held_out.by_region, "by speed": held_out.by_speed}
    rows: list[Sequence[str] | str] = [_row(held_out.overall, floor.rms)]
    for what, parts in groups.items():
        rows += [what, *(_row(part, floor.rms) for part in parts)]
    page.table(
        ("", "samples", "rms (nm)", "times the repeatability", "maximum (nm)", "classical PI, rms (nm)", "PI / model"),
        rows,
        best=0,
        caption="Free-run held-out errors; the classical PI model on the same blocks. "
        f"Repeatability: {length(floor.rms)} rms, {floor.source}.",
    )
    curves = [Series(held_out.kind, -held_out.error, AFTER)]
    if held_out.kind != CLASSICAL and np.isfinite(held_out.classical).any():
        curves.insert(0, Series("classical PI", -held_out.classical, BEFORE))
    chart, said = views.held_out(held_out.t, curves, floor.rms)
    page.chart(
        f"{name}-held-out",
        chart,
        f"Measured - model, each block predicted by a fit to the other blocks, and the histogram. {said}",
    )


def _row(part: Slice, floor: float) -> list[str]:
    times = f"{part.rms / floor:.2f}" if floor > 0.0 else ""
    classical = f"{part.classical_rms * 1e9:.1f}" if np.isfinite(part.classical_rms) else "-"
    ratio = f"{part.classical_rms / part.rms:.1f}" if np.isfinite(part.classical_rms) and part.rms > 0.0 else "-"
    rms, largest = f"{part.rms * 1e9:.1f}", f"{part.maximum * 1e9:.1f}"
    return [part.name, f"{part.samples:,}", rms, times, largest, classical, ratio]


def _part(t: FloatArray, fitted: Mask) -> str:
    """Return a sentence on the fitted samples."""
    if not fitted.any():
        return "No sample of this record was fitted."
    first, last = t[fitted][[0, -1]].tolist()
    return (
        f"Fitted: the samples from {first:.6g} s to {last:.6g} s, of {t[0]:.6g} s to {t[-1]:.6g} s. The others are "
        f"drawn as '{views.UNUSED}'; figures, histograms and maps exclude these. The voltage before the part that "
        "was fitted still determines the initial state."
    )
