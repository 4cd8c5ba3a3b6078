"""Statistics of a model's errors on its records that its uncertainty needs: by region of the motion, and over time."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.model.axis_model import FitQuality
from slpi_ros.model.uncertainty import REGIONS

# Fewest samples that tell the error of a region.
FEWEST_OF_REGION = 20
# A record is cut into this many blocks of equal duration. The drift is that between blocks this far apart.
BLOCKS, APART = 16, 8


def with_statistics(
    quality: FitQuality, records: Sequence[tuple[FloatArray, ...]], displacement_range: tuple[float, float]
) -> FitQuality:
    """Return the quality with what the uncertainty needs: times (s), displacements and errors (m), (N,), of records."""
    y, error = (np.concatenate([record[k] for record in records]) for k in (1, 2))
    return replace(
        quality,
        regions=by_region(y, error, displacement_range),
        drift=drift_of([(record[0], record[-1]) for record in records]),
        duration=max(float(record[0][-1] - record[0][0]) for record in records),
    )


def by_region(
    y: FloatArray, error: FloatArray, displacement_range: tuple[float, float]
) -> tuple[float | None, ...]:
    """Return the rms of errors (m) in `REGIONS` equal parts of a range (m); None where too few samples tell it.

    `y` is the displacement (m), `error` its error (m), shape (N,) each.
    """
    low, high = displacement_range
    place = np.clip(((y - low) * (REGIONS / (high - low))).astype(np.int64), 0, REGIONS - 1)
    count = np.bincount(place, minlength=REGIONS)
    square = np.bincount(place, error**2, minlength=REGIONS)
    return tuple(
        float(np.sqrt(total / n)) if n >= FEWEST_OF_REGION else None
        for total, n in zip(square.tolist(), count.tolist(), strict=True)
    )


def drift_of(records: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Return the drift of the zero, m per square root of a second, from times (s) and errors (m), (N,), of records.

    The model is a random walk of the zero beside errors that are independent from block to block. The mean square
    difference of block means at a distance of k blocks of duration T is then ``2 s^2 + d^2 (k - 1/3) T``. The answer is
    the d from distances of 1 and `APART` blocks, to which its own standard uncertainty is added: a drift that the
    records are too short to show is not taken as none.
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
        near, far = (_mean_square(mean[k:] - mean[:-k]) for k in (1, APART))
        if not (np.isfinite(near) and np.isfinite(far)):
            continue
        span = (APART - 1) * length
        # Of the differences over `APART` blocks only some are independent of each other.
        spread = max(far, near) * np.sqrt(2.0 * APART / BLOCKS)
        estimates.append(max(far - near, 0.0) / span + spread / (2.0 * span))
        weights.append(span)
    return float(np.sqrt(np.average(estimates, weights=weights))) if estimates else 0.0


def _mean_square(x: FloatArray) -> float:
    known = x[np.isfinite(x)]
    return float(np.mean(known**2)) if known.size else np.nan
