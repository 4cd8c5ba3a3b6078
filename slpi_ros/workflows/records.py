"""Reading of the records of a request, and the decision whether they can be used."""

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slpi_ros.diagnosis.prepare import no_cause, uncovered
from slpi_ros.errors import IdentificationError, ModelError, RecordError, SlpiError, UsageError
from slpi_ros.identification.held_readings import from_fresh
from slpi_ros.identification.record_quality import Finding, assess, findings, require_usable
from slpi_ros.identification.samples import FEWEST, ends_of
from slpi_ros.identification.signal_statistics import noise
from slpi_ros.io.alignment import SeparateTopics
from slpi_ros.io.bag_files import locate
from slpi_ros.io.bag_reader import read_bag, require_different, require_one_stage
from slpi_ros.io.digests import record_digest
from slpi_ros.io.record import OUT_OF_ORDER, Course, Record, first_step_back
from slpi_ros.io.stage_name import same_stage
from slpi_ros.io.surroundings import clean, named_in
from slpi_ros.io.unfinished_bags import place_of
from slpi_ros.model.axis_model import FitQuality, FittedRecord
from slpi_ros.model.sensor import IDEAL, Sensor, corrected
from slpi_ros.model.stage_model import StageModel

# In a session a record begins at the voltage at which the one before it ended, within this share of their range and
# this many times the noise of the voltage.
MEETS, MEETS_NOISE = 0.01, 6.0
# Findings on a record by axis.
Findings = Mapping[str, Sequence[Finding]]


class UnusableRecordError(IdentificationError):
    """The quality of a record does not allow the request; `findings` holds what was found up to the reason."""

    def __init__(self, message: str = "", found: Findings | None = None) -> None:
        super().__init__(message)
        self.findings = dict(found or {})


@dataclass(frozen=True)
class Source:
    """Records of one stage: the bags that hold them, or the records themselves."""

    bags: Sequence[str] = ()  # paths; not read if there are `records`
    topic: str | SeparateTopics = "stage_state"  # of voltage and displacement
    axes: Sequence[str] | None = None  # in use; default: all
    start: float | None = None  # s, from the first stamp of each record
    stop: float | None = None  # s
    records: Sequence[Record] = ()
    assessed: bool = False  # `assess_record` has found the axes in use usable already
    surroundings: Sequence[str] | None = None  # recorded quantities, TOPIC[:FIELD]; default: all that can be one
    accept_stage: str = ""  # name of a stage that is taken for that of the model and the other records

    @property
    def span(self) -> dict[str, Any]:
        """Start and stop of the part in use, by name."""
        return {"start": self.start, "stop": self.stop}

    def read(self, *, coupled: bool = False, stage: str = "") -> tuple[Record, ...]:
        """Return the records; with `coupled`, also axes that are not in use, which may couple into the others.

        `stage` is the name that a model gives, if there is one.
        """
        # In every command a wrong call, before anything is read.
        ends_of(self.start, self.stop)
        if self.records:
            return tuple(_with_chosen(record, self.surroundings) for record in self.records)
        records = tuple(self._ordered(self.read_bag(str(bag), coupled=coupled)) for bag in require_different(self.bags))
        if self.accept_stage:
            names = (record.hardware_id for record in records)
            others = (name for name in names if name and not same_stage(name, self.accept_stage))
            this = stage or next(others, self.accept_stage)
            records = tuple(
                replace(record, hardware_id=this) if same_stage(record.hardware_id, this, self.accept_stage) else record
                for record in records
            )
        require_one_stage(records)
        return records

    def read_bag(self, bag: str, *, coupled: bool) -> Record:
        """Return the record of a bag, as of `read`."""

        def read(axes: Sequence[str] | None) -> Record:
            return read_bag(bag, self.topic, axes=axes, surroundings=self.surroundings, accept_stage=self.accept_stage)

        # Separate topics may not name their axes; their names are then those of the request.
        if not coupled or (self.axes and isinstance(self.topic, SeparateTopics)):
            return read(self.axes)
        try:
            return read(None)
        except RecordError:
            if not self.axes:
                raise
            return read(self.axes)

    def _ordered(self, record: Record) -> Record:
        """Return a record without what comes after stamps that go back, where `stop` leaves it out anyway."""
        if self.stop is None:
            return record
        at = first_step_back(record.time_ns)
        if at is None or (int(record.time_ns[at - 1]) - int(record.time_ns[0])) * 1e-9 < self.stop:
            return record
        return record.part(slice(at))

    def for_model(self, model: StageModel) -> "Source":
        """Return the source with the quantities that a model follows, if any, unless others are named."""
        return self if self.surroundings is not None or model.quantities else replace(self, surroundings=())


