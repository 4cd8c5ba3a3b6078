"""The memory of the hysteresis at the start as a source of uncertainty: as long as it is remembered.

Whatever went before, the state at the start lies between those after a fall and after a rise over the whole range that
the hysteresis has felt. These two are followed beside the assumed one. Each reversal that the path wipes out is one
that they had not in common, and once all are wiped out, the three agree.
"""

from dataclasses import replace
from math import inf
from typing import TypeVar

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import EffectContext
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, Start, StartMemory

Scalars = TypeVar("Scalars", float, FloatArray)


class UnknownMemory:
    """Square of the uncertainty (m^2) from a memory that is not known, along a path or sample by sample."""

    # A lag or a rate limit before the hysteresis is ignored: it hardly changes the reversals.
    def __init__(self, axis: AxisModel, start_memory: StartMemory, felt: tuple[float, float]) -> None:
        low, high = felt
        self._clipped, self._around = axis.chain.clipped, axis.chain.around
        self.start = start = min(max(axis.initial(start_memory).voltage, low), high)
        assumed = axis.memory(start_memory)
        ways = [(assumed, [start])]
        for turns in ([high, start], [high, low, start]):
            ways.append((replace(axis, start=Start(low, 0.0, (low,))).memory("start"), turns))
        self._memories: list[tuple[Memory, float]] = []
        for memory, turns in ways:
            memory.forward_array(np.array(turns))
            here = memory.snapshot()
            # The zero is that after the whole range, where they agree.
            zero = float(memory.forward_array(np.array([low, high]))[-1])
            memory.restore(here)
            self._memories.append((memory, zero))
        self._streaming = self._around.streaming() if self._around else None
        if self._streaming:
            self._streaming.start(start)
        self._t = inf

    def along(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return it along voltages `v`, shape (N,), volts, at times `t`, shape (N,), seconds, from here on."""
        u = np.clip(v, *self._clipped)
        if self._around:
            u = self._around.apply(u, EffectContext.since_start(t, start=self.start))
        return np.asarray(_square(*(memory.forward_array(u) - zero for memory, zero in self._memories)))

    def step(self, t: float, v: float) -> float:
        """Return it after the voltage `v` (V) at time `t` (s)."""
        u = min(max(v, self._clipped[0]), self._clipped[1])
        if self._streaming:
            u = self._streaming.forward(max(t - self._t, 0.0), u)
            self._t = t
        return _square(*(memory.forward(u) - zero for memory, zero in self._memories))


def _square(assumed: Scalars, fallen: Scalars, risen: Scalars) -> Scalars:
    """Return the mean square (m^2) about the assumed displacement (m), rectangular between the two extreme ones."""
    one, other = fallen - assumed, risen - assumed
    return (one**2 + one * other + other**2) / 3.0
