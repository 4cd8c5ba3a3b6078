"""The repeatability of a record: how much repetitions of the same motion differ."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.identification.drive import hold_band, resting, smallest_turn
from slpi_ros.identification.signal_statistics import FEWEST, digit, noise

_FEWEST_READINGS = 5
# Largest number of moves and of holds used, evenly spread over the record; number of earlier moves searched.
_ENOUGH_PIECES, _LOOK_BACK = 1000, 1000
# Largest difference of equal reversals, and rms difference of voltages along equal moves (shares of the voltage range).
_SAME_TURN, _SAME_VOLTAGE = 0.005, 0.003
_FEWEST_OF_MOVE, _FEWEST_OF_HOLD = 10, 20
# Length (s) of the pieces into which a hold is cut, so that creep within a piece is nearly a parabola.
_LONGEST_PIECE = 2.0
# Limit for outliers, in standard deviations; rms of a Gaussian truncated there; number of truncations.
_OUTLIER, _CUT_GAUSSIAN, _CUTS = 2.5, 0.95460, 5
_ROBUST_FITS = 3
# Noise below this share of the range is due to rounding.
NO_NOISE = 1e-9


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of a record."""

    rms: float  # m, of the differences between repetitions, per reading
    source: str  # the data from which it was estimated, with numbers


def repeatability_of(t: FloatArray, v: FloatArray, y: FloatArray, residual: FloatArray | None = None) -> Repeatability:
    """Estimate the repeatability of a record: noise and all other differences between repetitions of a motion."""
    # Estimated from repeated moves between the same reversals if there are enough; else from holds; else from the
    # sample-to-sample noise. Slow and smooth differences (drift, creep) do not count. Neither do outliers. The residual
    # of a model (m) replaces `y` (m, NaN where unknown), so that drift and lines it describes do not count.
    signal = y if residual is None else residual
    usable = np.isfinite(v) & np.isfinite(signal)
    t, v, y, signal = t[usable], v[usable], y[usable], signal[usable]
    if t.size < _FEWEST_READINGS:
        raise RecordError(f"{t.size} samples have no repeatability; give at least {_FEWEST_READINGS}")
    found = _seen(t, v, signal, alone=residual is not None)
    step = digit(y)
    if found.rms < step / np.sqrt(12.0):
        return Repeatability(step / np.sqrt(12.0), f"digits: {step * 1e9:.3g} nm from one reading to the next")
    if found.rms < NO_NOISE * np.ptp(y):
        return Repeatability(0.0, f"no noise in {found.source}")
    return found


def _seen(t: FloatArray, v: FloatArray, signal: FloatArray, *, alone: bool) -> Repeatability:
    for name, seen in (("repeats", _repeats(t, v, signal)), ("holds", _holds(t, v, signal))):
        parts = list(seen)
        pooled = np.concatenate([np.empty(0), *parts])
        if pooled.size >= FEWEST:
            what = {"repeats": "moves made again", "holds": "pieces of holds"}[name]
            return Repeatability(robust_rms(pooled), f"{name}: {len(parts)} {what}, {pooled.size} samples")
    level = noise(signal, t) if alone else noise(signal, t, v)
    return Repeatability(
        level, f"high frequencies: {signal.size} samples, each beside its neighbours; slow noise is not seen"
    )


def robust_rms(x: FloatArray) -> float:
    """Return the rms of `x`, shape (N,), without outliers; unbiased for a Gaussian distribution."""
    size = np.abs(x)
    spread = 1.4826 * float(np.median(size))
    for _ in range(_CUTS):
        spread = float(np.sqrt(np.mean(size[size <= _OUTLIER * spread] ** 2))) / _CUT_GAUSSIAN
    # Where most are equal (coarse digits), nothing is an outlier.
    return spread or float(np.sqrt(np.mean(x**2)))


