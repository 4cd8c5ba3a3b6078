"""Selection and checks of the samples of one axis for a fit."""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.errors import IdentificationError, RecordError, UsageError
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.identification.bad_readings import (
    far_outliers,
    lone_of,
    mixed_by_model,
    mixed_readings,
    outliers_by_model,
    stuck,
    without,
)
from slpi_ros.identification.held_readings import held_readings, left_out
from slpi_ros.identification.signal_statistics import without_noise
from slpi_ros.io.record import Record, each_block, first_step_back, release

# Fewest samples for a fit.
FEWEST = 50
# Number of samples to which a record is thinned; more samples do not change the result.
ENOUGH = 1_000_000
# Length of the windows in which a longer record is examined, and samples that a window sees beyond its ends; it is
# extended until it holds this share of the range of the voltage.
WINDOW, MARGIN, WINDOW_RANGE = 2_000_000, 1_000, 0.5
NEVER_TURNS = "the voltage never turns back; drive it up and down over the range to be used"
# Negative correlation of voltage and displacement above which one sign is wrong.
CLEARLY = 0.3
# The hysteresis state is reset once the voltage has come this near to both ends of its range (share of the range).
NEAR_END = 0.02


@dataclass(frozen=True)
class Samples:
    """Samples of one axis, in time order, with a finite voltage; arrays have shape (N,)."""

    # The first `history` samples form an assumed initial state, and before them the voltage falls from far above,
    # which erases the hysteresis memory; 0: the axis starts at rest.
    v: FloatArray  # V, measurement noise removed, also where not fitted
    y: FloatArray  # m, finite where fitted
    fitted: Mask
    history: int = 0
    mixed: int = 0  # samples not fitted because they are mixed, see `bad_readings.Mixed`
    side: int = 0  # of the neighbour that they are mixed with
    held: float = 1.0  # samples for which each reading is repeated; only the fresh ones are fitted

    @property
    def primed(self) -> bool:
        """Whether the samples begin with an assumed initial state, and so with a fall from far above."""
        return self.history > 0

    def after(self, history: tuple[float, ...]) -> "Samples":
        """Return the samples preceded by the voltages (V) of an initial state."""
        before = np.array(history)
        return replace(
            self,
            v=np.concatenate([before, self.v]),
            y=np.concatenate([np.zeros(before.size), self.y]),
            fitted=np.concatenate([np.zeros(before.size, dtype=bool), self.fitted]),
            history=before.size + self.history,
        )

    def only(self, chosen: Mask) -> "Samples":
        """Return all samples, with the fit restricted to the mask `chosen`, shape (N,)."""
        return replace(self, fitted=self.fitted & chosen)

    def without_mixed(self, path: FloatArray) -> "Samples":
        """Exclude mixed readings from the fit, using the displacement of a model, `path`, shape (N,), metres."""
        # This includes readings next to a reversal, which `select_samples` cannot test without a model.
        if not self.side:
            return self
        fitted, mixed = self.fitted.copy(), mixed_by_model(path, self.y, self.fitted, self.side)
        fitted[mixed] = False
        return replace(self, fitted=fitted, mixed=self.mixed + mixed.size)

    def without_outliers(self, path: FloatArray) -> "Samples":
        """Exclude outliers from the fit, using the displacement of a model, `path`, shape (N,), metres."""
        # Samples with mixed readings are returned unchanged, because outliers cannot be distinguished from these.
        if self.side:
            return self
        at = np.flatnonzero(self.fitted)
        outliers = at[outliers_by_model(path[at], self.y[at], self.v[at])]
        if not outliers.size:
            return self
        fitted = self.fitted.copy()
        fitted[outliers] = False
        return replace(self, fitted=fitted)

    def thinned(self, most: int) -> "Samples":
        """Return about `most` evenly spaced samples plus all reversals, which preserves the hysteresis state."""
        kept = self.thinning(most)
        return self if kept.all() else self.at(kept)

    def thinning(self, most: int) -> Mask:
        """Return the mask, shape (N,), of the samples that `thinned` keeps."""
        every = max(1, round(self.v.size / most))
        kept = np.zeros(self.v.size, dtype=bool)
        fitted = np.flatnonzero(self.fitted)
        if every > 1 and self.held > 1.0:
            # Of a slow sensor, most samples have no reading of their own.
            kept[fitted[:: max(1, round(fitted.size / most))]] = True
        else:
            kept[::every] = True
        if every > 1:
            # Of equal consecutive samples at a reversal, keep both ends.
            ends = np.array(monotone_runs(self.v)).ravel()
            kept[ends[ends < self.v.size]] = kept[np.maximum(ends - 1, 0)] = True
        return kept

    def at(self, kept: Mask) -> "Samples":
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
    def after_reset(self) -> Mask:
        """Mask of the samples after visits to both ends of the voltage range, which reset the state, shape (N,)."""
        low, high = self.v.min(), self.v.max()
        margin = NEAR_END * (high - low)
        own = self.v[self.history :]
        seen_low = np.maximum.accumulate(own <= low + margin)
        seen_high = np.maximum.accumulate(own >= high - margin)
        return np.concatenate([np.zeros(self.history, dtype=bool), seen_low & seen_high])

    @property
    def mostly_after_reset(self) -> bool:
        """Whether at least half of the voltage travel of the fitted samples follows the hysteresis reset."""
        own = self.v[self.history :]
        way = np.abs(np.diff(own, prepend=own[0])) * self.fitted[self.history :]
        return bool(way @ self.after_reset[self.history :] >= 0.5 * way.sum())

    @property
    def judged(self) -> Mask:
        """Mask of the samples that can be held out, (N,)."""
        # Those before the reset of the hysteresis state depend on the initial state: not if `mostly_after_reset`.
        return self.fitted & self.after_reset if self.mostly_after_reset else self.fitted