def in_session(records: Sequence[Record]) -> tuple[Record, ...]:
    """Return records of one session, in which nothing else has moved the stage, each with those before it.

    UsageError if they overlap in time, or one begins at another voltage than that at which the one before it ended.
    """
    ordered = tuple(sorted(records, key=lambda record: int(record.time_ns[0])))
    for earlier, record in pairwise(ordered):
        if int(record.time_ns[0]) <= int(earlier.time_ns.max()):
            both = f"{earlier.source} and {record.source}"
            raise UsageError(f"{both} overlap in time: they are not of one session; leave out --session")
    for axis in ordered[0].axes:
        _require_meeting([record for record in ordered if axis in record.axes], axis)
    return tuple(replace(record, before=ordered[:number]) for number, record in enumerate(ordered))


def _require_meeting(records: Sequence[Record], axis: str) -> None:
    known = [(record.source, record.voltage[axis]) for record in records]
    ways = [(source, v[np.isfinite(v)]) for source, v in known if np.count_nonzero(np.isfinite(v)) >= FEWEST]
    span = max((float(v.max()) for _, v in ways), default=0.0) - min((float(v.min()) for _, v in ways), default=0.0)
    for (earlier, before), (source, v) in pairwise(ways):
        if abs(v[0] - before[-1]) > MEETS * span + MEETS_NOISE * max(noise(before), noise(v)):
            raise UsageError(
                f"axis '{axis}': {earlier} ends at {before[-1]:.4g} V, {source} begins at {v[0]:.4g} V: the stage has "
                "been moved between them; leave out --session"
            )


def fitted_record(record: Record, axis: str) -> FittedRecord:
    """Return by what a record is recognised from which an axis was identified."""
    key = "sha256", axis
    if key not in record.derived:
        record.derived[key] = record_digest(record, axis)
    return FittedRecord(record.source, record.derived[key])


def with_records(model: StageModel, fitted: Mapping[str, Sequence[FittedRecord]]) -> StageModel:
    """Return a model with the records from which some axes were identified; of the other axes they stay."""
    axes = dict(model.axes)
    for name, records in fitted.items():
        source = ", ".join(dict.fromkeys(record.source for record in records))
        quality = replace(axes[name].quality, source=source, records=tuple(dict.fromkeys(records)))
        axes[name] = replace(axes[name], quality=quality)
    return replace(model, axes=axes)


def with_given_names(
    model: StageModel, records: Sequence[Record], source: Source, model_file: str | None
) -> StageModel:
    """Return a model of which the records that were read from `source` have the names that they have there.

    They are recognised by their readings, wherever and however their bags are kept, and where a document does not tell
    these, by the place of their bags; those of the calibrator are beside its `model_file`. No other record of the model
    keeps the name of one of `source`.
    """
    if source.records:
        return model
    places = ["", *([] if model_file is None else [os.path.dirname(model_file)])]
    bags = [_Bag(record, str(bag), source) for bag, record in zip(source.bags, records, strict=True)]
    taken = {record.source for record in records}

    def named(fitted: FittedRecord, axis: str) -> FittedRecord:
        for bag in bags:
            if bag.is_that_of(fitted, axis, places):
                return replace(fitted, source=bag.record.source)
        return replace(fitted, source=f"{fitted.source} (earlier)") if fitted.source in taken else fitted

    def known(quality: FitQuality) -> Sequence[FittedRecord]:
        # A comma may also be of the name of a bag.
        whole = quality.records is None and any(_files_of(quality.source, at) for at in places)
        return [FittedRecord(quality.source)] if whole else quality.fitted

    return with_records(
        model, {name: [named(one, name) for one in known(axis.quality)] for name, axis in model.axes.items()}
    )


