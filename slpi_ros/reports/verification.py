"""The page and the files of a verification: errors on records not used for the fit, and the verdict."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slpi_ros.errors import length
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.schemas import format_document
from slpi_ros.model.axis_model import ABOVE_NOISE
from slpi_ros.reports import views
from slpi_ros.reports.chart import AFTER, BEFORE, DESIRED, MEASURED, NOISE, Chart, Panel, Quantity, over_time, thin_line
from slpi_ros.reports.chart import CAUSES as COLOURS
from slpi_ros.reports.page import Page, Severity
from slpi_ros.verification import verify
from slpi_ros.verification.step_answers import StepAnswer
from slpi_ros.verification.tracking import CAUSES, Burst, ErrorPart, Tracking
from slpi_ros.verification.verify import AxisVerification, RecordVerification, Verification

FILES = "verification.json", "report.html"
TRACKING_ERROR = Quantity("measured - desired", "nm", 1e9, ".1f")
STEP_SIZE, SETTLING = Quantity("step", "µm", 1e6, ".4g"), Quantity("settling time", "ms", 1e3, ".4g")
COLOUR = {**dict(zip(CAUSES, (*COLOURS, AFTER), strict=False)), "model": BEFORE, "noise": NOISE}
SEVERITY: dict[str, Severity] = {verify.PASSED: "good", verify.UNPROVED: "warn", verify.FAILED: "bad"}
# Names of the parts of a tracking error; smaller ones than this share of the rms without the zero are
# not told.
PARTS = {
    "zero": "zero", "memory": "initial state", "limits": "voltage limits", "delay": "delay", "rate": "rate dependence",
    "command": "other voltages than the model's", "model": "hysteresis", "noise": "noise and interference",
}  # fmt: skip
_SMALLEST_PART = 0.1
# Fewest sizes of steps of which a chart is drawn.
_FEWEST_SIZES = 3
# Largest number of times that are told.
MOST_TIMES = 3
LINES, ZERO = "line interference or vibration", "the zero"
# Where the initial state is given.
GIVEN = {
    "end": "as at the end of the identified record", "start": "as at the start of the identified record",
    "wiped": "as after a reset",
}  # fmt: skip
FOREIGN = "another stage, or of other units"


def write_files(folder: Path, found: Verification) -> None:
    """Write ``verification.json`` and ``report.html`` into `folder`, each atomically."""
    make_folder(folder, *FILES)
    with all_or_nothing(folder / FILES[0]) as file:
        file.write(format_document(found.to_document(), "verification"))
    page = Page("Verification of a model" + (f" of stage {found.hardware_id}" if found.hardware_id else ""))
    page.contents(tuple(found.axes))
    for name, axis in found.axes.items():
        page.heading(f"Axis {name}", name)
        page.verdict(name, _summary(axis), SEVERITY[axis.verdict], axis.verdict)
        page.tiles(_figures(axis))
        page.section("Errors by record")
        page.table(*_records_table(axis))
        several = len(axis.records) > 1
        page.lines(
            [
                f"{record.error.name}: {line}" if several else line
                for record in axis.records
                for line in record_notes(record)
            ]
        )
        page.section("Errors by level, speed and region")
        page.table(*_parts_table(axis))
        for number, record in enumerate(axis.records):
            _show_record(page, f"{name}-{number}", record)
    page.write(folder / FILES[1])


def verification_limits(found: Verification) -> dict[str, str]:
    """Return what limits the accuracy of each axis: the model, or the largest part of a tracking error."""
    limits = {}
    for name, axis in found.axes.items():
        tracked = [record.tracking for record in axis.records if record.tracking]
        said = []
        if not axis.passed:
            worst, unproved = axis.worst, axis.verdict == verify.UNPROVED
            limit = _limiting(worst)
            if unproved:
                limit = f"unproved{_where_unproved(axis.unproved)}"
            said.append(f"{limit}, {length(worst.judged_error)} rms where {length(worst.limit)} are allowed")
        path = max(tracked, key=lambda tracking: tracking.error.rms, default=None)
        if path and path.error.rms > max(axis.worst.limit, axis.worst.judged_error):
            busy = ", while computer or driver was busy" if (burst := path.burst) and burst.gap else ""
            said.append(f"the path, {length(path.error.rms)} rms, most by {_part(path)}{busy}")
        if said:
            limits[name] = "; ".join(said)
    return limits


def _where_unproved(record: RecordVerification) -> str:
    if not record.independent:
        return " on a record that the model was identified from"
    return f" without {', '.join(record.lacking)}, which the model follows" if record.lacking else ""


def _part(tracking: Tracking) -> str:
    """Return the name of the largest part of a tracking error."""
    return "a delay that varies" if tracking.delays and tracking.blame == "delay" else PARTS[tracking.blame]


def _limiting(record: RecordVerification) -> str:
    """Return what makes most of the error of a record that fails."""
    if record.lacking:
        return f"{', '.join(record.lacking)}, which the model follows and the record does not hold"
    if record.foreign:
        return FOREIGN
    if record.absolute and record.zero_moved and record.constant**2 > record.error.rms**2 / 2:
        return ZERO
    share = record.lines.share if record.lines else 0.0
    if record.rest.rms * np.sqrt(1.0 - share) <= ABOVE_NOISE * record.repeatability_rms:
        return LINES if record.lines else "the noise of the record"
    return "the model"


def verification_good(found: Verification) -> str:
    """Return how good a verified model is that nothing limits."""
    records = [record for axis in found.axes.values() for record in axis.records]
    noise = all(record.error.rms <= ABOVE_NOISE * record.repeatability_rms for record in records)
    lines = max((record.lines.share for record in records if record.lines), default=0.0)
    offset = "" if all(record.absolute for record in records) else ", offset left out"
    good = "at the repeatability of the record" if noise else f"within its limit on every record{offset}"
    return f"{good}{f'; {lines:.0%} of the mean square error is {LINES}' if lines else ''}"


def little_judged(found: Verification) -> str:
    """Return what share of the record with the least judged samples is judged, and why; "" if most are on each."""
    least = min((record for axis in found.axes.values() for record in axis.records), key=lambda record: record.share)
    return "" if least.share >= verify.MOST_KNOWN else f"; {least.error.name}: {_judged_share(least)}"


def describe_verification(found: Verification, *, details: bool = True) -> list[str]:
    """Return lines: for each axis the verdict and the notes of each record, in `details` errors (nm) by class."""
    lines = []
    for name, axis in found.axes.items():
        told = [f"{axis.verdict}: " + _summary(axis)]
        for record in axis.records:
            error = [_error(record)] if len(axis.records) > 1 else []
            followed = _tracking_notes(record.tracking) if record.tracking else []
            told += [f"{record.error.name}: {line}" for line in (*error, *followed, *record_notes(record))]
        if not any(record.tracking for record in axis.records):
            told.append("path: not judged, no bag holds desired_displacement or desired_trajectory")
        parts = (axis.overall, axis.rest, *axis.by_level, *axis.by_speed, *axis.by_region) if details else ()
        told += [f"{'error, nm':<24}{'samples':>9}{'rms':>9}{'max':>10}"] if parts else []
        for part in parts:
            told.append(f"{part.name:<24}{part.samples:9}{part.rms * 1e9:9.1f}{part.maximum * 1e9:10.1f}")
        lines += [f"axis {name}: {line}" for line in told]
    return lines


def _summary(axis: AxisVerification) -> str:
    """Return a sentence with the error and its limit, and the remedy for an axis that does not pass."""
    several = f" on the worst of {len(axis.counted)} records" if len(axis.counted) > 1 else ""
    lacking = next((record for record in axis.records if record.lacking), None)
    said = f"{f'{_lacking(lacking)} ' if lacking else ''}{_error(axis.worst)}{several}."
    if axis.passed:
        moved = [record for record in axis.records if record.zero_moved]
        return said + (f" The zero has moved by {_um(moved[0].offset)} µm; the loops are the same." if moved else "")
    if axis.verdict == verify.UNPROVED:
        return f"{said} {_why_unproved(axis.unproved)}"
    limit = _limiting(axis.worst)
    if limit == FOREIGN:
        return f"{said} The model is of {FOREIGN}: its gain is off by {axis.worst.gain:.0%}; give this stage's model."
    if limit == LINES:
        return f"{said} It is {LINES}, no error of the model."
    if limit == ZERO:
        return f"{said} The zero has moved: '~/set_zero' of the compensator, or judge --without-offset."
    if lacking:
        return said
    return f"{said} 'slpi diagnose' finds the cause, 'slpi refit' corrects the model."


def _lacking(record: RecordVerification) -> str:
    """Return which quantities that the model follows are not in a record, what is there, and what to do."""
    held = f"it holds {', '.join(record.holds)}" if record.holds else "it holds no other"
    return (
        f"{record.error.name} does not hold {', '.join(record.lacking)}, which the model follows ({held}): the "
        "reference value is taken; record it too, under this name."
    )


def _why_unproved(record: RecordVerification) -> str:
    """Return why nothing is proved (useless readings, the initial state, a record of the fit), and what to do."""
    if record.unusable >= 1.0 - verify.LEAST:
        return "Too few readings are left: check the sensor and its link, 'slpi doctor' says what is wrong with them."
    if record.share >= verify.LEAST and record.judged_error <= record.limit and not record.independent:
        return "The model was identified from this record, so that a small error proves nothing: record another one."
    if record.share >= verify.LEAST and record.judged_error <= record.limit and record.lacking:
        return "Without what the model follows a small error proves nothing."
    if record.share >= verify.LEAST:
        return (
            f"The initial state is unknown, which alone can be {length(record.offset_uncertainty)}: begin a record "
            "at an end of the voltage range, say the initial state with --start-memory, or judge --without-offset."
        )
    return "The initial state is unknown for most of the record: begin it at an end of the voltage range."


def _error(record: RecordVerification) -> str:
    error = record.error
    limit = "" if record.absolute else ", without offset"
    return (
        f"measured - model is {length(error.rms)} rms, {length(error.maximum)} at most; offset "
        f"{length(record.constant)}, without it {length(record.rest.rms)} rms (limit {length(record.limit)}{limit}; "
        f"repeatability {length(record.repeatability_rms)}); {_judged_share(record)}"
    )


def _judged_share(record: RecordVerification) -> str:
    """Return how many samples are judged, and why not more."""
    part = f" {part_judged(*record.span)}" if record.is_part else ""
    said = f"{record.error.samples:,} of {record.samples:,} samples{part} judged ({record.share:.0%})"
    if record.share >= verify.MOST_KNOWN:
        return said
    if record.unusable > (1.0 - record.share) / 2:
        why = f", as {record.unusable:.0%} of the readings are missing, stuck, late or outliers"
    elif record.known_from is not None:
        why = f", as the initial state is unknown before {record.known_from:.4g} s"
    else:
        why = ""
    return f"{'WARNING: only ' if record.share < verify.FEW else ''}{said}{why}"


def record_notes(record: RecordVerification) -> list[str]:
    """Return the assumptions about a record's initial state, and findings other than the error."""
    if record.start_memory:
        notes = [f"the initial state is given: {GIVEN[record.start_memory]} (--start-memory {record.start_memory})"]
    elif record.known_from is None:
        notes = ["the initial state is unknown: it is estimated from the record"]
    elif record.begins_known:
        notes = ["the initial state is known"]
    else:
        notes = [f"the initial state is known from {record.known_from:.4g} s on, but for a constant"]
    if record.is_part:
        notes.append(f"only a part of the record was to be judged: {part_judged(*record.span)}")
    if not record.begins_known:
        notes.append(f"the unknown initial state makes the constant uncertain by {length(record.offset_uncertainty)}")
    if record.moving and record.standing:
        notes.append(
            f"while the voltage moves {length(record.moving.rms)} rms, while it stands {length(record.standing.rms)}"
        )
    if record.lines:
        notes.append(f"{LINES}: of the error without its offset, {record.lines.evidence}")
    if record.corrected:
        notes.append(f"errors are those of the stage; taken out of the readings of its sensor: {record.corrected}")
    if record.zero_moved:
        notes.append(f"the zero has moved by {_um(record.offset)} µm")
    if not record.independent:
        notes.append("the model was identified from this bag: a small error on it proves nothing")
    if not record.passed:
        width = f"{record.width:+z.2%}" if record.width > -1.0 else "of no loop that a stage has"
        notes.append(f"relative to the model, gain {record.gain:+z.2%}, loop width {width}")
    if record.beyond:
        notes.append(f"{record.beyond}: the model extrapolates there")
    return notes


