"""A Dask cluster of separate processes from the command line, restarted when they end, as a service manager does."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

DASK = str(Path(sys.executable).parent / "dask")
CHECKOUT = str(Path(__file__).resolve().parents[2])


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class DaskProcesses:
    """``dask scheduler`` and ``dask worker``, by address; `kill` ends one of them, and it is started anew."""

    def __init__(self, folder, workers=2):
        port = free_port()
        self.address = f"tcp://127.0.0.1:{port}"
        worker = [DASK, "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        worker += ["--local-directory", str(folder), "--death-timeout", "20"]
        scheduler = [DASK, "scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", "--no-show"]
        self._commands = [scheduler, *[worker] * workers]
        self._environment = os.environ | {"PYTHONPATH": CHECKOUT, "OMP_NUM_THREADS": "1"}
        self._log = (Path(folder) / "dask.log").open("ab")
        self._lock, self._open = threading.Lock(), True
        self._running = [self._start(command) for command in self._commands]
        self._keeper = threading.Thread(target=self._keep)
        self._keeper.start()

    def _start(self, command):
        return subprocess.Popen(
            command, env=self._environment, stdout=self._log, stderr=self._log, stdin=subprocess.DEVNULL
        )

    def _keep(self):
        while self._open:
            with self._lock:
                for place, process in enumerate(self._running):
                    if process.poll() is not None and self._open:
                        self._running[place] = self._start(self._commands[place])
            time.sleep(0.2)

    def kill(self, place):
        """Kill the scheduler (0) or a worker (1, 2, ...)."""
        with self._lock:
            self._running[place].send_signal(signal.SIGKILL)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._open = False
        self._keeper.join()
        for process in reversed(self._running):
            process.kill()
            process.wait()
        self._log.close()
