"""Cross coupling: part of another axis's motion."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from slpi_ros.effects.base import Form, Left
from slpi_ros.effects.checks import require
from slpi_ros.effects.effect import Around, FloatArray, Removable, Side


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

    def apply(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement with the part of the other axes, shape (N,), metres."""
        return signal + self.part(signal, around)

    def invert(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the displacement without the part of the other axes, shape (N,), metres."""
        return signal - self.part(signal, around)

    def part(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return what the other axes add, shape (N,), metres."""
        known = (gain * around.others[axis] for axis, gain in self.gains.items() if axis in around.others)
        return sum(known, np.zeros_like(signal))

    @classmethod
    def fit(cls, left: Left) -> Iterator[Form]:
        """Yield the motion of all other axes."""
        if left.others:
            yield Form(np.column_stack(list(left.others.values())), partial(cls._of, tuple(left.others)))

    @classmethod
    def _of(cls, axes: tuple[str, ...], gains: FloatArray) -> "CrossCoupling":
        return cls(dict(zip(axes, gains.tolist(), strict=True)))

    def describe(self) -> str:
        """Say how much of which axis."""
        parts = [f"{gain * 100:.3g} % of axis {axis}" for axis, gain in self.gains.items()]
        return f"the axis moves along with {' and '.join(parts)}"

    def follower(self) -> None:
        """Return None: one axis alone cannot know how the others move; the stage takes the axes apart."""
        return
