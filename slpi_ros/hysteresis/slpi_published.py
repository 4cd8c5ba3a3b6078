"""The Separated Level-loop Prandtl-Ishlinskii (SLPI) model as published: one classical PI model for each single loop.

SLPI paper, sections 3.3 and 3.4. A path known in advance is separated into loops, each is evaluated by its own PI
model in coordinates that start at the loop's vertex, and the loops are linked again where they were sewn, from the
outer loop inwards. The inverse is rebuilt in the same way from the analytic inverses ("rollback").
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import ModelError, RecordError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import count_before, monotone_runs, require_finite, without_small_reversals
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Column ``sp`` of a separated record.
NO_VERTEX, SUSPECTED, TRUE_VERTEX = 0, 1, 2
# A loop of a path counts as identified when level and direction are the same, and vertex and span within this share
# of the outer loop's span: a path of displacements turns at slightly other places than the path of voltages did.
SAME_LOOP = 0.2
# A path starts where the axis rests if it starts as near as this (share of the outer loop's span).
NEAR_START = 0.01
# How far away a loop of another level, or of the other direction, is (share of the outer loop's span). More for two
# levels than for one would be wrong: how levels count depends on how a record is cut.
OTHER_LOOP = 0.5


class UnidentifiedLoopWarning(UserWarning):
    """A path holds loops that were not identified; the nearest identified ones are used for them."""


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
    phase, level, vertex = np.ones(v.size, np.int64), np.zeros(v.size, np.int64), np.full(v.size, NO_VERTEX)
    closed, suspects = _judge(v, phase, level, vertex)
    resting = monotone_runs(v)[0][1]
    falls_first = bool(suspects) and suspects[0] < resting
    vertex[0] = TRUE_VERTEX
    return Separation(v, d, phase, level, vertex, _loops(closed, suspects, falls_first, phase))


def _judge(
    v: FloatArray, phase: IntArray, level: IntArray, vertex: IntArray
) -> tuple[list[tuple[int, int]], list[int]]:
    """Find the closed loops, each as its vertex and the sample that closes it, and the vertices still suspected.

    The columns `phase`, `level` and `vertex` of the `Separation` are filled in.
    """
    suspects: list[int] = []
    closed: list[tuple[int, int]] = []
    now = 1
    for start, stop in monotone_runs(v)[1:]:
        direction = 1 if v[stop - 1] > v[start - 1] else -1
        if direction != now:
            now = direction
            suspects.append(start - 1)
            vertex[start - 1] = SUSPECTED
            phase[start - 1], level[start - 1] = now, len(suspects)
        while start < stop:
            cut = stop
            if len(suspects) > 1:
                cut = start + count_before(v[start:stop], now, float(v[suspects[-2]]))
            phase[start:cut], level[start:cut] = now, len(suspects)
            if cut < stop:
                vertex[suspects[-2]] = TRUE_VERTEX
                closed.append((suspects[-2], cut))
                del suspects[-2:]
            start = cut
    return closed, suspects


def _loops(closed: list[tuple[int, int]], suspects: list[int], falls_first: bool, phase: IntArray) -> tuple[Loop, ...]:
    """Assign every sample to the innermost loop around it."""
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


@dataclass(frozen=True)
class SingleLoop:
    """One identified loop.

    Parameters
    ----------
    level, direction : int
        As in `slpi_ros.hysteresis.slpi_published.Loop`.
    vertex : (float, float), volts and metres
        Where the loop starts.
    span : (float, float), volts and metres
        From the vertex to the farthest point of the loop, both positive.
    offset : (float, float), volts and metres
        How far the vertex lies from where the model of the loop below leads at the same displacement or voltage: every
        loop keeps its own place, so that the error of one is no error of those on it.
    model : PrandtlIshlinskii
        In coordinates that are zero at the vertex and positive along the loop.
    run_in : float or None, volts
        None: the play operators start at rest, as published; an inner loop then misses its vertex by ``sum w_i r_i``.
        0: they start primed, and must travel ``2 r`` before they move, as after a reversal; the loop closes.
        More: primed that much below the vertex, and driven up to it: an outer loop may start in mid-memory.
    """

    level: int
    direction: int
    vertex: tuple[float, float]
    span: tuple[float, float]
    offset: tuple[float, float]
    model: PrandtlIshlinskii
    run_in: float | None

    def memory(self) -> Memory:
        """Return the loop's own memory, at its vertex."""
        return at_vertex(self.model, self.run_in)


def at_vertex(model: PrandtlIshlinskii, run_in: float | None) -> Memory:
    """Return the memory of a single loop at its vertex, 0 V and 0 m; see `SingleLoop` for `run_in` (V)."""
    if run_in is None:
        return Memory(model)
    risen = Memory(model, -run_in, primed=True).forward(0.0)
    memory = Memory(model, -run_in, -risen, primed=True)
    memory.forward(0.0)
    return memory


