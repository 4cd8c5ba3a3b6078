"""Compiled parts of a design matrix: the rows of a loop family, and normal equations along the tree of branches."""

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.hysteresis.compiled import compiled


@compiled
def accumulate(
    pointers: IntArray,
    columns: IntArray,
    values: FloatArray,
    branch: IntArray,
    turns: IntArray,
    weights: FloatArray,
    y: FloatArray,
    half: FloatArray,
    vector: FloatArray,
) -> None:
    """Add ``A' W A / 2``, up to its transpose, to `half` (p, p), and ``A' W y`` to `vector` (p,).

    The increments of the samples are in compressed rows (`pointers`, `columns`, `values`); `branch` and `turns` as in
    `Walk`. A row of A is the increment of the sample plus the row of the reversal at which its branch started. What
    hangs on a reversal is summed relative to it, and is moved to the reversal before it once that branch has ended.
    """
    depth = np.zeros(turns.size + 1, np.int64)
    for turn in range(turns.size):
        depth[turn] = depth[branch[turns[turn]]] + 1
    open_turns = np.full(depth.max() + 1, -1, np.int64)
    rows = np.zeros((open_turns.size, half.shape[1]))
    counts, sums = np.zeros(open_turns.size), np.zeros(open_turns.size)
    top = 0
    for sample in range(branch.size + 1):
        turn = branch[sample] if sample < branch.size else -1
        if turn != open_turns[top]:
            # The nearest reversal that both share; the last entry of `depth`, which stands for none, is 0.
            shared, level = turn, depth[turn]
            while level > top or open_turns[level] != shared:
                shared, level = branch[turns[shared]], level - 1
            while top > level:
                at = turns[open_turns[top]]
                if counts[top] > 0.0:
                    row, before = rows[top], rows[top - 1]
                    for k in range(pointers[at], pointers[at + 1]):
                        row[columns[k]] += 0.5 * counts[top] * values[k]
                        vector[columns[k]] += sums[top] * values[k]
                    for k in range(pointers[at], pointers[at + 1]):
                        half[columns[k]] += values[k] * row
                    for k in range(pointers[at], pointers[at + 1]):
                        row[columns[k]] += 0.5 * counts[top] * values[k]
                    before += row
                    row[:] = 0.0
                    counts[top - 1] += counts[top]
                    sums[top - 1] += sums[top]
                    counts[top] = sums[top] = 0.0
                top -= 1
            top = depth[turn]
            for upper in range(top, level, -1):
                open_turns[upper] = turn
                turn = branch[turns[turn]]
        if sample < branch.size and weights[sample] != 0.0:
            w, row = weights[sample], rows[top]
            counts[top] += w
            sums[top] += w * y[sample]
            for k in range(pointers[sample], pointers[sample + 1]):
                by = w * values[k]
                row[columns[k]] += by
                vector[columns[k]] += by * y[sample]
                for other in range(pointers[sample], pointers[sample + 1]):
                    half[columns[k], columns[other]] += 0.5 * by * values[other]


@compiled
def surface_rows(
    upper: FloatArray, lower: FloatArray, factor: FloatArray, low: float, step: float, vertices: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], FloatArray]:
    """Return pointers, columns and values of the rows `SurfaceBasis` describes, for voltages (V) of shape (N,)."""
    pointers = np.zeros(upper.size + 1, np.int32)
    columns, values = np.empty(4 * upper.size, np.int32), np.empty(4 * upper.size)
    count = 0
    for sample in range(upper.size):
        by = factor[sample]
        if by != 0.0:
            x, z = (upper[sample] - low) / step, (lower[sample] - low) / step
            i, j = min(max(int(x), 0), vertices - 2), min(max(int(z), 0), vertices - 2)
            p, q = x - i, z - j
            for k in range(4):
                row, column = i + k // 2, j + k % 2
                if i == j:
                    value = by * (p - q) if k == 2 else 0.0
                else:
                    value = by * (p if k // 2 else 1.0 - p) * (q if k % 2 else 1.0 - q)
                if value != 0.0 and row > column:
                    columns[count], values[count] = row * (row - 1) // 2 + column, value
                    count += 1
        pointers[sample + 1] = count
    return pointers, columns[:count], values[:count]
