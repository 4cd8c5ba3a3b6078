"""The Separated Level-loop Prandtl-Ishlinskii (SLPI) model as published: one classical PI model for each single loop.

SLPI paper, sections 3.3 and 3.4. A known path is separated into loops; each is evaluated by its own PI model in
coordinates relative to its vertex; the loops are linked at the points of separation, starting with the outer loop. The
inverse is constructed in the same way from the analytic inverses ("rollback").
"""

import warnings
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import ModelError, RecordError
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import count_before, monotone_runs, require_finite, without_small_reversals
from slpi_ros.hysteresis.turning_points import Memory

# Values of column ``sp`` of a separated record.
NO_VERTEX, SUSPECTED, TRUE_VERTEX = 0, 1, 2
# A loop of a path matches an identified loop if level and direction are equal and vertex and span differ by at most
# this share of the outer loop's span: the reversals of a desired path differ slightly from those of the record.
SAME_LOOP = 0.2
# Tolerance for the start of a path at the rest point (share of the outer loop's span).
NEAR_START = 0.01
# Distance assigned to a loop of different level or direction (share of the outer loop's span). It is independent of the
# difference in level, because the level depends on how a record is divided.
OTHER_LOOP = 0.5


class UnidentifiedLoopWarning(UserWarning):
    """A path contains loops that were not identified; the nearest identified loops are used instead."""


@dataclass(frozen=True)
class Loop:
    """One separated loop."""

    level: int  # 0: outer loop, else one more than that of the loop `below`
    vertex: int  # sample at which the loop starts
    direction: int  # of the first move from there: 1 rising, -1 falling
    samples: IntArray  # (m,), without inner loops; a vertex belongs to the loop that contains it
    joined: IntArray  # (n,), samples of this loop that are vertices of separated inner loops
    closed: bool  # the voltage returned to the vertex; the outer loop is open by definition
    below: int  # index of the loop that contains the vertex; 0 for the outer loop

    @property
    def path(self) -> IntArray:
        """Samples of the joined loop, shape (n,): vertex, own samples and, if the loop is closed, the vertex again."""
        own = self.samples[self.samples != self.vertex]
        return np.concatenate([[self.vertex], own, [self.vertex] if self.closed else []]).astype(np.int64)


@dataclass(frozen=True)
class Separation:
    """A record separated into loops, ``NewData(k) = [k, v, d, tr, lv, sp]`` (Eq. 4); arrays of shape (N,)."""

    voltage: FloatArray  # V, without the reversals within the dead band
    displacement: FloatArray  # m
    phase: IntArray  # ``tr``: 1 boost (rising), -1 back; a reversal belongs to the phase that it starts
    level: IntArray  # ``lv``: suspected vertices, one more in the back phase of the outer loop
    vertex: IntArray  # ``sp``: 0 none, 1 suspected, 2 true vertex
    loops: tuple[Loop, ...]  # the outer one, then in the order of their vertices

    def table(self) -> FloatArray:
        """Return ``[k, v, d, tr, lv, sp]``, shape (N, 6), as floats."""
        k = np.arange(self.voltage.size)
        columns = (k, self.voltage, self.displacement, self.phase, self.level, self.vertex)
        return np.column_stack(columns).astype(np.float64)


def separate(voltage: FloatArray, displacement: FloatArray | None = None, *, dead_band: float = 0.0) -> Separation:
    """Separate a record (V, (N,)) that starts at rest at the vertex of the outer loop into single loops."""
    # For a desired path, pass the desired displacement as voltage. `displacement` (m, (N,)) is stored in the result
    # without being used. Reversals of at most `dead_band` (V) are treated as measurement noise.
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
    """Find the closed loops, as pairs of vertex and closing sample, and the remaining suspected vertices."""
    # The columns `phase`, `level` and `vertex` of the `Separation` are written in place.
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
    """Assign every sample to the innermost loop that contains it."""
    # The first remaining suspected vertex is the reversal of the outer loop, and every second one after it starts an
    # open loop. In a record that starts with a fall, the first sample is suspected, too.
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
            joined=np.array(inner[number], dtype=np.int64),
            closed=end < phase.size,
            below=below[number],
        )
        for number, (vertex, end) in enumerate(spans, 1)
    )


