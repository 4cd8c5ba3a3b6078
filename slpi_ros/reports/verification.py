"""The page and the files of a verification: errors on records not used for the fit, pass or fail."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slpi_ros.diagnosis.verify import (
    CAUSES,
    TIMES_THE_FLOOR,
    AxisVerification,
    ErrorPart,
    RecordVerification,
    Tracking,
    Verification,
)
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.schemas import format_document
from slpi_ros.model.axis_model import ABOVE_FLOOR
from slpi_ros.reports import views
from slpi_ros.reports.chart import (
    AFTER,
    BEFORE,
    DESIRED,
    DISPLACEMENT,
    MEASURED,
    NOISE,
    TIME,
    Chart,
    Panel,
    Quantity,
    thin_line,
)
from slpi_ros.reports.chart import CAUSES as COLOURS
from slpi_ros.reports.page import Page, Share
from slpi_ros.reports.text import nm

FloatArray = NDArray[np.float64]

FILES = "verification.json", "report.html"
TRACKING_ERROR = Quantity("measured - desired", "nm", 1e9, ".1f")
COLOUR = {**dict(zip(CAUSES, (*COLOURS, AFTER), strict=False)), "model": BEFORE, "noise": NOISE}
# Smaller shares of the tracking error are not reported.
_SMALLEST_SHARE = 0.01


def write_files(folder: Path, found: Verification) -> None:
    """Write ``verification.json`` and ``report.html`` into `folder`, each atomically.

    The folder is created if it does not exist. SlpiError if a file cannot be written.
    """
    make_folder(folder, *FILES)
    with all_or_nothing(folder / FILES[0]) as file:
        file.write(format_document(found.to_document(), "verification"))
    page = Page("Verification of a model" + (f" of stage {found.hardware_id}" if found.hardware_id else ""))
    page.contents(tuple(found.axes))
    for name, axis in found.axes.items():
        page.heading(f"Axis {name}", name)
        page.verdict(name, _summary(name, axis), "good" if axis.passed else "bad", "pass" if axis.passed else "fail")
        page.tiles(_figures(axis))
        page.section("Errors by record")
        page.table(*_records_table(axis))
        page.lines([f"{record.error.name}: {line}" for record in axis.records for line in _notes(record)])
        page.section("Errors by level, speed and region")
        page.table(*_parts_table(axis))
        for number, record in enumerate(axis.records):
            _show_record(page, f"{name}-{number}", record)
    page.write(folder / FILES[1])


def verification_limits(found: Verification) -> dict[str, str]:
    """Return what limits the accuracy of each axis: a failed model, or the largest part of a tracking error."""
    limits = {}
    for name, axis in found.axes.items():
        tracked = [record.tracking for record in axis.records if record.tracking]
        if not axis.passed:
            worst = axis.worst
            noisy = worst.error.rms <= ABOVE_FLOOR * worst.floor_rms
            limits[name] = (
                f"{'the noise of the record' if noisy else 'the model'}, {nm(worst.error.rms)} rms where "
                f"{nm(worst.limit)} are allowed"
            )
        elif tracked:
            worst_path = max(tracked, key=lambda tracking: tracking.error.rms)
            if worst_path.error.rms > axis.worst.limit:
                limits[name] = f"{worst_path.blame}, as the largest part of the tracking error"
    return limits


def verification_good(found: Verification) -> str:
    """Return how good a verified model is that nothing limits."""
    noise = all(
        record.error.rms <= ABOVE_FLOOR * record.floor_rms for axis in found.axes.values() for record in axis.records
    )
    return "at the noise floor" if noise else "within its limit on every record"


def describe_verification(found: Verification, *, details: bool = True) -> list[str]:
    """Return lines of text: for each axis pass or fail, and the errors (nm) by record, level, speed and region.

    Without `details`: pass or fail, and the notes of each record.
    """
    lines = []
    for name, axis in found.axes.items():
        told = [("pass: " if axis.passed else "fail: ") + _summary(name, axis).removeprefix(f"Axis {name}: ")]
        for record in axis.records:
            told += [f"{record.error.name}: {line}" for line in (_error(record), *_notes(record))]
            if record.tracking:
                told += [f"{record.error.name}: {line}" for line in _tracking_notes(record.tracking)]
        parts = (axis.overall, *axis.by_level, *axis.by_speed, *axis.by_region) if details else ()
        told += [f"{'error, nm':<24}{'samples':>9}{'rms':>9}{'max':>10}"] if parts else []
        for part in parts:
            told.append(f"{part.name:<24}{part.samples:9}{part.rms * 1e9:9.1f}{part.maximum * 1e9:10.1f}")
        lines += [f"axis {name}: {line}" for line in told]
    return lines


def _summary(name: str, axis: AxisVerification) -> str:
    """Return a sentence with the error and its limit, and the remedy for an axis that fails."""
    failed = [record for record in axis.records if not record.passed]
    several = f" on the worst of {len(axis.records)} records" if len(axis.records) > 1 else ""
    said = f"Axis {name}: {_error(axis.worst)}{several}."
    if not failed:
        moved = [record for record in axis.records if record.zero_moved]
        return said + (f" The zero has moved by {_um(moved[0].offset)} µm; the loops are the same." if moved else "")
    return f"{said} 'slpi diagnose' finds the cause, 'slpi refit' corrects the model."


def _error(record: RecordVerification) -> str:
    error = record.error
    return (
        f"measured - model is {nm(error.rms)} rms (limit {nm(record.limit)}), maximum {nm(error.maximum)}; "
        f"repeatability floor {nm(record.floor_rms)} rms"
    )


def _notes(record: RecordVerification) -> list[str]:
    """Return the assumptions about a record's start, and findings other than the error."""
    start = (
        "the start is unknown: the initial history and the offset are fitted to the record"
        if record.known_from is None
        else f"evaluated from {record.known_from:.4g} s on, where the unknown history before it only adds a constant"
    )
    notes = [start]
    if record.corrected:
        notes.append(f"errors are those of the stage; taken out of the readings of its sensor: {record.corrected}")
    if record.zero_moved:
        notes.append(f"the zero has moved by {_um(record.offset)} µm, which is not counted as an error")
    if not record.passed:
        notes.append(f"relative to the model, gain {record.gain:+.2%}, loop width {record.width:+.2%}")
    if record.outside:
        notes.append(f"{record.outside} voltages lie outside the identified range, where the model extrapolates")
    return notes


