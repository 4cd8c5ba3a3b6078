"""A residual of a known hysteresis, for the fits of single effects."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import EffectContext

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Residual:
    """A `FitContext` of N samples whose hysteresis is known: t (s), u (V), h and y (m)."""

    t: FloatArray
    u: FloatArray
    h: FloatArray
    y: FloatArray
    others: dict[str, FloatArray] = field(default_factory=dict)

    @property
    def used(self) -> NDArray[np.bool_]:
        return np.ones(self.t.size, dtype=bool)

    @property
    def residual(self) -> FloatArray:
        return self.y - self.h

    @property
    def around(self) -> EffectContext:
        return EffectContext(self.t, self.others, voltage=self.u)

    def respond(self, u: FloatArray) -> FloatArray:
        return np.interp(u, np.sort(self.u), np.sort(self.h))
