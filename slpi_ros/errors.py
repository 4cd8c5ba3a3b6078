"""Exceptions of the package, all derived from `SlpiError`, the form of text shown to people, and missing packages."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

# Characters of a line on a terminal, in a log or on a page; a hostile file may hold names of megabytes.
LONGEST_SHOWN = 2_000
_FLEET = "pip install 'dask[distributed]' bokeh pyarrow"
# How to get each package; a test compares the names with setup.py.
HOW_TO_GET = {
    "bokeh": _FLEET,
    "dask": _FLEET,
    "distributed": _FLEET,
    "h5py": "apt install python3-h5py, or pip install h5py",
    "jinja2": "apt install python3-jinja2, or pip install jinja2",
    "jsonschema": "apt install python3-jsonschema, or pip install jsonschema",
    "matplotlib": "apt install python3-matplotlib, or pip install matplotlib",
    "nidaqmx": "pip install 'nidaqmx[grpc]'",
    "nptdms": "pip install nptdms",
    "numba": "apt install python3-numba, or pip install numba",
    "numpy": "apt install python3-numpy, or pip install numpy",
    "openpyxl": "apt install python3-openpyxl, or pip install openpyxl",
    "osqp": "pip install osqp",
    "pandas": "apt install python3-pandas, or pip install pandas",
    "pyarrow": _FLEET,
    "pymodbus": "pip install pymodbus",
    "serial": "apt install python3-serial, or pip install pyserial",
    "rosbags": "pip install rosbags",
    "ruamel": "apt install python3-ruamel.yaml, or pip install ruamel.yaml",
    "scipy": "apt install python3-scipy, or pip install scipy",
    "threadpoolctl": "apt install python3-threadpoolctl, or pip install threadpoolctl",
    "yaml": "apt install python3-yaml, or pip install pyyaml",
}
_OF_ROS = ("ament_index_python", "builtin_interfaces", "launch", "launch_ros", "rcl_interfaces", "rclpy", "rpyutils")
_ENDINGS_OF_ROS = ("_msgs", "_srvs")
_FROM_ROS = "source a ROS 2 workspace, for example /opt/ros/jazzy/setup.bash"
# Characters of the reason that another package gives.
_LONGEST_REASON = 200


def shown(text: object, most: int = LONGEST_SHOWN) -> str:
    """Return a text as one line for a terminal, a log or a page."""
    # Names of axes, stages, columns, topics and files come from strangers: control characters, which could command a
    # terminal, are escaped, and a long text loses its middle, so that the remedy at the end of a message stays.
    line = _cut(str(text), most)
    if line.isprintable():
        return line
    # Text that is not UTF-8 reaches Python as lone surrogates, which are not printable either.
    return _cut("".join(c if c.isprintable() or c == "\N{NO-BREAK SPACE}" else _escaped(c) for c in line), most)


def length(metres: float) -> str:
    """Return a length with three digits in nm, µm or mm as text; "none" if it is not finite."""
    if not math.isfinite(metres):
        return "none"
    scale, unit = next((one for one in ((1e9, "nm"), (1e6, "µm")) if abs(metres) * one[0] < 999.5), (1e3, "mm"))
    return f"{metres * scale:.3g} {unit}"


def _cut(line: str, most: int) -> str:
    kept = most - len(" ... ")
    return line if len(line) <= most else f"{line[: kept * 2 // 3]} ... {line[kept * 2 // 3 - kept :]}"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


class SlpiError(Exception):
    """Base class: the data or a document do not allow the request; the message states cause, location and remedy.

    The message is one line that can be shown, see `shown`.
    """

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(shown(message))


class UsageError(SlpiError):
    """The call is invalid: an unknown option value, axis or kind."""

    exit_code = 2


class RecordError(SlpiError):
    """A record cannot be read or lacks required data."""


class ModelError(SlpiError):
    """A model document cannot be read, has an unsupported version or belongs to another stage."""


class IdentificationError(SlpiError):
    """A model cannot be identified from the given record."""


class UnreachableError(SlpiError):
    """A desired displacement lies far outside the identified displacement range."""


class DependencyError(SlpiError, ImportError):
    """A package that is needed is missing or cannot be loaded; the message names it and says how to get it."""


@contextmanager
def dependencies_needed() -> Iterator[None]:
    """Raise DependencyError if an import in the ``with`` block fails in another package or for the lack of it."""
    try:
        yield
    except DependencyError:
        raise
    except ImportError as error:
        message = explanation(error)
        if message is None:
            raise
        raise DependencyError(message) from error


def explanation(error: BaseException) -> str | None:
    """Return what is missing or broken and how to get it; None if the error is not that of a known dependency."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing and (how := _how_to_get(missing)):
        return f"{missing} is not installed; get it with: {how}" if how != _FROM_ROS else f"no {missing}: {how}"
    package = (error.name or "").split(".")[0] if isinstance(error, ImportError) else ""
    how = _how_to_get(package)
    at: TracebackType | None = error.__traceback__
    while at is not None:
        # The innermost known package: one that another dependency cannot load is the one to repair.
        own = str(at.tb_frame.f_globals.get("__name__", "")).split(".")[0]
        if found := _how_to_get(own):
            package, how = own, found
        at = at.tb_next
    if how is None:
        return None
    reason = " ".join(str(error).split())[:_LONGEST_REASON]
    return f"{package} is installed but cannot be loaded ({reason}); repair it: {how}"


def _how_to_get(package: str) -> str | None:
    if package in _OF_ROS or package.endswith(_ENDINGS_OF_ROS):
        return _FROM_ROS
    return HOW_TO_GET.get(package)
