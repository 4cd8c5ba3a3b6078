"""What is done with one bag: examination, identification, comparison with the stage's model, search for causes."""
# Each function depends on its arguments and the files that they name only, so that a repeated or moved task gives the
# same result. No function raises: what a bag does not allow is told in its rows.

import hashlib
import json
import os
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from threadpoolctl import threadpool_limits

from slpi_ros.effects.registry import to_document
from slpi_ros.errors import SlpiError
from slpi_ros.fleet.sources import Bag
from slpi_ros.io.record import Record
from slpi_ros.io.stage_name import stage_name
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.document import load_model, save_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.reports import verification as verification_page
from slpi_ros.verification.verify import Verification
from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose
from slpi_ros.workflows.identify import IdentifyRequest, identify
from slpi_ros.workflows.records import Source, assess_record
from slpi_ros.workflows.refit import RefitRequest, refit
from slpi_ros.workflows.verify import VerifyRequest, verify

# Verdicts of a row. REFUSED: no number can be given; IDENTIFIED: its model is the stage's reference; PASSED: the
# reference describes the record within the limit; CHANGED: it does so after changes of gain, loop width or zero;
# FOREIGN: the model of another stage describes the record; FAILED: none of these.
REFUSED, IDENTIFIED, PASSED, CHANGED, FOREIGN, FAILED = (
    "refused", "identified", "passed", "changed", "foreign", "failed",
)  # fmt: skip
# The model of another stage describes a record if its error is within its limit, and this share of that of the own one.
MUCH_BETTER = 0.5
# Number of models of other stages, those with the most similar loops, that are compared with a record.
CANDIDATES = 5
# Longest name of a stage as a file name, characters; file systems take 255 with the suffix.
_LONGEST_PLAIN = 200


@dataclass(frozen=True)
class Row:
    """One row of the results, see ``msg_schemas/README.md``: an axis of a bag, or a bag that cannot be used."""

    bag: str
    stage: str = ""
    axis: str = ""
    verdict: str = REFUSED
    error: str = ""
    date_ns: int | None = None
    hardware_id: str = ""
    samples: int | None = None
    gain_m_per_v: float | None = None
    gain_change: float | None = None
    gain_uncertainty: float | None = None
    loop_width_m: float | None = None
    width_change: float | None = None
    width_uncertainty: float | None = None
    offset_m: float | None = None
    offset_uncertainty_m: float | None = None
    repeatability_rms_m: float | None = None
    held_out_rms_m: float | None = None
    explained_rms_m: float | None = None
    limit_rms_m: float | None = None
    refitted_rms_m: float | None = None
    like_stage: str = ""
    diagnosis: str = ""
    causes: tuple[Mapping[str, Any], ...] = ()
    findings: tuple[str, ...] = ()
    model: str = ""
    page: str = ""
    seconds: float = 0.0

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "Row":
        """Return the row of a line of the journal, written with `asdict`."""
        return cls(**{**document, "causes": tuple(document["causes"]), "findings": tuple(document["findings"])})


@dataclass(frozen=True)
class Examined:
    """What is known of a bag without a model."""

    bag: Bag
    stage: str  # in the list, else the bag's hardware id, else ""
    hardware_id: str = ""
    date_ns: int | None = None  # first stamp, Unix time; None: cannot be read
    axes: tuple[str, ...] = ()  # that can be used
    findings: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # on the quality of the record, but "ok"
    refused: Mapping[str, str] = field(default_factory=dict)  # reasons by axis; "": the whole bag
    seconds: float = 0.0  # computing time

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "Examined":
        """Return the examination of a line of the journal, written with `asdict`."""
        told = {axis: tuple(texts) for axis, texts in document["findings"].items()}
        read = {"bag": Bag(**document["bag"]), "axes": tuple(document["axes"]), "findings": told}
        return cls(**{**document, **read})

    def rows(self) -> list[Row]:
        """Return the rows of the axes that cannot be used."""
        return [replace(self.row(axis), error=reason) for axis, reason in self.refused.items()]

    def row(self, axis: str) -> Row:
        """Return a row of this bag without numbers."""
        return Row(
            bag=self.bag.path,
            stage=self.stage,
            axis=axis,
            date_ns=self.date_ns,
            hardware_id=self.hardware_id,
            findings=self.findings.get(axis, ()),
        )


