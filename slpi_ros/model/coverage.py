"""What the record of a model covered, and whether a path or another record goes beyond it."""

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.model.axis_model import AxisModel

# Samples before and after one between which its rate is taken.
REACH = 2
# This share of the way may be faster than the rate of a signal: jumps and late stamps do not count.
FAST_SHARE = 0.05
# A signal is faster, or wider, than the record beyond this ratio of rates, or this share of the range.
FASTER, WIDER = 1.5, 0.02


def slopes(t: FloatArray, x: FloatArray) -> FloatArray:
    """Return dx/dt, shape (N,), unit of `x` per second, by central differences over a few samples."""
    at = np.arange(x.size)
    before, after = np.maximum(at - REACH, 0), np.minimum(at + REACH, x.size - 1)
    seconds = t[after] - t[before]
    return np.divide(x[after] - x[before], seconds, out=np.zeros(x.size), where=seconds > 0.0)


def rates(t: FloatArray, x: FloatArray) -> FloatArray:
    """Return the magnitude of dx/dt, shape (N,), unit of `x` per second; see `slopes`."""
    return np.abs(slopes(t, x))


def fastest(t: FloatArray, x: FloatArray) -> float:
    """Return the rate (unit of `x` per second) at or above which a signal, (N,), covers `FAST_SHARE` of its way."""
    rate, way = rates(t, x), np.abs(np.diff(x, prepend=x[:1]))
    order = np.argsort(rate)[::-1]
    far = np.cumsum(way[order])
    return float(rate[order][np.searchsorted(far, FAST_SHARE * far[-1])]) if far.size and far[-1] > 0.0 else 0.0


def fastest_displacement(axis: AxisModel) -> float | None:
    """Return the fastest rate of the record, m/s at the mean slope of the stage; None in older documents."""
    rate = axis.quality.fastest
    return None if rate is None else rate * float(np.ptp(axis.displacement_range) / np.ptp(axis.voltage_range))


def path_beyond(axis: AxisModel, t: FloatArray, y: FloatArray) -> str:
    """Return where desired displacements `y` (m) at `t` (s), (N,), NaN: none, are beyond the record; "" if nowhere."""
    known = np.isfinite(y)
    t, y = t[known], y[known] * 1e6
    low, high = (1e6 * end for end in axis.displacement_range)
    rate = fastest_displacement(axis)
    return _beyond("the path", fastest(t, y), y, None if rate is None else 1e6 * rate, (low, high), "µm")


def record_beyond(axis: AxisModel, t: FloatArray, v: FloatArray) -> str:
    """Return where the voltage `v` (V) of a record at `t` (s), (N,), is beyond the record of the model; else ""."""
    known = np.isfinite(v)
    t, v = t[known], v[known]
    return _beyond("this record", fastest(t, v), v, axis.quality.fastest, axis.voltage_range, "V")


def surroundings_beyond(axis: AxisModel, t: FloatArray) -> str:
    """Return which quantities are not known at times `t` (s), (N,), or beyond what was recorded; else ""."""
    told = []
    for one in axis.followed:
        course = axis.surroundings.get(one.key)
        if course is None:
            told.append(f"{one.key} is not known and taken as {one.reference:.4g}")
            continue
        value, margin = np.interp(t, *course), WIDER * (one.highest - one.lowest)
        if value.min() < one.lowest - margin or value.max() > one.highest + margin:
            told.append(
                f"{one.key} goes from {value.min():.4g} to {value.max():.4g}, in the record of the model from "
                f"{one.lowest:.4g} to {one.highest:.4g}"
            )
    return "; ".join(told)


def _beyond(
    what: str, rate: float, x: FloatArray, known_rate: float | None, known: tuple[float, float], unit: str
) -> str:
    if not x.size:
        return ""
    told, (low, high) = [], known
    if known_rate is not None and rate > FASTER * known_rate:
        told.append(faster(what, rate, known_rate, unit))
    margin = WIDER * (high - low)
    if x.min() < low - margin or x.max() > high + margin:
        told.append(
            f"{what} goes from {x.min():.4g} to {x.max():.4g} {unit}, the record of the model from {low:.4g} to "
            f"{high:.4g} {unit}"
        )
    return "; ".join(told)


def faster(what: str, rate: float, known: float, unit: str) -> str:
    """Return a sentence on a rate beyond that of the record, both in the unit per second."""
    return f"{what} moves at up to {rate:.3g} {unit}/s, the record of the model at up to {known:.3g} {unit}/s"
