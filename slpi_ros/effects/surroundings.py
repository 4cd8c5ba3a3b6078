"""Surroundings: the stage follows quantities that were recorded beside it, such as temperature, load or humidity."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import exp, isfinite
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.effects.base import (
    Candidate,
    Effect,
    EffectContext,
    FitContext,
    Followed,
    FollowedGain,
    StreamingEffect,
    Unsure,
    by_record,
    decays,
    longest,
)
from slpi_ros.effects.excitation import Excitation, full_loops
from slpi_ros.effects.filters import filtered, hold
from slpi_ros.effects.parameters import Fit, parameter, require, text
from slpi_ros.effects.readings import ReadingsFilter, best_filter, line_after
from slpi_ros.errors import length
from slpi_ros.io.record import Course

# Largest number of quantities.
MOST = 4
# Number of time constants of the candidates; the shortest (s), and the longest as a share of the longest record.
TIME_CONSTANTS, SHORTEST, LONGEST = 6, 1.0, 0.5
# Times (s) by which the stage precedes the readings, of the candidates.
LEADS = (1.5, 6.0)
# Largest plausible change of the sensitivity.
LARGEST = 0.3


@dataclass(frozen=True)
class Quantity:
    """A quantity that the stage follows, and how; its gains are for one unit of the quantity."""

    topic: str = text("topic on which it is measured")
    field: str = text("field of the messages, where they have several", default="")
    reference: float = parameter(
        "", "value at which it changes nothing, in its unit", -1e30, 1e30, default=0.0, required=True
    )
    offset_gain: float = parameter(
        "m", "displacement for one unit", -1e6, 1e6, default=0.0, fit=Fit("linear", stays=0.0)
    )
    sensitivity_gain: float = parameter(
        "", "relative change of the sensitivity for one unit", -1e6, 1e6, default=0.0, fit=Fit("linear", stays=0.0)
    )
    time_constant: float = parameter(
        "s", "time constant with which the stage follows, 0: at once", 0, 1e7, default=0.0,
        fit=Fit("relative", least=0.1 * SHORTEST, within_record=True, stays=0.0),
    )  # fmt: skip
    lead: float = parameter(
        "s", "time by which the stage precedes the readings, of a sensor that is slower", 0, 1e7, default=0.0,
        fit=Fit("relative", least=0.1 * SHORTEST, within_record=True, stays=0.0),
    )  # fmt: skip
    averaging: float = parameter(
        "s", "time constant of the filter of the readings in use, 0: none", 0, 1e7, default=0.0
    )
    ahead: float = parameter(
        "s", "time by which their running line is continued in use, 0: their mean is taken", 0, 1e7, default=0.0
    )
    # Range of the recorded values.
    lowest: float = parameter("", "lowest recorded value, in its unit", -1e30, 1e30, default=0.0, required=True)
    highest: float = parameter("", "highest recorded value, in its unit", -1e30, 1e30, default=0.0, required=True)
    # Of readings that come in use, with their filter.
    reading_error: float = parameter(
        "", "rms by which a reading in use is off the quantity, in its unit", 0, 1e30, default=0.0
    )

    @property
    def key(self) -> str:
        """Name of the quantity in a record."""
        return f"{self.topic}:{self.field}" if self.field else self.topic

    def followed(self, around: EffectContext) -> FloatArray:
        """Return by how much (its unit) the stage follows, shape (N,); 0 if the quantity is not known."""
        value = around.surroundings.get(self.key)
        if value is None:
            return np.zeros_like(around.t)
        return self._felt(value - self.reference, around)

    @by_record
    def _felt(self, moved: FloatArray, around: EffectContext) -> FloatArray:
        """Return what the stage feels of a deviation, shape (N,): at the end it stays, at the start it is at rest."""
        if self.lead:
            moved = np.interp(around.t + self.lead, around.t, moved)
        grid = around.uniform
        if not (self.time_constant and grid.dt > 0.0):
            return moved
        now, before, kept = hold(grid.dt, self.time_constant)
        return np.asarray(moved[0] + grid.off(filtered([now, before], [1.0, -kept], grid.on(moved - moved[0]))))


@dataclass(frozen=True)
class Surroundings(Effect):
    """Zero and sensitivity that follow quantities, ``y = x0 + (1 + sum_k s_k w_k) (x - x0) + sum_k o_k w_k``.

    ``w_k`` is the deviation of a quantity from its reference, or that after a first-order lag; ``o_k`` and ``s_k`` are
    `offset_gain` and `sensitivity_gain`, and ``x0`` is `origin`.
    """

    side = "stage"
    what = "zero or sensitivity follow a recorded quantity (temperature, load, humidity, pressure)"
    compensated = "yes, if the quantity is measured in use"
    changes_gain = True
    follows_quantities = True
    excitation = Excitation(
        "Full loops one after the other while one quantity alone is changed on purpose, up and down several times and "
        "each time for another while (heat on and off, load on and off): what comes and goes with it is its doing, "
        "and no drift does that.",
        full_loops,
        separates=("thermal_drift", "gain_drift", "surroundings"),
        order=3,
    )

    quantities: tuple[Quantity, ...] = parameter("", "quantities", count=(1, MOST))
    origin: float = parameter("m", "displacement that does not change with the sensitivity", -1e3, 1e3, default=0.0)
    # Of the records of the fit; elsewhere the stage has followed before the start.
    initial: tuple[float, ...] = parameter(
        "m", "what is left of before the start of each record, quantity by quantity with a time constant", -1e3, 1e3,
        default=(), count=(0, 4000),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        keys = [one.key for one in self.quantities]
        ranges = all(one.lowest <= one.highest for one in self.quantities)
        known = [one for one in self.quantities if one.lowest < one.highest]
        inside = all(one.lowest <= one.reference <= one.highest for one in known)
        require(
            self,
            ("quantities", len(set(keys)) == len(keys), "different ones"),
            ("quantities", ranges, "with a lowest value up to the highest"),
            ("quantities", inside, "with a reference from the lowest to the highest value"),
            ("quantities", all(0 < len(key) <= 400 and key.isprintable() for key in keys), "with printable topics"),
        )

    @property
    def unsure(self) -> Unsure:
        """The gains of the quantities, with their uncertainties."""
        found = []
        for k, (one, followed) in enumerate(zip(self.quantities, self.followed, strict=True)):
            names = (f"quantities.{k}.{name}" for name in ("offset_gain", "sensitivity_gain"))
            zero, sensitivity = (self.uncertainty.get(name, 0.0) for name in names)
            gains = one.offset_gain, one.sensitivity_gain
            found.append(FollowedGain(followed, gains, (zero, sensitivity), one.reading_error))
        return Unsure(quantities=tuple(found), origin=self.origin)

    @property
    def followed(self) -> tuple[Followed, ...]:
        """The quantities with what is known of their range."""
        return tuple(Followed(one.key, one.reference, one.lowest, one.highest) for one in self.quantities)

    def joined(self, other: "Surroundings") -> "Surroundings | None":
        """Return the quantities of both; of one that both have that of this effect."""
        new = [one for one in other.quantities if one.key not in self.keys]
        quantities = (*self.quantities, *new)
        return replace(self, quantities=quantities, uncertainty={}) if len(quantities) <= MOST else None

    def only(self, keys: Sequence[str]) -> "Surroundings | None":
        """Return the effect with some of its quantities; None without any."""
        kept = tuple(one for one in self.quantities if one.key in keys)
        return replace(self, quantities=kept, initial=(), uncertainty={}) if kept else None

    def plausible(self, context: FitContext) -> bool:
        """Return whether the sensitivity changes by little."""
        changes = sum(abs(one.sensitivity_gain) * (one.highest - one.lowest) for one in self.quantities)
        return bool(changes <= LARGEST)

    def parts(self, around: EffectContext) -> tuple[FloatArray, FloatArray]:
        """Return the factor of the sensitivity, and the displacement (m), shape (N,) each."""
        factor, offset = np.ones_like(around.t), np.zeros_like(around.t)
        for one in self.quantities:
            if one.sensitivity_gain or one.offset_gain:
                follows = one.followed(around)
                factor += one.sensitivity_gain * follows
                offset += one.offset_gain * follows
        return factor, offset + self._left(around)

    def apply(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement in its surroundings, shape (N,), metres."""
        factor, offset = self.parts(around)
        return self.origin + factor * (signal - self.origin) + offset

    def invert(self, signal: FloatArray, around: EffectContext) -> FloatArray:
        """Return the displacement at the reference values, shape (N,), metres."""
        factor, offset = self.parts(around)
        return self.origin + (signal - offset - self.origin) / factor

    @property
    def lasting(self) -> "Surroundings":
        """The effect without the starts of its records."""
        return replace(self, initial=())

    @property
    def without_records(self) -> "Surroundings":
        """The effect without the starts of its records."""
        return self.lasting

    def of_record(self, k: int) -> "Surroundings":
        """Return the effect with the start of the record of number `k` of those that it was fitted to."""
        count = len(self._lags)
        return replace(self, initial=self.initial[k * count : (k + 1) * count])

    def starting(self, around: EffectContext, used: Mask) -> FloatArray:
        """Return what is left of before each record for each quantity with a time constant, shape (N, k)."""
        return decays(self._lags, around)

    def started(self, amplitudes: FloatArray, records: int) -> "Surroundings":
        """Return the effect with what is left of before its records."""
        return replace(self, initial=tuple(amplitudes.tolist()))

    def with_filters(self, courses: Mapping[str, Sequence[Course]]) -> "Surroundings":
        """Return the effect with filters for readings like these, the courses of each quantity in each record."""
        return replace(self, quantities=tuple(_with_filter(one, courses.get(one.key, ())) for one in self.quantities))

    @property
    def _lags(self) -> tuple[float, ...]:
        return tuple(one.time_constant for one in self.quantities if one.time_constant)

    def _left(self, around: EffectContext) -> FloatArray:
        columns = decays(self._lags, around).T if self.initial else ()
        pairs = zip(self.initial, columns, strict=False)
        return sum((amplitude * column for amplitude, column in pairs), np.zeros_like(around.t))

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield for each quantity offset, sensitivity and both, at once and with time constants."""
        around, low = context.around, float(context.h.min())
        slowest = LONGEST * longest(around)
        lags = np.geomspace(SHORTEST, slowest, TIME_CONSTANTS).tolist() if slowest > SHORTEST else []
        for group, (key, value) in enumerate(around.surroundings.items()):
            inside = value[context.used]
            lowest, highest = float(inside.min()), float(inside.max())
            if not highest > lowest:
                continue
            topic, _, own = key.partition(":")
            found = Quantity(topic, own, float(inside.mean()), lowest=lowest, highest=highest)
            for tau, lead in ((0.0, 0.0), *((tau, 0.0) for tau in lags), *((0.0, lead) for lead in LEADS)):
                one = replace(found, time_constant=tau, lead=lead)
                follows = one.followed(around)
                size = float(np.abs(follows).max())
                if not size > 0.0:
                    continue
                starting = decays([tau] if tau else [], around)
                moved = follows / size
                for with_offset, with_sensitivity in ((True, False), (False, True), (True, True)):
                    own_columns = [moved] * with_offset + [moved * (context.h - low)] * with_sensitivity
                    yield Candidate(
                        np.column_stack([starting, *own_columns]),
                        partial(cls._through, one, size, low, with_offset, len(own_columns)),
                        group=group,
                    )

    @classmethod
    def _through(
        cls, one: Quantity, size: float, low: float, with_offset: bool, count: int, found: FloatArray
    ) -> "Surroundings | None":
        gains = (found[-count:] / size).tolist()
        if not all(map(isfinite, gains)) or not all(gains):
            return None
        offset = gains[0] if with_offset else 0.0
        sensitivity = gains[-1] if count == 2 or not with_offset else 0.0
        return cls((replace(one, offset_gain=offset, sensitivity_gain=sensitivity),), low)

    def describe(self) -> str:
        """Describe for each quantity what one unit does, and the time constant."""
        return "; ".join(map(_described, self.quantities))

    def laws(self) -> Mapping[str, Any]:
        """Return nothing: it does nothing at the reference values, and others are undone beforehand."""
        return {}

    def streaming(self) -> "StreamingSurroundings":
        """Return the streaming effect, at first at the reference values."""
        return StreamingSurroundings(self)


class StreamingSurroundings(StreamingEffect):
    """Streaming (sample by sample) surroundings: each quantity holds its last value, at first the reference.

    Of noisy or late readings it is what their filter gives.
    """

    def __init__(self, effect: Surroundings) -> None:
        self._quantities, self._origin = effect.quantities, effect.origin
        self._places = {one.key: place for place, one in enumerate(effect.quantities)}
        self._values: list[float | None] = [None] * len(effect.quantities)
        # Of each quantity, by deviation from the reference: what the filter gives, state of the lag, and value and
        # slope (1/s) of the running line.
        self._states = [(0.0, 0.0, 0.0, 0.0)] * len(effect.quantities)

    def surround(self, key: str, value: float) -> None:
        """Note the value of a quantity for the next sample; one that it does not follow, or not finite, is ignored."""
        place = self._places.get(key)
        if place is None or not isfinite(value):
            return
        if self._values[place] is None:
            # The first value that is known: the stage has followed it before.
            moved = value - self._quantities[place].reference
            self._states[place] = moved, moved, moved, 0.0
        self._values[place] = value

    def forward(self, dt: float, x: float) -> float:
        """Advance by `dt` (s) to the displacement `x` (m) and return it in its surroundings (m)."""
        self._states = self._after(dt)
        factor, offset = self._parts(self._states)
        return self._origin + factor * (x - self._origin) + offset

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) at the reference values."""
        factor, offset = self._parts(self._after(dt))
        return self._origin + (wanted - offset - self._origin) / factor

    def resume(self, other: "StreamingSurroundings", x: float) -> None:
        """Take over the values of the quantities from another model's surroundings."""
        for key, place in other._places.items():
            value = other._values[place]
            if value is not None:
                self.surround(key, value)

    def snapshot(self) -> tuple[tuple[tuple[float, ...], ...], ...]:
        """Return known value and states of each quantity, without the first one where it is not known."""
        pairs = zip(self._values, self._states, strict=True)
        return (tuple((*state,) if value is None else (value, *state) for value, state in pairs),)

    def restore(self, state: Any) -> None:
        """Replace the state by one returned by `snapshot`."""
        for place, one in enumerate(state[0]):
            self._values[place] = one[0] if len(one) == 5 else None
            self._states[place] = one[-4], one[-3], one[-2], one[-1]

    def _after(self, dt: float) -> list[tuple[float, float, float, float]]:
        states = []
        for one, value, (before, state, level, slope) in zip(self._quantities, self._values, self._states, strict=True):
            moved = before if value is None else value - one.reference
            if one.ahead and one.averaging:
                level, slope = line_after(dt, one.averaging, moved, level, slope)
                moved = level + one.ahead * slope
            elif one.averaging:
                moved -= exp(-dt / one.averaging) * (moved - before)
            if one.time_constant:
                step = hold(dt, one.time_constant)
                state = step.now * moved + step.before * before + step.kept * state
            else:
                state = moved
            states.append((moved, state, level, slope))
        return states

    def _parts(self, states: Sequence[tuple[float, float, float, float]]) -> tuple[float, float]:
        factor, offset = 1.0, 0.0
        for one, (_, follows, _, _) in zip(self._quantities, states, strict=True):
            factor += one.sensitivity_gain * follows
            offset += one.offset_gain * follows
        return factor, offset


def _with_filter(one: Quantity, courses: Sequence[Course]) -> Quantity:
    """Return a quantity with the filter of its readings that takes the least time, of those that suit the records."""
    found = min((best_filter(course, one.lead) for course in courses), default=ReadingsFilter())
    return replace(one, averaging=found.time_constant, ahead=found.ahead, reading_error=found.error)


def _described(one: Quantity) -> str:
    said = []
    if one.offset_gain:
        said.append(f"the zero moves by {length(one.offset_gain)}")
    if one.sensitivity_gain:
        said.append(f"the sensitivity by {100 * one.sensitivity_gain:.3g} %")
    late = f", with a time constant of {one.time_constant:.3g} s" if one.time_constant else ""
    late += f", {one.lead:.3g} s before its readings" if one.lead else ""
    return (
        f"for each unit of {one.key} {' and '.join(said) or 'nothing changes'}{late} (recorded from {one.lowest:.4g} "
        f"to {one.highest:.4g})"
    )