@dataclass(frozen=True)
class Judged:
    """Rows of one bag, and whether its error is still to be explained by `explain`."""

    rows: tuple[Row, ...]
    unexplained: bool = False
    model: str = ""


def examine(bag: Bag, reading: Source) -> Examined:
    """Read a bag and assess the quality of its record; `reading` names topics, and this bag is its only one."""
    began = time.process_time()
    try:
        with _quiet():
            source = replace(reading, bags=(bag.path,), surroundings=())
            (record,) = source.read()
            assessed = assess_record(record, source)
    except Exception as error:
        return Examined(bag, bag.stage, refused={"": _reason(error)}, seconds=time.process_time() - began)
    return Examined(
        bag,
        stage_name(bag.stage or record.hardware_id),
        record.hardware_id,
        int(record.time_ns[0]),
        tuple(axis for axis in record.axes if axis not in assessed.refused),
        {
            axis: tuple(f"{one.level}: {one.text}" for one in found if one.level != "ok")
            for axis, found in assessed.findings.items()
        },
        {axis: str(error) for axis, error in assessed.refused.items()},
        time.process_time() - began,
    )


def identify_bag(one: Examined, reading: Source, output: str, name: str) -> Judged:
    """Identify the reference model of a stage from a bag, and write it to the file `name` in the folder `output`."""
    began = time.process_time()
    rows, axes = [], {}
    try:
        with _quiet():
            (record,) = replace(reading, bags=(one.bag.path,), surroundings=reading.surroundings or ()).read()
            for axis in one.axes:
                try:
                    source = replace(_examined(record, (axis,)), surroundings=reading.surroundings)
                    axes[axis] = identify(IdentifyRequest(source)).model.axes[axis]
                except SlpiError as error:
                    rows.append(replace(one.row(axis), error=str(error)))
            if axes:
                model = StageModel(axes, one.stage, datetime.now(UTC).isoformat(timespec="seconds"))
                found = _verification(_of_stage(record, one.stage), model, tuple(axes))
                rows += [_identified(one, axis, found, axes[axis], name) for axis in axes]
                path = Path(output, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                save_model(model, path)
    except Exception as error:
        return Judged(_refused(one, error, began))
    unexplained = any(_beyond(row.held_out_rms_m, row.limit_rms_m) for row in rows)
    return Judged(_timed(rows, one, began), unexplained, name if axes else "")


def compare(one: Examined, reading: Source, output: str, reference: str, name: str) -> Judged:
    """Verify the stage's model `reference` on a bag, and write a refitted one, `name`, where it is beyond the limit."""
    began = time.process_time()
    try:
        with _quiet():
            record = _read(one, reading)
            model = _model(output, reference)
            shared = [axis for axis in one.axes if axis in model.axes]
            rows = [
                replace(one.row(axis), error=f"the stage's model {reference} has no axis '{axis}'")
                for axis in one.axes
                if axis not in model.axes
            ]
            verified = _verification(record, model, shared) if shared else None
            for axis in shared:
                assert verified is not None
                rows.append(_verified(one, axis, verified, model.axes[axis], reference))
            if verified and not verified.passed:
                folder = str(Path("bags", _file_name(one)))
                verification_page.write_files(Path(output, folder), verified)
                rows = [replace(row, page=f"{folder}/{verification_page.FILES[1]}") for row in rows]
                if not any(row.verdict == FAILED for row in rows):
                    rows = _refitted(rows, record, model, output, name)
    except Exception as error:
        return Judged(_refused(one, error, began))
    return Judged(_timed(rows, one, began), any(row.verdict == FAILED for row in rows))


def explain(
    one: Examined,
    rows: Sequence[Row],
    reading: Source,
    output: str,
    reference: str,
    name: str,
    others: Mapping[str, str],
    diagnosed: bool,
) -> Judged:
    """Explain the error of a bag that neither the reference model nor a changed gain, width or zero describes."""
    # `others` are the paths of the reference models of all other stages. If `diagnosed`, a diagnosis names the causes
    # if none of these describes the record.
    began = time.process_time()
    told = []
    try:
        with _quiet():
            record = _read(one, reading)
            for row in rows:
                told.append(_like_another(row, record, others, output) if row.verdict == FAILED else row)
            model = _model(output, reference)
            if any(row.verdict == FAILED for row in told) and not any(row.verdict == FOREIGN for row in told):
                told = _refitted(told, record, model, output, name)
            if diagnosed:
                beyond = {FAILED, IDENTIFIED}
                told = [
                    _diagnosed(row, record, model) if row.verdict in beyond and _unexplained(row) else row
                    for row in told
                ]
    except Exception as error:
        told = [replace(row, error=row.error or _reason(error)) for row in rows]
    seconds = (time.process_time() - began) / max(len(told), 1)
    return Judged(tuple(replace(row, seconds=row.seconds + seconds) for row in told))


def given_up(one: Examined, reason: str) -> Judged:
    """Return the rows of a bag that could not be processed."""
    return Judged((*(replace(one.row(axis), error=reason) for axis in one.axes), *one.rows()))


def _file_name(one: Examined) -> str:
    """Return a name for the files of a bag, unique by its date and path."""
    return f"{plain_name(one.stage)}/{one.date_ns}-{hashlib.sha256(os.fsencode(one.bag.path)).hexdigest()[:8]}"


def model_name(one: Examined) -> str:
    """Return the path of the model of a bag within the folder of the results."""
    return f"models/{_file_name(one)}.json"


def plain_name(stage: str) -> str:
    """Return the name of a stage as a file name; different names differ, also where they are too long for a file."""
    name = quote(stage, safe=" ").replace(".", "%2E")
    if len(name) > _LONGEST_PLAIN:
        digest = hashlib.sha256(name.encode()).hexdigest()[:16]
        name = f"{name[: _LONGEST_PLAIN - len(digest) - 1]}-{digest}"
    return name or "unnamed"


def _read(one: Examined, reading: Source) -> Record:
    """Return the record of a bag, under the name of its stage."""
    return _of_stage(replace(reading, bags=(one.bag.path,)).read()[0], one.stage)


def _verification(record: Record, model: StageModel, axes: Sequence[str]) -> Verification:
    return verify(VerifyRequest(_examined(record, axes), model)).verification


def _examined(record: Record, axes: Sequence[str]) -> Source:
    """Return axes of a record that `examine` has found usable."""
    return Source(records=(record,), axes=axes, assessed=True)


def _of_stage(record: Record, stage: str) -> Record:
    """Return the record under the name of its stage, which a list may give."""
    return replace(record, hardware_id=stage)


@cache
def _read_model(path: str, modified: int) -> StageModel:
    return load_model(path)


def _model(output: str, name: str) -> StageModel:
    path = Path(output, name)
    return _read_model(str(path), path.stat().st_mtime_ns)


def _identified(one: Examined, axis: str, found: Verification, model: AxisModel, name: str) -> Row:
    """Return the row of a bag from which the reference is identified; its changes are zero by definition."""
    row = _measured(one, axis, found, model)
    held_out = model.quality.held_out_rms
    return replace(row, verdict=IDENTIFIED, held_out_rms_m=held_out, explained_rms_m=held_out, model=name)


def _verified(one: Examined, axis: str, found: Verification, model: AxisModel, name: str) -> Row:
    row = _measured(one, axis, found, model)
    judged = found.axes[axis].records[0]
    verdict = PASSED if judged.passed else FAILED if _unexplained(row) else CHANGED
    return replace(row, verdict=verdict, model=name)


def _measured(one: Examined, axis: str, found: Verification, model: AxisModel) -> Row:
    """Return a row with the figures of a verification."""
    judged = found.axes[axis].records[0]
    match, (height, width) = judged.match, _outermost_loop(model)
    low, high = model.voltage_range
    gain, widened = 1.0 + match.gain_change, match.width_change
    return replace(
        one.row(axis),
        samples=judged.error.samples,
        gain_m_per_v=height / (high - low) * gain,
        gain_change=match.gain_change,
        gain_uncertainty=_finite(match.gain_uncertainty),
        loop_width_m=width * (gain + widened),
        width_change=widened,
        width_uncertainty=_finite(match.width_uncertainty),
        offset_m=judged.offset,
        offset_uncertainty_m=_finite(judged.offset_uncertainty),
        repeatability_rms_m=judged.repeatability_rms,
        held_out_rms_m=judged.rest.rms,
        explained_rms_m=min(match.rms_explained, judged.rest.rms),
        limit_rms_m=judged.limit,
    )


def _outermost_loop(model: AxisModel) -> tuple[float, float]:
    """Return height and width at the middle voltage (m) of the loop over the identified voltage range."""
    low, high = model.voltage_range
    ramp = np.linspace(low, high, 101)
    path = np.concatenate([[high], ramp, ramp[::-1]])
    y = model.hysteresis_only.simulate(np.zeros(path.size), path)[1:]
    rise, fall = y[: ramp.size], y[ramp.size :][::-1]
    return float(rise[-1] - rise[0]), float((fall - rise)[ramp.size // 2])


def _unexplained(row: Row) -> bool:
    """Return whether the error is beyond the limit even with changes of gain, width, zero, lag and a linear drift."""
    return _beyond(row.explained_rms_m, row.limit_rms_m)


def _beyond(error: float | None, limit: float | None) -> bool:
    return error is not None and limit is not None and error > limit


def _refitted(rows: Sequence[Row], record: Record, model: StageModel, output: str, name: str) -> list[Row]:
    """Refit the reference to a record; write the model, and note error and reason of a refusal in the rows."""
    try:
        axes = [row.axis for row in rows if row.axis in model.axes]
        found = refit(RefitRequest(_examined(record, axes), model))
    except SlpiError as error:
        return [replace(row, error=row.error or str(error)) for row in rows]
    path = Path(output, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(found.model, path)
    changes = found.steps[-1].changes
    return [
        replace(row, refitted_rms_m=changes[row.axis].error_after, model=name) if row.axis in changes else row
        for row in rows
    ]


def _like_another(row: Row, record: Record, others: Mapping[str, str], output: str) -> Row:
    """Compare a record with the models of other stages; return a row that names the stage that it belongs to."""
    axis = row.axis
    known = np.isfinite(record.voltage[axis]) & np.isfinite(record.displacement[axis])
    t, v, y = record.t[known], record.voltage[axis][known], record.displacement[axis][known]
    errors = {}
    for stage, name in others.items():
        model = _model(output, name).axes.get(axis)
        if model is not None and model.causal:
            off = y - model.simulate(t, v)
            errors[stage] = float(np.sqrt(np.mean((off - np.median(off)) ** 2)))
    for stage in sorted(errors, key=lambda stage: (errors[stage], stage))[:CANDIDATES]:
        found = _verification(_of_stage(record, stage), _model(output, others[stage]), [axis])
        match = found.axes[axis].records[0].match
        limit = found.axes[axis].records[0].limit
        if match.rms_explained <= limit and match.rms_explained <= MUCH_BETTER * (row.explained_rms_m or np.inf):
            return replace(row, verdict=FOREIGN, like_stage=stage)
    return row


def _diagnosed(row: Row, record: Record, model: StageModel) -> Row:
    """Return the row with the causes that a diagnosis names."""
    try:
        request = DiagnoseRequest(_examined(record, (row.axis,)), model)
        found = diagnose(request).diagnosis.axes[row.axis]
    except SlpiError as error:
        return replace(row, error=row.error or f"no diagnosis: {error}")
    causes = tuple(
        {
            "name": named.effect.name,
            "parameters": json.dumps(to_document(named.effect)["parameters"]),
            "gain_percent": named.gain_percent,
            "share_of_residual": named.share_of_residual,
            "p_value": named.p_value,
        }
        for named in found.effects
    )
    return replace(row, diagnosis=found.verdict, causes=causes)


def _refused(one: Examined, error: Exception, began: float) -> tuple[Row, ...]:
    return _timed([replace(one.row(axis), error=_reason(error)) for axis in one.axes], one, began)


def _timed(rows: Sequence[Row], one: Examined, began: float) -> tuple[Row, ...]:
    """Return the rows of all axes, with the computing time in equal shares."""
    every = sorted([*rows, *one.rows()], key=lambda row: row.axis)
    seconds = (one.seconds + time.process_time() - began) / max(len(every), 1)
    return tuple(replace(row, seconds=seconds) for row in every)


def _reason(error: Exception) -> str:
    """Return the message of an error on one line, with its type if it is none of this package."""
    text = " ".join(str(error).split())
    return text if isinstance(error, SlpiError) else f"{type(error).__name__}: {text}; report this bag as a defect"


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings, and use one thread of the numerical libraries, within a ``with`` block."""
    with warnings.catch_warnings(action="ignore"), threadpool_limits(1):
        yield