def _repeats(t: FloatArray, v: FloatArray, signal: FloatArray) -> Iterator[FloatArray]:
    """Yield the difference (m) of each repeated move from its earlier repetition, scaled to noise of one reading."""
    # Between two reversals the stage follows one branch until the enclosing loop closes; motion before the previous
    # reversal has no influence.
    span = float(np.ptp(v))
    ends = reversals(v, smallest_turn(v, noise(v, t)))
    # For each move: voltage of the reversal before its start, of its start and of its end.
    turns = np.column_stack([v[ends[:-2]], v[ends[1:-1]], v[ends[2:]]])
    for move in range(1, len(turns), max(1, len(turns) // _ENOUGH_PIECES)):
        earliest = max(0, move - _LOOK_BACK)
        alike = np.flatnonzero(np.abs(turns[earliest:move] - turns[move]).max(axis=1) < _SAME_TURN * span)
        if not alike.size:
            continue
        own, other = (
            Move(t[part] - t[part.start], v[part], signal[part])
            for part in (slice(ends[k + 1], ends[k + 2] + 1) for k in (move, earliest + int(alike[-1])))
        )
        direction = np.sign(turns[move, 2] - turns[move, 1])
        within = direction * (own.v - turns[move, 0]) <= 0.0
        difference = _difference(own, other, within, _SAME_VOLTAGE * span)
        if difference.size:
            yield difference


class Move(NamedTuple):
    """Move from one reversal to the next: time since its start (s), voltage (V) and signal (m)."""

    t: FloatArray
    v: FloatArray
    signal: FloatArray


def _difference(own: Move, other: Move, within: Mask, same: float) -> FloatArray:
    """Return the difference (m) of two moves at samples `within`; empty if their voltages differ by over `same` (V)."""
    t, v, signal = (x[within] for x in own)
    if min(t.size, other.t.size) < _FEWEST_OF_MOVE:
        return np.empty(0)
    shift = _shift(t, v, other.t, other.v)
    inside = (t + shift >= other.t[0]) & (t + shift <= other.t[-1])
    t, v, signal = t[inside], v[inside], signal[inside]
    if t.size < _FEWEST_OF_MOVE:
        return np.empty(0)
    after = np.clip(np.searchsorted(other.t, t + shift), 1, other.t.size - 1)
    before = after - 1
    step = other.t[after] - other.t[before]
    share = np.divide(t + shift - other.t[before], step, out=np.zeros_like(t), where=step > 0.0)
    v_other, signal_other = ((1.0 - share) * x[before] + share * x[after] for x in (other.v, other.signal))
    if np.sqrt(np.mean((v - v_other) ** 2)) > same:
        return np.empty(0)
    # A value interpolated between two readings is less noisy than these.
    weight = 1.0 / np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    # A small voltage difference causes a displacement difference, with a gain that changes along the move.
    beside = v - v_other
    return _without(weight * (signal - signal_other), *(weight * x for x in (np.ones_like(t), t, beside, beside * t)))


def _shift(t: FloatArray, v: FloatArray, t_other: FloatArray, v_other: FloatArray) -> float:
    """Return the delay (s) of the other move for the best match of the voltages."""
    rate = np.gradient(v, np.maximum.accumulate(t) + 1e-12 * np.arange(t.size))
    shift = 0.0
    for _ in range(3):
        behind = v - np.interp(t + shift, t_other, v_other)
        shift += float(behind @ rate / max(rate @ rate, 1e-300))
    return shift


def _holds(t: FloatArray, v: FloatArray, signal: FloatArray) -> Iterator[FloatArray]:
    """Yield the residual (m) of a parabola fitted to each piece of a hold."""
    starts, stops = resting(t, v, hold_band(v, noise(v, t), digit(v)))
    every = max(1, starts.size // _ENOUGH_PIECES)
    for start, stop in zip(starts[::every].tolist(), stops[::every].tolist(), strict=True):
        # In its first half the stage still creeps after the preceding move.
        first = (start + stop) // 2
        pieces = max(1, round((t[stop - 1] - t[first]) / _LONGEST_PIECE))
        for piece in np.array_split(np.arange(first, stop), pieces):
            if piece.size >= _FEWEST_OF_HOLD:
                since = t[piece] - t[piece[0]]
                yield _without(signal[piece], np.ones(piece.size), since, since**2)


def _without(x: FloatArray, *columns: FloatArray) -> FloatArray:
    """Return the residual of a robust fit of `columns` to `x`, shape (n,), corrected for the degrees of freedom."""
    design = np.column_stack(columns)
    size = np.sqrt((design**2).sum(axis=0))
    design = design[:, size > 0.0] / size[size > 0.0]
    left = x
    for _ in range(_ROBUST_FITS):
        kept = np.abs(left) <= _OUTLIER * 1.4826 * np.median(np.abs(left)) if left is not x else slice(None)
        left = x - design @ np.linalg.lstsq(design[kept], x[kept], rcond=1e-9)[0]
    return np.asarray(left * np.sqrt(x.size / (x.size - design.shape[1])))
