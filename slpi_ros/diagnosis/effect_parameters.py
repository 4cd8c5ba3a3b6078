"""Free parameters of effects as vectors, with their bounds, step sizes and uncertainties."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, isfinite, log
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import (
    Candidate,
    Effect,
    EffectBase,
    EffectContext,
    ResidualView,
    Side,
    Signal,
    leaves,
    usual_step,
    with_leaves,
)
from slpi_ros.effects.creep import FASTEST, LAW_FEWEST, Creep, plausible
from slpi_ros.effects.resonance import LEAST_GAIN, Resonance, within

FloatArray = NDArray[np.float64]

# Fitted parameters of each effect; the others (times of a drift) are chosen, not fitted.
FREE = {
    "delay": ("seconds",),
    "lag": ("time_constant",),
    "saturation": ("lower", "upper"),
    "rate_dependence": ("threshold", "onset_rate", "reversible_gain", "initial"),
    "creep": ("time_constants", "gains"),
    "resonance": ("modes",),
    "gain_drift": ("gains", "origin"),
    "cross_coupling": ("gains",),
    "thermal_drift": ("values",),
    "sensor_periodic": ("period", "amplitude", "phase"),
    "hum": ("lines",),
}
# Fields with the state of an effect at the start of each record; an entry that is 0 stays 0.
STARTS = ("initial",)
# Lower bounds by parameter, or by effect and parameter; others may be negative, except those of `NOT_NEGATIVE`.
LEAST = {
    "time_constant": 1e-6,
    "time_constants": FASTEST,
    "damping": 1e-3,
    "frequency": 1e-3,
    "period": 1e-9,
    "amplitude": 0.0,
    "resonance.gain": LEAST_GAIN,
    "threshold": 1e-6,
    "onset_rate": 1e-9,
    "initial": -np.inf,
}
# Upper bounds by parameter, or by effect and parameter. With more damping there is no resonance.
MOST = {
    "damping": 0.4,
    "resonance.gain": 1.0,
    "cross_coupling.gains": 0.4,
}
# Effects whose parameters have the lower bound 0 if `LEAST` states no other.
NOT_NEGATIVE = ("creep", "rate_dependence")
# Parameters in which the displacement is linear, or nearly so; their steps are not limited.
LINEAR = ("gain", "gains", "values", "origin", "seconds", "reversible_gain")
# Parameters that are fitted by their logarithms, as they range over decades, and the largest change of one in a step.
LOGARITHMIC, LARGEST_LOG_STEP = ("threshold", "onset_rate"), 2.0
# A state at the start below this size (V) is none.
NO_START = 1e-6
# Largest change of a parameter in one step, relative to its magnitude.
LARGEST_STEP = 0.7


@dataclass(frozen=True)
class EachRecord(EffectBase):
    """An effect with separate parameters in each record, such as drift or hum.

    Parameters
    ----------
    parts : tuple of Effect
        The effect in each record.
    """

    parts: tuple[Effect, ...]
    side: ClassVar[Side] = "record"
    acts_on: ClassVar[Signal] = "displacement"

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.parts[0].name

    @property
    def uncertainty(self) -> Mapping[str, float]:
        """Standard deviations of the parameters in the first record, by name."""
        return self.parts[0].uncertainty

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the output for the concatenated signals of all records, shape (N,), metres."""
        records = zip(self.parts, around.split(signal), around.records, strict=True)
        return np.concatenate([part.apply(own, record) for part, own, record in records])

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the input signal, shape (N,), metres, for an output signal of all records."""
        records = zip(self.parts, around.split(signal), around.records, strict=True)
        return np.concatenate([part.invert(own, record) for part, own, record in records])

    def describe(self) -> str:
        """Describe the effect in each record."""
        return "; ".join(f"record {k}: {part.describe()}" for k, part in enumerate(self.parts, 1))

    @classmethod
    def fit(cls, left: ResidualView) -> Iterator[Candidate | Effect]:
        """Yield nothing: candidates come from the effect of each record."""
        yield from ()


def _is_law(effect: Effect) -> bool:
    """Return whether an effect is logarithmic creep: several relaxations with equal gains."""
    return isinstance(effect, Creep) and len(effect.gains) >= LAW_FEWEST and len(set(effect.gains)) == 1


def _leaves(effect: Effect) -> list[tuple[str, str, float]]:
    """Return place, field and value of each free parameter, such as ``modes.0.gain``, ``gain`` and 1."""
    if isinstance(effect, EachRecord):
        return [leaf for part in effect.parts for leaf in _leaves(part)]
    if isinstance(effect, Creep) and _is_law(effect):
        return [("gains", "gains", effect.gains[0])]
    found = [leaf for name in FREE[effect.name] for leaf in leaves(name, getattr(effect, name))]
    return [leaf for leaf in found if _is_free(*leaf[1:])]


def _is_free(field: str, value: float) -> bool:
    return isfinite(value) and (bool(value) or field not in STARTS)


def _bounds(effect: Effect, field: str) -> tuple[float, float]:
    """Return the bounds of the numbers in a field."""
    own, least = f"{effect.name}.{field}", 0.0 if effect.name in NOT_NEGATIVE else -np.inf
    return LEAST.get(own, LEAST.get(field, least)), MOST.get(own, MOST.get(field, np.inf))


def names(effect: Effect) -> list[str]:
    """Return the names of the free parameters; elements of a field have names such as ``gains.0``."""
    return [place for place, _, _ in _leaves(effect)]


def of_starts(effect: Effect) -> list[bool]:
    """Return for each free parameter whether it is the state at the start of a record."""
    return [field in STARTS for _, field, _ in _leaves(effect)]


def free(effect: Effect) -> FloatArray:
    """Return the values of the free parameters, shape (k,), SI, or logarithms of these, see `LOGARITHMIC`."""
    values = [log(max(value, LEAST[field])) if field in LOGARITHMIC else value for _, field, value in _leaves(effect)]
    return np.array(values, dtype=np.float64)


def moved(effect: Effect, values: FloatArray, longest: float = np.inf) -> Effect:
    """Return the effect with new free parameters, clipped to their bounds; `longest`: largest time constant (s)."""
    if isinstance(effect, EachRecord):
        own = np.split(values, np.cumsum([free(part).size for part in effect.parts[:-1]]))
        return EachRecord(tuple(moved(part, some, longest) for part, some in zip(effect.parts, own, strict=True)))
    left = values.tolist()
    if isinstance(effect, Creep) and _is_law(effect):
        gain = max(left[0], 0.0)
        return replace(
            effect, gains=(min(plausible(effect.time_constants, (gain,) * len(effect.gains))),) * len(effect.gains)
        )

    def new(field: str, value: float) -> float:
        if not _is_free(field, value):
            return value
        value = exp(min(left.pop(0), 300.0)) if field in LOGARITHMIC else left.pop(0)
        least, most = _bounds(effect, field)
        value = min(max(value, least), longest if field == "time_constants" else most)
        return 0.0 if field in STARTS and abs(value) < NO_START else value

    changed: dict[str, Any] = {}
    for name in FREE[effect.name]:
        now = getattr(effect, name)
        changed[name] = with_leaves(now, iter([new(field, value) for _, field, value in leaves(name, now)]))
    if isinstance(effect, Creep):
        changed["gains"] = plausible(changed["time_constants"], changed["gains"])
    if isinstance(effect, Resonance):
        changed["modes"] = within(changed["modes"])
    return replace(effect, **changed)  # type: ignore[type-var]


def steps(effect: Effect, t: FloatArray, v: FloatArray) -> FloatArray:
    """Return the step of each free parameter for numerical derivatives, shape (k,), SI."""
    if isinstance(effect, EachRecord):
        return np.concatenate([steps(part, t, v) for part in effect.parts])
    dt = usual_step(t)
    small = {
        "seconds": 0.05 * dt,
        "time_constant": 0.05 * dt,
        "lower": 1e-3 * float(np.ptp(v)),
        "upper": 1e-3 * float(np.ptp(v)),
        "phase": 1e-4,
    }
    found = []
    for _, field, value in _leaves(effect):
        scale = {"hum": 1e-3 / float(np.ptp(t)), "sensor_periodic": 1e-5 * abs(value)}
        if field in ("frequency", "period") and effect.name in scale:
            step = scale[effect.name]
        elif field in LOGARITHMIC:
            step = 1e-4
        elif field in ("gain", "gains"):
            step = 1e-5
        elif field == "reversible_gain":
            step = 1e-9 / float(np.ptp(v))
        elif field in ("values", "origin"):
            step = 1e-9
        else:
            step = small.get(field, 1e-4 * abs(value) + 1e-12)
        # Downwards where there is an upper bound: at the bound, a step upwards would change nothing.
        least, most = _bounds(effect, field)
        found.append(-step if most < np.inf and value - step >= least else step)
    return np.array(found)


def bounded(effect: Effect, change: FloatArray) -> FloatArray:
    """Return a change of the free parameters, limited to the range in which the linearised fit is valid."""
    limit = LARGEST_STEP * np.abs(free(effect))
    for k, (_, field, _) in enumerate(_leaves(effect)):
        if field in LINEAR:
            limit[k] = np.inf
        elif field in LOGARITHMIC:
            limit[k] = LARGEST_LOG_STEP
        elif field == "phase":
            limit[k] = LARGEST_STEP
    return np.clip(change, -limit, limit)


def certain(effect: Effect, spread: Sequence[float]) -> Effect:
    """Return the effect with `spread`, the standard deviations of its free parameters in order, as its uncertainty."""
    left = list(spread)
    if isinstance(effect, EachRecord):
        return EachRecord(tuple(certain(part, [left.pop(0) for _ in free(part)]) for part in effect.parts))
    found = dict(zip(names(effect), left, strict=True))
    for name in found.keys() & set(LOGARITHMIC):
        found[name] *= getattr(effect, name)
    return replace(effect, uncertainty=found)  # type: ignore[type-var]
