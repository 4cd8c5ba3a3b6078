"""Cross coupling: displacement of an axis caused by the motion of other axes."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np

from slpi_ros.effects.base import Candidate, EffectBase, EffectContext, FloatArray, ResidualView, Side, Signal, require


@dataclass(frozen=True)
class CrossCoupling(EffectBase):
    """Linear coupling, ``y = x + sum_j gain_j m_j``, with ``m_j`` the motion of axis j relative to its start.

    It needs the setpoints of all axes and is compensated by the stage model.

    Parameters
    ----------
    gains : mapping of axis name to float
        Gain by axis name, metres per metre. An axis with unknown motion is taken as stationary.
    """

    name: ClassVar[str] = "cross_coupling"
    acts_on: ClassVar[Signal] = "displacement"
    side: ClassVar[Side] = "stage"

    gains: Mapping[str, float]
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(
            self,
            ("gains", 1 <= len(self.gains) <= 100, "for at least one axis"),
            ("gains", sum(map(abs, self.gains.values())) < 0.9, "less than 0.9 in sum, to tell the axes apart"),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement including the coupled motion, shape (N,), metres."""
        return signal + self.part(signal, around)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without the coupled motion, shape (N,), metres."""
        return signal - self.part(signal, around)

    def part(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement caused by the other axes, shape (N,), metres."""
        known = (gain * around.others[axis] for axis, gain in self.gains.items() if axis in around.others)
        return sum(known, np.zeros_like(signal))

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield a candidate with the motion of all other axes."""
        if left.others:
            yield Candidate(np.column_stack(list(left.others.values())), partial(cls._of, tuple(left.others)))

    @classmethod
    def _of(cls, axes: tuple[str, ...], gains: FloatArray) -> "CrossCoupling":
        return cls(dict(zip(axes, gains.tolist(), strict=True)))

    @property
    def coupling(self) -> Mapping[str, float]:
        """The gains."""
        return self.gains

    def describe(self) -> str:
        """Describe the coupling gains by axis."""
        parts = [f"{gain * 100:.3g} % of axis {axis}" for axis, gain in self.gains.items()]
        return f"the axis follows {' and '.join(parts)}"


Motion = TypeVar("Motion", float, FloatArray)


class Coupling:
    """Linear coupling of all axes: the observed motions are ``(I + G) m``, with ``m`` the motions without coupling.

    ``gains[x][y]`` is the displacement of x per metre of y; axes that are not in the mapping have no coupling, and
    without any gain it is not `on`.
    """

    def __init__(self, gains: Mapping[str, Mapping[str, float]]) -> None:
        self._gains = {
            name: {other: gain for other, gain in row.items() if other in gains and other != name and gain}
            for name, row in gains.items()
        }
        self.on = any(self._gains.values())
        self._solutions: dict[tuple[str, ...], list[list[float]]] = {}

    def part(self, name: str, motions: Mapping[str, Motion]) -> Motion | float:
        """Return the displacement (m) of axis `name` caused by the own motions of the others, 0 for missing axes."""
        part: Motion | float = 0.0
        for other, gain in self._gains[name].items():
            if other in motions:
                part = part + gain * motions[other]
        return part

    def parts(self, seen: Mapping[str, Motion], resting: Mapping[str, Any]) -> dict[str, Motion | float]:
        """Return the displacement (m) of each axis that the others cause; arguments as in `decouple`."""
        motions: dict[str, Any] = {**(self.decouple(seen, resting) if seen else {}), **resting}
        return {name: self.part(name, motions) for name in self._gains}

    def decouple(self, seen: Mapping[str, Motion], resting: Mapping[str, Any]) -> dict[str, Motion]:
        """Return the own motions (m), those without coupling, that produce the observed ones, `seen` (m).

        Each from the start, a number or of shape (N,). `resting` are own motions (m) of axes held in position.
        """
        left = {name: motion - self.part(name, resting) for name, motion in seen.items()}
        rows = self._solution(tuple(seen))
        own = {}
        for name, row in zip(seen, rows, strict=True):
            # Not `sum`, which rounds numbers otherwise than arrays.
            motion: Any = 0.0
            for share, each in zip(row, left.values(), strict=True):
                motion = motion + share * each
            own[name] = motion
        return own

    def _solution(self, names: tuple[str, ...]) -> list[list[float]]:
        if names not in self._solutions:
            matrix = [[float(one == other) + self._gains[one].get(other, 0.0) for other in names] for one in names]
            self._solutions[names] = np.linalg.inv(np.array(matrix)).tolist()
        return self._solutions[names]
