"""The certificate of a verification: a page and a document for the files of a laboratory."""

import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from slpi_ros.errors import SlpiError, length
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.digests import digests
from slpi_ros.io.record import Record
from slpi_ros.io.schemas import format_document
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.stage_model import StageModel, seconds_since
from slpi_ros.model.uncertainty import COMPONENTS, COVERAGE_FACTOR, AxisUncertainty
from slpi_ros.reports.page import Page
from slpi_ros.reports.uncertainty import PLACES, TIMES, uncertainty_document
from slpi_ros.reports.verification import SEVERITY, part_judged, record_notes
from slpi_ros.verification.verify import RecordVerification, counted
from slpi_ros.workflows.verify import VerifyOutcome

SCHEMA = "slpi_ros/certificate/1"
FILES = "certificate.json", "certificate.html"
AXIS_FIGURES = "rms_m", "maximum_m", "rest_rms_m", "rest_maximum_m", "samples"
PROGRAMS = "slpi_ros", "numpy", "scipy"
METHOD = (
    "The voltage of each record is given to the model, and the displacement that it computes (free run, without any "
    "reading of the sensor) is compared with the measured one: the error is measured - model.",
    "An error includes its offset, unless the line says without offset: then the mean of each record is subtracted.",
    "Known delay, lag and periodic error of the sensor are taken out of its readings first.",
    "A record proves something only if the model was not identified from it.",
)


def certificate(done: VerifyOutcome, bags: Sequence[str], model: StageModel, model_file: str) -> dict[str, Any]:
    """Return the certificate as a document, ``msg_schemas/certificate.schema.json``; RecordError if a file is gone.

    It rests on a verification with its records and their bags, and on a model and its file.
    """
    found = done.verification
    ((_, digest),) = digests(model_file).items()
    known = _middles(done.records, model)
    return {
        "schema": SCHEMA,
        "hardware_id": found.hardware_id or next((each.hardware_id for each in done.records if each.hardware_id), ""),
        "issued": datetime.now(UTC).isoformat(timespec="seconds"),
        "verdict": found.verdict,
        "tolerance_m": found.tolerance,
        **found.given,
        "method": list(METHOD),
        "model": {"source": model_file, "sha256": digest, "created": model.created},
        "records": [
            _record(record, bag, model, independent=one.independent)
            for record, bag, one in zip(done.records, bags, next(iter(found.axes.values())).records, strict=True)
        ],
        "axes": {
            name: {
                "verdict": axis.verdict,
                **_model(model.axes[name]),
                **{figure: axis.to_document()[figure] for figure in AXIS_FIGURES},
                "errors": [
                    _errors(one, model.surrounded(record).axes[name], _age(model, record))
                    for one, record in zip(axis.records, done.records, strict=True)
                ],
                **_uncertainty(model.axes[name], known),
            }
            for name, axis in found.axes.items()
        },
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PROGRAMS}},
    }


def write_files(folder: Path, document: dict[str, Any]) -> None:
    """Write ``certificate.json`` and ``certificate.html`` into `folder`, each atomically."""
    make_folder(folder, *FILES)
    with all_or_nothing(folder / FILES[0]) as file:
        file.write(format_document(document, "certificate"))
    stage, made = document["hardware_id"], document["model"]
    page = Page("Certificate of verification" + (f" of stage {stage}" if stage else ""))
    verdict = document["verdict"]
    page.verdict("stage", _verdict(document), SEVERITY[verdict], verdict)
    page.definitions(
        {
            "stage": stage or "unknown hardware id",
            "issued": document["issued"],
            "model": f"{made['source']}, identified {made['created'] or 'at an unknown time'}",
            "SHA-256 of the model": made["sha256"],
            "tolerance of the rms error": length(document["tolerance_m"])
            if document["tolerance_m"]
            else "none given; the limit of each record is in the table of its errors",
            "judged of each record": part_judged(document["start_s"], document["stop_s"]),
        }
    )
    page.contents(tuple(document["axes"]))
    page.heading("Method")
    page.lines(document["method"])
    page.heading("Records and conditions")
    for number, record in enumerate(document["records"], 1):
        page.subsection(f"Record {number}")
        page.definitions(_record_facts(record))
    for name, axis in document["axes"].items():
        _show_axis(page, name, axis)
    page.heading("Versions")
    page.definitions(document["versions"])
    page.write(folder / FILES[1])


def _verdict(document: dict[str, Any]) -> str:
    own = [record["source"] for record in document["records"] if not record["independent"]]
    dependent = f" It proves nothing on {', '.join(own)}, from which the model was identified." if own else ""
    deciding = [
        one
        for axis in document["axes"].values()
        for one in counted(axis["errors"], [(each["source"] not in own, each["verdict"]) for each in axis["errors"]])
    ]
    worst = max(deciding, key=lambda one: one[one["limit_of"]] / one["limit_m"] if one["limit_m"] else np.inf)
    several = {"axis": len(document["axes"]), "record": len({one["source"] for one in deciding})}
    among = [what for what, count in several.items() if count > 1]
    where = f" on the worst {' and '.join(among)}" if among else ""
    limit = f"{where} (limit {length(worst['limit_m'])})"
    if worst["limit_of"] == "rms_m":
        return f"The absolute error of the model is {length(worst['rms_m'])} rms{limit}.{dependent}"
    why = "the tolerance is not for it" if document["tolerance_m"] else "no tolerance for it was given"
    return (
        f"The error of the model without its offset is {length(worst['rest_rms_m'])} rms{limit}; the absolute "
        f"error is {length(max(one['rms_m'] for one in deciding))}: {why}.{dependent}"
    )


def _show_axis(page: Page, name: str, axis: dict[str, Any]) -> None:
    page.heading(f"Axis {name}", name)
    page.verdict(
        name,
        f"{axis['kind']}; {'; '.join(axis['effects']) or 'no effects'}",
        SEVERITY[axis["verdict"]],
        axis["verdict"],
    )
    (low, high), (v_low, v_high) = axis["displacement_range_m"], axis["voltage_range_V"]
    page.tiles(
        {
            "range, µm": f"{low * 1e6:.4g} to {high * 1e6:.4g}",
            "range, V": f"{v_low:.4g} to {v_high:.4g}",
            "error, rms": length(axis["rms_m"]),
            "at most": length(axis["maximum_m"]),
            "without offset, rms": length(axis["rest_rms_m"]),
            "without offset, at most": length(axis["rest_maximum_m"]),
        }
    )
    page.section("Errors")
    header = "record", "", "judged", "rms", "max", "offset", "rms without", "max without", "limit", "within 2 u"
    rows = [
        (
            str(number), one["verdict"], f"{one['samples']:,} ({one['share']:.0%})", _nm(one["rms_m"]),
            _nm(one["maximum_m"]), f"{one['constant_m'] * 1e9:+z.1f}", _nm(one["rest_rms_m"]),
            _nm(one["rest_maximum_m"]), _nm(one["limit_m"]),
            "not known" if one["within_expanded"] is None else f"{one['within_expanded']:.1%}",
        )
        for number, one in enumerate(axis["errors"], 1)
    ]  # fmt: skip
    judged = "rms" if axis["errors"][0]["limit_of"] == "rms_m" else "rms without"
    offset = "with" if judged == "rms" else "without"
    page.table(
        header,
        rows,
        caption=f"Errors in nm, with the offset and without it. The limit holds for '{judged}'. Within 2 u: share of "
        f"the judged samples whose error {offset} the offset is within twice the combined standard uncertainty u, the "
        "noise of the sensor included.",
    )
    page.lines([f"record {k}: {remark}" for k, one in enumerate(axis["errors"], 1) for remark in one["remarks"]])
    page.section("Budget of uncertainty")
    if axis["uncertainty"] is None:
        page.text(f"Not known: {axis['uncertainty_unknown']}.")
        return
    _show_budget(page, axis["uncertainty"])


