"""Selection and checks of the samples of one axis for a fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.bad_readings import (
    far_outliers,
    lone_of,
    mixed_beside,
    mixed_readings,
    outliers_beside,
    stuck,
    without,
)
from slpi_ros.identification.signal_statistics import without_noise
from slpi_ros.io.record import Record

FloatArray = NDArray[np.float64]

# Fewest samples for a fit.
FEWEST = 50
# Number of samples to which a record is thinned; more samples do not change the result.
ENOUGH = 1_000_000
NEVER_TURNS = "the voltage never turns back; drive it up and down over the range to be used"
# Negative correlation of voltage and displacement above which one sign is wrong.
CLEARLY = 0.3
# The hysteresis state is reset once the voltage has come this near to both ends of its range (share of the range).
NEAR_END = 0.02


@dataclass(frozen=True)
class Samples:
    """Samples of one axis, in time order, with a finite voltage.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
        Voltage, including samples that are not fitted, with measurement noise removed.
    y : ndarray, shape (N,), metres
        Displacement; finite where `fitted`.
    fitted : ndarray of bool, shape (N,)
        Samples whose displacement is to be fitted.
    history : int
        Number of leading samples that form an assumed initial history. Before the first of them the voltage falls from
        far above, which erases the hysteresis memory. Default 0: the axis starts at rest.
    mixed, side : int
        Number of samples that are not fitted because their displacement belongs to a neighbouring sample or is a
        mixture with it, and the side of that neighbour, as in `slpi_ros.identification.bad_readings.Mixed`. Default 0.
    """

    v: FloatArray
    y: FloatArray
    fitted: NDArray[np.bool_]
    history: int = 0
    mixed: int = 0
    side: int = 0

    @property
    def primed(self) -> bool:
        """Whether the samples begin with an assumed initial history, and so with a fall from far above."""
        return self.history > 0

    def after(self, history: tuple[float, ...]) -> "Samples":
        """Return the samples preceded by the voltages (V) of an initial history."""
        before = np.array(history)
        return replace(
            self,
            v=np.concatenate([before, self.v]),
            y=np.concatenate([np.zeros(before.size), self.y]),
            fitted=np.concatenate([np.zeros(before.size, dtype=bool), self.fitted]),
            history=before.size + self.history,
        )

    def only(self, chosen: NDArray[np.bool_]) -> "Samples":
        """Return all samples, with the fit restricted to the mask `chosen`, shape (N,)."""
        return replace(self, fitted=self.fitted & chosen)

    def without_mixed(self, path: FloatArray) -> "Samples":
        """Exclude mixed readings from the fit, using the displacement of a model, `path`, shape (N,), metres.

        This includes readings next to a reversal, which `select_samples` cannot test without a model.
        """
        if not self.side:
            return self
        fitted, mixed = self.fitted.copy(), mixed_beside(path, self.y, self.fitted, self.side)
        fitted[mixed] = False
        return replace(self, fitted=fitted, mixed=self.mixed + mixed.size)

    def without_outliers(self, path: FloatArray) -> "Samples":
        """Exclude outliers from the fit, using the displacement of a model, `path`, shape (N,), metres.

        Samples with mixed readings are returned unchanged: outliers cannot be distinguished from mixed readings.
        """
        if self.side:
            return self
        off = np.flatnonzero(self.fitted)[outliers_beside(path[self.fitted], self.y[self.fitted], self.v[self.fitted])]
        return self.only(np.isin(np.arange(self.v.size), off, invert=True)) if off.size else self

    def thinned(self, most: int) -> "Samples":
        """Return about `most` evenly spaced samples plus all reversals, which preserves the hysteresis state."""
        kept = self.thinning(most)
        return self if kept.all() else self.at(kept)

    def thinning(self, most: int) -> NDArray[np.bool_]:
        """Return the mask, shape (N,), of the samples that `thinned` keeps."""
        every = max(1, round(self.v.size / most))
        kept = np.zeros(self.v.size, dtype=bool)
        kept[::every] = True
        if every > 1:
            # Of equal consecutive samples at a reversal, keep both ends.
            ends = np.array(monotone_runs(self.v)).ravel()
            kept[ends[ends < self.v.size]] = kept[np.maximum(ends - 1, 0)] = True
        return kept

    def at(self, kept: NDArray[np.bool_]) -> "Samples":
        """Return only the samples selected by the mask `kept`, shape (N,)."""
        history = int(np.count_nonzero(kept[: self.history]))
        return replace(self, v=self.v[kept], y=self.y[kept], fitted=self.fitted[kept], history=history)

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Smallest and largest voltage among the fitted samples, volts."""
        v = self.v[self.fitted]
        return float(v.min()), float(v.max())

    @property
    def spread(self) -> tuple[float, float]:
        """Ranges of voltage (V) and displacement (m) of the fitted samples, from the 1st to the 99th percentile."""
        v, y = (np.percentile(x[self.fitted], (1, 99)) for x in (self.v, self.y))
        return float(v[1] - v[0]), float(y[1] - y[0])

    @property
    def wiped(self) -> NDArray[np.bool_]:
        """Mask of the samples after visits to both ends of the voltage range, which reset the state, shape (N,)."""
        low, high = self.v.min(), self.v.max()
        margin = NEAR_END * (high - low)
        own = self.v[self.history :]
        seen_low = np.maximum.accumulate(own <= low + margin)
        seen_high = np.maximum.accumulate(own >= high - margin)
        return np.concatenate([np.zeros(self.history, dtype=bool), seen_low & seen_high])

    @property
    def mostly_wiped(self) -> bool:
        """Whether at least half of the voltage travel of the fitted samples follows the hysteresis reset (`wiped`)."""
        own = self.v[self.history :]
        way = np.abs(np.diff(own, prepend=own[0])) * self.fitted[self.history :]
        return bool(way @ self.wiped[self.history :] >= 0.5 * way.sum())

    @property
    def judged(self) -> NDArray[np.bool_]:
        """Mask of the samples that can be held out, shape (N,).

        Samples before the reset of the hysteresis state depend on the initial history and cannot be predicted; they are
        excluded if `mostly_wiped`.
        """
        return self.fitted & self.wiped if self.mostly_wiped else self.fitted