def part_judged(start: float | None, stop: float | None) -> str:
    """Return which part of each record was to be judged, from `start` to `stop` (s; None: no limit)."""
    if start is None and stop is None:
        return "the whole record"
    begin, end = ("the beginning" if start is None else f"{start:g} s"), ("the end" if stop is None else f"{stop:g} s")
    return f"from {begin} to {end}"


def _tracking_notes(tracking: Tracking) -> list[str]:
    """Return the tracking error of a compensated path, what it consists of, and what helps against the largest part."""
    error, late = tracking.error, f" ({tracking.delay * 1e3:.3g} ms)" if tracking.delay else ""
    if tracking.delays:
        late = f" (varies, {tracking.delays[0] * 1e3:.3g} to {tracking.delays[1] * 1e3:.3g} ms)"
    told = [
        f"{PARTS[cause]} {length(part)}{late if cause == 'delay' else ''}" for cause, part in _parts(tracking).items()
    ]
    burst = tracking.burst
    return [
        f"path: measured - desired is {length(error.rms)} rms, {length(error.maximum)} at most, without the zero "
        f"{length(tracking.rest_rms)} rms; of it {', '.join(told)}",
        *_loop_notes(tracking),
        *([_when(burst)] if burst else []),
        f"path, largest part: {tracking.advice(tracking.blame)}",
    ]


