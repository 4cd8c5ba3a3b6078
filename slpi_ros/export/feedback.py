"""The closed loop beside an exported inverse: what ``slpi_feedback_step`` computes, by axis."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, expm1, inf

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_filter import Section, sections
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits, RateLimiter

# Largest correction where the gains name none, as a share of the voltage range, as in the node.
MOST = 0.2


@dataclass(frozen=True)
class ExportedLoop:
    """Gains of one axis at the period (s) of the loop, and the largest correction (V)."""

    gains: PidGains
    period: float
    most: float

    @property
    def sections(self) -> tuple[Section, ...]:
        """Low pass and notches."""
        return sections(self.gains.notches, self.gains.measurement_filter, self.period)

    @property
    def moved(self) -> float:
        """Share of a new slope that the low pass of the derivative takes in a period."""
        time_constant = self.gains.derivative_filter
        return -expm1(-self.period / time_constant) if time_constant else 1.0

    @property
    def released(self) -> float:
        """Share of the offset of the beginning that is left after a period."""
        return exp(-self.period / Feedback.release_time)

    def reference(self) -> Feedback:
        """Return the feedback that the exported one equals: ``correct(k period, desired, measured, 0.0)``."""
        feedback = Feedback(self.gains, RateLimiter(Limits(-inf, inf), self.period, 0.0), self.most)
        feedback.switch(True)
        return feedback


def exported_loops(tuned: TunedGains, axes: Sequence[tuple[str, Limits]]) -> tuple[ExportedLoop, ...]:
    """Return the loops of axes with their voltage limits; UsageError if gains for one are missing, or too slow."""
    period = 1.0 / tuned.rate
    if not period <= Feedback.longest_gap:
        raise UsageError(f"gains for a loop of {tuned.rate:g} Hz; the exported one takes 10 Hz and more")
    for name, _ in axes:
        if name not in tuned.axes:
            raise UsageError(f"axis '{name}': the gains are for axes {', '.join(tuned.axes)}; tune that axis as well")
    return tuple(ExportedLoop(tuned.axes[name], period, MOST * (limits.upper - limits.lower)) for name, limits in axes)
