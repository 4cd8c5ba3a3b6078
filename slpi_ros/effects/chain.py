"""The effects around the hysteresis of one axis, along whole paths."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.registry import EFFECTS, in_order
from slpi_ros.effects.saturation import Saturation

FloatArray = NDArray[np.float64]
Middle = Callable[[FloatArray], FloatArray]

_PLACES = list(EFFECTS)
_COUPLING = _PLACES.index(CrossCoupling.name)
# Rate dependence looks at the voltage that its own inverse leads to: so often it is tried again.
_TRIALS = 6


@dataclass(frozen=True)
class Chain:
    """Effects in the order in which they act.

    Parameters
    ----------
    before : tuple of Effect
        They act on the voltage.
    own : tuple of Effect
        Behind the hysteresis, before other axes come in.
    shared : tuple of Effect
        Coupling to other axes and what comes behind it.
    """

    before: tuple[Effect, ...]
    own: tuple[Effect, ...]
    shared: tuple[Effect, ...]

    @classmethod
    def of(cls, effects: tuple[Effect, ...]) -> "Chain":
        """Return the chain of an axis's effects, in whatever order they come."""
        ordered = in_order(effects)
        behind = [effect for effect in ordered if effect.side == "displacement"]
        return cls(
            tuple(effect for effect in ordered if effect.side == "voltage"),
            tuple(effect for effect in behind if _PLACES.index(effect.name) < _COUPLING),
            tuple(effect for effect in behind if _PLACES.index(effect.name) >= _COUPLING),
        )

    @property
    def rate_dependence(self) -> RateDependence | None:
        """The effect that looks at the hysteresis's voltage; None: there is none."""
        first = self.own[0] if self.own else None
        return first if isinstance(first, RateDependence) else None

    @property
    def coercivity(self) -> RateDependence | None:
        """The effect through which the hysteresis sees the voltage; None: there is none."""
        last = self.before[-1] if self.before else None
        return last if isinstance(last, RateDependence) else None

    @property
    def gains(self) -> Mapping[str, float]:
        """How much of which other axis comes in, metres per metre."""
        return next((effect.gains for effect in self.shared if isinstance(effect, CrossCoupling)), {})

    @property
    def delay(self) -> float:
        """By how much the displacement answers later, seconds."""
        return next((effect.seconds for effect in self.before if isinstance(effect, Delay)), 0.0)

    @property
    def clipped(self) -> tuple[float, float]:
        """Lowest and highest voltage (V) that the amplifier lets through."""
        found = (effect for effect in self.before if isinstance(effect, Saturation))
        return next(((effect.lower, effect.upper) for effect in found), (-np.inf, np.inf))

    def hysteresis_for(
        self, own: FloatArray, around: EffectContext, inverse: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacement (m) and voltage (V) of the hysteresis, shape (N,) each, for the axis's own displacement.

        Parameters
        ----------
        own : ndarray, shape (N,), metres
            Before other axes come in.
        around : EffectContext
            Its `u` is not needed.
        inverse : callable
            The inverse hysteresis from its start: metres to volts.
        """
        rate, coercivity = self.rate_dependence, self.coercivity
        h = backward(self.own[1:] if rate else self.own, own, around)
        u = inverse(h)
        if not rate and not coercivity:
            return h, u
        slower, last_change = h, np.inf
        for _ in range(_TRIALS):
            if rate:
                tried = rate.invert(slower, replace(around, u=u))
            elif coercivity:
                tried = slower - coercivity.reversible_bypass(coercivity.invert(u, around), u)
            change = float(np.abs(tried - h).max(initial=0.0))
            if not change < last_change:
                break
            h, last_change = tried, change
            u = inverse(h)
        return h, u


def reaching(effects: Sequence[Effect], v: FloatArray, around: EffectContext) -> tuple[FloatArray, FloatArray]:
    """Return what effects let a command reach the hysteresis, and what goes round it: shape (N,), volts and metres."""
    u, reversible_bypass = v, np.zeros_like(v)
    for effect in effects:
        if effect.side == "voltage":
            before, u = u, effect.apply(u, around)
            if isinstance(effect, RateDependence):
                reversible_bypass = effect.reversible_bypass(before, u)
    return u, reversible_bypass


def forward(effects: tuple[Effect, ...], signal: FloatArray, around: EffectContext) -> FloatArray:
    """Return what effects make of a signal, shape (N,)."""
    for effect in effects:
        signal = effect.apply(signal, around)
    return signal


def backward(effects: tuple[Effect, ...], signal: FloatArray, around: EffectContext) -> FloatArray:
    """Return the signal, shape (N,), of which effects make the given one."""
    for effect in reversed(effects):
        signal = effect.invert(signal, around)
    return signal


def loop_middle(forward_array: Callable[[FloatArray], FloatArray], low: float, high: float) -> tuple[FloatArray, ...]:
    """Return voltages and the middle of the largest loop there.

    Parameters
    ----------
    forward_array : callable
        The hysteresis from its start: volts to metres.
    low, high : float, volts
        Ends of the loop.

    Returns
    -------
    voltages : ndarray, shape (K,), volts
    middle : ndarray, shape (K,), metres
        Half-way between the rising and the falling branch.
    """
    rise = np.linspace(low, high, 201)
    y = forward_array(np.concatenate([[high], rise, rise[::-1]]))[1:]
    return rise, (y[: rise.size] + y[rise.size :][::-1]) / 2