def _show_budget(page: Page, uncertainty: dict[str, Any]) -> None:
    budget = uncertainty["budget"]
    middle = budget[len(PLACES) // 2 :: len(PLACES)]
    rows: list[Sequence[str] | str] = [
        (name, what, *(f"{one[f'{name}_m'] * 1e9:.1f}" for one in middle))
        for name, what in (
            *COMPONENTS.items(),
            ("combined", "root of the sum of the squares"),
            ("expanded", f"combined, with the coverage factor {COVERAGE_FACTOR:g}"),
        )
    ]
    page.table(
        ("component", "what it is", *TIMES),
        rows,
        caption="Standard uncertainty (nm) of the displacement that the model promises, at the middle of the range, by "
        "the time since the last reset or calibration. Without a reset, besides "
        f"{length(uncertainty['unknown_memory_m'])} at first, until the voltage has gone over its range."
        f"{_quantities(uncertainty)}",
    )
    places = [budget[k :: len(PLACES)] for k in range(len(PLACES))]
    page.table(
        ("displacement (µm)", *TIMES),
        [
            (f"{those[0]['displacement_m'] * 1e6:.4g}", *(f"{one['expanded_m'] * 1e9:.1f}" for one in those))
            for those in places
        ],
        caption=f"Expanded uncertainty (nm, k = {COVERAGE_FACTOR:g}) over the range.",
    )  # fmt: skip


def _quantities(uncertainty: dict[str, Any]) -> str:
    """Return what the budget takes for the quantities that the model follows; "" if it follows none."""
    values = {one["name"]: one["value"] for one in uncertainty["quantities"]}
    known = ", ".join(f"{name} {value:.4g}" for name, value in values.items() if value is not None)
    lacking = ", ".join(name for name, value in values.items() if value is None)
    told = (
        f" Quantities that the model follows are taken as known, in the middle of their range: {known}."
        if known
        else ""
    )
    told += f" Not recorded, and not known in the budget: {lacking}." if lacking else ""
    if known:
        told += f" Where none is known, 'surroundings' is {length(uncertainty['unknown_quantities_m'])} instead."
    return told


def _nm(metres: float) -> str:
    return f"{metres * 1e9:.1f}"


def _record_facts(one: dict[str, Any]) -> dict[str, str]:
    conditions = [f"{each['name']} {each['lowest']:.4g} to {each['highest']:.4g}" for each in one["surroundings"]]
    conditions += [f"{name}, which the model follows, was not recorded" for name in one["not_recorded"]]
    return {
        "bag": one["source"],
        "begins": one["begins"],
        "duration": f"{one['duration_s']:.1f} s",
        "independent": "yes" if one["independent"] else "no: the model was identified from it",
        "surroundings": ", ".join(conditions) or "none that the model follows",
        **{f"SHA-256 of {name}": digest for name, digest in one["files"].items()},
    }


def _record(record: Record, bag: str, model: StageModel, *, independent: bool) -> dict[str, Any]:
    begins, ends = int(record.time_ns[0]), int(record.time_ns[-1])
    known = {key: record.surroundings[key][1] for key in model.quantities if key in record.surroundings}
    known = {key: values for key, values in known.items() if np.isfinite(values).any()}
    return {
        "source": bag,
        "files": digests(bag),
        "begins": _date(begins),
        "duration_s": max(ends - begins, 0) * 1e-9,
        "independent": independent,
        "surroundings": [
            {"name": key, "lowest": float(np.nanmin(values)), "highest": float(np.nanmax(values))}
            for key, values in known.items()
        ],
        "not_recorded": [key for key in model.quantities if key not in known],
    }


def _model(axis: AxisModel) -> dict[str, Any]:
    return {
        "kind": axis.kind,
        "effects": [f"{effect.name}: {effect.describe()}" for effect in axis.effects],
        "voltage_range_V": list(axis.voltage_range),
        "displacement_range_m": list(axis.displacement_range),
    }


def _errors(one: RecordVerification, axis: AxisModel, age: float) -> dict[str, Any]:
    told = one.to_document()
    names = (
        "source", "verdict", "samples", "share", "rms_m", "maximum_m", "constant_m", "rest_rms_m", "rest_maximum_m",
        "limit_m", "limit_of", "repeatability_rms_m", "start",
    )  # fmt: skip
    return {
        **{name: told[name] for name in names},
        "voltage_range_V": [float(one.v.min()), float(one.v.max())],
        "within_expanded": _within(one, axis, age),
        "remarks": record_notes(one),
    }


def _within(one: RecordVerification, axis: AxisModel, age: float) -> float | None:
    """Return the share of the judged samples with an error within the expanded uncertainty; None if not known."""
    try:
        own = AxisUncertainty(axis, known_memory=one.begins_known)
    except SlpiError:
        return None
    courses = {key: np.interp(one.t, *course) for key, course in axis.surroundings.items()}
    spread = own.budget(one.t, one.model, one.v, age, courses).combined
    # What is read is the stage and the noise of its sensor.
    allowed = COVERAGE_FACTOR * np.hypot(spread, axis.quality.floor_rms)[one.judged]
    error = one.left + (one.constant if one.absolute else 0.0)
    return float(np.mean(np.abs(error) <= allowed))


def _age(model: StageModel, record: Record) -> float:
    """Return the time (s) from the identification of a model to a record; 0 if it is not known."""
    return max(seconds_since(model.created, int(record.time_ns[0]) * 1e-9) or 0.0, 0.0)


def _middles(records: Sequence[Record], model: StageModel) -> dict[str, float]:
    """Return the quantities that a model follows and the records hold, each in the middle of its range in them."""
    found = {}
    for key in model.quantities:
        values = [record.surroundings[key][1] for record in records if key in record.surroundings]
        known = [value[np.isfinite(value)] for value in values]
        if any(value.size for value in known):
            both = np.concatenate(known)
            found[key] = float(both.min() + both.max()) / 2.0
    return found


def _uncertainty(axis: AxisModel, known: Mapping[str, float]) -> dict[str, Any]:
    try:
        return {"uncertainty": uncertainty_document(axis, known), "uncertainty_unknown": ""}
    except SlpiError as error:
        return {"uncertainty": None, "uncertainty_unknown": str(error)}


def _date(time_ns: int) -> str:
    try:
        return datetime.fromtimestamp(time_ns // 10**9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