def select_samples(record: Record, axis: str, start: float | None, stop: float | None) -> Samples:
    """Select the samples of one axis for a fit, ``start <= t < stop`` (s), preceded by all earlier voltages."""
    # A record is assessed before it is fitted.
    key = select_samples, axis, start, stop
    if key not in record.derived:
        record.derived[key] = _selected(record, axis, start, stop)
    samples: Samples = record.derived[key]
    return samples


def _selected(record: Record, axis: str, start: float | None, stop: float | None) -> Samples:
    record.require_axis(axis)
    _require_order(record)
    # Stamps are ordered, so the selection is a slice and long records are not copied.
    t = record.t
    first, until = part_of(t, start, stop)
    v, y = record.voltage[axis][:until], record.displacement[axis][:until]
    fitted = np.isfinite(y)
    fitted[:first] = False
    driven = np.isfinite(v)
    _require_enough(record, axis, int(np.count_nonzero(fitted & driven)), start, stop)
    where, rows = f"{record.source}: axis '{axis}'", _rows_held(record, axis)
    if driven.all():
        return _examined(t[:until], v, y, fitted, where, rows)
    return _examined(t[:until][driven], v[driven], y[driven], fitted[driven], where, rows)


def _rows_held(record: Record, axis: str) -> float:
    """Return the rows for which each reading was held, if held ones have been left out; else 1."""
    found = left_out(record, axis)
    return found.rows if found else 1.0


