"""Batch evaluation and inversion of the effects around the hysteresis of one axis."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.registry import EFFECTS, in_order
from slpi_ros.effects.saturation import Saturation

FloatArray = NDArray[np.float64]
Middle = Callable[[FloatArray], FloatArray]

_PLACES = list(EFFECTS)
_COUPLING = _PLACES.index(CrossCoupling.name)
# Number of fixed-point iterations for the voltage on which the inverse rate dependence depends.
_TRIALS = 6


@dataclass(frozen=True)
class Chain:
    """The effects of one axis, grouped in the order in which they act.

    Parameters
    ----------
    before : tuple of Effect
        Effects on the voltage.
    own : tuple of Effect
        Effects on the displacement before the contributions of other axes.
    shared : tuple of Effect
        Coupling to other axes, and the effects of the stage that act after it.
    measured : tuple of Effect
        Effects of the sensor and of the record, between the displacement of the stage and the reading. No inverse for
        the stage contains them.
    """

    before: tuple[Effect, ...]
    own: tuple[Effect, ...]
    shared: tuple[Effect, ...]
    measured: tuple[Effect, ...] = ()

    @classmethod
    def of(cls, effects: tuple[Effect, ...]) -> "Chain":
        """Return the chain of the effects of an axis, given in any order."""
        ordered = in_order(effects)
        inside = [effect for effect in ordered if effect.side == "stage"]
        behind = [effect for effect in inside if effect.acts_on == "displacement"]
        return cls(
            tuple(effect for effect in inside if effect.acts_on == "voltage"),
            tuple(effect for effect in behind if _PLACES.index(effect.name) < _COUPLING),
            tuple(effect for effect in behind if _PLACES.index(effect.name) >= _COUPLING),
            tuple(effect for effect in ordered if effect.side != "stage"),
        )

    @property
    def rate_dependence(self) -> RateDependence | None:
        """The rate dependence that acts on the displacement and requires the voltage of the hysteresis, or None."""
        first = self.own[0] if self.own else None
        return first if isinstance(first, RateDependence) else None

    @property
    def coercivity(self) -> RateDependence | None:
        """The rate dependence in its coercivity form, which acts on the voltage, or None if there is none."""
        last = self.before[-1] if self.before else None
        return last if isinstance(last, RateDependence) else None

    @property
    def gains(self) -> Mapping[str, float]:
        """Coupling gains by name of the other axis, metres per metre."""
        return next((effect.gains for effect in self.shared if isinstance(effect, CrossCoupling)), {})

    @property
    def delay(self) -> float:
        """Delay from voltage to displacement, seconds."""
        return next((effect.seconds for effect in self.before if isinstance(effect, Delay)), 0.0)

    @property
    def clipped(self) -> tuple[float, float]:
        """Lowest and highest voltage (V) of the amplifier, infinite without saturation."""
        found = (effect for effect in self.before if isinstance(effect, Saturation))
        return next(((effect.lower, effect.upper) for effect in found), (-np.inf, np.inf))

    def hysteresis_for(
        self, own: FloatArray, around: EffectContext, inverse: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacement (m) and voltage (V) of the hysteresis, shape (N,) each, for a displacement of the axis.

        Parameters
        ----------
        own : ndarray, shape (N,), metres
            Displacement before the contributions of other axes.
        around : EffectContext
            Context of the effects; `u` is not used.
        inverse : callable
            Maps displacement (m) to voltage (V) by the inverse hysteresis from its initial state.
        """
        rate, coercivity = self.rate_dependence, self.coercivity
        h = backward(self.own[1:] if rate else self.own, own, around)
        u = inverse(h)
        if not rate and not coercivity:
            return h, u
        slower, last_change, around = h, np.inf, replace(around, grid=around.uniform)
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


def lasting(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return the effects that outlast their record: no drift and no hum; a gain drift keeps its last value."""
    kept = (effect for effect in effects if effect.side != "record")
    return tuple(effect.last if isinstance(effect, GainDrift) else effect for effect in kept)


def reaching(effects: Sequence[Effect], v: FloatArray, around: EffectContext) -> tuple[FloatArray, FloatArray]:
    """Return the voltage (V) of the hysteresis and the reversible displacement (m) parallel to it, shape (N,) each."""
    u, reversible_bypass = v, np.zeros_like(v)
    for effect in effects:
        if effect.acts_on == "voltage":
            before, u = u, effect.apply(u, around)
            if isinstance(effect, RateDependence):
                reversible_bypass = effect.reversible_bypass(before, u)
    return u, reversible_bypass


def forward(effects: tuple[Effect, ...], signal: FloatArray, around: EffectContext) -> FloatArray:
    """Return a signal, shape (N,), after all effects have been applied in order."""
    for effect in effects:
        signal = effect.apply(signal, around)
    return signal


def backward(effects: tuple[Effect, ...], signal: FloatArray, around: EffectContext) -> FloatArray:
    """Return the input signal, shape (N,), for an output signal, by inverting all effects in reverse order."""
    for effect in reversed(effects):
        signal = effect.invert(signal, around)
    return signal


def loop_middle(forward_array: Callable[[FloatArray], FloatArray], low: float, high: float) -> tuple[FloatArray, ...]:
    """Return the mid-line of the largest loop within a voltage range.

    Parameters
    ----------
    forward_array : callable
        Maps voltage (V) to displacement (m) by the hysteresis from its initial state.
    low, high : float, volts
        Ends of the loop.

    Returns
    -------
    voltages : ndarray, shape (K,), volts
    middle : ndarray, shape (K,), metres
        Mean of the rising and the falling branch.
    """
    rise = np.linspace(low, high, 201)
    y = forward_array(np.concatenate([[high], rise, rise[::-1]]))[1:]
    return rise, (y[: rise.size] + y[rise.size :][::-1]) / 2