@dataclass(frozen=True)
class SingleLoop:
    """One identified loop; pairs are in volts and metres."""

    # `offset` is in voltage at the same displacement and in displacement at the same voltage: every loop keeps its
    # measured position, so that errors do not propagate.
    #
    # With a `run_in` (V) of None the play operators start at rest, as published; an inner loop then misses its vertex
    # by ``sum w_i r_i``. With 0 they start primed and move after ``2 r``, as after a reversal; the loop closes. If
    # positive, they are primed this far below the vertex and driven up to it, for an outer loop with a history.
    level: int
    direction: int
    vertex: tuple[float, float]  # start of the loop
    span: tuple[float, float]  # distance from there to its farthest point, positive
    offset: tuple[float, float]  # distance of the vertex from the model of the containing loop
    model: PrandtlIshlinskii  # its coordinates are zero at the vertex and increase along the loop
    run_in: float | None

    def memory(self) -> Memory:
        """Return the memory of the loop at its vertex."""
        return at_vertex(self.model, self.run_in)


def at_vertex(model: PrandtlIshlinskii, run_in: float | None) -> Memory:
    """Return the memory of a single loop at its vertex, 0 V and 0 m; for `run_in` (V) see `SingleLoop`."""
    if run_in is None:
        return Memory(model)
    risen = Memory(model, -run_in, primed=True).forward(0.0)
    memory = Memory(model, -run_in, -risen, primed=True)
    memory.forward(0.0)
    return memory


@dataclass(frozen=True)
class SeparatedLoops:
    """The identified loops of an axis, at least one of level 0."""

    loops: tuple[SingleLoop, ...]
    dead_band: float = 0.0  # V; smaller reversals are measurement noise

    def __post_init__(self) -> None:
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
        """Return the model for known paths, each starting from rest at `voltage` (V) and `displacement` (m)."""
        return KnownPath(self, (voltage, displacement))

    @property
    def outer_span(self) -> tuple[float, float]:
        """Span of the largest outer loop, volts and metres."""
        return max(loop.span for loop in self.loops if loop.level == 0)

    def nearest(self, level: int, direction: int, vertex: float, span: float, coordinate: int) -> SingleLoop:
        """Return the identified loop nearest to a loop of a path; vertex and span in V (`coordinate` 0) or m (1)."""
        # A `level` or `direction` that differs adds half the outer loop's span to the distance.
        scale = self.outer_span[coordinate]

        def distance(loop: SingleLoop) -> float:
            apart = abs(loop.vertex[coordinate] - vertex) + abs(loop.span[coordinate] - span)
            return OTHER_LOOP * ((loop.level != level) + (loop.direction != direction)) + apart / scale

        return min(self.loops, key=distance)

    def matches(
        self, loop: SingleLoop, level: int, direction: int, vertex: float, span: float, coordinate: int
    ) -> bool:
        """Return whether `loop` matches the loop described by the other parameters, which are those of `nearest`."""
        tolerance = SAME_LOOP * self.outer_span[coordinate]
        apart = max(abs(loop.vertex[coordinate] - vertex), abs(loop.span[coordinate] - span))
        return (loop.level, loop.direction) == (level, direction) and apart <= tolerance


class KnownPath:
    """The published SLPI model for completely known paths, each from the rest point `start` (V and m)."""

    def __init__(self, model: SeparatedLoops, start: tuple[float, float]) -> None:
        self._model = model
        self._start = start

    def forward_array(self, v: FloatArray) -> FloatArray:
        """Return displacements (m, (N,)) along voltages (V); UnidentifiedLoopWarning: a loop was not identified."""
        return self._through(v, 0)

    def inverse_array(self, y: FloatArray, lower: float = -np.inf, upper: float = np.inf) -> FloatArray:
        """Return the voltages (V, (N,)) within limits for displacements (m), with the warning of `forward_array`."""
        return np.clip(self._through(y, 1), lower, upper)

    def _through(self, x: FloatArray, coordinate: int) -> FloatArray:
        """Return the other coordinate along `x` (`coordinate` of `x`: 0 voltage, 1 displacement), outer loop first."""
        if not x.size:
            return np.empty_like(x)
        require_finite(x)
        # The path starts at the rest point; a negligible first step is not treated as a loop.
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
    """Return the message about the unidentified loops of a path: their number and the first of them."""
    unit, factor = ("V", 1.0) if coordinate == 0 else ("um", 1e6)
    level, _, vertex, span = place
    return (
        f"{count} loop{'s' if count > 1 else ''} of the path not identified; the nearest by level, vertex and span "
        f"used instead; first at sample {max(loop.vertex - 1, 0)}: level {level}, vertex {vertex * factor:.5g} {unit}, "
        f"span {span * factor:.5g} {unit}"
    )
