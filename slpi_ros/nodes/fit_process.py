"""One identification in a process of its own."""

from dataclasses import dataclass

from slpi_ros.bags import read_bag
from slpi_ros.errors import SlpiError
from slpi_ros.identification.fit import identify
from slpi_ros.model_file import format_model, save_model
from slpi_ros.nodes.worker_process import WorkerProcess


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
    """

    bags: tuple[str, ...]
    topic: str
    kind: str
    start: float | None
    stop: float | None
    output: str

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
        model = identify(records, request.kind, start=request.start, stop=request.stop)
        document = format_model(model)
        if request.output:
            save_model(model, request.output)
    except SlpiError as error:
        return FitOutcome(document, str(error))
    return FitOutcome(document)
