"""Statistics of a model's errors on its records that its uncertainty needs: by region of the motion, and over time."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.model.axis_model import FitQuality
from slpi_ros.model.uncertainty import REGIONS

# Fewest samples that tell the error of a region.
FEWEST_OF_REGION = 20
# A record is cut into this many blocks of equal duration. The drift is that between blocks so far apart.
BLOCKS, APART = 16, (8, 15)


def with_statistics(
    quality: FitQuality, records: Sequence[tuple[FloatArray, ...]], displacement_range: tuple[float, float]
) -> FitQuality:
    """Return the quality with what the uncertainty needs: times (s), displacements and errors (m), (N,), of records."""
    y, error = (np.concatenate([record[k] for record in records]) for k in (1, 2))
    low, high = displacement_range
    return replace(
        quality,
        regions=by_region(y, error, displacement_range),
        drift=drift_of([(t, beside(y, left, low, high)) for t, y, *_, left in records]),
        duration=max(float(record[0][-1] - record[0][0]) for record in records),
    )


def by_region(y: FloatArray, error: FloatArray, displacement_range: tuple[float, float]) -> tuple[float | None, ...]:
    """Return the rms of errors (m) in `REGIONS` equal parts of a range (m); None where too few samples tell it.

    `y` is the displacement (m), `error` its error (m), shape (N,) each.
    """
    place = _region(y, *displacement_range)
    count = np.bincount(place, minlength=REGIONS)
    square = np.bincount(place, error**2, minlength=REGIONS)
    return tuple(
        float(np.sqrt(total / n)) if n >= FEWEST_OF_REGION else None
        for total, n in zip(square.tolist(), count.tolist(), strict=True)
    )


def beside(y: FloatArray, error: FloatArray, low: float, high: float) -> FloatArray:
    """Return errors (m) without their mean in each region of the range `low` to `high` (m) and direction, shape (N,).

    What the model is always wrong by at a place is no drift, though a record may come to that place late.
    """
    rising = np.gradient(y) > 0.0 if y.size > 1 else np.zeros(y.size, dtype=bool)
    place = 2 * _region(y, low, high) + rising
    count = np.maximum(np.bincount(place, minlength=2 * REGIONS), 1)
    mean = np.bincount(place, error, minlength=2 * REGIONS) / count
    return np.asarray(error - mean[place] + error.mean())


def _region(y: FloatArray, low: float, high: float) -> IntArray:
    return np.clip(((y - low) * (REGIONS / (high - low))).astype(np.int64), 0, REGIONS - 1)


def drift_of(records: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Return the drift of the zero, m per square root of a second, from times (s) and errors (m), (N,), of records.

    The model is a random walk of the zero beside errors that are independent from block to block. The mean square
    difference of block means at a distance of k blocks of duration T is then ``2 s^2 + d^2 (k - 1/3) T``. The answer is
    the largest d from the differences at the distances `APART` and at 1, to which its own standard uncertainty is
    added: a drift that the records are too short to show is not taken as none, and one that goes straight on counts
    more the longer it is seen.
    """
    estimates, weights = [], []
    for t, error in records:
        if t.size < 2 or not t[-1] > t[0]:
            continue
        length = float(t[-1] - t[0]) / BLOCKS
        place = np.minimum(((t - t[0]) / length).astype(np.int64), BLOCKS - 1)
        count = np.bincount(place, minlength=BLOCKS)
        mean = np.bincount(place, error, minlength=BLOCKS) / np.maximum(count, 1)
        mean[count == 0] = np.nan
        near, *far = (_mean_square(mean[k:] - mean[:-k]) for k in (1, *APART))
        found = [
            (max(each - near, 0.0) + max(each, near) * np.sqrt(k / (2.0 * BLOCKS))) / ((k - 1) * length)
            for k, each in zip(APART, far, strict=True)
            if np.isfinite(near) and np.isfinite(each)
        ]
        if found:
            # Of the differences over k blocks only every k-th is independent of the others.
            estimates.append(max(found))
            weights.append(length)
    return float(np.sqrt(np.average(estimates, weights=weights))) if estimates else 0.0


def _mean_square(x: FloatArray) -> float:
    known = x[np.isfinite(x)]
    return float(np.mean(known**2)) if known.size else np.nan
