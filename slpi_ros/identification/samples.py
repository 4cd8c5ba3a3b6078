"""The samples of one axis that a fit uses, after the checks that every fit needs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.hysteresis.runs import monotone_runs
from slpi_ros.identification.record import Record

FloatArray = NDArray[np.float64]

# Fewer samples than this say nothing about a loop.
FEWEST = 50
NEVER_TURNS = "the voltage never turns back; drive it up and down over the range to be used"
# The memory counts as wiped once the voltage has come this near to both ends of its range (share of the range).
NEAR_END = 0.02


@dataclass(frozen=True)
class Samples:
    """One axis, in time order, without gaps in the voltage.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        All that moves the memory.
    y : ndarray, shape (N,), metres
        Finite where `fitted`.
    fitted : ndarray of bool, shape (N,)
        Samples whose displacement is to be fitted.
    primed : bool
        Whether a long fall to the first voltage wiped the memory; else the axis had never been moved.
    """

    v: FloatArray
    y: FloatArray
    fitted: NDArray[np.bool_]
    primed: bool = False

    def after(self, history: tuple[float, ...]) -> "Samples":
        """Return the samples with the voltages of an earlier drive before them."""
        before = np.array(history)
        return Samples(
            np.concatenate([before, self.v]),
            np.concatenate([np.zeros(before.size), self.y]),
            np.concatenate([np.zeros(before.size, dtype=bool), self.fitted]),
            primed=before.size > 0,
        )

    def only(self, chosen: NDArray[np.bool_]) -> "Samples":
        """Return the samples with only those fitted that are `chosen`, shape (N,)."""
        return replace(self, fitted=self.fitted & chosen)

    def thinned(self, most: int) -> "Samples":
        """Return every so manieth sample, about `most` of them, and all at which the voltage turns: the same memory."""
        every = round(self.v.size / most)
        if every <= 1:
            return self
        kept = np.zeros(self.v.size, dtype=bool)
        kept[::every] = True
        # Of equal samples in a row both ends: the memory does not tell which one is the turn.
        ends = np.array(monotone_runs(self.v)).ravel()
        kept[ends[ends < self.v.size]] = kept[np.maximum(ends - 1, 0)] = True
        return Samples(self.v[kept], self.y[kept], self.fitted[kept], self.primed)

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Smallest and largest voltage among the fitted samples, volts."""
        v = self.v[self.fitted]
        return float(v.min()), float(v.max())

    @property
    def spread(self) -> tuple[float, float]:
        """Voltage (V) and displacement (m) covered by the fitted samples, outliers apart."""
        v, y = (np.percentile(x[self.fitted], (1, 99)) for x in (self.v, self.y))
        return float(v[1] - v[0]), float(y[1] - y[0])

    @property
    def wiped(self) -> NDArray[np.bool_]:
        """Which samples come after both ends of the voltage range have been visited, shape (N,)."""
        low, high = self.v.min(), self.v.max()
        margin = NEAR_END * (high - low)
        seen_low = np.maximum.accumulate(self.v <= low + margin)
        seen_high = np.maximum.accumulate(self.v >= high - margin)
        both: NDArray[np.bool_] = seen_low & seen_high
        return both


def select_samples(record: Record, axis: str, start: float | None, stop: float | None) -> Samples:
    """Take one axis of a record from ``start <= t < stop`` (s), with the voltage before it.

    Raises
    ------
    UsageError
        If the record has no such axis.
    RecordError
        If the samples are too few, out of order, or one signal does not vary.
    IdentificationError
        If the voltage never turns back.
    """
    record.require_axis(axis)
    where = f"{record.source}: axis '{axis}'"
    back = np.flatnonzero(record.time_ns[1:] < record.time_ns[:-1])
    if back.size:
        at = int(back[0]) + 1
        raise RecordError(
            f"{record.source}: time runs backwards at sample {at} (t = {record.t[at]:.6g} s); sort the record"
        )
    # In order, so that the part to be used is a slice: a long record leaves no room for copies.
    t = record.t
    first = np.searchsorted(t, -np.inf if start is None else start)
    until = np.searchsorted(t, np.inf if stop is None else stop)
    del t
    v, y = record.voltage[axis][:until], record.displacement[axis][:until]
    fitted = np.isfinite(y)
    fitted[:first] = False
    driven = np.isfinite(v)
    if not driven.all():
        v, y, fitted = v[driven], y[driven], fitted[driven]
    count = int(np.count_nonzero(fitted))
    if count < FEWEST:
        raise RecordError(
            f"{where}: {count} usable samples of {len(record)} between start and stop; at least {FEWEST} are needed"
        )
    if count < fitted.size:
        y = np.where(fitted, y, 0.0)
    _require_motion(v, y, fitted, where)
    return Samples(v, y, fitted)


def _require_motion(v: FloatArray, y: FloatArray, fitted: NDArray[np.bool_], where: str) -> None:
    """Raise RecordError unless both signals vary, in their units, and together; IdentificationError without a turn."""
    turns = bool((v[1:] > v[:-1]).any() and (v[1:] < v[:-1]).any())
    if not fitted.all():
        v, y = v[fitted], y[fitted]
    for name, unit, least, most, signal in (("voltage", "V", 1e-6, 1e4, v), ("displacement", "m", 1e-12, 1.0, y)):
        low, high = float(signal.min()), float(signal.max())
        largest = max(-low, high)
        if largest > most:
            raise RecordError(f"{where}: {name} of {largest:g} {unit} is none of a stage; check the unit")
        if high - low < least or high - low <= 1e-9 * largest:
            raise RecordError(
                f"{where}: {name} stays at {signal[0]:g} {unit}; record a drive over the range to be used"
            )
    if not turns:
        raise IdentificationError(f"{where}: {NEVER_TURNS}")
    if (v - v.mean()) @ (y - y.mean()) < 0:
        raise RecordError(f"{where}: displacement falls where voltage rises; change the sign of one of them")


def only_one(records: Sequence[Samples], kind: str) -> Samples:
    """Return the samples of the only record; UsageError where there are several, which `kind` cannot be fitted to."""
    if len(records) != 1:
        raise UsageError(f"{len(records)} records given, but kind '{kind}' is fitted to one; choose one or 'slpi'")
    return records[0]