def select_samples(record: Record, axis: str, start: float | None, stop: float | None) -> Samples:
    """Select the samples of one axis for a fit, ``start <= t < stop`` (s), preceded by all earlier voltages.

    Raises
    ------
    UsageError
        If the record has no such axis.
    RecordError
        If the samples are too few or unordered, or a signal is constant, implausibly large or of the wrong sign.
    IdentificationError
        If the voltage has no reversal.
    """
    record.require_axis(axis)
    where = f"{record.source}: axis '{axis}'"
    back = np.flatnonzero(record.time_ns[1:] < record.time_ns[:-1])
    if back.size:
        at = int(back[0]) + 1
        raise RecordError(
            f"{record.source}: time runs backwards at sample {at} (t = {record.t[at]:.6g} s); sort the record"
        )
    # Stamps are ordered, so the selection is a slice and long records are not copied.
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
    # Outliers of the voltage must not count as reversals or extend the range.
    when = t if driven.all() else t[driven]
    far_v, far_y = far_outliers(v, without(y, np.flatnonzero(~fitted)))
    v = without(v, far_v)
    fitted[far_y] = False
    _require_motion(v, y, fitted, where)
    # Stuck and mixed readings are not fitted.
    known = np.flatnonzero(fitted)
    fitted[known[stuck(y[known], v[known])]] = False
    known = np.flatnonzero(fitted)
    mixed = mixed_readings(y[known], v[known])
    off_v, off_y = lone_of(when[known], v[known], y[known], at_kinks=False)
    # If the record has mixed readings, only these are excluded: they look like outliers, too.
    fitted[known[mixed.readings if mixed.side else off_y]] = False
    smooth = without_noise(when, without(v, known[off_v]))
    return Samples(smooth, y, fitted, mixed=mixed.readings.size, side=mixed.side)


def part_of(t: FloatArray, start: float | None, stop: float | None) -> tuple[int, int]:
    """Return indices ``first:until`` of ``start <= t < stop`` (s) in ordered times; UsageError unless start < stop."""
    low, high = -np.inf if start is None else start, np.inf if stop is None else stop
    if not low < high:
        raise UsageError(f"start {start} s is not before stop {stop} s; give seconds from the first stamp, in order")
    return int(np.searchsorted(t, low)), int(np.searchsorted(t, high))


def _require_motion(v: FloatArray, y: FloatArray, fitted: NDArray[np.bool_], where: str) -> None:
    """Raise RecordError for constant, implausible or opposing signals, IdentificationError if there is no reversal."""
    turns = bool((v[1:] > v[:-1]).any() and (v[1:] < v[:-1]).any())
    if not fitted.all():
        v, y = v[fitted], y[fitted]
    for name, unit, least, most, signal in (("voltage", "V", 1e-6, 1e4, v), ("displacement", "m", 1e-12, 1.0, y)):
        low, high = float(signal.min()), float(signal.max())
        largest = max(-low, high)
        if largest > most:
            raise RecordError(f"{where}: {name} of {largest:g} {unit} is not plausible for a stage; check the unit")
        if high - low < least or high - low <= 1e-9 * largest:
            raise RecordError(
                f"{where}: {name} stays at {signal[0]:g} {unit}; record a drive over the range to be used"
            )
    if not turns:
        raise IdentificationError(f"{where}: {NEVER_TURNS}")
    if np.corrcoef(v, y)[0, 1] < -CLEARLY:
        raise RecordError(f"{where}: displacement falls where voltage rises; change the sign of one of them")


def only_one(records: Sequence[Samples], kind: str) -> Samples:
    """Return the thinned samples of a single record; UsageError for several, as `kind` cannot be fitted to them."""
    if len(records) != 1:
        raise UsageError(f"{len(records)} records given, but kind '{kind}' is fitted to one; choose one or 'slpi'")
    return records[0].thinned(ENOUGH)
