"""Programs of the package as processes of their own that are forked where their modules have been imported before.

A start takes as long as its imports, a second of computing and more, and the tests start hundreds of programs. A forked
process has an environment, a folder, a session, outputs and an exit code of its own, as one from a shell has.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import get_context

NODES = (
    "calibrator", "compensator", "device_simulator", "driver", "exciter", "identify", "recorder", "stage_simulator",
)  # fmt: skip
_FORKS = get_context("forkserver")
_FORKS.set_forkserver_preload(
    ["forked", "slpi_ros", "slpi_ros.cli", *(f"slpi_ros.nodes.{name}" for name in (*NODES, "common", "help"))]
)


def _run(program: str, arguments: list[str], environment: dict[str, str], folder: str, outputs: list[str]) -> None:
    """Become the program ``module:function``; outputs 1 and 2 go to files."""
    os.setsid()
    for number, path in enumerate(outputs, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    module, _, function = program.partition(":")
    sys.argv = [function, *arguments]
    sys.exit(getattr(import_module(module), function)())


class Forked:
    """A program ``module:function`` as a process; what of `subprocess.Popen` the tests use."""

    def __init__(self, program: str, arguments: Sequence[str], output: str = os.devnull, errors: str = os.devnull):
        given = (program, list(arguments), dict(os.environ), os.getcwd(), [output, errors])
        self._process = _FORKS.Process(target=_run, args=given)
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid
        # From then on it is a session, and can be signalled as one.
        while self.poll() is None and os.getpgid(self.pid) != self.pid:
            time.sleep(1e-3)

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        """The exit code, or None while it runs."""
        return self.poll()

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit code."""
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Signal the process alone."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it."""
        if self.poll() is None:
            self._process.kill()


def completed(program: str, arguments: Sequence[str], timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Run a program to its end; return its exit code, and what it said."""
    with tempfile.NamedTemporaryFile("r") as output, tempfile.NamedTemporaryFile("r") as errors:
        process = Forked(program, arguments, output.name, errors.name)
        try:
            code = process.wait(timeout)
        finally:
            process.kill()
        return subprocess.CompletedProcess([program, *arguments], code, output.read(), errors.read())