@dataclass(frozen=True)
class _Bag:
    """A bag that was read, as a record of which a model may have been identified."""

    record: Record
    path: str
    source: Source

    def is_that_of(self, fitted: FittedRecord, axis: str, places: Sequence[str]) -> bool:
        """Return whether it is that of a record of a model; `places`: folders in which its path may begin."""
        if fitted.sha256 is None:
            files = _files_of(self.path)
            return fitted.source == self.record.source or any(files & _files_of(fitted.source, at) for at in places)
        own = axis in self.record.axes and fitted_record(self.record, axis).sha256 == fitted.sha256
        return own or (axis, fitted.sha256) in self.related

    @cached_property
    def related(self) -> set[tuple[str, str | None]]:
        """Axis and SHA-256 of the whole of a split bag, if this is a part of it, or of its parts, if this is all."""
        place, found = place_of(Path(self.path)), set[tuple[str, str | None]]()
        part = place.is_file()
        whole = place.parent if part else place
        files = _files_of(str(whole)) if (whole / "metadata.yaml").is_file() else set[str]()
        if len(files) < 2 or (part and os.path.realpath(place) not in files):
            return found
        others = [str(whole)] if part else sorted(files)
        for other in others:
            with suppress(SlpiError):
                record = replace(self.source, surroundings=()).read_bag(other, coupled=True)
                found |= {(axis, fitted_record(record, axis).sha256) for axis in record.axes}
        return found


def _files_of(bag: str, folder: str = "") -> set[str]:
    """Return the files of a bag, whose path begins in a folder, without links; none if there is no bag."""
    # A name out of a document need not be one of a file.
    with suppress(SlpiError, OSError, ValueError):
        return {os.path.realpath(file) for file in locate(Path(folder, bag))} if bag else set()
    return set()


def _with_chosen(record: Record, chosen: Sequence[str] | None) -> Record:
    """Return a record with the chosen quantities only; RecordError if it lacks one."""
    if chosen is None or not (chosen or record.surroundings):
        return record
    for text in chosen:
        if not named_in(record.surroundings, [text]):
            held = ", ".join(record.surroundings) or "none"
            raise RecordError(f"{record.source}: no quantity '{text}'; it holds {held}; name one of them (--with)")
    return replace(record, surroundings=named_in(record.surroundings, chosen))


def require_causes(records: Sequence[Record], source: Source) -> None:
    """Warn of named quantities that can be no cause; RecordError if none of them can."""
    _require_named(records, source, lambda record, _, course: no_cause(record, course, *_span(record, source)))


def require_followed(records: Sequence[Record], source: Source, model: StageModel) -> None:
    """Warn of named quantities that a model does not follow, or not over the record; RecordError if it follows none."""
    follows = f"it follows {', '.join(model.quantities)}" if model.quantities else "it follows none"

    def why(_: Record, key: str, __: Course) -> str:
        return "" if key in model.quantities else f"the model does not follow it; {follows}"

    _require_named(records, source, why)
    for record in records if source.surroundings and not source.records else ():
        for key, course in record.surroundings.items():
            if key in model.quantities and (gap := uncovered(clean(course)[0], *_span(record, source))):
                warnings.warn(f"{record.source}: {key}: {gap}; beyond them the nearest one is taken", stacklevel=2)


def _require_named(records: Sequence[Record], source: Source, why_not: Callable[[Record, str, Course], str]) -> None:
    """Warn of each named quantity with a reason against it; RecordError if there is one against each of them."""
    # The records of a fleet are those of many stages, of which not each has every quantity.
    if not source.surroundings or source.records:
        return
    reasons: list[str] = []
    usable = False
    for text in source.surroundings:
        against: dict[str, str] = {}
        for record in records:
            for key, course in named_in(record.surroundings, [text]).items():
                if why := why_not(record, key, course):
                    against.setdefault(key, f"{record.source}: {key} is not used: {why}")
        usable |= any(
            named_in({key: course}, [text]) for key, course in records[0].surroundings.items() if key not in against
        )
        reasons += against.values()
    if not usable:
        raise RecordError(f"{'; '.join(reasons)}; name other quantities (--with), or none")
    for reason in reasons:
        warnings.warn(reason, stacklevel=2)


def _span(record: Record, source: Source) -> tuple[float, float]:
    """Return the time (s) of the part of a record that is in use."""
    ends = (int(record.time_ns[-1]) - int(record.time_ns[0])) * 1e-9
    begins = 0.0 if source.start is None else min(max(source.start, 0.0), ends)
    return begins, ends if source.stop is None else max(min(source.stop, ends), begins)


@dataclass(frozen=True)
class Assessment:
    """Findings on a record by axis, and the reason for each axis that cannot be used."""

    findings: Findings
    refused: Mapping[str, SlpiError]


def assess_record(record: Record, source: Source, sensors: Mapping[str, Sensor] | None = None) -> Assessment:
    """Assess the axes of a record that are in use, all by default; `sensors` are known by axis."""
    found: dict[str, Sequence[Finding]] = {}
    refused: dict[str, SlpiError] = {}
    for axis in record.axes if source.axes is None else source.axes:
        try:
            sensed = _sensed(record, axis, (sensors or {}).get(axis, IDEAL))
            found[axis] = findings(assess(sensed, axis, start=source.start, stop=source.stop))
            require_usable(found[axis], f"{record.source}: axis '{axis}'")
        except SlpiError as error:
            reason = next((note for note in record.notes if note.startswith(OUT_OF_ORDER)), "")
            said = f"{record.source}: axis '{axis}': {reason}" if reason else str(error)
            refused[axis] = UnusableRecordError(said, found) if axis in found else error
    return Assessment(found, refused)


def _sensed(record: Record, axis: str, sensor: Sensor) -> Record:
    """Return the record without delay and lag of the sensor, and without its end, which a late one has not told yet."""
    if not sensor:
        return record
    ends_ns = record.time_ns[-1:] - round(sensor.delay * 1e9)
    told = slice(int((record.time_ns <= ends_ns).sum()))
    return from_fresh(record, [axis], lambda read: corrected(read, {axis: sensor.undo}).part(told))


def shared_axes(records: Sequence[Record], model: StageModel, source: Source) -> Sequence[str]:
    """Return the axes in use; by default those that the model and every record hold."""
    return source.axes or [axis for axis in model.axes if all(axis in record.axes for record in records)]


def require_for_model(records: Sequence[Record], model: StageModel, source: Source) -> tuple[Findings, ...]:
    """Return the findings on records that a model is compared with; SlpiError if one of them cannot be used."""
    for record in records:
        for axis in source.axes or ():
            record.require_axis(axis)
            model.axis(axis)
    return require_records(records, source, {name: axis.sensor for name, axis in model.axes.items()})


def require_records(
    records: Sequence[Record], source: Source, sensors: Mapping[str, Sensor] | None = None
) -> tuple[Findings, ...]:
    """Return the findings on each record; SlpiError for the first axis that cannot be used."""
    found: list[Findings] = []
    for record in () if source.assessed else records:
        assessed = assess_record(record, source, sensors)
        for error in assessed.refused.values():
            raise error
        found.append(assessed.findings)
    return tuple(found)


@contextmanager
def mismatch_in_data() -> Iterator[None]:
    """Raise ModelError for a UsageError: records and model that do not match are found in the data, not in the call."""
    try:
        yield
    except UsageError as error:
        raise ModelError(str(error)) from None
