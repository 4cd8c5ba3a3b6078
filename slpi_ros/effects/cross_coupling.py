"""Cross coupling: displacement of an axis caused by the motion of other axes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Additive, Candidate, EffectContext, FitContext
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, loops, move, remaining
from slpi_ros.effects.parameters import Fit, parameter, require


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    spans = ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0), (0.25, 0.75))
    seconds = remaining(limits) / (len(spans) * 2 * (1 + 2))
    for low, high in spans:
        move(path, low)
        for each in (2 * seconds, seconds):
            loops(path, low, high, each, 1)
            path.hold(seconds / 4)


@dataclass(frozen=True)
class CrossCoupling(Additive):
    """Linear coupling, ``y = x + sum_j gain_j m_j``, with ``m_j`` the motion of axis j; the stage model inverts it."""

    side = "stage"
    what = "part of the movement of another axis"
    compensated = "if both axes are in one node"
    excitation = Excitation(
        "One axis moves while all others rest: what a resting axis shows then is coupling, and neither its own "
        "hysteresis nor its own dynamics.",
        _draw,
        least_axes=2,
    )

    gains: Mapping[str, float] = parameter(
        "", "metres for one metre of another axis, by its name", -1, 1, count=(1, 100),
        fit=Fit("linear", 1e-5, most=0.4),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        least = sum(map(abs, self.gains.values())) < 0.9
        require(self, ("gains", least, "less than 0.9 in sum, to tell the axes apart"))

    def added(self, around: EffectContext) -> FloatArray:
        """Return the displacement caused by the other axes, shape (N,), metres."""
        known = (gain * around.others[axis] for axis, gain in self.gains.items() if axis in around.others)
        return sum(known, np.zeros_like(around.t))

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield a candidate with the motion of all other axes."""
        if others := context.around.others:
            columns = np.column_stack(list(others.values()))
            yield Candidate(columns, lambda gains: cls(dict(zip(others, gains.tolist(), strict=True))))

    @property
    def coupling(self) -> Mapping[str, float]:
        """The gains."""
        return self.gains

    def describe(self) -> str:
        """Describe the coupling gains by axis."""
        parts = [f"{gain * 100:.3g} % of axis {axis}" for axis, gain in self.gains.items()]
        return f"the axis follows {' and '.join(parts)}"
