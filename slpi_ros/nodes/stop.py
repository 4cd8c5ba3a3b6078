"""Request to stop the node of this process, by a signal or by an error."""

import signal
import threading

TYPE_CHECKING = False
if TYPE_CHECKING:
    from slpi_ros.errors import SlpiError

# Ctrl-C often arrives twice (terminal and launcher), so only the third signal interrupts an orderly shutdown.
PATIENT_SIGNALS = 2
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


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


def listening() -> Stop:
    """Return a stop request of this process, which `SIGNALS` are from now on; an ignored SIGHUP stays so (nohup)."""
    stop = Stop()
    # Python allows signal handlers in the main thread only. They stay until the process has ended.
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, stop.on_signal)
    return stop


# Stop request of this process, if it was started as an executable of the package.
of_process: Stop | None = None
