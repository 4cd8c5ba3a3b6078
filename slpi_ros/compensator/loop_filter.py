"""Filter of the feedback: notches and a first-order low pass, in discrete time."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, isfinite, pi, tan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

# States of the sections of a filter, two for each.
States = list[tuple[float, float]]


@dataclass(frozen=True)
class Notch:
    """Notch ``(s^2 + 2 d w s + w^2) / (s^2 + 2 q w s + w^2)`` with ``w = 2 pi frequency``."""

    frequency: float  # Hz
    damping: float = 0.0  # d, of the numerator: that of the mode, or more
    width: float = 1.0  # q, damping of the denominator

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("frequency", self.frequency, self.frequency > 0.0),
            ("damping", self.damping, self.damping >= 0.0),
            ("width", self.width, self.width > 0.0),
        ):
            if not (isfinite(value) and allowed):
                least = "a finite value that is not negative" if name == "damping" else "a finite positive value"
                raise UsageError(f"notch {name} is {value}; give {least}")

    def require_below(self, rate: float) -> None:
        """Raise UsageError unless the frequency is below half the rate (Hz) of the loop."""
        if not self.frequency < 0.5 * rate:
            raise UsageError(
                f"notch_frequency {self.frequency:g} Hz is not below half the loop's rate of {rate:g} Hz; raise "
                "output_rate, or leave that notch out"
            )

    def section(self, period: float) -> "Section":
        """Return the section at a period (s), by Tustin's rule with the frequency itself exact (prewarping)."""
        self.require_below(1.0 / period)
        k = tan(pi * self.frequency * period)
        square, whole = k * k, 1.0 + 2.0 * self.width * k + k * k
        middle = 2.0 * (square - 1.0) / whole
        return Section(
            (1.0 + 2.0 * self.damping * k + square) / whole,
            middle,
            (1.0 - 2.0 * self.damping * k + square) / whole,
            middle,
            (1.0 - 2.0 * self.width * k + square) / whole,
        )


def notches_of(
    axis: str, frequencies: Sequence[float], dampings: Sequence[float], widths: Sequence[float], rate: float
) -> tuple[Notch, ...]:
    """Return the notches of an axis from lists of numbers, one value or one for each; a frequency of 0 is none.

    UsageError for numbers of another count, or a notch that is not below half the rate (Hz) of the loop.
    """
    filled = []
    for name, several in (("damping", dampings), ("width", widths)):
        if len(several) not in (1, len(frequencies)):
            raise UsageError(
                f"notch_{name}.{axis} has {len(several)} values, notch_frequency.{axis} has {len(frequencies)}; give "
                "one value, or one for each notch"
            )
        filled.append(several if len(several) == len(frequencies) else [*several] * len(frequencies))
    try:
        found = tuple(Notch(*each) for each in zip(frequencies, *filled, strict=True) if each[0])
        for notch in found:
            notch.require_below(rate)
    except UsageError as error:
        raise UsageError(f"axis '{axis}': {error}") from None
    return found


class Section(NamedTuple):
    """Second-order section ``(b0 + b1 / z + b2 / z^2) / (1 + a1 / z + a2 / z^2)`` with static gain 1."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float

    def at_rest(self, u: float) -> tuple[float, float]:
        """Return the states for an input that has always been `u`."""
        second = (self.b2 - self.a2) * u
        return (self.b1 - self.a1) * u + second, second


def low_pass(time_constant: float, period: float) -> Section:
    """Return a first-order low pass (s) at a period (s)."""
    kept = exp(-period / time_constant)
    return Section(1.0 - kept, 0.0, 0.0, -kept, 0.0)


def sections(notches: tuple[Notch, ...], time_constant: float, period: float) -> tuple[Section, ...]:
    """Return low pass (time constant, s; 0: none) and notches at a period (s); UsageError above half the rate."""
    first = (low_pass(time_constant, period),) if time_constant else ()
    return (*first, *(each.section(period) for each in notches))


def response(filters: tuple[Section, ...], z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the product of the transfer functions of sections, shape (N,), at ``z = exp(i w period)``, shape (N,)."""
    found, back = np.ones_like(z), 1.0 / z
    for one in filters:
        found *= (one.b0 + back * (one.b1 + back * one.b2)) / (1.0 + back * (one.a1 + back * one.a2))
    return found


class Filtered(NamedTuple):
    """Error and reading (m) after the filter, its states for each, and the time (ns) that they are of."""

    error: float
    reading: float
    errors: States
    readings: States
    now_ns: int


class LoopFilter:
    """Sections in a row for one signal, at a fixed period (s); the caller keeps the states."""

    def __init__(self, notches: tuple[Notch, ...], time_constant: float, period: float) -> None:
        self.period = period
        self.sections = sections(notches, time_constant, period)

    def at_rest(self, u: float) -> States:
        """Return the states for an input that has always been `u`, as the output then is."""
        return [each.at_rest(u) for each in self.sections]

    def resting(self, error: float, reading: float, now_ns: int) -> Filtered:
        """Return what an error and a reading (m) come to that have always been there."""
        return Filtered(error, reading, self.at_rest(error), self.at_rest(reading), now_ns)

    def after(self, states: States, u: float, steps: int) -> tuple[float, States]:
        """Return output and states after `steps` (1 or more) periods with the input `u`."""
        for _ in range(steps):
            value, following = u, []
            for (b0, b1, b2, a1, a2), (first, second) in zip(self.sections, states, strict=True):
                y = b0 * value + first
                following.append((b1 * value - a1 * y + second, b2 * value - a2 * y))
                value = y
            states = following
        return value, states
