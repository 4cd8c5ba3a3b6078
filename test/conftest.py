"""What all tests share: a ROS graph of their own, the installed programs and the measured data."""

import fcntl
import os
import signal
import time
from collections.abc import Callable, Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

import hypothesis
import pytest

from benchmarks.ros_domain import OWN, keep_to_own_domain

CHECKOUT = Path(__file__).resolve().parents[1]
# The folder whose tests start nodes.
STREAM = "nodes"
# Workers that begin with them, each in a ROS domain of its own.
STREAMS = 2
# Folders whose files are run one after the other, too: they share what takes long to make, or start some nodes.
TOGETHER = ("fleet", "documentation")
# Those that compute more than they wait, and need no core at any moment.
COMPUTES = ("test_identify.py", "test_site.py")
# Folders whose tests talk to simulated devices.
DEVICES = ("drivers", "devices")
# Younger shared memory is left alone, s.
NEW_S = 10.0


def _remove_shared_memory() -> None:
    """Remove what participants of Fast DDS that were killed left in shared memory, 0.5 MB each.

    The lock beside each segment is held as long as its owner lives; a segment that is new may have no lock yet.
    """
    for lock in Path("/dev/shm").glob("fastrtps_" + 16 * "[0-9a-f]" + "_el"):
        with suppress(OSError), lock.open() as file:
            if time.time() - lock.stat().st_mtime > NEW_S:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                lock.with_name(lock.name.removesuffix("_el")).unlink(missing_ok=True)
                lock.unlink()


# The tests run on all cores already: threads of BLAS would only wait for each other. Read when NumPy is imported.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

# Set before any test module imports rclpy; the nodes that tests start inherit both.
os.environ.pop(OWN, None)  # that of pytest's first process
keep_to_own_domain()

# A shell starts background jobs with SIGINT ignored, and the nodes that tests start and interrupt inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Priority of a test with nodes.
USUAL = os.getpriority(os.PRIO_PROCESS, 0)
# No verdict depends on the clock. CI draws the same examples every time; `make test-properties` draws more of them.
CI = bool(os.environ.get("CI"))
EXAMPLES = int(os.environ.get("SLPI_EXAMPLES", "25"))
# The other environments differ in versions: of each test they run the first quick case.
FIRST_CASES = bool(os.environ.get("SLPI_FIRST_CASES"))
hypothesis.settings.register_profile("slpi_ros", deadline=None, derandomize=CI, max_examples=EXAMPLES)
hypothesis.settings.load_profile("slpi_ros")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what needs ROS and what needs the measured records; put files with long tests first."""
    # Real processes on a busy machine may be stopped for seconds: under CI such a test has a second try, which the
    # last line counts ("rerun"). Pure numerics have none.
    repeats = CI and config.pluginmanager.hasplugin("rerunfailures")
    for item in items:
        if "nodes" in item.path.parent.name or "rclpy" in getattr(item.module, "__dict__", {}):
            item.add_marker("ros")
        # Simulated devices answer over sockets within time limits, as nodes do.
        devices = item.path.parent.name in DEVICES or "device" in item.path.name
        if repeats and (item.get_closest_marker("ros") or devices):
            item.add_marker(pytest.mark.flaky(reruns=1, reruns_delay=2))
        if "measured_data" in getattr(item, "fixturenames", ()):
            item.add_marker("measured")
    if FIRST_CASES:
        _keep_first_cases(config, items)
    # Nodes and the files with slow tests begin first; what is short fills the gaps at the end.
    first = {item.path for item in items if item.get_closest_marker("slow") or item.path.parent.name in TOGETHER}
    items.sort(key=lambda item: (item.path.parent.name != STREAM, item.path not in first))


def _keep_first_cases(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect all but the first quick case of each test."""
    found, kept, others = set(), [], []
    for item in items:
        quick = not (item.get_closest_marker("slow") or item.get_closest_marker("long"))
        test = item.nodeid.partition("[")[0]
        (others if quick and test in found else kept).append(item)
        if quick:
            found.add(test)
    config.hook.pytest_deselected(items=others)
    items[:] = kept


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give whole files to workers, as a file's tests share fixtures: those with nodes to two, the others to the rest.

    Nodes wait most of their time, but many of them at once would disturb each other. Who has done his own helps.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = Path(nodeid.partition("::")[0])
            together = file.parent.name in TOGETHER and file.name not in COMPUTES
            return str(file.parent if together else file)

        def _assign_work_unit(self, node: Any) -> None:
            has_nodes = node in list(self.assigned_work)[:STREAMS]
            for scope in self.workqueue:
                path = Path(scope)
                if (path.parent.name == STREAM and path.name not in COMPUTES) == has_nodes:
                    self.workqueue.move_to_end(scope, last=False)
                    break
            super()._assign_work_unit(node)

        def mark_test_pending(self, item: str) -> None:
            """Give the test in which a worker died its second try: `remove_node` has queued it again already."""

    # As sorted above.
    config.option.loadscopereorder = False
    return ByFile(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let nodes have the cores when they want them: pure numerics on other workers stand back."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        # Only root may go back to the usual priority.
        with suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, USUAL if item.get_closest_marker("ros") else max(USUAL, 10))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tidy up once all workers have ended."""
    if not hasattr(session.config, "workerinput"):
        _remove_shared_memory()


def _refuse_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    """Turn a skip into a failure under CI: there everything a test needs is installed."""
    if CI and not os.environ.get("SLPI_ALLOW_SKIPS") and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped under CI: {report.longrepr}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Generator[None, Any, Any]:
    """See that nothing is skipped under CI."""
    report = yield
    _refuse_skip(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """See that no module is skipped under CI."""
    report = yield
    _refuse_skip(report)
    return report


@pytest.fixture(scope="session")
def installed() -> Callable[[str], Path]:
    """Return a function from a program's name to its path, the one that ``ros2 run slpi_ros NAME`` starts."""

    def path_of(name: str) -> Path:
        path = CHECKOUT / os.environ.get("SLPI_INSTALL", "install") / "slpi_ros" / "lib" / "slpi_ros" / name
        if not path.exists():
            pytest.fail(f"{path} is not there: run 'make build'")
        return path

    return path_of


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Return the folder of the measured records, or skip where it is not at hand."""
    named = os.environ.get("SLPI_MEASURED_DATA")
    folder = Path(named) if named else CHECKOUT.parent / "shared" / "data"
    if named and not folder.is_dir():
        pytest.fail(f"SLPI_MEASURED_DATA={named} is no folder")
    if not folder.is_dir():
        pytest.skip(f"no measured data: {folder} does not exist and SLPI_MEASURED_DATA is not set")
    return folder
