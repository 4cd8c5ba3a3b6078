"""The page and the files of a calibration: what was recorded, why, what it showed, and the verified error."""

from pathlib import Path

from slpi_ros.calibration.closed_loop import gains_of
from slpi_ros.calibration.run import Outcome
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.errors import length
from slpi_ros.io.atomic_file import make_folder
from slpi_ros.model.document import save_model
from slpi_ros.reports import diagnosis as diagnosis_files
from slpi_ros.reports.chart import AFTER, BEFORE, DESIRED, Chart, Quantity, over_time
from slpi_ros.reports.page import Page
from slpi_ros.reports.text import describe_model
from slpi_ros.reports.tuning import describe, describe_measured
from slpi_ros.reports.verification import show_steps

# The model, the page, the folder with the files of the last diagnosis, and the gains of a tuned loop.
MODEL, PAGE, DIAGNOSIS, GAINS = "model.json", "report.html", "diagnosis", "gains.yaml"
TRACKING_ERROR = Quantity("measured - desired", "nm", 1e9, ".1f")


def write_files(folder: Path, outcome: Outcome) -> None:
    """Write ``model.json``, ``report.html`` and the files of the last diagnosis into `folder`, each atomically."""
    make_folder(folder)
    save_model(outcome.model, str(folder / MODEL))
    diagnosis_files.write_files(folder / DIAGNOSIS, outcome.diagnosis)
    if any(one.design for one in outcome.loops.values()):
        stage = f" for stage {outcome.model.hardware_id}" if outcome.model.hardware_id else ""
        TunedGains(outcome.settings.rate, gains_of(outcome.loops)).write(str(folder / GAINS), f"the calibrator{stage}")
    page_of(outcome).write(folder / PAGE)


def page_of(outcome: Outcome) -> Page:
    """Return the page of a calibration."""
    stage = f" of stage {outcome.model.hardware_id}" if outcome.model.hardware_id else ""
    page = Page(f"Calibration{stage}")
    page.contents(tuple(outcome.errors))
    path = "the desired path" if outcome.settings.path else "a path of its own"
    page.text(
        f"{outcome.why[0].upper()}{outcome.why[1:]}. The stage moved for {outcome.seconds:.0f} s in "
        f"{sum(step.seconds > 0 for step in outcome.steps)} drives; every verification followed {path} "
        "through the compensator after a sweep over the whole range, which resets the memory. Errors are absolute, "
        "measured - desired; what counts is the latest verification."
    )
    page.table(
        ("verification", "axis", "model", "mean error", "of the stroke", "maximum", "offset", "mean without it"),
        _errors(outcome),
    )
    for axis, error in outcome.errors.items():
        found = outcome.diagnosis.axes[axis]
        page.heading(f"Axis {axis}", axis)
        page.verdict(axis, found.summary, "good" if error.met else "warn", found.verdict)
        page.tiles({
            "verified error, mean": length(error.mean),
            "of the stroke": f"{error.mean / error.stroke:.3%}",
            "offset": length(error.offset),
            "mean without offset": length(error.rest),
            "maximum": length(error.maximum),
            "target": length(error.goal),
            "repeatability, rms": length(found.repeatability_rms),
        })  # fmt: skip
        page.definitions({named.name: named.evidence for named in found.effects})
        page.chart(
            f"{axis}-tracking", _chart(outcome, axis), "The last path, and the errors of the first and the last."
        )
    for axis, loop in outcome.loops.items():
        page.heading(f"Feedback of axis {axis}", f"{axis}-loop")
        page.text(f"At {outcome.settings.rate:g} Hz, in {GAINS}: {loop.told}.")
        if loop.design:
            page.lines([*describe(outcome.model.axis(axis), loop.design)[1:], *describe_measured(loop.design, None)])
        show_steps(page, axis, loop.steps)
    page.heading("What was recorded, why, and what it showed")
    rows = [
        (
            step.name,
            f"{step.seconds:.0f} s" if step.seconds else "",
            step.why,
            "; ".join([step.finding, *(one.text for one in step.missing)]),
        )
        for step in outcome.steps
    ]
    page.table(("step", "drive", "why", "what it showed"), rows)
    page.heading("The model")
    page.lines(describe_model(outcome.model))
    return page


def _errors(outcome: Outcome) -> list[list[str]]:
    """Return a row for each axis in each verification."""
    return [
        [
            step.name,
            axis,
            "with the causes found" if axis in step.extended else "hysteresis alone",
            length(error.mean),
            f"{error.mean / error.stroke:.3%}",
            *map(length, (error.maximum, error.offset, error.rest)),
        ]
        for step in outcome.steps
        for axis, error in (step.errors or {}).items()
    ]


def _chart(outcome: Outcome, axis: str) -> Chart:
    verified = [step.errors[axis] for step in outcome.steps if step.errors]
    first, last = verified[0], verified[-1]
    chart = over_time(TRACKING_ERROR)
    chart.thinned(0, "desired", last.t, last.desired, DESIRED)
    for name, one, colour in (("first", first, BEFORE), ("last", last, AFTER)):
        chart.thinned(1, f"{name} path", one.t, one.error, colour, width=1.0)
    return chart
