"""Compensation of all axes, independent of ROS. `now_ns`: steady clock; `clock_ns`: that, or the simulated one."""

from array import array
from collections.abc import Mapping, Sequence
from datetime import datetime
from enum import Enum

from numpy.typing import ArrayLike

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.amplifier import STEADY_NS
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.block import Block, BlockFollower, plan, require_mean_rates
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.messages import Messages
from slpi_ros.compensator.monitor import Finding, Monitor
from slpi_ros.compensator.motion import (
    REFUSALS,
    REPLACED_BY,
    Fault,
    Idle,
    Kind,
    Ramp,
    Reset,
    Safety,
    reset_limits,
)
from slpi_ros.compensator.motion import Block as BlockMotion
from slpi_ros.compensator.ownership import Ownership
from slpi_ros.compensator.persistence import RESETTING, SENSOR, MemoryConfidence, SavedAxis, Zero, model_id
from slpi_ros.compensator.reporters import WhoseStage
from slpi_ros.compensator.statistics import Counts
from slpi_ros.compensator.surroundings import Surroundings
from slpi_ros.compensator.trajectory import Trajectory, TrajectoryExecutor
from slpi_ros.compensator.validation import RejectedError, TimestampRules
from slpi_ros.compensator.watchdog import CommandWatchdog
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.model.axis_model import StartMemory
from slpi_ros.model.coupling import Coupling
from slpi_ros.model.limits import PERIOD, Limits, decaying_turns
from slpi_ros.model.stage_model import StageModel, seconds_since
from slpi_ros.model.streaming import StageStream

OPEN_LOOP = LoopSettings(False, PidGains(0.0), 0.1)


