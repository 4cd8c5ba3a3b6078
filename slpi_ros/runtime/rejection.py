"""Why a message is rejected."""

from slpi_ros.errors import SlpiError

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


class RejectedError(SlpiError):
    """A message was rejected as a whole, and nothing has moved; `cause` is one of `CAUSES`."""

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause
