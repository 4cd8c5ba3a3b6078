"""Why a message is rejected."""

from collections.abc import Collection, Sequence
from math import isfinite

from slpi_ros.errors import SlpiError
from slpi_ros.model.stream import refusal

NO_MODEL = "no_model"
INACTIVE = "inactive"
RESETTING = "resetting"
FOLLOWING = "following"
EMPTY = "empty"
LENGTH = "length"
DUPLICATE_AXIS = "duplicate_axis"
UNKNOWN_AXIS = "unknown_axis"
NOT_FINITE = "not_finite"
DUPLICATE = "duplicate"
TIME_BACKWARDS = "time_backwards"
STALE = "stale"
OUT_OF_RANGE = "out_of_range"
CAUSES = (
    NO_MODEL, INACTIVE, RESETTING, FOLLOWING, EMPTY, LENGTH, DUPLICATE_AXIS, UNKNOWN_AXIS, NOT_FINITE, DUPLICATE,
    TIME_BACKWARDS, STALE, OUT_OF_RANGE,
)  # fmt: skip
# Of measured displacements.
MEASURED_CAUSES = (NOT_FINITE, OUT_OF_RANGE)


class RejectedError(SlpiError):
    """A message was rejected as a whole, and nothing has moved; `cause` is one of `CAUSES`."""

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


def require_names(names: Sequence[str], axes: Collection[str]) -> None:
    """Reject names that are none of the node's axes, or no list of them.

    Raises
    ------
    RejectedError
        If there is none, one is named twice, or one is unknown.
    """
    if not names:
        raise RejectedError(EMPTY, "no axis is named; name the axes to move")
    if len(set(names)) != len(names):
        raise RejectedError(DUPLICATE_AXIS, f"{', '.join(names)}: an axis is named twice; name each once")
    unknown = [name for name in names if name not in axes]
    if unknown:
        raise RejectedError(UNKNOWN_AXIS, f"no axis '{unknown[0]}'; this node moves {', '.join(axes)}")


def implausible(y: float, accepted: tuple[float, float], kind: str) -> RejectedError:
    """Return why the displacement `y` (m), outside of those accepted (m), is none; `kind`: "desired" or "measured"."""
    if isfinite(y):
        return RejectedError(OUT_OF_RANGE, refusal(y, accepted, kind))
    return RejectedError(NOT_FINITE, f"{kind} displacement is {y} m; send finite ones only")