def select_thinned(
    record: Record, axis: str, start: float | None, stop: float | None, most: int
) -> tuple[Samples, IntArray]:
    """Return what `thinned` returns for the samples of `select_samples`, and their indices in the record."""
    # A record longer than `WINDOW` is examined in windows, which need little memory, each with noise of its own.
    if len(record) <= WINDOW:
        samples = select_samples(record, axis, start, stop)
        # `samples` excludes those without a voltage and those after `stop`.
        at = np.flatnonzero(np.isfinite(record.voltage[axis]))[: samples.v.size]
        if samples.v.size <= most:
            return samples, at
        kept = samples.thinning(most)
        return samples.at(kept), at[kept]
    record.require_axis(axis)
    _require_order(record)
    stamps, origin = record.time_ns, int(record.time_ns[0])
    first, until = bounds(record, start, stop)
    every = max(1, round(until / most))
    parts, indices, count = [], [], 0
    for begin, end in windows(record.voltage[axis], 0, until):
        seen = slice(max(begin - MARGIN, 0), min(end + MARGIN, until))
        v, y = record.voltage[axis][seen], record.displacement[axis][seen]
        driven = np.flatnonzero(np.isfinite(v))
        at = driven + seen.start
        v, y, t = v[driven], y[driven], np.asarray((stamps[seen][driven] - origin) * 1e-9)
        fitted = np.isfinite(y) & (at >= first)
        own = (at >= begin) & (at < end)
        count += int(np.count_nonzero(fitted & own))
        if np.count_nonzero(fitted) >= FEWEST:
            samples = _examined(t, v, y, fitted, "", _rows_held(record, axis))
        else:
            samples = Samples(v, np.where(fitted, y, 0.0), np.zeros(v.size, dtype=bool))
        kept = own & samples.thinning(max(1, round(samples.v.size / every)))
        parts.append(samples.at(kept))
        indices.append(at[kept])
        release(stamps, record.voltage[axis], record.displacement[axis])
    _require_enough(record, axis, count, start, stop)
    sides = np.array([part.side for part in parts])
    whole = Samples(
        held=float(np.median([part.held for part in parts])),
        v=np.concatenate([part.v for part in parts]),
        y=np.concatenate([part.y for part in parts]),
        fitted=np.concatenate([part.fitted for part in parts]),
        mixed=sum(part.mixed for part in parts),
        side=int(np.sign(sides.sum())),
    )
    _require_motion(whole.v, whole.y, whole.fitted, f"{record.source}: axis '{axis}'")
    return whole, np.concatenate(indices)


