"""One identification in a process of its own."""

from dataclasses import dataclass

from slpi_ros.errors import RecordError, SlpiError
from slpi_ros.identification.fit import identify
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.record import Record
from slpi_ros.model.document import format_model, save_model
from slpi_ros.model.stage_model import StageModel
from slpi_ros.nodes.worker_process import WorkerProcess


@dataclass(frozen=True)
class StageIdentity:
    """What tells a stage from others.

    Parameters
    ----------
    hardware_id : str
        "": not known.
    axes : tuple of str
    """

    hardware_id: str
    axes: tuple[str, ...]

    @classmethod
    def of(cls, model: StageModel, before: "StageIdentity | None") -> "StageIdentity":
        """Return the stage of a model; its hardware id may be known from `before`, where the model does not say."""
        return cls(model.hardware_id or (before.hardware_id if before else ""), tuple(model.axes))

    def require(self, record: Record) -> None:
        """Raise RecordError for a record of another stage."""
        other, lacking = "", [axis for axis in self.axes if axis not in record.axes]
        if lacking:
            other = f"no axis '{lacking[0]}', only {', '.join(record.axes)}"
        if record.hardware_id and self.hardware_id and record.hardware_id != self.hardware_id:
            other = f"of stage '{record.hardware_id}'"
        if other:
            name = f" of stage '{self.hardware_id}'" if self.hardware_id else ""
            raise RecordError(
                f"{record.source}: {other}, and skipped: the published model{name} holds {', '.join(self.axes)}; give "
                "each stage a node and a folder of its own, or name this bag in the parameter bags"
            )


@dataclass(frozen=True)
class FitRequest:
    """What to identify.

    Parameters
    ----------
    bags : tuple of str
        Paths; all in one fit.
    topic : str
    kind : str
        Kind of hysteresis model.
    start, stop : float or None, seconds
        Part of the record to fit.
    output : str
        File that gets the model too; "": none.
    stage : StageIdentity, optional
        The only stage whose bags are wanted; by default any.
    """

    bags: tuple[str, ...]
    topic: str
    kind: str
    start: float | None
    stop: float | None
    output: str
    stage: StageIdentity | None = None

    @property
    def source(self) -> str:
        """The bags, in words."""
        return ", ".join(self.bags)


@dataclass(frozen=True)
class FitOutcome:
    """What came of it: a model document, or an error, or both when only the file could not be written."""

    document: str = ""
    error: str = ""


class FitProcess(WorkerProcess[FitRequest, FitOutcome]):
    """An identification under way."""

    def __init__(self, request: FitRequest) -> None:
        super().__init__(fit, request, FitOutcome, f"{request.source}: the identification")


def fit(request: FitRequest) -> FitOutcome:
    """Read the bag, identify the model and write it to the file, if one is named."""
    document = ""
    try:
        records = [read_bag(bag, request.topic) for bag in request.bags]
        if request.stage:
            for record in records:
                request.stage.require(record)
        model = identify(records, request.kind, start=request.start, stop=request.stop)
        document = format_model(model)
        if request.output:
            save_model(model, request.output)
    except SlpiError as error:
        return FitOutcome(document, str(error))
    return FitOutcome(document)
