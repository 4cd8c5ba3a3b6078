"""Long work in a process of its own, so that the node that asked for it stays awake."""

import json
import multiprocessing
import signal
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

Request = TypeVar("Request")
Outcome = TypeVar("Outcome")


class WorkerProcess(Generic[Request, Outcome]):
    """Work under way.

    Parameters
    ----------
    work : callable
        Makes the outcome of the request; a function of a module.
    request : object
    outcome : type
        A dataclass of plain values. Made with `error` alone where the process ends without a result.
    what : str
        What is done, for that error.
    """

    def __init__(
        self, work: Callable[[Request], Outcome], request: Request, outcome: Callable[..., Outcome], what: str
    ) -> None:
        self.request = request
        self._make, self._what = outcome, what
        # No fork: the threads of the middleware would not survive it.
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_run, args=(sender, work, request), daemon=True)
        # Ctrl-C reaches the whole group of processes; it is for this one to end the other.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        sender.close()

    def outcome(self) -> Outcome | None:
        """Return what came of it, or None while it is under way; never waits for it."""
        if not self._receiver.poll():
            return None
        try:
            outcome = self._make(**json.loads(self._receiver.recv_bytes()))
        except EOFError:
            self._process.join()
            outcome = self._make(
                error=f"{self._what} ended with exit code {self._process.exitcode} and no result; look for a lack of "
                "memory, or try a shorter record"
            )
        self.end()
        return outcome

    def end(self) -> None:
        """End it, done or not."""
        self._process.kill()
        self._process.join()
        self._receiver.close()


def _run(sender: Connection, work: Callable[[Any], Any], request: Any) -> None:
    """Send the outcome of a request: what the process does."""
    sender.send_bytes(json.dumps(asdict(work(request))).encode())
