"""Desired messages: their axes, displacements and stamps, checked as a whole."""

from collections.abc import Sequence

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.validation import RejectedError, TimestampRules, require_names
from slpi_ros.io.messages import SECOND_NS


class Messages:
    """Check the desired messages for some axes: each is accepted for all the axes that it names, or moves none."""

    def __init__(self, axes: Sequence[Axis], rules: TimestampRules) -> None:
        self.by_name = {axis.name: axis for axis in axes}
        self._last_names: Sequence[str] | None = None
        self._last_axes: list[Axis] = []
        self.use(rules)

    def use(self, rules: TimestampRules) -> None:
        """Replace the rules for time stamps."""
        self.jump, self._max_age_ns = rules.jump, int(rules.max_age * SECOND_NS)
        # Whether the arrival time is needed even of messages that carry a time stamp.
        self.needs_arrival = self._max_age_ns > 0
        for axis in self.by_name.values():
            axis.samples.jump_ns = int(rules.jump * SECOND_NS)

    def axes(self, names: Sequence[str]) -> list[Axis]:
        """Return the named axes; raise RejectedError as `require_names` does."""
        # Most senders use the same names in every message.
        if names != self._last_names:
            require_names(names, self.by_name)
            self._last_axes = [self.by_name[name] for name in names]
            # Copied because the caller may modify the sequence.
            self._last_names = names[:]
        return self._last_axes

    def read(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float], arrival_ns: int) -> list[Axis]:
        """Return the axes of a message; RejectedError if a displacement (m), its stamp or its age is not acceptable."""
        if len(displacements) != len(names):
            raise RejectedError(
                rejection.LENGTH, f"{len(names)} axes but {len(displacements)} displacements; send one for each"
            )
        axes = self.axes(names)
        axis = axes[0]
        try:
            for axis, y in zip(axes, displacements, strict=True):
                axis.check(y)
            if stamp_ns:
                for axis in axes:
                    axis.samples.check(stamp_ns)
        except RejectedError as error:
            raise RejectedError(error.cause, f"axis '{axis.name}': {error}") from None
        if stamp_ns and 0 < self._max_age_ns < arrival_ns - stamp_ns:
            age = (arrival_ns - stamp_ns) * 1e-9
            raise RejectedError(
                rejection.STALE, f"stamped {age:.6g} s ago, longer than max_age; check delays and clocks"
            )
        return axes