def _loop_notes(tracking: Tracking) -> list[str]:
    """Return what a path shows of the loop: bandwidth, and answers to steps."""
    followed = tracking.bandwidth
    told = [f"path: bandwidth {followed:.3g} Hz, where the error reaches -3 dB of the path"] if followed else []
    return told + [
        f"path: {each.count} step{'s' if each.count > 1 else ''} of {length(each.size)}: overshoot "
        f"{each.overshoot:.1%}, within 1 % after {_settled(each.settled)}, within the noise after "
        f"{_settled(each.quiet)}"
        for each in tracking.steps[:MOST_TIMES]
    ]


def _settled(seconds: float | None) -> str:
    return "not before the next step" if seconds is None else f"{seconds * 1e3:.3g} ms"


def _when(burst: Burst) -> str:
    """Return when most of a tracking error occurs, and that readings are missing there."""
    times = [f"{begin:.4g} to {end:.4g} s" for begin, end in burst.times[:MOST_TIMES]]
    others = len(burst.times) - MOST_TIMES
    times += [f"{others} other times"] if others > 0 else []
    said = (
        f"path: {burst.share:.0%} of the mean square error without the zero is at {', '.join(times)} of the record, "
        f"elsewhere it is {length(burst.elsewhere)} rms"
    )
    if burst.gap:
        said += f"; no reading comes there for up to {burst.gap * 1e3:.3g} ms: computer or driver was busy"
    return said


def _parts(tracking: Tracking) -> dict[str, float]:
    """Return the parts (m rms) of a tracking error that are large enough to be told."""
    return {cause: part for cause, part in tracking.rms.items() if part > _SMALLEST_PART * tracking.rest_rms}


def _figures(axis: AxisVerification) -> dict[str, str]:
    worst = axis.worst
    figures = {
        "measured - model, rms": length(axis.overall.rms),
        "at most": length(axis.overall.maximum),
        "without offset, rms": length(axis.rest.rms),
        f"limit of the {'rms' if worst.absolute else 'rms without offset'}": length(worst.limit),
        "repeatability, rms": length(worst.repeatability_rms),
        "samples judged": f"{min(record.share for record in axis.records):.0%}",
        "held-out error of the model": length(axis.resolution),
    }
    tracked = [record.tracking.error.rms for record in axis.records if record.tracking]
    return figures | ({"measured - desired, rms": length(max(tracked))} if tracked else {})


def _records_table(axis: AxisVerification) -> tuple[Sequence[str], list[Sequence[str]], None, str]:
    header = (
        "record", "verdict", "judged", "rms (nm)", "maximum (nm)", "offset (nm)", "without it (nm)", "limit (nm)",
    )  # fmt: skip
    rows: list[Sequence[str]] = [
        (
            record.error.name,
            record.verdict,
            f"{record.error.samples:,} ({record.share:.0%})",
            *(f"{x * 1e9:.1f}" for x in (record.error.rms, record.error.maximum)),
            f"{record.constant * 1e9:+z.1f}",
            *(f"{x * 1e9:.1f}" for x in (record.rest.rms, record.limit)),
        )
        for record in axis.records
    ]
    held_to = "rms" if axis.worst.absolute else "rms without offset"
    caption = (
        f"Measured - model, free-run. The limit holds for the {held_to}: the tolerance, else "
        f"{verify.TIMES_REPEATABILITY:g} times the repeatability, but at least 0.02 % of the stroke. Repeatability: "
        f"{length(axis.records[0].repeatability_rms)}, {axis.records[0].repeatability_source}."
    )
    return header, rows, None, caption


