"""Fewer points that show the same picture."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Points of a line, and dots of a cloud: each dot is an element of the page.
LINE_POINTS, CLOUD_POINTS = 5000, 1500


def thin_line(*signals: FloatArray, most: int = LINE_POINTS) -> IntArray:
    """Return the samples that draw lines as all of them would: of each stretch every signal's extremes, and the ends.

    Where a signal is NaN for as long as a stretch, one of them is kept too: a line is interrupted there.

    Parameters
    ----------
    *signals : ndarray, shape (N,)
        Drawn over one axis, from the same samples; NaN where there is nothing to draw.
    most : int
        About as many as may be kept.

    Returns
    -------
    ndarray of int, shape (K,)
        In order.
    """
    size = signals[0].size
    if size <= most:
        return np.arange(size)
    stretches = max(1, (most - 2) // (2 * len(signals)))
    length = -(-size // stretches)
    kept = [np.array([0, size - 1])]
    for signal in signals:
        padded = np.full(stretches * length, np.nan)
        padded[:size] = signal
        rows = padded.reshape(stretches, length)
        offset = np.arange(stretches) * length
        kept.append(_holes(signal, length))
        kept += [offset + np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1)]
        kept += [offset + np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1)]
    found = np.unique(np.concatenate(kept))
    return found[found < size]


def _holes(signal: FloatArray, length: int) -> IntArray:
    """Return where a signal, shape (N,), is NaN for `length` samples or more: the first of each such row."""
    missing = np.pad(np.isnan(signal), 1).astype(np.int8)
    first, after = np.flatnonzero(np.diff(missing) > 0), np.flatnonzero(np.diff(missing) < 0)
    return first[after - first >= length]


def thin_cloud(x: FloatArray, y: FloatArray, most: int = CLOUD_POINTS) -> IntArray:
    """Return samples that show where a cloud of dots, shape (N,) each, lies: its outline along `x`, and some inside."""
    finite = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if finite.size <= most:
        return finite
    along = finite[np.argsort(x[finite], kind="stable")]
    outline = along[thin_line(y[along], most=most // 2)]
    inside = finite[np.linspace(0, finite.size - 1, most - outline.size).astype(np.int64)]
    return np.union1d(outline, inside)
