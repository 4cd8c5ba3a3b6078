"""Loop separation: the single loop that each sample of a record belongs to.

SLPI paper, section 3.2. Complex hysteresis is one outer loop with inner loops, each of which starts and ends at its
vertex. The samples are judged in order: a turning point is a suspected vertex; it is a true one once the voltage has
come back to it. What lies between is a single loop, and is taken out; the rest is sewn together at the vertex.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import RecordError
from slpi_ros.hysteresis.runs import count_before, monotone_runs, require_finite, without_small_reversals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NO_VERTEX, SUSPECTED, TRUE_VERTEX = 0, 1, 2


@dataclass(frozen=True)
class Loop:
    """One separated loop.

    Parameters
    ----------
    level : int
        0 for the outer loop; else one more than that of the loop its vertex lies on.
    vertex : int
        Sample from which it starts.
    direction : int
        Of the first move from the vertex: -1 where the vertex lies on a rising branch, +1 on a falling one.
    samples : ndarray of int, shape (m,)
        Samples that belong to this loop and to no other, in order. The vertex belongs to the loop it lies on, but for
        that of the outer loop, sample 0.
    sewn : ndarray of int, shape (n,)
        Those samples at which inner loops were taken out: their vertices.
    closed : bool
        Whether the voltage came back to the vertex. The outer loop counts as open: nothing forgets it.
    below : int
        Number of the loop that its vertex lies on; 0 for the outer loop too, which lies on none.
    """

    level: int
    vertex: int
    direction: int
    samples: IntArray
    sewn: IntArray
    closed: bool
    below: int

    @property
    def path(self) -> IntArray:
        """Samples of the single loop as sewn together, shape (m + 1 or 2,): vertex, samples, and the vertex again."""
        own = self.samples[self.samples != self.vertex]
        return np.concatenate([[self.vertex], own, [self.vertex] if self.closed else []]).astype(np.int64)


@dataclass(frozen=True)
class Separation:
    """A record separated into loops, ``NewData(k) = [k, v, d, tr, lv, sp]`` (Eq. 4).

    Parameters
    ----------
    voltage : ndarray, shape (N,), volts
        Without the reversals within the dead band.
    displacement : ndarray, shape (N,), metres
    phase : ndarray of int, shape (N,)
        ``tr``: +1 boost (rising), -1 back (falling); that of a turning point is the phase it starts.
    level : ndarray of int, shape (N,)
        ``lv``: the number of suspected vertices at that time. A loop of the outer loop's back phase counts one more
        than one of its boost phase; `Loop.level` is the depth of nesting instead.
    vertex : ndarray of int, shape (N,)
        ``sp``: 0 none, 1 suspected, 2 true vertex.
    loops : tuple of Loop
        The outer loop first, then in the order of their vertices.
    """

    voltage: FloatArray
    displacement: FloatArray
    phase: IntArray
    level: IntArray
    vertex: IntArray
    loops: tuple[Loop, ...]

    def table(self) -> FloatArray:
        """Return ``[k, v, d, tr, lv, sp]``, shape (N, 6), as floats."""
        k = np.arange(self.voltage.size)
        columns = (k, self.voltage, self.displacement, self.phase, self.level, self.vertex)
        return np.column_stack(columns).astype(np.float64)


class _Marks:
    """What the judging process writes down on its way."""

    def __init__(self, count: int) -> None:
        self.phase = np.ones(count, dtype=np.int64)
        self.level = np.zeros(count, dtype=np.int64)
        self.vertex = np.full(count, NO_VERTEX)

    def write(self, start: int, stop: int, phase: int, level: int) -> None:
        self.phase[start:stop] = phase
        self.level[start:stop] = level


def separate(voltage: FloatArray, displacement: FloatArray | None = None, *, dead_band: float = 0.0) -> Separation:
    """Separate a record into single loops.

    Parameters
    ----------
    voltage : ndarray, shape (N,), volts
        The record starts at rest, at the vertex of the outer loop. A desired displacement in its place gives the loops
        of a desired path.
    displacement : ndarray, shape (N,), metres, optional
        Only carried along.
    dead_band : float, volts
        Smaller reversals than this are noise of the measurement.

    Returns
    -------
    Separation

    Raises
    ------
    RecordError
        If there is no sample, or the lengths differ.
    UsageError
        If a voltage is not finite.
    """
    v = np.asarray(voltage, dtype=np.float64)
    d = np.zeros_like(v) if displacement is None else np.asarray(displacement, dtype=np.float64)
    if v.ndim != 1 or v.shape != d.shape or not v.size:
        raise RecordError(f"{v.shape} voltages and {d.shape} displacements; give as many of each, at least one")
    require_finite(v)
    v = without_small_reversals(v, dead_band)
    marks = _Marks(v.size)
    closed, suspects = _judge(v, marks)
    resting = monotone_runs(v)[0][1]
    falls_first = bool(suspects) and suspects[0] < resting
    marks.vertex[0] = TRUE_VERTEX
    loops = _loops(closed, suspects, falls_first, marks.phase)
    return Separation(v, d, marks.phase, marks.level, marks.vertex, loops)


def _judge(v: FloatArray, marks: _Marks) -> tuple[list[tuple[int, int]], list[int]]:
    """Find the closed loops, each as its vertex and the sample that closes it, and the vertices still suspected."""
    suspects: list[int] = []
    closed: list[tuple[int, int]] = []
    phase = 1
    for start, stop in monotone_runs(v)[1:]:
        direction = 1 if v[stop - 1] > v[start - 1] else -1
        if direction != phase:
            phase = direction
            suspects.append(start - 1)
            marks.vertex[start - 1] = SUSPECTED
            marks.write(start - 1, start, phase, len(suspects))
        while start < stop:
            cut = stop
            if len(suspects) > 1:
                cut = start + count_before(v[start:stop], phase, float(v[suspects[-2]]))
            marks.write(start, cut, phase, len(suspects))
            if cut < stop:
                marks.vertex[suspects[-2]] = TRUE_VERTEX
                closed.append((suspects[-2], cut))
                del suspects[-2:]
            start = cut
    return closed, suspects


def _loops(closed: list[tuple[int, int]], suspects: list[int], falls_first: bool, phase: IntArray) -> tuple[Loop, ...]:
    """Hand every sample to the innermost loop around it."""
    # The first vertex still suspected is the outer loop's own turn, and every second one from there that of an open
    # loop. A record that falls at first suspects its very start too.
    opened = [(vertex, phase.size) for vertex in suspects[2 if falls_first else 1 :: 2]]
    spans = sorted(closed + opened)
    owner = np.zeros(phase.size, dtype=np.int64)
    levels, below, inner = [0], [0], [list[int]() for _ in range(len(spans) + 1)]
    for number, (vertex, end) in enumerate(spans, 1):
        below.append(int(owner[vertex]))
        levels.append(levels[below[number]] + 1)
        inner[below[number]].append(vertex)
        owner[vertex + 1 : end] = number
    samples = np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner, minlength=len(levels)))[:-1])
    outer = Loop(0, 0, -1 if falls_first else 1, samples[0], np.array(inner[0], dtype=np.int64), False, 0)
    return outer, *(
        Loop(
            level=levels[number],
            vertex=vertex,
            direction=int(phase[vertex]),
            samples=samples[number],
            sewn=np.array(inner[number], dtype=np.int64),
            closed=end < phase.size,
            below=below[number],
        )
        for number, (vertex, end) in enumerate(spans, 1)
    )
