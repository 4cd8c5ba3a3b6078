"""What tests of drives look at in a record of voltages."""

import numpy as np


def turning_points(v):
    """Return the voltages at which a record turns, holds or not."""
    moving = v[np.concatenate([[True], np.abs(np.diff(v)) > 1e-9])]
    return moving[1:-1][np.diff(np.sign(np.diff(moving))) != 0]


def visited_cells(v, cells=10):
    """Share of the (alpha, beta) triangle's cells in which a branch from a turning point has been."""
    share = (v - v.min()) / (v.max() - v.min())
    turning = np.flatnonzero(np.diff(np.sign(np.diff(share)))) + 1
    seen = np.zeros((cells, cells), dtype=bool)
    origin = share[0]
    for begin, end in zip([0, *turning], [*turning, len(v) - 1], strict=True):
        branch = share[begin : end + 1]
        alpha, beta = np.maximum(branch, origin), np.minimum(branch, origin)
        index = np.minimum((np.array([alpha, beta]) * cells).astype(int), cells - 1)
        seen[tuple(index)] = True
        origin = share[end]
    triangle = np.tril_indices(cells)
    return seen[triangle].mean()


def holds(v, least=2):
    """Return (length in steps, voltage) of every stretch of at least so many steps without motion."""
    found, begin = [], 0
    for end in [*np.flatnonzero(np.diff(v)), len(v) - 1]:
        if end - begin >= least:
            found.append((int(end - begin), float(v[begin])))
        begin = end + 1
    return found


def fastest(t, v):
    """Largest change of voltage per second."""
    return float(np.max(np.abs(np.diff(v) / np.diff(t))))
