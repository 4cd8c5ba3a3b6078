"""What a desired message must be to be answered: of known axes, within reach, and in time."""

from collections.abc import Mapping, Sequence

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.validation import RejectedError, require_names


def match(names: Sequence[str], axes: Mapping[str, Axis]) -> list[Axis]:
    """Return the named ones of all axes; RejectedError as `require_names`."""
    require_names(names, axes)
    return [axes[name] for name in names]


def check(axes: Sequence[Axis], stamp_ns: int, displacements: Sequence[float], now_ns: int, max_age_ns: int) -> None:
    """Reject what an axis would refuse: first for what is asked, then for when.

    Parameters
    ----------
    axes : sequence of Axis
        At least one.
    stamp_ns : int, nanoseconds
        0: none.
    displacements : sequence of float, metres
        One for each axis.
    now_ns : int, nanoseconds
        The arrival; needed where `max_age_ns` counts.
    max_age_ns : int, nanoseconds
        Stamped longer ago is stale; 0: never.

    Raises
    ------
    RejectedError
        It names the axis.
    """
    axis = axes[0]
    try:
        for axis, y in zip(axes, displacements, strict=True):
            axis.check(y)
        if stamp_ns:
            for axis in axes:
                axis.stamps.check(stamp_ns)
    except RejectedError as error:
        raise RejectedError(error.cause, f"axis '{axis.name}': {error}") from None
    if stamp_ns and 0 < max_age_ns < now_ns - stamp_ns:
        age = (now_ns - stamp_ns) * 1e-9
        raise RejectedError(rejection.STALE, f"stamped {age:.6g} s ago, longer than max_age; check delays and clocks")
