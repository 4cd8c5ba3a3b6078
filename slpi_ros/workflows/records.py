"""Reading of the records of a request, and the decision whether they can be used."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

from slpi_ros.errors import IdentificationError, ModelError, RecordError, SlpiError, UsageError
from slpi_ros.identification.record_quality import Finding, assess, findings, require_usable
from slpi_ros.io.alignment import SeparateTopics
from slpi_ros.io.bag_reader import read_bag, require_different, require_one_stage
from slpi_ros.io.record import Record
from slpi_ros.io.surroundings import named_in
from slpi_ros.model.sensor import IDEAL, Sensor, corrected
from slpi_ros.model.stage_model import StageModel

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

    def read(self, *, coupled: bool = False) -> tuple[Record, ...]:
        """Return the records; with `coupled`, also axes that are not in use, which may couple into the others."""
        if self.records:
            return tuple(_with_chosen(record, self.surroundings) for record in self.records)
        records = tuple(self._read(str(bag), coupled) for bag in require_different(self.bags))
        require_one_stage(records)
        return records

    def _read(self, bag: str, coupled: bool) -> Record:
        # Separate topics may not name their axes; their names are then those of the request.
        if not coupled or (self.axes and isinstance(self.topic, SeparateTopics)):
            return read_bag(bag, self.topic, axes=self.axes, surroundings=self.surroundings)
        try:
            return read_bag(bag, self.topic, surroundings=self.surroundings)
        except RecordError:
            if not self.axes:
                raise
            return read_bag(bag, self.topic, axes=self.axes, surroundings=self.surroundings)

    def for_model(self, model: StageModel) -> "Source":
        """Return the source with the quantities that a model follows, if any, unless others are named."""
        return self if self.surroundings is not None or model.quantities else replace(self, surroundings=())


def _with_chosen(record: Record, chosen: Sequence[str] | None) -> Record:
    """Return a record with the chosen quantities only; RecordError if it lacks one."""
    if chosen is None or not (chosen or record.surroundings):
        return record
    for text in chosen:
        if not named_in(record.surroundings, [text]):
            held = ", ".join(record.surroundings) or "none"
            raise RecordError(f"{record.source}: no quantity '{text}'; it holds {held}; name one of them (--with)")
    return replace(record, surroundings=named_in(record.surroundings, chosen))


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
            refused[axis] = UnusableRecordError(str(error), found) if axis in found else error
    return Assessment(found, refused)


def _sensed(record: Record, axis: str, sensor: Sensor) -> Record:
    """Return the record without delay and lag of the sensor, and without its end, which a late one has not told yet."""
    if not sensor:
        return record
    ends_ns = record.time_ns[-1:] - round(sensor.delay * 1e9)
    told = slice(int((record.time_ns <= ends_ns).sum()))
    return corrected(record, {axis: sensor.undo}).part(told)


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