@dataclass(frozen=True)
class SeparatedLoops:
    """The identified loops of an axis.

    Parameters
    ----------
    loops : tuple of SingleLoop
        At least one of level 0.
    dead_band : float, volts
        Smaller reversals of the voltage are noise of its measurement.

    Raises
    ------
    ModelError
        If there is no outer loop, or a loop has no extent or no inverse.
    """

    loops: tuple[SingleLoop, ...]
    dead_band: float = 0.0

    def __post_init__(self) -> None:
        """Check the loops."""
        if not self.dead_band >= 0.0:
            raise ModelError(f"published SLPI: dead band of {self.dead_band} V; give 0 or more")
        if not any(loop.level == 0 for loop in self.loops):
            raise ModelError("published SLPI: no loop of level 0; the outer loop is needed")
        for number, loop in enumerate(self.loops):
            if loop.run_in is not None and not loop.run_in >= 0:
                raise ModelError(
                    f"published SLPI: loop {number} has a run-in of {loop.run_in} V; give 0 or more, or none"
                )
            if not (min(loop.span) > 0 and loop.direction in (-1, 1) and loop.level >= 0):
                raise ModelError(f"published SLPI: loop {number} has no extent, direction or level; leave it out")
            if not loop.model.invertible:
                raise ModelError(f"published SLPI: loop {number} has no linear weight and so no inverse")

    def along(self, voltage: float, displacement: float) -> "KnownPath":
        """Return the model on paths known in advance, each from rest at `voltage` (V) and `displacement` (m)."""
        return KnownPath(self, (voltage, displacement))

    @property
    def outer_span(self) -> tuple[float, float]:
        """Span of the largest outer loop, volts and metres."""
        return max(loop.span for loop in self.loops if loop.level == 0)

    def nearest(self, level: int, direction: int, vertex: float, span: float, coordinate: int) -> SingleLoop:
        """Return the identified loop nearest to a loop of a path.

        Parameters
        ----------
        level, direction : int
            Another level, and the other direction, weigh as much as half the outer loop's span each.
        vertex, span : float
            In volts (`coordinate` 0) or metres (1).
        coordinate : int
            Which of the two.
        """
        scale = self.outer_span[coordinate]

        def distance(loop: SingleLoop) -> float:
            apart = abs(loop.vertex[coordinate] - vertex) + abs(loop.span[coordinate] - span)
            return OTHER_LOOP * ((loop.level != level) + (loop.direction != direction)) + apart / scale

        return min(self.loops, key=distance)

    def matches(
        self, loop: SingleLoop, level: int, direction: int, vertex: float, span: float, coordinate: int
    ) -> bool:
        """Whether `loop` is the loop that the other parameters (as in `nearest`) describe."""
        tolerance = SAME_LOOP * self.outer_span[coordinate]
        apart = max(abs(loop.vertex[coordinate] - vertex), abs(loop.span[coordinate] - span))
        return (loop.level, loop.direction) == (level, direction) and apart <= tolerance


class KnownPath:
    """The published SLPI model on paths that are known from beginning to end.

    Parameters
    ----------
    model : SeparatedLoops
    start : (float, float), volts and metres
        Where the axis rests before every path.
    """

    def __init__(self, model: SeparatedLoops, start: tuple[float, float]) -> None:
        self._model = model
        self._start = start

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Return the displacements, shape (N,), metres, along the voltages `v`, shape (N,), volts.

        Warns
        -----
        UnidentifiedLoopWarning
            If the path holds loops that were never identified.
        """
        return self._through(v, 0)

    def inverse_array(self, y: FloatArray, lower: float = -np.inf, upper: float = np.inf) -> FloatArray:
        """Return the voltages, shape (N,), volts, for the displacements `y`, shape (N,), metres, within limits (V).

        Warns
        -----
        UnidentifiedLoopWarning
            If the path holds loops that were never identified.
        """
        return np.clip(self._through(y, 1), lower, upper)

    def _through(self, x: FloatArray, coordinate: int) -> FloatArray:
        """Drive one coordinate (0 voltage, 1 displacement) through `x`: the outer loop first, then those on it."""
        if not x.size:
            return np.empty_like(x)
        require_finite(x)
        # The path begins where the axis rests; a step from there that is next to nothing is no loop.
        path = np.concatenate([[self._start[coordinate]], x])
        answer = np.full_like(path, self._start[1 - coordinate])
        if abs(path[1] - path[0]) < NEAR_START * self._model.outer_span[coordinate]:
            path[0] = path[1]
        replaced = []
        separation = separate(path, dead_band=0.0 if coordinate else self._model.dead_band)
        path = separation.voltage
        path[0] = self._start[coordinate]
        for loop in separation.loops:
            drive = loop.direction * (path[loop.samples] - path[loop.vertex])
            place = loop.level, loop.direction, float(path[loop.vertex]), float(np.max(np.abs(drive), initial=0.0))
            model, vertex = self._model.nearest(*place, coordinate), answer[loop.vertex]
            if self._model.matches(model, *place, coordinate):
                vertex += model.offset[1 - coordinate]
            elif loop.level:
                replaced.append((loop, place))
            memory = model.memory()
            move = memory.inverse_array if coordinate else memory.forward_array
            answer[loop.samples] = vertex + loop.direction * move(drive)
        if replaced:
            warnings.warn(_unidentified(*replaced[0], len(replaced), coordinate), UnidentifiedLoopWarning, stacklevel=4)
        return answer[1:]


def _unidentified(loop: Loop, place: tuple[int, int, float, float], count: int, coordinate: int) -> str:
    """Describe the loops of a path that were not identified, and the first of them."""
    unit, factor = ("V", 1.0) if coordinate == 0 else ("um", 1e6)
    level, _, vertex, span = place
    return (
        f"{count} loop{'s' if count > 1 else ''} of the path not identified; the nearest by level, vertex and span "
        f"used instead; first at sample {max(loop.vertex - 1, 0)}: level {level}, vertex {vertex * factor:.5g} {unit}, "
        f"span {span * factor:.5g} {unit}"
    )
