"""What is exported: the axes of a model with their limits, the numbers of their inverse, and what is left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, isfinite, isinf, pi
from typing import Any, NamedTuple

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.effects.base import Effect, Followed
from slpi_ros.effects.filters import SPACING
from slpi_ros.effects.paths import Laws
from slpi_ros.effects.surroundings import Surroundings
from slpi_ros.errors import UsageError
from slpi_ros.export.feedback import ExportedLoop, exported_loops
from slpi_ros.hysteresis.kinds import DESCRIPTIONS, PathModel
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import STEEP, MultiSlope
from slpi_ros.hysteresis.shapes import FAR, Branches
from slpi_ros.hysteresis.turning_points import Memory, MemoryState
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import MAX_DT, Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.streaming import StageStream, accepted_range

# Desired displacements that are kept of each mode, unless SLPI_HISTORY says otherwise.
HISTORY = 128


def resolved(omega: float) -> float:
    """Return the shortest step (s) of which all desired displacements are kept, for a mode of `omega` (rad/s)."""
    return 4.0 * SPACING / ((HISTORY - 4) * omega)


class ExportedLaws(NamedTuple):
    """The fields of `slpi_ros.effects.paths.Laws` that the exported inverse has, in its order."""

    lag: float
    slew: float
    rate: FloatArray
    relaxations: FloatArray
    rest_of_creep: float
    contact: FloatArray
    modes: FloatArray
    rest: float
    factors: FloatArray
    heating: FloatArray
    gain: FloatArray


class Base(NamedTuple):
    """Branch without a turning point: its origin (V, m), and its curve, knots of shape (2, k), V and m."""

    voltage: float
    displacement: float
    knots: FloatArray


@dataclass(frozen=True)
class ExportedAxis:
    """One axis of an export; UsageError, which names it, where its model cannot be exported."""

    name: str
    model: AxisModel
    limits: Limits
    # Axes beside it, whose motion it may contain.
    others: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.model.hysteresis, PathModel):
            raise UsageError(
                f"axis '{self.name}': kind '{self.model.kind}' needs the whole path in advance and cannot be exported; "
                "identify kind 'slpi'"
            )
        chain, refused = self.model.chain, list[str]()
        for effect in self._inside:
            if effect.streaming() is None:
                # It is a delay, which only future setpoints undo, or part of the limits.
                known = bool(effect.shift) or effect.passes != (-inf, inf) or effect.acts_on == "voltage"
            else:
                laws = effect.laws()
                known = isinstance(effect, Surroundings) or (
                    bool(laws) and set(laws or {}) <= set(ExportedLaws._fields)
                )
            refused += [] if known else [effect.name]
        refused += [effect.name for effect in chain.shared if not effect.coupling]
        if refused:
            raise UsageError(f"axis '{self.name}': effect '{refused[0]}' cannot be exported; leave it out of the model")

    @property
    def _inside(self) -> tuple[Effect, ...]:
        """Effects of the axis itself."""
        chain = self.model.chain
        return (*chain.before, *([chain.around] if chain.around else []), *chain.own)

    @cached_property
    def laws(self) -> Laws:
        """Parameters of the effects."""
        found = dict[str, Any]()
        for effect in self._inside:
            if effect.streaming() is not None:
                found |= effect.laws() or {}
        return Laws(**found)

    @property
    def surroundings(self) -> Surroundings | None:
        """The recorded quantities that it follows, and how."""
        return next((effect for effect in self.model.chain.own if isinstance(effect, Surroundings)), None)

    @cached_property
    def memory(self) -> Memory:
        """Memory at the end of the record; not to be moved."""
        return self.model.memory()

    @property
    def primed(self) -> bool:
        """Whether a long fall led to the first voltage of the memory."""
        start = self.model.initial("end")
        return bool(start.history) and not start.from_rest

    @cached_property
    def start(self) -> MemoryState:
        """State at the end of the record, without the turning point far outside that a primed memory begins with."""
        state = self.memory.snapshot()
        first = 1 if self.primed else 0
        turns = state.turn_voltages[first:], state.turn_displacements[first:]
        return MemoryState(state.direction, state.voltage, state.displacement, *turns)

    @cached_property
    def base(self) -> Base:
        """Branch without a turning point, as the stream has it."""
        if not self.primed:
            rest, _, first, _ = self.memory.shape_arrays()
            return Base(float(rest[0]), float(rest[1]), first)
        state = self.memory.snapshot()
        top = state.turn_voltages[0]
        assert not isinstance(self.model.hysteresis, PathModel)
        return Base(top, state.turn_displacements[0], self.model.hysteresis.branch(-1, top).knots)

    @cached_property
    def near_base(self) -> Base:
        """The same branch, of a primed memory with its origin at the upper limit: for numbers of few digits."""
        base = self.base
        if not self.primed:
            return base
        # A knot is put there, so that no piece within the limits begins far outside.
        u, f = base.knots
        at = base.voltage - self.allowed.upper
        reached = float(np.interp(at, u, f))
        place = int(np.searchsorted(u, at))
        knots = np.array([np.insert(u, place, at) - at, np.insert(f, place, reached) - reached])
        return Base(self.allowed.upper, base.displacement - reached, knots)

    @cached_property
    def branches(self) -> Branches:
        """Curves of all branches."""
        return self.memory.shape_arrays()[3]

    @cached_property
    def allowed(self) -> Limits:
        """Limits of the command: those given, within the identified range and what passes the effects."""
        limits = self.limits.within(self.model.voltage_range)
        return self.model.stream(limits).restricted(limits)

    @property
    def accepted(self) -> tuple[float, float]:
        """Smallest and largest desired displacement (m)."""
        return accepted_range(self.model.displacement_range)

    @property
    def inverted(self) -> list[str]:
        """Names of the effects that the inverse compensates."""
        inside = (*self._inside, *self.model.chain.shared)
        return [effect.name for effect in inside if not effect.shift]

    @property
    def left_out(self) -> list[str]:
        """Effects that the inverse does not contain, and why."""
        chain = self.model.chain
        told = [f"{effect.name}: its inverse needs setpoints ahead" for effect in chain.before if effect.shift]
        told += [f"{effect.name}: of the {effect.side}" for effect in chain.measured]
        named = {effect.name for effect in (*chain.measured, *chain.before)} | set(self.inverted)
        told += [f"{each.name}: of the {each.side}" for each in self.model.effects if each.name not in named]
        away = [axis for effect in chain.shared for axis in effect.coupling if axis not in self.others]
        return told + [f"{chain.shared[0].name} with {axis}: not in this export, assumed at rest" for axis in away]

    def forgotten(self, turns: int) -> float:
        """Return by how much (m) a forgotten loop changes the displacement at most, with so many turns kept."""
        # Of the rectangles in the Preisach plane between successive turning points the smallest has at most the area of
        # a square with this side (V). An operator has its relays on a line, which is in it over at most that side.
        shape, side = self.model.hysteresis, 2.0 * (self.allowed.upper - self.allowed.lower) / (turns - 2)
        assert not isinstance(shape, PathModel)
        if isinstance(shape, LoopFamily):
            return _densest(shape) * side**2
        if isinstance(shape, MultiSlope):
            return STEEP * float(shape.weights.sum()) * side
        return float(np.abs(shape.weights[shape.thresholds > 0.0]).sum()) * side

    @property
    def describe(self) -> list[str]:
        """Return the lines that say what the axis is."""
        low, high = self.allowed.lower, self.allowed.upper
        slew = "none" if isinf(self.allowed.slew) else f"{self.allowed.slew:g} V/s"
        effects = ", ".join(self.inverted) or "none"
        return [
            f"axis {self.name}: {DESCRIPTIONS[self.model.kind]}",
            f"  limits {low:.6g} to {high:.6g} V, slew limit {slew}",
            f"  desired displacements {self.accepted[0]:.6g} to {self.accepted[1]:.6g} m",
            f"  effects that are compensated: {effects}",
            *(f"  left out: {told}" for told in self.left_out),
        ]


@dataclass(frozen=True)
class ExportedStage:
    """The axes of an export, in order."""

    axes: tuple[ExportedAxis, ...]
    model: StageModel
    loops: tuple[ExportedLoop, ...] = ()  # feedback of each axis; (): none

    def with_feedback(self, tuned: TunedGains) -> "ExportedStage":
        """Return the export with the feedback of tuned gains; UsageError if they lack an axis."""
        return replace(self, loops=exported_loops(tuned, [(axis.name, axis.allowed) for axis in self.axes]))

    @classmethod
    def of(cls, model: StageModel, limits: Limits, names: Sequence[str] | None = None) -> "ExportedStage":
        """Return the export of the axes `names` (default: all) within `limits` and their identified ranges."""
        chosen = {name: model.axis(name) for name in (model.axes if names is None else names)}
        others = tuple(chosen)
        axes = tuple(ExportedAxis(name, axis, limits, others) for name, axis in chosen.items())
        for axis in axes:
            require_numbers(axis)
            require_resolved(axis)
        return cls(axes, StageModel(chosen, model.hardware_id, model.created))

    def stream(self) -> StageStream:
        """Return the causal compensator that the exported inverse equals."""
        streams = {axis.name: axis.model.stream(axis.limits) for axis in self.axes}
        return StageStream(streams, self.model.coupling, self.model.origins)

    @cached_property
    def quantities(self) -> tuple[Followed, ...]:
        """Recorded quantities that any axis follows, by their numbers."""
        found = dict[str, Followed]()
        for axis in self.axes:
            for one in axis.surroundings.followed if axis.surroundings else ():
                found.setdefault(one.key, one)
        return tuple(found.values())

    @cached_property
    def gains(self) -> FloatArray:
        """Coupling gains (m/m), shape (n, n): of the row's axis by the motion of the column's axis."""
        rows: Mapping[str, Mapping[str, float]] = {axis.name: axis.model.chain.gains for axis in self.axes}
        names = list(rows)
        return np.array([[0.0 if one == other else rows[one].get(other, 0.0) for other in names] for one in names])


def _densest(family: LoopFamily) -> float:
    """Return the largest density (m/V^2) of an Everett function."""
    cells, everett = np.diff(family.grid), family.everett
    mixed = -np.diff(np.diff(everett, axis=0), axis=1)
    inside = np.tri(cells.size, k=-1, dtype=bool)
    density = mixed / np.outer(cells, cells)
    # A cell on the diagonal is a triangle.
    diagonal = np.diag(everett, -1) / (0.5 * cells**2)
    return float(max(np.abs(density[inside]).max(initial=0.0), np.abs(diagonal).max()))


def require_resolved(axis: ExportedAxis) -> None:
    """Raise UsageError if a mode is so slow that the last part of a pause is not resolved."""
    # A pause is a hold of any length and at most MAX_DT in which the voltage moves.
    for law in axis.laws.factors:
        if law[0] > 0.0 and 2.0 * resolved(law[1]) > MAX_DT:
            raise UsageError(
                f"axis '{axis.name}': effect 'resonance' has a mode of {law[1] / (2.0 * pi):.3g} Hz, too slow for an "
                f"export (from {resolved(1.0) / (pi * MAX_DT):.2g} Hz on); leave it out of the model"
            )


def require_numbers(axis: ExportedAxis) -> None:
    """Raise UsageError if limits leave no voltage, or a voltage of the model is no number of a stage."""
    allowed = axis.allowed
    if not (isfinite(allowed.lower) and isfinite(allowed.upper) and max(abs(allowed.lower), abs(allowed.upper)) < FAR):
        raise UsageError(
            f"axis '{axis.name}': limits {allowed.lower:g} to {allowed.upper:g} V are too wide for an export; "
            "give --voltage-min and --voltage-max"
        )
    if allowed.lower == allowed.upper:
        raise UsageError(
            f"axis '{axis.name}': limits and identified range have only {allowed.lower:g} V in common; "
            "give limits between which the voltage can move"
        )
