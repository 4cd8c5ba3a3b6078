"""One diagnosis in a process of its own."""

from dataclasses import dataclass, field
from pathlib import Path

from slpi_ros.diagnosis.diagnose import diagnose
from slpi_ros.errors import SlpiError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.model.document import parse_model
from slpi_ros.nodes.worker_process import WorkerProcess


@dataclass(frozen=True)
class DiagnosisRequest:
    """What to diagnose.

    Parameters
    ----------
    bag, topic : str
    document : str
        The model's.
    folder : str
        Of the files to be written.
    """

    bag: str
    topic: str
    document: str
    folder: str


@dataclass(frozen=True)
class DiagnosisOutcome:
    """What came of it: of each axis the verdict and a summary, or an error."""

    verdicts: dict[str, str] = field(default_factory=dict)
    summaries: dict[str, str] = field(default_factory=dict)
    error: str = ""


class DiagnosisProcess(WorkerProcess[DiagnosisRequest, DiagnosisOutcome]):
    """A diagnosis under way."""

    def __init__(self, request: DiagnosisRequest) -> None:
        super().__init__(judge, request, DiagnosisOutcome, f"{request.bag}: the diagnosis")


def judge(request: DiagnosisRequest) -> DiagnosisOutcome:
    """Read the bag, diagnose the model and write the files."""
    # Plotting is slow to load, and a node that only identifies does without.
    from slpi_ros.reports.diagnosis_files import make_room, write_files

    folder = Path(request.folder)
    try:
        make_room(folder)
        diagnosis = diagnose(read_bag(request.bag, request.topic), parse_model(request.document, "stage_model"))
        write_files(folder, diagnosis)
    except SlpiError as error:
        return DiagnosisOutcome(error=str(error))
    return DiagnosisOutcome(
        {axis: found.verdict for axis, found in diagnosis.axes.items()},
        {axis: found.summary for axis, found in diagnosis.axes.items()},
    )