def _parts_table(axis: AxisVerification) -> tuple[Sequence[str], list[Sequence[str] | str], int, str]:
    floor = float(np.median([record.repeatability_rms for record in axis.records]))

    def row(part: ErrorPart) -> list[str]:
        times = f"{part.rms / floor:.2f}" if floor > 0.0 else ""
        return [part.name, f"{part.samples:,}", f"{part.rms * 1e9:.1f}", times, f"{part.maximum * 1e9:.1f}"]

    rows: list[Sequence[str] | str] = [row(axis.overall), row(axis.rest)]
    groups = {"by loop level": axis.by_level, "by speed": axis.by_speed, "by region": axis.by_region}
    for name, parts in groups.items():
        rows += [name, *map(row, parts)]
    return (
        ("", "samples", "rms (nm)", "times the repeatability", "maximum (nm)"),
        rows,
        0,
        f"All records; but for the first row without the offset of each record; repeatability {length(floor)}.",
    )


def _show_record(page: Page, name: str, record: RecordVerification) -> None:
    t, v, y = record.t, record.v, record.measured
    page.section(record.error.name)
    if record.tracking:
        _show_tracking(page, name, record.tracking)
    views.show_model(page, name, t, v, y, record.model, record.repeatability_rms, record.judged)


def _show_tracking(page: Page, name: str, tracking: Tracking) -> None:
    """Add the causes of the error along a compensated path."""
    page.subsection("Measured - desired displacement")
    page.lines(_tracking_notes(tracking)[:-1])
    page.table(
        ("part of the error", "rms (nm)", "what it is, and what helps"),
        [(PARTS[cause], f"{part * 1e9:.1f}", tracking.advice(cause)) for cause, part in _parts(tracking).items()],
        caption="Rms by which each part enters the whole; of parts that cancel, the smaller one is left out.",
    )
    chart = over_time(TRACKING_ERROR)
    error = tracking.whole
    t, desired = tracking.t, tracking.desired
    kept = thin_line(desired, error)
    chart.line(0, "measured", t[kept], (desired + error)[kept], MEASURED, width=2.6)
    chart.line(0, "desired", t[kept], desired[kept], DESIRED, width=1.0)
    chart.line(1, "measured - desired", t[kept], error[kept], MEASURED, width=1.2)
    for cause, part in tracking.parts.items():
        if part.any():
            chart.thinned(1, PARTS[cause], t, part, COLOUR[cause], width=1.0)
    said = views.focus(chart, (1,), [error])
    show_steps(page, name, tracking.steps)
    page.chart(f"{name}-tracking", chart, f"Desired and measured displacement, and the parts of the error. {said}")


def show_steps(page: Page, name: str, steps: Sequence[StepAnswer]) -> None:
    """Add how steps of the path settle, by their size."""
    if not steps:
        return
    page.table(
        ("step", "number", "overshoot", "within 1 % after", "within the noise after"),
        [
            (length(each.size), str(each.count), f"{each.overshoot:.1%}", _settled(each.settled), _settled(each.quiet))
            for each in steps
        ],
        caption="Steps of the setpoint by their size; of each size the worst.",
    )
    if len(steps) < _FEWEST_SIZES or all(each.settled is None and each.quiet is None for each in steps):
        return
    chart = Chart([Panel(STEP_SIZE, SETTLING)], "column", 300)
    sizes = np.array([each.size for each in steps])
    for label, times, colour in (
        ("to 1 %", [each.settled for each in steps], AFTER),
        ("to the noise", [each.quiet for each in steps], BEFORE),
    ):
        chart.dots(0, label, sizes, np.array(times, dtype=float), colour)
    page.chart(f"{name}-steps", chart, "Settling time by the size of the step, where it settles before the next one.")


def _um(metres: float) -> str:
    return f"{metres * 1e6:+z.3f}"
