"""The samples of one axis that a fit uses, after the checks that every fit needs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.signal_statistics import mixed_readings, stuck, without_noise
from slpi_ros.io.record import Record

FloatArray = NDArray[np.float64]

# Fewer samples than this say nothing about a loop.
FEWEST = 50
# More than this need time and memory, and tell nothing new.
ENOUGH = 1_000_000
NEVER_TURNS = "the voltage never turns back; drive it up and down over the range to be used"
# A displacement that falls where the voltage rises does so clearly: this correlation is none of chance.
CLEARLY = 0.3
# The memory counts as wiped once the voltage has come this near to both ends of its range (share of the range).
NEAR_END = 0.02


@dataclass(frozen=True)
class Samples:
    """One axis, in time order, without gaps in the voltage.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        All that moves the memory; without the noise of its measurement.
    y : ndarray, shape (N,), metres
        Finite where `fitted`.
    fitted : ndarray of bool, shape (N,)
        Samples whose displacement is to be fitted.
    history : int
        How many of the first samples are those of an earlier drive. A long fall to the first one wiped the memory;
        without any the axis had never been moved.
    """

    v: FloatArray
    y: FloatArray
    fitted: NDArray[np.bool_]
    history: int = 0

    @property
    def primed(self) -> bool:
        """Whether a long fall to the first voltage wiped the memory."""
        return self.history > 0

    def after(self, history: tuple[float, ...]) -> "Samples":
        """Return the samples with the voltages of an earlier drive before them."""
        before = np.array(history)
        return Samples(
            np.concatenate([before, self.v]),
            np.concatenate([np.zeros(before.size), self.y]),
            np.concatenate([np.zeros(before.size, dtype=bool), self.fitted]),
            history=before.size + self.history,
        )

    def only(self, chosen: NDArray[np.bool_]) -> "Samples":
        """Return the samples with only those fitted that are `chosen`, shape (N,)."""
        return replace(self, fitted=self.fitted & chosen)

    def thinned(self, most: int) -> "Samples":
        """Return every so manieth sample, about `most` of them, and all at which the voltage turns: the same memory."""
        kept = self.thinning(most)
        return self if kept.all() else self.at(kept)

    def thinning(self, most: int) -> NDArray[np.bool_]:
        """Return which samples are kept where about `most` are, shape (N,)."""
        every = max(1, round(self.v.size / most))
        kept = np.zeros(self.v.size, dtype=bool)
        kept[::every] = True
        if every > 1:
            # Of equal samples in a row both ends: the memory does not tell which one is the turn.
            ends = np.array(monotone_runs(self.v)).ravel()
            kept[ends[ends < self.v.size]] = kept[np.maximum(ends - 1, 0)] = True
        return kept

    def at(self, kept: NDArray[np.bool_]) -> "Samples":
        """Return the samples that are `kept`, shape (N,)."""
        return Samples(self.v[kept], self.y[kept], self.fitted[kept], int(np.count_nonzero(kept[: self.history])))

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
        own = self.v[self.history :]
        seen_low = np.maximum.accumulate(own <= low + margin)
        seen_high = np.maximum.accumulate(own >= high - margin)
        return np.concatenate([np.zeros(self.history, dtype=bool), seen_low & seen_high])

    @property
    def mostly_wiped(self) -> bool:
        """Whether the larger part of the way that is fitted comes after the memory was wiped."""
        own = self.v[self.history :]
        way = np.abs(np.diff(own, prepend=own[0])) * self.fitted[self.history :]
        return bool(way @ self.wiped[self.history :] >= 0.5 * way.sum())

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Which samples can be predicted from others, shape (N,).

        What comes before the memory was wiped depends on what moved the axis before, and is seen only once.
        """
        return self.fitted & self.wiped if self.mostly_wiped else self.fitted


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
    first, until = part_of(t, start, stop)
    t = t[:until]
    v, y = record.voltage[axis][:until], record.displacement[axis][:until]
    fitted = np.isfinite(y)
    fitted[:first] = False
    driven = np.isfinite(v)
    if not driven.all():
        v, y, fitted = v[driven], y[driven], fitted[driven]
    count = int(np.count_nonzero(fitted))
    if count < FEWEST:
        part = "" if start is None and stop is None else f" between start and stop, of {record.t[-1]:.6g} s in all"
        raise RecordError(f"{where}: {count} usable samples of {len(record)}{part}; at least {FEWEST} are needed")
    if count < fitted.size:
        y = np.where(fitted, y, 0.0)
    _require_motion(v, y, fitted, where)
    # A sensor that hangs says nothing, as one that is silent; a reading mixed with another says something wrong.
    for bad in (stuck, mixed_readings):
        if fitted.all():
            fitted[bad(y, v)] = False
        else:
            known = np.flatnonzero(fitted)
            fitted[known[bad(y[known], v[known])]] = False
    return Samples(without_noise(t if driven.all() else t[driven], v), y, fitted)


def part_of(t: FloatArray, start: float | None, stop: float | None) -> tuple[int, int]:
    """Return the samples ``first:until`` with ``start <= t < stop`` (s) of times in order; UsageError without order."""
    low, high = -np.inf if start is None else start, np.inf if stop is None else stop
    if not low < high:
        raise UsageError(f"start {start} s is not before stop {stop} s; give seconds from the first stamp, in order")
    return int(np.searchsorted(t, low)), int(np.searchsorted(t, high))


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
    if np.corrcoef(v, y)[0, 1] < -CLEARLY:
        raise RecordError(f"{where}: displacement falls where voltage rises; change the sign of one of them")


def only_one(records: Sequence[Samples], kind: str) -> Samples:
    """Return the samples of the only record, thinned; UsageError for several, which `kind` cannot be fitted to."""
    if len(records) != 1:
        raise UsageError(f"{len(records)} records given, but kind '{kind}' is fitted to one; choose one or 'slpi'")
    return records[0].thinned(ENOUGH)