def _tracking_notes(tracking: Tracking) -> list[str]:
    """Return the tracking error of a compensated path and its causes."""
    error = tracking.error
    told = sorted(tracking.shares.items(), key=lambda item: -item[1])
    shares = [f"{cause} {share:.0%}" for cause, share in told if abs(share) >= _SMALLEST_SHARE]
    notes = [
        f"measured - desired is {nm(error.rms)} rms, {nm(error.maximum)} at most; of its mean square: "
        f"{', '.join(shares) or 'nothing'}",
        f"largest contribution, {tracking.blame}: {CAUSES[tracking.blame]}",
    ]
    notes += [f"the displacement lags by {tracking.delay * 1e3:.3g} ms"] if tracking.delay else []
    notes += [f"effects: {', '.join(tracking.effects)}"] if tracking.effects else []
    return notes


def _figures(axis: AxisVerification) -> dict[str, str]:
    worst = axis.worst
    figures = {
        "measured - model, rms": nm(axis.overall.rms),
        "maximum": nm(axis.overall.maximum),
        "limit of the rms": nm(worst.limit),
        "repeatability floor, rms": nm(worst.floor_rms),
        "held-out error of the model": nm(axis.resolution),
    }
    tracked = [record.tracking.error.rms for record in axis.records if record.tracking]
    return figures | ({"measured - desired, rms": nm(max(tracked))} if tracked else {})


def _records_table(axis: AxisVerification) -> tuple[Sequence[str], list[Sequence[str]], None, str]:
    header = (
        "record", "", "samples", "rms (nm)", "maximum (nm)", "limit (nm)", "floor (nm)", "zero moved (µm)",
    )  # fmt: skip
    rows: list[Sequence[str]] = [
        (
            record.error.name,
            "pass" if record.passed else "fail",
            f"{record.error.samples:,}",
            *(f"{x * 1e9:.1f}" for x in (record.error.rms, record.error.maximum, record.limit, record.floor_rms)),
            _um(record.offset) if record.zero_moved else "no",
        )
        for record in axis.records
    ]
    caption = (
        "Measured - model, free-run, without a constant offset for each record. The rms must be within the tolerance, "
        f"else within {TIMES_THE_FLOOR:g} times the repeatability floor, but at least the model's held-out error. "
        f"Floor: {axis.records[0].floor_source}."
    )
    return header, rows, None, caption


def _parts_table(axis: AxisVerification) -> tuple[Sequence[str], list[Sequence[str] | str], int, str]:
    floor = float(np.median([record.floor_rms for record in axis.records]))

    def row(part: ErrorPart) -> list[str]:
        times = f"{part.rms / floor:.2f}" if floor > 0.0 else ""
        return [part.name, f"{part.samples:,}", f"{part.rms * 1e9:.1f}", times, f"{part.maximum * 1e9:.1f}"]

    rows: list[Sequence[str] | str] = [row(axis.overall)]
    groups = {"by loop level": axis.by_level, "by speed": axis.by_speed, "by region": axis.by_region}
    for name, parts in groups.items():
        rows += [name, *map(row, parts)]
    return ("", "samples", "rms (nm)", "times the floor", "maximum (nm)"), rows, 0, f"All records; floor {nm(floor)}."


def _show_record(page: Page, name: str, record: RecordVerification) -> None:
    """Add the charts of one record."""
    t, v, y = record.t, record.v, record.measured
    page.section(record.error.name)
    if record.tracking:
        _show_tracking(page, name, record.tracking)
    views.show_model(page, name, t, v, y, record.model, record.floor_rms, record.judged)


def _show_tracking(page: Page, name: str, tracking: Tracking) -> None:
    """Add the causes of the error along a compensated path."""
    page.subsection("Measured - desired displacement")
    shares = {cause: share for cause, share in tracking.shares.items() if share >= _SMALLEST_SHARE}
    whole = sum(shares.values())
    page.shares([Share(cause, share / whole, COLOUR[cause]) for cause, share in shares.items()])
    page.definitions({cause: CAUSES[cause] for cause in shares})
    page.lines(_tracking_notes(tracking))
    chart = Chart([Panel(TIME, DISPLACEMENT), Panel(TIME, TRACKING_ERROR, 1.2)], "column", 540)
    error = np.sum(list(tracking.parts.values()), axis=0)
    t, desired = tracking.t, tracking.desired
    kept = thin_line(desired, error)
    chart.line(0, "measured", t[kept], (desired + error)[kept], MEASURED, width=2.6)
    chart.line(0, "desired", t[kept], desired[kept], DESIRED, width=1.0)
    chart.line(1, "measured - desired", t[kept], error[kept], MEASURED, width=1.2)
    for cause, part in tracking.parts.items():
        if part.any():
            some = thin_line(part)
            chart.line(1, cause, t[some], part[some], COLOUR[cause], width=1.0)
    said = views.focus(chart, (1,), [error])
    page.chart(f"{name}-tracking", chart, f"Desired and measured displacement, and the parts of the error. {said}")


def _um(metres: float) -> str:
    return f"{metres * 1e6:+.3f}"
