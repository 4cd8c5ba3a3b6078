"""Executables of the nodes: signals are handled before ROS is imported, which takes most of the time of a start."""

# Few imports: until the handlers are set, SIGINT ends the process with a traceback.
import signal
import sys
import threading
import warnings
from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from slpi_ros.errors import SlpiError

# Ctrl-C often arrives twice (terminal and launcher), so only the third signal interrupts an orderly shutdown.
PATIENT_SIGNALS = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Stop request for the running node, with the number of received signals and the error that is the reason."""

    def __init__(self) -> None:
        self.requested, self.signals = False, 0
        self.failure: SlpiError | None = None

    def on_signal(self, *_: object) -> None:
        """Request an orderly shutdown, also while the node is being created."""
        self.requested = True
        self.signals += 1
        if self.signals > PATIENT_SIGNALS:
            raise KeyboardInterrupt


# Stop request of this process, if it was started as an executable of the package.
of_process: Stop | None = None


def _executable(name: str) -> "Callable[[], int]":
    def main() -> int:
        global of_process
        of_process = Stop()
        # Python allows signal handlers in the main thread only. They stay until the process has ended.
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                signal.signal(number, of_process.on_signal)
        from slpi_ros.errors import DependencyError, dependencies_needed, shown

        # Like a line of the node's log, without the line of code that warns.
        warnings.formatwarning = lambda message, *_: f"[WARN] {shown(str(message))}\n"
        try:
            with dependencies_needed():
                return int(import_module(f"slpi_ros.nodes.{name}").main())
        except KeyboardInterrupt:
            return 0
        except DependencyError as error:
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            return error.exit_code

    main.__doc__ = f"Run the node ``{name}``; return the exit code of the process."
    return main


calibrator = _executable("calibrator")
compensator = _executable("compensator")
exciter = _executable("exciter")
identify = _executable("identify")
recorder = _executable("recorder")
stage_simulator = _executable("stage_simulator")

if __name__ == "__main__":
    # The handlers have to be those of the module that the nodes import.
    sys.exit(getattr(import_module("slpi_ros.nodes.start"), sys.argv[1])())
