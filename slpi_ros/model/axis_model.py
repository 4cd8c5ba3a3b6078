"""The model of one axis: a hysteresis model, the effects around it, where its memory starts, what it comes from."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.chain import Chain, Middle, backward, forward, loop_middle, reaching
from slpi_ros.effects.registry import in_order
from slpi_ros.errors import UnreachableError, UsageError
from slpi_ros.hysteresis import multi_slope as smpi
from slpi_ros.hysteresis import slpi_published as slpi
from slpi_ros.hysteresis.kinds import Hysteresis, PathModel
from slpi_ros.hysteresis.reversals import require_finite
from slpi_ros.hysteresis.turning_points import FAR, Memory
from slpi_ros.model.limits import Limits, decaying_turns
from slpi_ros.model.streaming import ROUNDING, StreamingInverse, accepted_range, refusal

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]
StartMemory = Literal["end", "start", "wiped"]
START_MEMORIES: tuple[StartMemory, ...] = ("end", "start", "wiped")

# Turning voltages kept in a document.
MOST_TURNS = 1000
# Cycles of the decaying drive after which the memory is taken for wiped.
WIPING_CYCLES = 10


@dataclass(frozen=True)
class Start:
    """A state of the memory: at `voltage` (V) and `displacement` (m), after `history`.

    Parameters
    ----------
    voltage : float, volts
    displacement : float, metres
    history : tuple of float, volts
        Voltages at which the drive turned before, oldest first. Empty: the stage has never been moved.
    from_rest : bool
        True: the stage had never been moved before it left the first voltage of `history`. False: a long fall to that
        voltage wiped the memory.
    """

    voltage: float
    displacement: float
    history: tuple[float, ...] = ()
    from_rest: bool = False


@dataclass(frozen=True)
class FitQuality:
    """How well the model describes the record it comes from, free-run, metres.

    Parameters
    ----------
    rms, maximum : float, metres
        Error over the samples fitted.
    held_out_rms : float, metres
        Error over blocks left out of the fit, from cross-validation.
    floor_rms : float, metres
        Noise of the sensor, estimated from the record.
    samples : int
        Samples fitted.
    covered : float
        Share of the surface's cells that the record visited, 0..1.
    source : str
        The record.
    """

    rms: float
    maximum: float
    held_out_rms: float
    floor_rms: float
    samples: int
    covered: float
    source: str


@dataclass(frozen=True)
class AxisModel:
    """One axis.

    Parameters
    ----------
    kind : str
        Name of the hysteresis model.
    hysteresis : Hysteresis
    start : Start
        The memory where the record began.
    voltage_range : (float, float), volts
    displacement_range : (float, float), metres
        What the record covered. `compensate` keeps to these voltages.
    quality : FitQuality
    effects : tuple of Effect
        What the stage does beside its hysteresis, in the order in which it acts.
    end : Start, optional
        The memory where the record ended, the last one of several. None: not known, as in older documents, and for
        kinds that are not causal.

    Raises
    ------
    ModelError
        If an effect comes twice.
    """

    kind: str
    hysteresis: Hysteresis
    start: Start
    voltage_range: tuple[float, float]
    displacement_range: tuple[float, float]
    quality: FitQuality
    effects: tuple[Effect, ...] = ()
    end: Start | None = None

    def __post_init__(self) -> None:
        """Put the effects in order."""
        object.__setattr__(self, "effects", in_order(self.effects))

    @property
    def causal(self) -> bool:
        """Whether the model can follow a path that is not known in advance."""
        return not isinstance(self.hysteresis, PathModel)

    def initial(self, start_memory: StartMemory) -> Start:
        """Return the state of the memory that a drive starts from.

        Parameters
        ----------
        start_memory : str
            ``end`` of the record (its start where the end is not known), ``start`` of it, or ``wiped``: after a
            decaying drive over the identified voltages to 0 V, or the identified voltage nearest to that.

        Raises
        ------
        UsageError
            If `start_memory` is none of these, or ``wiped`` is asked of a model that is not causal.
        """
        match start_memory:
            case "start":
                return self.start
            case "end":
                return self.end or self.start
            case "wiped":
                limits = Limits(*self.voltage_range)
                return self.after(np.array(decaying_turns(limits, limits.clip(0.0), WIPING_CYCLES)), "end")
        raise UsageError(f"start_memory is '{start_memory}'; give one of {', '.join(START_MEMORIES)}")

    def memory(self, start_memory: StartMemory = "end") -> Memory:
        """Return a fresh memory in the state that `start_memory` names, see `initial`.

        Raises
        ------
        UsageError
            If the model is not causal, or `start_memory` is not known.
        """
        if isinstance(self.hysteresis, PathModel):
            raise UsageError(
                f"kind '{self.kind}' needs the whole path in advance and cannot follow it sample by sample; "
                "give it a whole path, or identify kind 'slpi'"
            )
        start = self.initial(start_memory)
        if not start.history:
            return Memory(self.hysteresis, start.voltage, start.displacement)
        first, *turns = (*start.history, start.voltage)
        # Displacement is known at the end of the history: walk it once to learn how far it leads.
        primed = not start.from_rest
        way = Memory(self.hysteresis, first, 0.0, primed=primed).forward_array(np.array([first, *turns]))[-1]
        memory = Memory(self.hysteresis, first, start.displacement - float(way), primed=primed)
        for v in turns:
            memory.forward(v)
        return memory

    def after(self, u: FloatArray, start_memory: StartMemory = "start") -> Start:
        """Return the state of the memory after a drive, reduced to the turns that are still remembered.

        Parameters
        ----------
        u : ndarray, shape (N,), volts
            Voltages that reach the hysteresis.
        start_memory : str
            Where the drive starts; see `initial`.

        Returns
        -------
        Start
            Of at most `MOST_TURNS` turns; some of the nested loops are left out where there are more.

        Raises
        ------
        UsageError
            As `memory`.
        """
        start, memory = self.initial(start_memory), self.memory(start_memory)
        memory.forward_array(u)
        state = memory.snapshot()
        if not state.direction:
            return Start(state.voltage, state.displacement)
        from_rest = start.from_rest or not start.history
        # A primed memory remembers a fall from farther than any stage has been.
        turns = tuple(v for v in state.turn_voltages if abs(v) < FAR / 2)
        if from_rest:
            turns = ((*start.history, start.voltage)[0], *turns)
        if len(turns) > MOST_TURNS:
            # Loops are left out whole, evenly over the nested ones, so that every turn still changes the direction.
            loops = np.unique(np.linspace(0, len(turns) // 2 - 1, MOST_TURNS // 2 - 1).astype(np.int64)) * 2
            turns = tuple(turns[i] for first in loops for i in (first, first + 1)) + turns[len(turns) // 2 * 2 :]
        return Start(state.voltage, state.displacement, turns or (state.voltage,), from_rest)

    def stream(self, limits: Limits | None = None, start_memory: StartMemory = "end") -> StreamingInverse:
        """Return a fresh stream within `limits` and the identified voltages; it starts as `initial` says."""
        return self.stream_from(self.memory(start_memory), self._allowed(limits))

    def stream_from(self, memory: Memory, allowed: Limits) -> StreamingInverse:
        """Return a stream that goes on from a memory of this axis; its effects are at rest there."""
        middle = self._middle if self.chain.rate_dependence else None
        return StreamingInverse(memory, self.displacement_range, allowed, self.effects, middle)

    def simulate(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the displacement, shape (N,), metres, for the voltage `v`, shape (N,), volts, at times `t` (s).

        Other axes rest. Time does not matter to a model without effects.
        """
        return self.seen(t, self.uncoupled_displacement(t, v), {})

    def uncoupled_displacement(self, t: FloatArray, v: FloatArray) -> FloatArray:
        """Return the displacement, shape (N,), metres, that the voltage alone gives: before other axes come in."""
        if not self.effects:
            return self._forward_array(v)
        around = EffectContext(t - t[:1])
        u, reversible_bypass = reaching(self.chain.before, v, around)
        middle = self._middle if self.chain.rate_dependence else None
        return forward(
            self.chain.own,
            self._forward_array(u) + reversible_bypass,
            replace(around, u=u, middle=middle),
        )

    def seen(self, t: FloatArray, own: FloatArray, others: Mapping[str, FloatArray]) -> FloatArray:
        """Return the displacement that a sensor sees, shape (N,), metres.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
        own : ndarray, shape (N,), metres
            What `uncoupled_displacement` gives.
        others : mapping of axis name to ndarray, shape (N,), metres
            Own motions of the other axes from their start.
        """
        return forward(self.chain.shared, own, EffectContext(t - t[:1], others=others)) if self.effects else own

    def compensate(
        self, t: FloatArray, y: FloatArray, limits: Limits | None = None, start_memory: StartMemory = "end"
    ) -> tuple[FloatArray, Mask]:
        """Return the voltage for a desired displacement `y`, shape (N,), metres, and where it waits at a limit.

        Other axes rest. Time `t`, shape (N,), seconds, does not matter to a model without effects. The memory starts as
        `initial` says.

        Raises
        ------
        UnreachableError
            If a displacement lies far outside the identified ones.
        UsageError
            If a displacement is not finite.
        """
        return self.command(t, self.remove_sensor_effects(t, y), limits, start_memory)

    def remove_sensor_effects(self, t: FloatArray, y: FloatArray) -> FloatArray:
        """Return the own displacement, shape (N,), metres, for a desired one, shape (N,), metres; other axes rest.

        Raises
        ------
        SlpiError
            As `compensate`.
        """
        require_finite(y)
        accepted = accepted_range(self.displacement_range)
        far = (y < accepted[0]) | (y > accepted[1])
        if far.any():
            at = int(np.argmax(far))
            raise UnreachableError(f"sample {at}: {refusal(float(y[at]), accepted)}")
        return backward(self.chain.shared, y, EffectContext(t - t[:1])) if self.effects else y

    def command(
        self, t: FloatArray, own: FloatArray, limits: Limits | None = None, start_memory: StartMemory = "end"
    ) -> tuple[FloatArray, Mask]:
        """Return the voltage for an own displacement, shape (N,), metres, and where it waits at a limit."""
        if start_memory != "start":
            return replace(self, start=self.initial(start_memory)).command(t, own, limits, "start")
        allowed = self._allowed(limits)
        if not self.effects:
            return self._invert_hysteresis(own, allowed)
        chain, (lowest, highest) = self.chain, self.chain.clipped
        between = replace(allowed, lower=max(allowed.lower, lowest), upper=max(min(allowed.upper, highest), lowest))
        around = EffectContext(t - t[:1], middle=self._middle if chain.rate_dependence else None)
        if chain.coercivity and self.causal:
            return self._through_play(around, own, allowed, between)
        h, u = chain.hysteresis_for(own, around, lambda h: self._invert_hysteresis(h, between)[0])
        held = self._missed(h, u, between)
        return self._kept(backward(chain.before, u, around), held, allowed)

    def _through_play(
        self, around: EffectContext, own: FloatArray, allowed: Limits, between: Limits
    ) -> tuple[FloatArray, Mask]:
        """Return what `command` does where the hysteresis sees the voltage through a play: one sample after another."""
        chain = self.chain
        h = backward(chain.own, own, around)
        stream = StreamingInverse(self.memory("start"), self.displacement_range, between, chain.before[-1:])
        u, held = np.empty_like(h), np.zeros(h.size, dtype=np.bool_)
        elapsed = np.diff(around.t, prepend=around.t[:1]).tolist()
        for k, (dt, desired) in enumerate(zip(elapsed, h.tolist(), strict=True)):
            u[k] = stream.move(dt, desired)
            held[k] = stream.held
        return self._kept(backward(chain.before[:-1], u, around), held, allowed)

    def _kept(self, wanted: FloatArray, held: Mask, allowed: Limits) -> tuple[FloatArray, Mask]:
        v = np.clip(wanted, allowed.lower, allowed.upper)
        width = self.voltage_range[1] - self.voltage_range[0]
        return v, held | (np.abs(v - wanted) > ROUNDING * width)

    @cached_property
    def chain(self) -> Chain:
        """The effects in their places."""
        return Chain.of(self.effects)

    @cached_property
    def _middle(self) -> Middle:
        """The middle of the largest loop (m), at voltages (V)."""
        voltages, middle = loop_middle(self._forward_array, *self.voltage_range)
        return lambda u: np.interp(u, voltages, middle)

    def _allowed(self, limits: Limits | None) -> Limits:
        return (limits or Limits(-inf, inf)).within(self.voltage_range)

    def _forward_array(self, v: FloatArray) -> FloatArray:
        return (self._known_path() or self.memory("start")).forward_array(v)

    def _known_path(self) -> slpi.KnownPath | smpi.KnownPath | None:
        """Return what moves a model that is not causal along whole paths."""
        if isinstance(self.hysteresis, PathModel):
            return self.hysteresis.along(self.start.voltage, self.start.displacement)
        return None

    def _path(self, allowed: Limits) -> slpi.KnownPath | smpi.KnownPath | Memory:
        """Return what moves the hysteresis from the start on, within voltages that are `allowed`."""
        # The axis may rest outside its limits; the first voltage it is given is inside.
        return self._known_path() or StreamingInverse(self.memory("start"), self.displacement_range, allowed).memory

    def _invert_hysteresis(self, h: FloatArray, allowed: Limits) -> tuple[FloatArray, Mask]:
        """Return the voltage for a displacement without effects, shape (N,), metres, and where it waits at a limit."""
        u = self._path(allowed).inverse_array(h, allowed.lower, allowed.upper)
        return u, self._missed(h, u, allowed)

    def _missed(self, h: FloatArray, u: FloatArray, allowed: Limits) -> Mask:
        """Return where a voltage at a limit does not give the wanted displacement."""
        held = (u <= allowed.lower) | (u >= allowed.upper)
        if held.any():
            # At a limit a desired displacement may just be met.
            with warnings.catch_warnings():
                # What stands in for loops that were never identified has been said.
                warnings.simplefilter("ignore", slpi.UnidentifiedLoopWarning)
                missed = self._path(allowed).forward_array(u) - h
            low, high = self.displacement_range
            held &= np.abs(missed) > ROUNDING * (high - low)
        return held
