"""The effects around the hysteresis of one axis, in the order in which they act."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.registry import in_order


@dataclass(frozen=True)
class Chain:
    """The effects of one axis, in the order in which they act."""

    before: tuple[Effect, ...]  # on the voltage
    around: Effect | None  # the hysteresis
    own: tuple[Effect, ...]  # on the displacement of the axis itself
    shared: tuple[Effect, ...]  # coupling to other axes, and what follows it
    measured: tuple[Effect, ...] = ()  # of sensor and record, which no inverse for the stage contains

    @classmethod
    def of(cls, effects: tuple[Effect, ...]) -> "Chain":
        """Return the chain of the effects of an axis, given in any order."""
        ordered = in_order(effects)
        inside = [effect for effect in ordered if effect.side == "stage"]
        behind = [effect for effect in inside if effect.acts_on == "displacement"]
        coupled = next((place for place, effect in enumerate(behind) if effect.coupling), len(behind))
        around = [effect for effect in inside if effect.acts_on == "hysteresis"]
        return cls(
            tuple(effect for effect in inside if effect.acts_on == "voltage"),
            around[0] if around else None,
            tuple(behind[:coupled]),
            tuple(behind[coupled:]),
            tuple(effect for effect in ordered if effect.side != "stage"),
        )

    @property
    def gains(self) -> Mapping[str, float]:
        """Coupling gains by name of the other axis, metres per metre."""
        return self.shared[0].coupling if self.shared else {}

    @property
    def delay(self) -> float:
        """Delay from voltage to displacement, seconds."""
        return sum(effect.shift for effect in self.before)

    @property
    def clipped(self) -> tuple[float, float]:
        """Lowest and highest voltage (V) that passes all effects."""
        passes = [effect.passes for effect in self.before]
        return max([-np.inf, *(low for low, _ in passes)]), min([np.inf, *(high for _, high in passes)])

    def reaching(self, v: FloatArray, context: EffectContext) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the voltages (V) at the piezo and felt by the hysteresis, and the displacement (m) beside it, (N,)."""
        v = forward(self.before, v, context)
        if not self.around:
            return v, v, np.zeros_like(v)
        u = self.around.apply(v, context)
        return v, u, self.around.beside(v, u)


def lasting(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects that outlast their record, as they are after it."""
    return tuple(kept for effect in effects if (kept := effect.lasting) is not None)


def forward(effects: Sequence[Effect], signal: FloatArray, context: EffectContext) -> FloatArray:
    """Return a signal, shape (N,), after all effects have been applied in order."""
    for effect in effects:
        signal = effect.apply(signal, context)
    return signal


def backward(effects: Sequence[Effect], signal: FloatArray, context: EffectContext) -> FloatArray:
    """Return the input signal, shape (N,), for an output signal, by inverting all effects in reverse order."""
    for effect in reversed(effects):
        signal = effect.invert(signal, context)
    return signal
