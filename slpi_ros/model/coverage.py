"""What the record of a model covered, and whether a path or another record goes beyond it."""

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.arrays.rates import fastest
from slpi_ros.model.axis_model import AxisModel

# A signal is faster, or wider, than the record beyond this ratio of rates, or this share of the range.
FASTER, WIDER = 1.5, 0.02


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
