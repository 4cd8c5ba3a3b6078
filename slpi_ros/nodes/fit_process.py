"""One identification in a process of its own, so that the node that asked for it stays awake."""

import json
import multiprocessing
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection

from slpi_ros.bags import read_bag
from slpi_ros.errors import SlpiError
from slpi_ros.identification.fit import identify
from slpi_ros.model_file import format_model, save_model


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


class FitProcess:
    """An identification under way."""

    def __init__(self, request: FitRequest) -> None:
        self.request = request
        # No fork: the threads of the middleware would not survive it.
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=work, args=(sender, request), daemon=True)
        # Ctrl-C reaches the whole group of processes; it is for this one to end the other.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        sender.close()

    def outcome(self) -> FitOutcome | None:
        """Return what came of it, or None while it is under way; never waits for it."""
        if not self._receiver.poll():
            return None
        try:
            outcome = FitOutcome(**json.loads(self._receiver.recv_bytes()))
        except EOFError:
            self._process.join()
            outcome = FitOutcome(
                error=f"{self.request.source}: the identification ended with exit code {self._process.exitcode} "
                "and no result; look for a lack of memory, or try a shorter part of the record"
            )
        self.end()
        return outcome

    def end(self) -> None:
        """End it, done or not."""
        self._process.kill()
        self._process.join()
        self._receiver.close()


def work(sender: Connection, request: FitRequest) -> None:
    """Send the outcome of a request: what the process does."""
    sender.send_bytes(json.dumps(vars(fit(request))).encode())


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