def windows(v: FloatArray, first: int, until: int) -> Iterator[tuple[int, int]]:
    """Yield the bounds of windows of a voltage (V, (N,)), from `first` to `until`, each with enough of its range."""
    # The memory of a mapped voltage is released after each window.
    low, high = np.inf, -np.inf
    for (part,) in each_block(v[first:until]):
        finite = part[np.isfinite(part)]
        low, high = min(low, finite.min(initial=np.inf)), max(high, finite.max(initial=-np.inf))
    begin = first
    for end in [*range(first + WINDOW, until - WINDOW // 2, WINDOW), until]:
        finite = v[begin:end][np.isfinite(v[begin:end])]
        if end == until or finite.max(initial=-np.inf) - finite.min(initial=np.inf) >= WINDOW_RANGE * (high - low):
            yield begin, end
            begin = end
        release(v)


def _require_order(record: Record) -> None:
    stamps, at = record.time_ns, first_step_back(record.time_ns)
    if at is not None:
        before, then = ((int(stamps[k]) - int(stamps[0])) * 1e-9 for k in (at - 1, at))
        part = f"use the part before it (--stop {before:.6g}), or record again" if at >= FEWEST else "record again"
        raise RecordError(
            f"{record.source}: stamps go back by {before - then:.4g} s at message {at + 1} of {len(record)}, from "
            f"{before:.6g} to {then:.6g} s: {part}"
        )
    if len(record) >= FEWEST and stamps[0] == stamps[-1]:
        raise RecordError(
            f"{record.source}: all {len(record)} messages have one stamp, so that nothing can be said of time; record "
            "the stamps of the sensor"
        )


def _require_enough(record: Record, axis: str, count: int, start: float | None, stop: float | None) -> None:
    if count < FEWEST:
        seconds = (int(record.time_ns[-1]) - int(record.time_ns[0])) * 1e-9 if len(record) else 0.0
        part = "" if start is None and stop is None else f" between start and stop, of {seconds:.6g} s in all"
        raise RecordError(
            f"{record.source}: axis '{axis}': {count} usable samples of {len(record)}{part}; "
            f"at least {FEWEST} are needed"
        )


def _examined(t: FloatArray, v: FloatArray, y: FloatArray, fitted: Mask, where: str, rows: float) -> Samples:
    """Return the samples, with a smooth voltage; outliers and repeated, stuck and mixed readings are not `fitted`."""
    # The mask `fitted` has at least `FEWEST` samples and is modified in place. `where` names the record in the error of
    # signals without motion; "" for a part of a record, which is not tested. Each reading was held for `rows`, if held
    # ones have been left out before.
    known = np.flatnonzero(fitted)
    held = held_readings(y[known], v[known])
    fitted[known[~held.fresh]] = False
    if not fitted.all():
        y = np.where(fitted, y, 0.0)
    # Outliers of the voltage must not count as reversals or extend the range.
    far_v, far_y = far_outliers(v, without(y, np.flatnonzero(~fitted)))
    v = without(v, far_v)
    fitted[far_y] = False
    if where:
        _require_motion(v, y, fitted, where)
    # Stuck and mixed readings are not fitted.
    known = np.flatnonzero(fitted)
    fitted[known[stuck(y[known], v[known])]] = False
    known = np.flatnonzero(fitted)
    mixed = mixed_readings(y[known], v[known])
    off_v, off_y = lone_of(t[known], v[known], y[known], at_kinks=False)
    # If the record has mixed readings, only these are excluded: they look like outliers, too.
    fitted[known[mixed.readings if mixed.side else off_y]] = False
    smooth = without_noise(t, without(v, known[off_v]))
    return Samples(smooth, y, fitted, mixed=mixed.readings.size, side=mixed.side, held=max(held.rows, rows))


def ends_of(start: float | None, stop: float | None) -> tuple[float, float]:
    """Return the ends (s) of a part of a record, infinite where None; UsageError unless start < stop."""
    low, high = -np.inf if start is None else start, np.inf if stop is None else stop
    if not low < high:
        raise UsageError(f"start {start} s is not before stop {stop} s; give seconds from the first stamp, in order")
    return low, high


def part_of(t: FloatArray, start: float | None, stop: float | None) -> tuple[int, int]:
    """Return indices ``first:until`` of ``start <= t < stop`` (s) in ordered times; UsageError unless start < stop."""
    low, high = ends_of(start, stop)
    return int(np.searchsorted(t, low)), int(np.searchsorted(t, high))


def bounds(record: Record, start: float | None, stop: float | None) -> tuple[int, int]:
    """Return `part_of` for a record with ordered stamps, without its times as an array."""
    low, high = ends_of(start, stop)
    origin = int(record.time_ns[0])
    first, until = (
        bisect_left(record.time_ns, at, key=lambda stamp: (int(stamp) - origin) * 1e-9) for at in (low, high)
    )
    return first, until


def _require_motion(v: FloatArray, y: FloatArray, fitted: Mask, where: str) -> None:
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
        raise RecordError(
            f"{where}: {butterfly(v, y) or 'displacement falls where voltage rises; change the sign of one of them'}"
        )


def butterfly(v: FloatArray, y: FloatArray) -> str:
    """Return what a displacement (m) is that follows both signs of a voltage (V) alike, (N,); "" if it does not."""
    both = float(v.min()) < 0.0 < float(v.max())
    if not both or abs(np.corrcoef(np.abs(v), y)[0, 1]) <= abs(np.corrcoef(v, y)[0, 1]):
        return ""
    return (
        "the displacement is V-shaped over the voltage, as of a ferroelectric that a bipolar drive switches: no model "
        "here describes that; drive within one sign of the voltage"
    )


def only_one(records: Sequence[Samples], kind: str) -> Samples:
    """Return the thinned samples of a single record; UsageError for several, as `kind` cannot be fitted to them."""
    if len(records) != 1:
        raise UsageError(f"{len(records)} records given, but kind '{kind}' is fitted to one; choose one or 'slpi'")
    return records[0].thinned(ENOUGH)
