"""The Separated Level-loop Prandtl-Ishlinskii (SLPI) model as published: one classical PI model for each single loop.

SLPI paper, sections 3.3 and 3.4. A path known in advance is separated into loops, each is evaluated by its own PI
model in coordinates that start at the loop's vertex, and the loops are linked again where they were sewn, from the
outer loop inwards. The inverse is rebuilt in the same way from the analytic inverses ("rollback").
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import ModelError
from slpi_ros.hysteresis.loops import Loop, separate
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.runs import require_finite

FloatArray = NDArray[np.float64]

# A loop of a path counts as identified when level and direction are the same, and vertex and span within this share
# of the outer loop's span: a path of displacements turns at slightly other places than the path of voltages did.
SAME_LOOP = 0.2
# A path starts where the axis rests if it starts as near as this (share of the outer loop's span).
NEAR_START = 0.01
# How far away a loop of another level, or of the other direction, is (share of the outer loop's span). More for two
# levels than for one would be wrong: how levels count depends on how a record is cut.
OTHER = 0.5


class UnidentifiedLoopWarning(UserWarning):
    """A path holds loops that were never identified; the nearest ones stand in for them."""


@dataclass(frozen=True)
class SingleLoop:
    """One identified loop.

    Parameters
    ----------
    level, direction : int
        As in `slpi_ros.hysteresis.loops.Loop`.
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
        """Return what moves along paths known in advance, each from rest at `voltage` (V) and `displacement` (m)."""
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
            return OTHER * ((loop.level != level) + (loop.direction != direction)) + apart / scale

        return min(self.loops, key=distance)

    def holds(self, loop: SingleLoop, level: int, direction: int, vertex: float, span: float, coordinate: int) -> bool:
        """Whether `loop` is the very loop that the other parameters (as in `nearest`) describe."""
        tolerance = SAME_LOOP * self.outer_span[coordinate]
        apart = max(abs(loop.vertex[coordinate] - vertex), abs(loop.span[coordinate] - span))
        return (loop.level, loop.direction) == (level, direction) and apart <= tolerance


class KnownPath:
    """Moves along a path that is known from beginning to end.

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
            if self._model.holds(model, *place, coordinate):
                vertex += model.offset[1 - coordinate]
            elif loop.level:
                replaced.append((loop, place))
            memory = model.memory()
            move = memory.inverse_array if coordinate else memory.forward_array
            answer[loop.samples] = vertex + loop.direction * move(drive)
        if replaced:
            warnings.warn(_say(*replaced[0], len(replaced), coordinate), UnidentifiedLoopWarning, stacklevel=4)
        return answer[1:]


def _say(loop: Loop, place: tuple[int, int, float, float], count: int, coordinate: int) -> str:
    unit, factor = ("V", 1.0) if coordinate == 0 else ("um", 1e6)
    level, _, vertex, span = place
    return (
        f"{count} loop{'s' if count > 1 else ''} of the path never identified; the nearest by level, vertex and span "
        f"stand in; first at sample {max(loop.vertex - 1, 0)}: level {level}, vertex {vertex * factor:.5g} {unit}, "
        f"span {span * factor:.5g} {unit}"
    )
