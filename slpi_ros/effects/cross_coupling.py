"""Cross coupling: part of another axis's motion."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, TypeVar

import numpy as np

from slpi_ros.effects.base import Candidate, EffectContext, FloatArray, Removable, ResidualView, Side, require


@dataclass(frozen=True)
class CrossCoupling:
    """An axis moves along with others, ``y = x + sum_j gain_j m_j``, ``m_j`` their own motion from the start.

    Parameters
    ----------
    gains : mapping of axis name to float
        Metres per metre. An axis that is not known to move rests.
    uncertainty : mapping of str to float
        Of single axes as ``gains.y``.
    """

    name: ClassVar[str] = "cross_coupling"
    side: ClassVar[Side] = "displacement"
    removable: ClassVar[Removable] = "always"

    gains: Mapping[str, float]
    uncertainty: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what cannot be taken apart again."""
        require(
            self,
            ("gains", 1 <= len(self.gains) <= 100, "for at least one axis"),
            (
                "gains",
                sum(map(abs, self.gains.values())) < 0.9,
                "less than 0.9 in sum, or the axes cannot be told apart",
            ),
        )

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement with the part of the other axes, shape (N,), metres."""
        return signal + self.part(signal, around)

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement without the part of the other axes, shape (N,), metres."""
        return signal - self.part(signal, around)

    def part(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return what the other axes add, shape (N,), metres."""
        known = (gain * around.others[axis] for axis, gain in self.gains.items() if axis in around.others)
        return sum(known, np.zeros_like(signal))

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate]:
        """Yield the motion of all other axes."""
        if left.others:
            yield Candidate(np.column_stack(list(left.others.values())), partial(cls._of, tuple(left.others)))

    @classmethod
    def _of(cls, axes: tuple[str, ...], gains: FloatArray) -> "CrossCoupling":
        return cls(dict(zip(axes, gains.tolist(), strict=True)))

    def describe(self) -> str:
        """Say how much of which axis."""
        parts = [f"{gain * 100:.3g} % of axis {axis}" for axis, gain in self.gains.items()]
        return f"the axis moves along with {' and '.join(parts)}"

    def streaming(self) -> None:
        """Return None: one axis alone cannot know how the others move; the stage takes the axes apart."""
        return


Motion = TypeVar("Motion", float, FloatArray)


class Coupling:
    """What each axis takes from the own motion of the others: ``(I + G) m`` are the motions to be seen.

    Parameters
    ----------
    gains : mapping of axis name to mapping of axis name to float
        ``gains[x][y]``: metres that x moves for one metre of y. Axes that are none of the mapping's rest.

    Attributes
    ----------
    on : bool
        Whether any axis takes anything.
    """

    def __init__(self, gains: Mapping[str, Mapping[str, float]]) -> None:
        self._gains = {
            name: {other: gain for other, gain in row.items() if other in gains and other != name and gain}
            for name, row in gains.items()
        }
        self.on = any(self._gains.values())
        self._solutions: dict[tuple[str, ...], list[list[float]]] = {}

    def part(self, name: str, motions: Mapping[str, Motion]) -> Motion | float:
        """Return what an axis takes from the others' own motions, metres; an axis that is not given rests."""
        return sum((gain * motions[other] for other, gain in self._gains[name].items() if other in motions), 0.0)

    def decouple(self, seen: Mapping[str, Motion], resting: Mapping[str, Motion]) -> dict[str, Motion]:
        """Return the own motions that add up to the ones to be seen.

        Parameters
        ----------
        seen : mapping of axis name to float or ndarray, shape (N,), metres
            Wanted motions from the start.
        resting : mapping of axis name to float or ndarray, shape (N,), metres
            Own motions of axes that stay where they are.
        """
        left = {name: motion - self.part(name, resting) for name, motion in seen.items()}
        rows = self._solution(tuple(seen))
        return {
            name: sum(share * motion for share, motion in zip(row, left.values(), strict=True))  # type: ignore[misc]
            for name, row in zip(seen, rows, strict=True)
        }

    def _solution(self, names: tuple[str, ...]) -> list[list[float]]:
        if names not in self._solutions:
            matrix = [[float(one == other) + self._gains[one].get(other, 0.0) for other in names] for one in names]
            self._solutions[names] = np.linalg.inv(np.array(matrix)).tolist()
        return self._solutions[names]