class OperatingMode(Enum):
    """Operating mode of the whole stage, which follows from the motions of its axes."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    # Desired displacements are converted to voltages.
    STREAMING = "streaming"
    # Points of a trajectory are pending.
    TRAJECTORY = "trajectory"
    # An axis ramps to a voltage, or to rest.
    RAMPING = "ramping"
    # A device plays a block by itself.
    BLOCK = "block"
    # The memory of an axis is being reset.
    RESETTING = "resetting"


class StopReason(Enum):
    """Why all motion was ended."""

    CANCELED = "canceled"  # by an empty trajectory, by a model that does not accept it, or as its times are not valid
    SILENCE = "no command"
    ZERO = "zero set"
    DEACTIVATED = "deactivated"
    LOST = "not armed"  # somebody else moves the stage


class Controller:
    """Inverse hysteresis compensation, with optional feedback, for all axes of a stage; sequences in their order.

    Every axis has one motion at a time (`slpi_ros.compensator.motion`). `update` checks a desired message as a whole
    and moves every axis named in it; `advance` does what is due without a message. A motion that is asked for either
    replaces the present ones, as the table allows, or is rejected; `stop` is the one way to end them without another
    one. The first voltage starts from where the amplifiers are (`locate`), and their reports are held
    against what was output (`report`). A loaded model cannot relax the limits; one with another `hardware_id` is
    refused, "" accepts any, and what is named `accept_stage` is taken for this stage. Without `loops`, feedback is
    disabled.
    """

    def __init__(
        self,
        axes: Sequence[str],
        limits: Sequence[Limits],
        hardware_id: str = "",
        time: TimestampRules | None = None,
        loops: Sequence[LoopSettings] = (),
        period: float = PERIOD,
        starts: Sequence[str | float] = (),
        accept_stage: str = "",
    ) -> None:
        self.names = list(axes)
        loops = loops or [OPEN_LOOP] * len(self.names)
        self.axes = [Axis(*each, period) for each in zip(self.names, limits, loops, strict=True)]
        self.messages = Messages(self.axes, time or TimestampRules())
        # Whether voltages may be output.
        self.ownership = Ownership(self.axes, starts, WhoseStage(hardware_id, accept_stage))
        self.surroundings = Surroundings(self.axes)  # quantities that the model in use follows
        self.counts = Counts()
        # The model in use, and as it was identified, before its zeros were moved.
        self.model: StageModel | None = None
        self.identified: StageModel | None = None
        by_name = self.messages.by_name
        self.trajectory = TrajectoryExecutor(period, lambda name: by_name[name].setpoint)
        self.watchdog = CommandWatchdog()
        # What it finds is answered by `watch`; what is reported of the amplifiers, by `report` at once.
        rules = [rule for axis in self.axes for rule in (axis.loop.sensor, axis.loop.oscillation)]
        self.monitor = Monitor(self.watchdog, *rules)
        self.block: BlockFollower | None = None  # the last one
        self.stopped: StopReason | None = None  # why all motion was ended last
        self._lifecycle = OperatingMode.UNCONFIGURED
        self._discarded: StageModel | None = None  # the last one in use before `cleanup`, as it was identified
        self._stage: StageStream | None = None
        # Offset of the trajectory clock from the monotonic clock at the last call, nanoseconds.
        self._clock_ahead_ns = 0

    # State

    @property
    def active(self) -> bool:
        """Whether the compensator is activated."""
        return self._lifecycle is OperatingMode.STREAMING

    @property
    def mode(self) -> OperatingMode:
        """What the whole stage does."""
        if not self.active or self._following:
            return self._lifecycle
        kinds = [axis.motion.kind for axis in self.axes]
        if Kind.RESET in kinds:
            return OperatingMode.RESETTING
        if Kind.BLOCK in kinds:
            return OperatingMode.BLOCK
        if self.trajectory.on:
            return OperatingMode.TRAJECTORY
        return OperatingMode.RAMPING if Kind.RAMP in kinds else OperatingMode.STREAMING

    @property
    def voltages(self) -> "array[float]":
        """Present voltages, volts."""
        return array("d", [axis.output.voltage for axis in self.axes])

    @property
    def _following(self) -> bool:
        """Whether all axes follow setpoints already, so that another one may come."""
        if not self.ownership.owned or self.trajectory.on:
            return False
        for axis in self.axes:  # noqa: SIM110, 1 us faster than all() for each message
            if not axis.motion.follows:
                return False
        return True

    @property
    def ramping(self) -> bool:
        """Whether any axis executes a ramp or decelerates to rest."""
        return any(isinstance(axis.motion, Ramp) for axis in self.axes)

    def activity(self, now_ns: int) -> str:
        """Return a text that describes the present activity."""
        mode = self.mode
        if mode is OperatingMode.RESETTING:
            return "resetting the memory"
        if mode is OperatingMode.BLOCK:
            return "a device plays a block"
        deadline_ns = self.trajectory.next_deadline_ns
        if deadline_ns is None:
            return "compensating"
        wait = (deadline_ns - self._clock_ahead_ns - now_ns) * 1e-9
        if wait < 1.0:
            return "following a trajectory"
        return f"waiting for a trajectory that {'goes on' if self.trajectory.moving else 'begins'} in {wait:.0f} s"

    # Lifecycle and models

    def configure(self) -> None:
        """Enter the inactive mode."""
        self._lifecycle = OperatingMode.INACTIVE

    def cleanup(self) -> None:
        """Discard the model; the voltages are unchanged."""
        self._discarded = self.identified or self._discarded
        self._lifecycle, self.model, self.identified = OperatingMode.UNCONFIGURED, None, None
        self.ownership.stage.model = ""

    def activate(self, now_ns: int) -> None:
        """Start processing messages at `now_ns` (ns), with all axes at rest at their present voltages."""
        self._lifecycle, self.stopped = OperatingMode.STREAMING, None
        self.watchdog.start(now_ns)
        for axis in self.axes:
            axis.rest(now_ns)
        self.ownership.await_start(now_ns)

    def deactivate(self, now_ns: int) -> None:
        """Stop processing messages at `now_ns` (ns); the voltages are held."""
        self.stop(StopReason.DEACTIVATED, now_ns)
        for axis in self.axes:
            axis.rest(now_ns)
            axis.amplifier.forget_output()
        self._lifecycle = OperatingMode.INACTIVE

    def use_model(
        self,
        model: StageModel,
        saved: Mapping[str, SavedAxis] | None = None,
        start_memory: StartMemory = "end",
        last_voltages: Mapping[str, float] | None = None,
        now_ns: int = 0,
    ) -> None:
        """Replace the model in use, or raise and keep the old one; the voltages are unchanged.

        A trajectory that the new model does not accept is canceled, as by a command at `now_ns`.
        """
        # Only the first model uses what was saved; `last_voltages` (V) are of axes saved with another model.
        stage = self.ownership.stage
        if why := stage.difference(model=model.hardware_id):
            raise UsageError(f"{why}; use a model of this stage, correct hardware_id, or set accept_stage")
        if self.mode is OperatingMode.BLOCK:
            self._require(Kind.STREAM, 0)
        turns, identified = {name: each.reversal_voltages for name, each in (saved or {}).items()}, model
        zeros = {name: each.zero for name, each in (saved or {}).items()}
        if not saved and self._discarded and model_id(self._discarded) == model_id(model):
            zeros = {axis.name: axis.zero for axis in self.axes}
        model = model.shifted({name: zero.offset for name, zero in zeros.items()})
        prepared = []
        for axis in self.axes:
            own = model.axis(axis.name)
            try:
                stream = axis.prepare(own, turns.get(axis.name), start_memory)
            except SlpiError as error:
                raise type(error)(f"axis '{axis.name}': {error}") from None
            if saved:
                stream.relax_from(saved[axis.name].relaxing, saved[axis.name].age)
            prepared.append((axis, own, stream))
        for axis, own, stream in prepared:
            first = axis.model is None
            if first:
                axis.initial.assumed = None if saved else start_memory
            axis.use(own, stream)
            if saved:
                axis.confidence = saved[axis.name].confidence(own.hysteresis_range)
            elif first and last_voltages and axis.name in last_voltages:
                axis.locate(last_voltages[axis.name], 0)
            axis.zero = zeros.get(axis.name, axis.zero)
        self._discarded = None
        self.model, self.identified, stage.model = model, identified, model.hardware_id
        self._couple()
        self.surroundings.use(model)
        if self.trajectory.recheck({axis.name: axis.stream.accepted for axis in self.axes}):
            # As at its end: each axis holds its last setpoint, or stays where it is if that is not accepted either.
            self.stopped = StopReason.CANCELED
            self.watchdog.feed(now_ns)
            for axis in self.axes:
                axis.samples.restart()
                axis.use_checked(False)
                if axis.motion.follows and axis.motion.due_ns is None:
                    # It has waited for the next sample.
                    axis.motion.due_ns = now_ns

    def set_zero(self, now_ns: int) -> dict[str, float | None]:
        """Let the models agree with the sensors now; return by how much (m) each zero moves, None: not measured."""
        # Whenever a new trajectory may begin.
        self._require(Kind.TRAJECTORY, now_ns)
        self.ownership.begin_output(now_ns)
        assert self.model
        moved = {axis.name: axis.loop.offsets.present(now_ns) for axis in self.axes}
        known = {name: offset for name, offset in moved.items() if offset is not None}
        axes = [axis for axis in self.axes if axis.name in known]
        model = self.model.shifted(known)
        for axis in axes:
            axis.prepare(model.axis(axis.name))
        if axes:
            self.stop(StopReason.ZERO, now_ns)
            self.model = model
            for axis in axes:
                zero = Zero.now(SENSOR, axis.zero.offset + known[axis.name])
                axis.move_zero(zero, model.axis(axis.name))
            self._couple()
        return moved

    def _couple(self) -> None:
        """Set up the compensation of cross-coupling between the axes."""
        assert self.model
        coupling = Coupling({axis.name: self.model.axis(axis.name).chain.gains for axis in self.axes})
        streams = {axis.name: axis.stream for axis in self.axes}
        self._stage = StageStream(streams, coupling, self.model.origins) if coupling.on else None

    # Settings

    def use_limits(self, limits: Sequence[Limits], now_ns: int, period: float = PERIOD) -> None:
        """Replace voltage limits and output period (s), or raise; a voltage outside goes inside at the slew limit."""
        for axis, new in zip(self.axes, limits, strict=True):
            axis.check_limits(new)
        for axis, new in zip(self.axes, limits, strict=True):
            axis.use_limits(new, period)
            if self.ownership.owned:
                axis.return_inside(now_ns)
        self.trajectory.period = period

    # Where the amplifiers are

    def report(self, names: Sequence[str], voltages: Sequence[float], now_ns: int, stage: str | None = None) -> bool:
        """Take the voltages (V) that amplifiers report, and the name that the stage gives itself.

        Return whether somebody else has begun to move, command or report an axis; all then stops until `arm`.
        """
        self.ownership.hear(now_ns)
        if stage is not None:
            self.ownership.stage.hear(stage, now_ns)
        for name, voltage in zip(names, voltages, strict=False):
            axis = self.messages.by_name.get(name)
            if axis:
                axis.amplifier.report(voltage, now_ns)
        if not self.ownership.lost(now_ns):
            return False
        self.stop(StopReason.LOST, now_ns)
        if self.ownership.armed:
            self.stopped = None
        return True

    def locate(self, now_ns: int) -> None:
        """Find the voltages at which the axes start, unless a voltage has been output already."""
        if self.model is not None and self.active and not self.ownership.started:
            self.ownership.locate(now_ns)

    def arm(self, now_ns: int, steady_ns: int = STEADY_NS) -> str:
        """Continue from where somebody else has moved the stage; return the reason if that is not possible, else ""."""
        # The steady voltage that the amplifiers report counts as the last output and enters the memory as one move.
        if self.ownership.armed:
            return ""
        why = self.ownership.arm(now_ns, steady_ns)
        if not why:
            self.stopped = None
            self.watchdog.start(now_ns)
        return why

    def _require(self, kind: Kind, now_ns: int) -> None:
        """Reject a motion that may not replace the present ones, or any while inactive or without a model.

        It begins after `Ownership.begin_output`, which rejects it until the amplifiers are known to be where they are.
        """
        if not self.active:
            raise RejectedError(rejection.INACTIVE, "the compensator is not active; activate it")
        if self.model is None:
            raise RejectedError(rejection.NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        # All axes are asked: a reset, a block or a trajectory belongs to the whole stage.
        for present in [axis.motion.kind for axis in self.axes] + [Kind.TRAJECTORY] * self.trajectory.on:
            if kind in REPLACED_BY[present]:
                continue
            if present is Kind.FAULT and self.ownership.obstacle:
                raise RejectedError(*self.ownership.obstacle)
            cause, advice = REFUSALS[present]
            raise RejectedError(cause, f"{self.activity(now_ns)}; {advice}")

    # Desired and measured displacements

    def update(
        self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float], now_ns: int, arrival_ns: int = 0
    ) -> bool:
        """Move the named axes to their displacements (m), or none; return whether one is held at a voltage limit."""
        # `arrival_ns`, on the clock of the stamps, is used instead of a `stamp_ns` of 0, or if `needs_arrival`.
        self.counts["received"] += 1
        try:
            following = self._following
            if not following:
                self._require(Kind.STREAM, now_ns)
            axes = self.messages.read(stamp_ns, names, displacements, arrival_ns)
            if not self.ownership.owned:
                self.ownership.begin_output(now_ns)
        except RejectedError as error:
            self.counts.reject(error)
            raise
        aheads = []
        for axis in axes:
            if not following:
                axis.end_ramp(now_ns)
            samples = axis.samples
            aheads.append(samples.accept(stamp_ns) if stamp_ns else samples.arrive(arrival_ns))
        held, slewing = self._move(axes, names, displacements, aheads, now_ns)
        self.counts.note(aheads, self.messages.jump, held, slewing)
        return held

    def measure(
        self, names: Sequence[str], displacements: Sequence[float], now_ns: int, fresh: bool = True, age: float = 0.0
    ) -> None:
        """Store displacements (m) measured `age` (s) ago, `fresh`: stamped now; a bad one is raised after others."""
        rejected: RejectedError | None = None
        for name, y in zip(names, displacements, strict=False):
            axis = self.messages.by_name.get(name)
            if axis:
                try:
                    axis.measure(y, now_ns, fresh, age)
                except RejectedError as error:
                    self.counts.reject(error, "measurements_rejected")
                    rejected = RejectedError(error.cause, f"axis '{name}': {error}")
        if rejected:
            raise rejected

    def _move(
        self,
        axes: Sequence[Axis],
        names: Sequence[str],
        displacements: Sequence[float],
        aheads: Sequence[float | None],
        now_ns: int,
        early: bool = False,
    ) -> tuple[bool, bool]:
        """Move each axis to its displacement (m), `aheads` (s) after its last sample; return (held, slew limited).

        `early`: before its time, by the delay of its stage.
        """
        if self._stage:
            self._stage.decouple(dict(zip(names, displacements, strict=True)))
            for axis in self.axes:
                axis.motion.wake(now_ns + axis.output.period_ns)
        held = slewing = began = False
        for axis, y, ahead in zip(axes, displacements, aheads, strict=True):
            was_held = axis.held
            axis.update(ahead, y, now_ns, early)
            held, slewing = held or axis.held, slewing or axis.slewing
            began = began or (axis.held and not was_held)
        self.counts["excursions"] += began
        self.watchdog.commanded = True
        self.watchdog.feed(now_ns)
        return held, slewing

    # Trajectories and blocks

    def follow(
        self,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        start_ns: int,
        now_ns: int,
        clock_ns: int,
    ) -> None:
        """Start a trajectory, or raise and keep the current one; times (N,), positions (N, K) in m; empty: cancel."""
        # `start_ns` is on the trajectory clock; 0 starts at once.
        self.counts["trajectories"] += 1
        if not len(time_from_start_ns):  # type: ignore[arg-type]
            self.watchdog.feed(now_ns)
            if self.trajectory.on:
                self.stop(StopReason.CANCELED, now_ns)
            return
        try:
            path = self._path(Kind.TRAJECTORY, names, time_from_start_ns, positions, start_ns, now_ns)
            require_mean_rates(path, self.axes, now_ns, clock_ns)
            delays = {axis.name: axis.model.chain.delay for axis in self.axes if axis.model}
            self.trajectory.start(path, clock_ns, delays, {axis.name: axis.stream for axis in self.axes})
        except RejectedError:
            self.counts["trajectories_rejected"] += 1
            raise
        self._clock_ahead_ns = clock_ns - now_ns
        self.watchdog.feed(now_ns)
        for axis in self.axes:
            axis.use_checked(True)

    def follow_block(
        self,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        now_ns: int,
        stamp_ns: int,
    ) -> Block:
        """Return a trajectory as one block of voltages from the present ones on, which a device plays from now on.

        It is checked as a whole, or raises and nothing changes. Until `hear_block` has heard of its end nothing else
        moves.
        """
        self.counts["trajectories"] += 1
        try:
            path = self._path(Kind.BLOCK, names, time_from_start_ns, positions, 0, now_ns)
            for axis in self.axes:
                axis.begin(BlockMotion(), now_ns)
            try:
                block = plan(path, self.axes, self._stage, self.trajectory.period, stamp_ns, now_ns)
            except RejectedError:
                self._end_block(now_ns)
                raise
        except RejectedError:
            self.counts["trajectories_rejected"] += 1
            raise
        self.trajectory.too_fast = block.missed
        self.block = BlockFollower(block, self.messages.by_name, now_ns)
        self.watchdog.feed(now_ns)
        return block

    def _path(
        self, kind: Kind, names: Sequence[str], times: ArrayLike, positions: ArrayLike, start_ns: int, now_ns: int
    ) -> Trajectory:
        """Return a path that may begin now, with all its points within the accepted displacements."""
        self._require(kind, now_ns)
        path = Trajectory.of(names, times, positions, start_ns, axes=self.names)
        path.check_reach({axis.name: axis.stream.accepted for axis in self.axes})
        self.ownership.begin_output(now_ns)
        return path

    def hear_block(self, stamp_ns: int, state: str, sample: int, reason: str, now_ns: int) -> bool:
        """Take what a driver tells of a block; return whether the present one has ended with it."""
        block = self.block
        if self.mode is not OperatingMode.BLOCK or block is None or stamp_ns != block.block.stamp_ns:
            return False
        block.hear(state, sample, reason, now_ns)
        if block.done:
            self._end_block(now_ns)
        return block.done

    def _end_block(self, now_ns: int) -> None:
        for axis in self.axes:
            axis.begin(Idle(), now_ns)
            if self.ownership.owned:
                axis.return_inside(now_ns)
        self.watchdog.feed(now_ns)

    def _step_trajectory(self, now_ns: int, clock_ns: int) -> bool:
        """Output the trajectory point that is due, if any; return whether there was one."""
        point = self.trajectory.due(clock_ns)
        if point is None:
            return False
        axes = self.messages.axes(point.names)
        for axis in axes:
            axis.end_ramp(now_ns)
        aheads = [axis.samples.point(point.deadline_ns) for axis in axes]
        held, slewing = self._move(axes, point.names, point.displacements, aheads, now_ns, early=True)
        if not point.between:
            self.counts["points_held_at_limit"] += held
            self.counts["points_slew_limited"] += slewing
        self.trajectory.look_ahead()
        if not self.trajectory.on:
            for axis in self.axes:
                axis.samples.restart()
                axis.use_checked(False)
        return True

    # Motion without desired displacements

    def next_due_ns(self, now_ns: int, clock_ns: int) -> int | None:
        """Return the time (ns, monotonic) of the next required call of `advance`; None if nothing follows."""
        due: int | None = None
        if self.ownership.owned:
            for axis in self.axes:
                at_ns = axis.due_ns if axis.loop.active else axis.motion.due_ns
                if at_ns is not None and (due is None or at_ns < due):
                    due = at_ns
        point = self.trajectory.next_deadline_ns
        if point is not None:
            point += now_ns - clock_ns
            due = point if due is None else min(point, due)
        return due

    def advance(self, now_ns: int, clock_ns: int) -> bool:
        """Do what is due without messages; return whether there are new `voltages` to output."""
        self._clock_ahead_ns = clock_ns - now_ns
        if not self.ownership.owned:
            return False
        due = [axis for axis in self.axes if (at_ns := axis.due_ns) is not None and at_ns <= now_ns]
        new = self._tick(due, now_ns) if due else False
        if self.trajectory.on:
            new = self._step_trajectory(now_ns, clock_ns) or new
        return new

    def _tick(self, axes: Sequence[Axis], now_ns: int) -> bool:
        """Let each axis do what is due; return whether a voltage has changed."""
        if self._stage:
            self._stage.decouple({axis.name: axis.aim for axis in axes if axis.motion.kind is Kind.HOLD})
        moving = self.trajectory.moving if self.trajectory.on else ()
        new, resetting = False, any(axis.motion.kind is Kind.RESET for axis in axes)
        for axis in axes:
            was_held = axis.held
            new = axis.tick(now_ns, axis.name in moving) or new
            if axis.held and not was_held:
                # What the slew limit held back of a message is out of reach.
                self.counts["held_at_limit"] += 1
                self.counts["excursions"] += 1
        if resetting and self.mode is not OperatingMode.RESETTING:
            # The watchdog is suspended during a reset.
            self.watchdog.feed(now_ns)
        return new

    def stop(self, reason: StopReason, now_ns: int) -> None:
        """End all motion: axes that move within an acceleration limit brake during the next calls of `advance`."""
        self.stopped = reason
        self.trajectory.cancel()
        if reason is not StopReason.SILENCE:
            self.watchdog.feed(now_ns)
        for axis in self.axes:
            axis.use_checked(False)
            if reason is StopReason.LOST:
                axis.begin(Idle() if self.ownership.armed else Fault(), now_ns)
                continue
            axis.stop(now_ns)
            if self.ownership.owned:
                axis.return_inside(now_ns)

    def ramp(self, voltages: Sequence[float], rate: float, now_ns: int) -> None:
        """Start a ramp to `voltages` (V, one per axis, clipped to the limits) at `rate` (V/s)."""
        self._require(Kind.RAMP, now_ns)
        self.ownership.begin_output(now_ns)
        self.trajectory.cancel()
        for axis, voltage in zip(self.axes, voltages, strict=True):
            axis.begin(Ramp([voltage], rate), now_ns)

    def reset_memory(
        self, cycles: int, rate: float, finals: Sequence[float], now_ns: int, spans: Sequence[tuple[float, float]] = ()
    ) -> None:
        """Start the decaying oscillation that resets the memory, to `finals` (V), within `spans` (V; the limits)."""
        self._require(Kind.RESET, now_ns)
        self.ownership.begin_output(now_ns)
        limits = reset_limits(self.axes, spans)
        turns = [decaying_turns(each, each.clip(v), cycles) for v, each in zip(finals, limits, strict=True)]
        for axis, goals in zip(self.axes, turns, strict=True):
            axis.begin(Reset(goals, rate, axis.stream.voltage), now_ns)
            axis.confidence = MemoryConfidence(RESETTING)

    def watch(self, safety: Safety, fault_time: float, now_ns: int) -> list[Finding]:
        """Return what the monitor newly finds, after the answer to it.

        Commands that stop: the voltages are held, or go to the safe ones. A sensor that is faulty for `fault_time` (s;
        0: never), or an oscillation that feedback sustains: its feedback is switched off. A block of which nothing is
        heard: it is given up.
        """
        # A trajectory counts as a command until its last point. The watchdog is suspended during a reset of the memory.
        waiting = self.mode in (OperatingMode.STREAMING, OperatingMode.RAMPING)
        self.watchdog.timeout = safety.command_timeout if waiting else 0.0
        for axis in self.axes:
            axis.loop.judge(fault_time, self.ownership.owned and not axis.motion.drives, now_ns)
        news = self.monitor.check(now_ns)
        for found in news:
            if found.rule in ("sensor", "oscillation"):
                self.messages.by_name[found.axis].loop.switch_off(found)
        for axis in self.axes:
            axis.loop.listen()
        if self.watchdog.react(safety):
            if self.watchdog.safe_voltages and self.ownership.owned:
                self.stopped = StopReason.SILENCE
                self.ramp(safety.voltages, safety.rate, now_ns)
            else:
                # The voltages are held, not the displacements: nothing follows creep or a sensor without commands.
                self.stop(StopReason.SILENCE, now_ns)
        block = self.block
        if block is None or self.mode is not OperatingMode.BLOCK:
            return news
        silent = block.check(now_ns)
        if silent is None:
            block.band(now_ns)
            return news
        if block.state:
            # It may still be moving.
            self.ownership.obstacle = rejection.NOT_ARMED, silent.reason
            self.stop(StopReason.LOST, now_ns)
        else:
            self._end_block(now_ns)
        return [*news, silent]


def watch_uncertainty(axes: Sequence[Axis], model: StageModel | None, wanted: bool, now: datetime, now_ns: int) -> str:
    """Follow the uncertainty of all axes, or no longer; return why that is not possible, else "".

    `now` is the present in UTC: the age counts from when a zero was set, or the model was made, as far as known.
    """
    for axis in axes:
        if not wanted or model is None or axis.model is None:
            axis.uncertainty.end()
            continue
        age = max(seconds_since(axis.zero.at or model.created, now.timestamp()) or 0.0, 0.0)
        of = axis.model, axis.confidence.state, axis.zero
        try:
            axis.uncertainty.follow(of, axis.stream, axis.surroundings, age)
        except SlpiError as error:
            return f"axis '{axis.name}': {error}"
        axis.uncertainty.wait((now_ns - axis.samples.given_ns) * 1e-9, axis.expected, axis.voltage)
    return ""
