"""Compensation of all axes, independent of ROS. `now_ns`: steady clock; `clock_ns`: that, or the simulated one."""

from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from enum import Enum

from numpy.typing import ArrayLike

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.amplifier import REARM_NS, STEADY_NS
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.block import Block, BlockFollower, plan
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.monitor import Finding
from slpi_ros.compensator.ownership import Ownership
from slpi_ros.compensator.persistence import (
    INTERRUPTED,
    KNOWN,
    RESET,
    RESETTING,
    SENSOR,
    MemoryConfidence,
    SavedAxis,
    Zero,
)
from slpi_ros.compensator.ramps import Ramp, Safety
from slpi_ros.compensator.statistics import Counts
from slpi_ros.compensator.surroundings import Surrounding
from slpi_ros.compensator.trajectory import CHECKED_FIRST, CHECKED_LATER, PaceCheck, Trajectory, TrajectoryExecutor
from slpi_ros.compensator.validation import RejectedError, TimestampRules, require_names
from slpi_ros.compensator.watchdog import CommandWatchdog
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import StartMemory
from slpi_ros.model.coupling import Coupling
from slpi_ros.model.limits import PERIOD, Limits, decaying_turns
from slpi_ros.model.stage_model import StageModel, seconds_since
from slpi_ros.model.streaming import StageStream

OPEN_LOOP = LoopSettings(False, PidGains(0.0), 0.1)


class OperatingMode(Enum):
    """Operating mode of the whole stage."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    # Desired displacements are converted to voltages.
    STREAMING = "streaming"
    # Points of a trajectory are pending.
    TRAJECTORY = "trajectory"
    # A ramp to the safe voltages is running; a desired displacement ends it.
    RAMPING = "ramping"
    # A device plays a block by itself; only its end, or deactivation, ends it.
    BLOCK = "block"
    # The memory is being reset; only deactivation interrupts the reset.
    RESETTING = "resetting"


class Controller:
    """Inverse hysteresis compensation, with optional feedback, for all axes of a stage; sequences in their order."""

    # A loaded model cannot relax the limits; one with another `hardware_id` is refused, "" accepts any. Without
    # `loops`, feedback is disabled. `update` validates a message as a whole and then moves every axis named in it;
    # `advance` executes what is due without a message: trajectories, what the limits held back, holds, ramps, the reset
    # of the memory. The first voltage starts from where the amplifiers are (`locate`), and their reports are held
    # against what was output (`report`).
    def __init__(
        self,
        axes: Sequence[str],
        limits: Sequence[Limits],
        hardware_id: str = "",
        time: TimestampRules | None = None,
        loops: Sequence[LoopSettings] = (),
        period: float = PERIOD,
        starts: Sequence[str | float] = (),
    ) -> None:
        self.names = list(axes)
        loops = loops or [OPEN_LOOP] * len(self.names)
        self.axes = [Axis(name, place, limits[place], loops[place], period) for place, name in enumerate(self.names)]
        self.ownership = Ownership(self.axes, starts)  # whether voltages may be output
        self._checks: list[PaceCheck] = []
        self.too_fast = ""  # the first point of the trajectory that will be late; "" if none is known
        # Quantities that the model in use follows, by name.
        self.surroundings: dict[str, Surrounding] = {}
        self.voltages = array("d", [0.0] * len(self.axes))  # V, updated in place
        self.mode = OperatingMode.UNCONFIGURED
        self.counts = Counts()
        # The model in use, and as it was identified, before its zeros were moved.
        self.model: StageModel | None = None
        self.identified: StageModel | None = None
        self.trajectory = TrajectoryExecutor(period, self._place)
        self.watchdog = CommandWatchdog()
        self.block: BlockFollower | None = None  # the last one
        self._stage: StageStream | None = None
        self._hardware_id = hardware_id
        self._by_name = {axis.name: axis for axis in self.axes}
        self._last_names: Sequence[str] | None = None
        self._last_axes: list[Axis] = []
        # Lowest and highest voltage (V) of each axis during a reset.
        self._spans: list[tuple[float, float]] = []
        # Offset of the trajectory clock from the monotonic clock at the last call, nanoseconds.
        self._clock_ahead_ns = 0
        self.use_time(time or TimestampRules())

    # Lifecycle and models

    @property
    def active(self) -> bool:
        """Whether the compensator is activated."""
        return self.mode not in (OperatingMode.UNCONFIGURED, OperatingMode.INACTIVE)

    @property
    def driven(self) -> bool:
        """Whether a model has ever been loaded; before that, the voltages of the axes are unknown."""
        return self.axes[0].driven

    def configure(self) -> None:
        """Enter the inactive mode."""
        self.mode = OperatingMode.INACTIVE

    def cleanup(self) -> None:
        """Discard the model; the voltages are unchanged."""
        self.mode, self.model, self.identified = OperatingMode.UNCONFIGURED, None, None

    def activate(self, now_ns: int) -> None:
        """Start processing messages at `now_ns` (ns), with all axes at rest at their present voltages."""
        self.mode = OperatingMode.STREAMING
        self.watchdog.start(now_ns)
        self._rest_all(now_ns)
        self.ownership.await_start(now_ns)

    def deactivate(self, now_ns: int) -> None:
        """Stop processing messages at `now_ns` (ns); the voltages are held."""
        self.hold(now_ns)
        self._rest_all(now_ns)
        for axis in self.axes:
            axis.amplifier.forget_output()
        self.mode = OperatingMode.INACTIVE

    def use_model(
        self,
        model: StageModel,
        saved: Mapping[str, SavedAxis] | None = None,
        start_memory: StartMemory = "end",
        last_voltages: Mapping[str, float] | None = None,
    ) -> None:
        """Replace the model in use, or raise and keep the old one; the voltages are unchanged."""
        # Only the first model uses what was saved; `last_voltages` (V) are of axes saved with another model.
        if self._hardware_id and model.hardware_id and model.hardware_id != self._hardware_id:
            raise UsageError(
                f"the model has hardware id '{model.hardware_id}', this stage has '{self._hardware_id}'; "
                "use a model of this stage, or correct hardware_id"
            )
        self._require_no_block(0)
        turns, identified = {name: each.reversal_voltages for name, each in (saved or {}).items()}, model
        model = model.shifted({name: each.zero.offset for name, each in (saved or {}).items()})
        prepared = []
        for axis in self.axes:
            one = model.axis(axis.name)
            try:
                stream = axis.prepare(one, turns.get(axis.name), start_memory)
            except SlpiError as error:
                raise type(error)(f"axis '{axis.name}': {error}") from None
            if saved:
                stream.relax_from(saved[axis.name].relaxing, saved[axis.name].age)
            prepared.append((axis, one, stream))
        for axis, one, stream in prepared:
            first = not axis.driven
            if first:
                axis.start_memory = None if saved else start_memory
            axis.use(one, stream)
            if saved:
                axis.confidence, axis.zero = saved[axis.name].confidence(one.hysteresis_range), saved[axis.name].zero
            elif first and last_voltages and axis.name in last_voltages:
                axis.locate(last_voltages[axis.name])
        self.model, self.identified = model, identified
        self._couple()
        known = self.surroundings
        self.surroundings = {}
        for followed in (one for axis in model.axes.values() for one in axis.followed):
            before = known.get(followed.key)
            same = before is not None and before.followed == followed
            self.surroundings[followed.key] = before if before and same else Surrounding(followed)

    def surround(self, key: str, value: float, now_ns: int) -> bool:
        """Take a value of a quantity that came at `now_ns` (ns); return whether it is used."""
        known = self.surroundings.get(key)
        if known is None or not known.note(value, now_ns):
            return False
        for axis in self.axes:
            axis.surround(key, value)
        return True

    def set_zero(self, now_ns: int) -> dict[str, float | None]:
        """Let the models agree with the sensors now; return by how much (m) each zero moves, None: not measured."""
        self._require_ready()
        self._begin_output(now_ns)
        assert self.model
        moved = {axis.name: axis.offset(now_ns) for axis in self.axes}
        known = {name: offset for name, offset in moved.items() if offset is not None}
        axes = [axis for axis in self.axes if axis.name in known]
        model = self.model.shifted(known)
        for axis in axes:
            axis.prepare(model.axis(axis.name))
        if axes:
            self.hold(now_ns)
            self.model = model
            for axis in axes:
                zero = Zero.now(SENSOR, axis.zero.offset + known[axis.name])
                axis.move_zero(zero, model.axis(axis.name))
            self._couple()
        return moved

    # Where the amplifiers are

    def report(self, names: Sequence[str], voltages: Sequence[float], now_ns: int) -> bool:
        """Take the voltages (V) that amplifiers report; return whether somebody now moves an axis, until `arm`."""
        for name, voltage in zip(names, voltages, strict=False):
            axis = self._by_name.get(name)
            if axis:
                axis.amplifier.report(voltage, now_ns)
        if not self.ownership.lost(now_ns):
            return False
        self._end_reset()
        if self.mode is OperatingMode.TRAJECTORY:
            self._end_trajectory()
        self._end_block(now_ns)
        for axis in self.axes:
            axis.stop_ramp()
            axis.drop_goal()
        if self.active:
            self.mode = OperatingMode.STREAMING
        return True

    def locate(self, now_ns: int) -> None:
        """Find the voltages at which the axes start, unless a voltage has been output already."""
        if self.model is not None and self.active and not self.ownership.started:
            self.ownership.locate(now_ns)
            self._read_voltages()

    def arm(self, now_ns: int, steady_ns: int = STEADY_NS) -> str:
        """Continue from where somebody else has moved the stage; return the reason if that is not possible, else ""."""
        # The steady voltage that the amplifiers report counts as the last output and enters the memory as one move.
        if self.ownership.armed:
            return ""
        why = self.ownership.arm(now_ns, steady_ns)
        if not why:
            self._read_voltages()
            self.watchdog.start(now_ns)
        return why

    def rearm(self, now_ns: int) -> bool:
        """Arm if the reports have been steady for long enough; return whether it did."""
        return not self.ownership.armed and not self.arm(now_ns, REARM_NS)

    def _begin_output(self, now_ns: int) -> None:
        """Require that voltages may be output, from where the amplifiers are; RejectedError with the reason if not."""
        self._require_no_block(now_ns)
        self.ownership.begin_output(now_ns)
        self._read_voltages()

    def _read_voltages(self) -> None:
        for axis in self.axes:
            self.voltages[axis.place] = axis.voltage

    def _place(self, name: str) -> float:
        """Return the displacement (m) of an axis according to its model."""
        stream = self._by_name[name].stream
        return stream.uncoupled_displacement + stream.coupled

    # Settings

    def check_limits(self, limits: Sequence[Limits]) -> None:
        """Raise the error that `use_limits` would raise, without changing anything."""
        for axis, new in zip(self.axes, limits, strict=True):
            axis.check_limits(new)

    def use_limits(self, limits: Sequence[Limits], now_ns: int, period: float = PERIOD) -> None:
        """Replace voltage limits and output period (s), or raise; a voltage outside goes inside at the slew limit."""
        self.check_limits(limits)
        for axis, new in zip(self.axes, limits, strict=True):
            axis.use_limits(new, period)
            if self.ownership.owned:
                axis.return_inside(now_ns)
        self.trajectory.period = period

    def use_loops(self, loops: Sequence[LoopSettings]) -> None:
        """Replace the feedback settings of all axes without a voltage step."""
        for axis, settings in zip(self.axes, loops, strict=True):
            axis.retune(settings)

    def use_time(self, rules: TimestampRules) -> None:
        """Replace the rules for message time stamps."""
        self._jump, self._max_age_ns = rules.jump, int(rules.max_age * SECOND_NS)
        for axis in self.axes:
            axis.stamps.jump_ns = int(rules.jump * SECOND_NS)

    # Desired and measured displacements

    @property
    def needs_arrival(self) -> bool:
        """Whether `update` needs the arrival time even of messages that carry a time stamp."""
        return self._max_age_ns > 0

    def update(
        self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float], now_ns: int, arrival_ns: int = 0
    ) -> bool:
        """Move the named axes to their displacements (m), or none; return whether one is held at a voltage limit."""
        # `arrival_ns`, on the clock of the stamps, is used instead of a `stamp_ns` of 0, or if `needs_arrival`.
        counts = self.counts
        counts.received += 1
        try:
            axes = self._axes_of(names, len(displacements), now_ns)
            self._check(axes, stamp_ns, displacements, arrival_ns)
            if not self.ownership.owned:
                self._begin_output(now_ns)
        except RejectedError as error:
            counts.by_cause[error.cause] += 1
            raise
        self.mode = OperatingMode.STREAMING
        for axis in axes:
            axis.stop_ramp()
        aheads = [axis.stamps.accept(stamp_ns) if stamp_ns else axis.stamps.arrive(arrival_ns) for axis in axes]
        held, slewing = self._move(axes, names, displacements, aheads, now_ns)
        counts.accepted += 1
        if held or slewing:
            counts.held_at_limit += held
            counts.slew_limited += slewing
        for ahead in aheads:
            if ahead is not None and not 0.0 <= ahead <= self._jump:
                known = [each for each in aheads if each is not None]
                counts.gaps += max(known) > self._jump
                counts.time_jumps += min(known) < 0.0
                break
        return held

    def measure(self, names: Sequence[str], displacements: Sequence[float], now_ns: int, fresh: bool = True) -> None:
        """Store measured displacements (m), `fresh`: stamped now; a bad one is counted, raised after the others."""
        rejected: RejectedError | None = None
        for name, y in zip(names, displacements, strict=False):
            axis = self._by_name.get(name)
            if axis:
                try:
                    axis.measure(y, now_ns, fresh)
                except RejectedError as error:
                    self.counts.measured_by_cause[error.cause] += 1
                    rejected = RejectedError(error.cause, f"axis '{name}': {error}")
        if rejected:
            raise rejected

    def watch_sensors(self, fault_time: float, now_ns: int) -> list[tuple[Axis, Finding]]:
        """Switch off the feedback of axes whose sensor is faulty for `fault_time` (s); return the new faults."""
        found = [(axis, axis.watch_sensor(fault_time, now_ns)) for axis in self.axes] if self.ownership.owned else []
        return [(axis, fault) for axis, fault in found if fault]

    def watch_uncertainty(self, wanted: bool, now: datetime, now_ns: int) -> str:
        """Follow the uncertainty of all axes, or no longer; return why that is not possible, else "".

        `now` is the present in UTC: the age counts from when a zero was set, or the model was made, as far as known.
        """
        for axis in self.axes:
            since = axis.zero.at or (self.model.created if self.model else "")
            age = max(seconds_since(since, now.timestamp()) or 0.0, 0.0) if wanted else 0.0
            try:
                axis.watch_uncertainty(wanted and self.model is not None, age, now_ns)
            except SlpiError as error:
                return f"axis '{axis.name}': {error}"
        return ""

    def _axes_of(self, names: Sequence[str], count: int, now_ns: int) -> list[Axis]:
        """Return the named axes; RejectedError unless they can accept `count` desired displacements now."""
        if self.mode is not OperatingMode.STREAMING or self.model is None or not self.ownership.owned:
            self._require_ready()
            self._require_no_block(now_ns)
            if self.mode is OperatingMode.TRAJECTORY:
                raise RejectedError(
                    rejection.FOLLOWING, f"{self.activity(now_ns)}; wait, or cancel it with an empty one"
                )
        if count != len(names):
            raise RejectedError(rejection.LENGTH, f"{len(names)} axes but {count} displacements; send one for each")
        return self._named(names)

    def _named(self, names: Sequence[str]) -> list[Axis]:
        """Return the named axes; raise RejectedError as `require_names` does."""
        # Most senders use the same names in every message.
        if names != self._last_names:
            require_names(names, self._by_name)
            self._last_axes = [self._by_name[name] for name in names]
            # Copied because the caller may modify the sequence.
            self._last_names = names[:]
        return self._last_axes

    def _check(self, axes: Sequence[Axis], stamp_ns: int, displacements: Sequence[float], arrival_ns: int) -> None:
        """Reject the message if a displacement, its stamp or its age is not acceptable, checked in this order."""
        axis = axes[0]
        try:
            for axis, y in zip(axes, displacements, strict=True):
                axis.check(y)
            if stamp_ns:
                for axis in axes:
                    axis.stamps.check(stamp_ns)
        except RejectedError as error:
            raise RejectedError(error.cause, f"axis '{axis.name}': {error}") from None
        if stamp_ns and 0 < self._max_age_ns < arrival_ns - stamp_ns:
            age = (arrival_ns - stamp_ns) * 1e-9
            raise RejectedError(
                rejection.STALE, f"stamped {age:.6g} s ago, longer than max_age; check delays and clocks"
            )

    def _require_ready(self) -> None:
        """Reject a command while the compensator is inactive, without a model, or resetting the memory."""
        if not self.active:
            raise RejectedError(rejection.INACTIVE, "the compensator is not active; activate it")
        if self.model is None:
            raise RejectedError(rejection.NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        if self.mode is OperatingMode.RESETTING:
            raise RejectedError(rejection.RESETTING, "the memory is being reset; wait until reset_memory answers")

    def _move(
        self,
        axes: Sequence[Axis],
        names: Sequence[str],
        displacements: Sequence[float],
        aheads: Sequence[float | None],
        now_ns: int,
    ) -> tuple[bool, bool]:
        """Move each axis to its displacement (m), `aheads` (s) after its last sample; return (held, slew limited)."""
        if self._stage:
            self._stage.decouple(dict(zip(names, displacements, strict=True)))
            for axis in self.axes:
                axis.wake(now_ns)
        held = slewing = began = False
        for axis, y, ahead in zip(axes, displacements, aheads, strict=True):
            was_held = axis.held
            self.voltages[axis.place] = axis.update(ahead, y, now_ns)
            if axis.held:
                held, began = True, began or not was_held
            elif axis.slewing:
                slewing = True
        if began:
            self.counts.excursions += 1
        self.watchdog.commanded = True
        self.watchdog.feed(now_ns)
        return held, slewing

    # Trajectories

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
        self.counts.trajectories += 1
        try:
            if not len(time_from_start_ns):  # type: ignore[arg-type]
                self.cancel(now_ns)
                return
            self._require_ready()
            path = Trajectory.of(names, time_from_start_ns, positions, start_ns, axes=self.names)
            path.check_reach({axis.name: axis.stream.accepted for axis in self.axes})
            self._begin_output(now_ns)
            delays = {axis.name: axis.model.chain.delay for axis in self.axes if axis.model}
            self.trajectory.start(path, clock_ns, delays)
        except RejectedError:
            self.counts.trajectories_rejected += 1
            raise
        self.too_fast = ""
        self.mode, self._clock_ahead_ns = OperatingMode.TRAJECTORY, clock_ns - now_ns
        self.watchdog.feed(now_ns)
        wait = (start_ns - clock_ns) * 1e-9 if start_ns else 0.0
        self._checks = [
            PaceCheck(axis.name, axis.stream, path, wait, axis.output.period)
            for axis in self.axes
            if axis.name in path.names
        ]
        self.check_pace(CHECKED_FIRST)

    def follow_block(
        self,
        names: Sequence[str],
        time_from_start_ns: ArrayLike,
        positions: ArrayLike,
        now_ns: int,
        stamp_ns: int,
    ) -> Block:
        """Return a trajectory as one block of voltages from the present ones on, which a device plays from now on.

        It is checked as a whole, or raises and nothing changes. Until `told` has heard of its end nothing else moves.
        """
        self.counts.trajectories += 1
        try:
            self._require_ready()
            path = Trajectory.of(names, time_from_start_ns, positions, axes=self.names)
            path.check_reach({axis.name: axis.stream.accepted for axis in self.axes})
            self._begin_output(now_ns)
            if self.mode is OperatingMode.TRAJECTORY:
                raise RejectedError(rejection.FOLLOWING, f"{self.activity(now_ns)}; wait, or cancel it first")
            for axis in self.axes:
                axis.begin_block()
            try:
                block = plan(path, self.axes, self._stage, self.trajectory.period, stamp_ns)
            except RejectedError:
                for axis in self.axes:
                    axis.end_block(now_ns)
                raise
        except RejectedError:
            self.counts.trajectories_rejected += 1
            raise
        self.mode, self.too_fast = OperatingMode.BLOCK, block.missed
        self.block = BlockFollower(block, self._by_name, now_ns)
        self.watchdog.feed(now_ns)
        return block

    def told(self, stamp_ns: int, state: str, sample: int, reason: str, now_ns: int) -> bool:
        """Take what a driver tells of a block; return whether the present one has ended with it."""
        block = self.block
        if self.mode is not OperatingMode.BLOCK or block is None or stamp_ns != block.block.stamp_ns:
            return False
        block.hear(state, sample, reason, now_ns)
        self._read_voltages()
        if not block.done:
            return False
        self._end_block(now_ns)
        return True

    def watch_block(self, now_ns: int) -> str:
        """Return why a block is given up now, as nothing is heard of it; "" if not."""
        block = self.block
        if self.mode is not OperatingMode.BLOCK or block is None:
            return ""
        found = block.check(now_ns)
        if not found:
            block.band(now_ns)
            return ""
        why = found.reason
        self._end_block(now_ns)
        if block.state:
            # It may still be moving.
            self.ownership.obstacle = rejection.NOT_ARMED, why
        return why

    def _end_block(self, now_ns: int) -> None:
        if self.mode is OperatingMode.BLOCK:
            for axis in self.axes:
                axis.end_block(now_ns)
            self._read_voltages()
            self.watchdog.feed(now_ns)
            self.mode = OperatingMode.STREAMING

    def _require_no_block(self, now_ns: int) -> None:
        if self.mode is OperatingMode.BLOCK:
            raise RejectedError(
                rejection.FOLLOWING, f"{self.activity(now_ns)}; wait, or cancel it with an empty trajectory"
            )

    def check_pace(self, points: int = CHECKED_LATER) -> None:
        """Look at the next points of the trajectory: whether the slew limit will make one late (`too_fast`)."""
        for check in self._checks:
            self.too_fast = self.too_fast or check.look(points)
        self._checks = [check for check in self._checks if not check.done]

    def activity(self, now_ns: int) -> str:
        """Return a text that describes the present activity."""
        if self.mode is OperatingMode.RESETTING:
            return "resetting the memory"
        if self.mode is OperatingMode.BLOCK:
            return "a device plays a block"
        deadline_ns = self.trajectory.next_deadline_ns
        if deadline_ns is None:
            return "compensating"
        wait = (deadline_ns - self._clock_ahead_ns - now_ns) * 1e-9
        if wait < 1.0:
            return "following a trajectory"
        return f"waiting for a trajectory that {'goes on' if self.trajectory.begun else 'begins'} in {wait:.0f} s"

    def cancel(self, now_ns: int) -> None:
        """Cancel the trajectory, if any; its axes decelerate to rest within their acceleration limit."""
        self.watchdog.feed(now_ns)
        if self.mode is OperatingMode.TRAJECTORY:
            self._end_trajectory()
            self._release((), now_ns)

    def _end_trajectory(self) -> None:
        self.trajectory.cancel()
        self._checks = []
        self.mode = OperatingMode.STREAMING
        for axis in self.axes:
            axis.stamps.restart()
            axis.point_ns = None

    def _step_trajectory(self, now_ns: int, clock_ns: int) -> bool:
        """Execute the trajectory point that is due, if any; return whether there was one."""
        point = self.trajectory.due(clock_ns)
        if point is None:
            return False
        axes = self._named(point.names)
        aheads: list[float | None] = []
        for axis in axes:
            axis.stop_ramp()
            since = axis.point_ns
            aheads.append((point.deadline_ns - since) * 1e-9 if since is not None else None)
            axis.point_ns = point.deadline_ns
        held, slewing = self._move(axes, point.names, point.displacements, aheads, now_ns)
        if not point.between:
            self.counts.points_held += held
            self.counts.points_slewing += slewing
        self.check_pace()
        if not self.trajectory.on:
            self._end_trajectory()
        return True

    # Motion without desired displacements

    @property
    def ramping(self) -> bool:
        """Whether any axis executes a ramp or decelerates to rest."""
        for axis in self.axes:  # noqa: SIM110, 1 us faster than any() for each command
            if axis.ramp is not None:
                return True
        return False

    def next_due_ns(self, now_ns: int, clock_ns: int) -> int | None:
        """Return the time (ns, monotonic) of the next required call of `advance`; None if nothing follows."""
        due: int | None = None
        if self.ownership.owned:
            for axis in self.axes:
                if axis.due_ns is not None and (due is None or axis.due_ns < due):
                    due = axis.due_ns
        point = self.trajectory.next_deadline_ns
        if point is not None:
            point += now_ns - clock_ns
            due = point if due is None else min(point, due)
        return due

    def advance(self, now_ns: int, clock_ns: int) -> bool:
        """Do what is due without messages; return whether there are new `voltages` to output."""
        new, self._clock_ahead_ns = False, clock_ns - now_ns
        if not self.ownership.owned:
            return False
        following = self.trajectory.moving if self.mode is OperatingMode.TRAJECTORY else ()
        due = [axis for axis in self.axes if axis.due_ns is not None and axis.due_ns <= now_ns]
        if due:
            new = self._tick([axis for axis in due if axis.ramp or axis.name not in following], now_ns)
            for axis in due:
                # The samples of its trajectory move the axis on.
                if axis.due_ns is not None and axis.due_ns <= now_ns:
                    axis.due_ns = None
        if self.mode is OperatingMode.TRAJECTORY:
            new = self._step_trajectory(now_ns, clock_ns) or new
        return new

    def hold(self, now_ns: int) -> None:
        """End all motion: axes in motion decelerate to rest during the next calls of `advance`, the others hold."""
        self._end_block(now_ns)
        self.cancel(now_ns)
        self._release((), now_ns)
        if self.active:
            self.mode = OperatingMode.STREAMING

    def ramp(self, voltages: Sequence[float], rate: float, now_ns: int) -> None:
        """Start a ramp to `voltages` (V, one per axis, clipped to the limits) at `rate` (V/s)."""
        self._begin_output(now_ns)
        self._start_ramps([Ramp([voltage], rate) for voltage in voltages], OperatingMode.RAMPING, now_ns)

    def reset_memory(
        self, cycles: int, rate: float, finals: Sequence[float], now_ns: int, spans: Sequence[tuple[float, float]] = ()
    ) -> None:
        """Start the decaying oscillation that resets the memory, to `finals` (V), within `spans` (V; the limits)."""
        self._begin_output(now_ns)
        ramps = []
        for final, limits in zip(finals, self.reset_limits(spans), strict=True):
            ramps.append(Ramp(decaying_turns(limits, limits.clip(final), cycles), rate))
        self._start_ramps(ramps, OperatingMode.RESETTING, now_ns)
        for axis in self.axes:
            axis.confidence = MemoryConfidence(RESETTING)
        self._spans = [(axis.stream.voltage,) * 2 for axis in self.axes]

    def reset_limits(self, spans: Sequence[tuple[float, float]] = ()) -> list[Limits]:
        """Return the limits of the oscillation of `reset_memory` for each axis."""
        every = [axis.stream.limits for axis in self.axes]
        if not spans:
            return every
        return [
            replace(limits, lower=limits.clip(low), upper=limits.clip(high))
            for limits, (low, high) in zip(every, spans, strict=True)
        ]

    def watch(self, safety: Safety, now_ns: int) -> bool:
        """Check the command watchdog: on expiry, hold or ramp to safe voltages; return whether the state changed."""
        # A trajectory counts as a command until its last point. The watchdog is suspended during a reset of the memory.
        waiting = self.mode in (OperatingMode.STREAMING, OperatingMode.RAMPING)
        news = self.watchdog.update(safety, now_ns, waiting)
        if news and self.watchdog.safe_voltages and self.ownership.owned:
            self.ramp(safety.voltages, safety.rate, now_ns)
        elif news:
            # The voltages are held, not the displacements: nothing follows creep or a sensor without commands.
            self._release((), now_ns)
            self.mode = OperatingMode.STREAMING
        return news

    def _start_ramps(self, ramps: Sequence[Ramp], mode: OperatingMode, now_ns: int) -> None:
        if self.mode is OperatingMode.TRAJECTORY:
            self._end_trajectory()
        self._end_reset()
        for axis, ramp in zip(self.axes, ramps, strict=True):
            axis.start_ramp(ramp, now_ns)
        self.mode = mode

    def _tick(self, axes: Sequence[Axis], now_ns: int) -> bool:
        """Let each axis do what is due; return whether a voltage has changed."""
        if self._stage:
            holding = {axis.name: axis.tracking.desired for axis in axes if axis.holding}
            self._stage.decouple({name: y for name, y in holding.items() if y is not None})
        new, ramping = False, self.ramping
        for axis in axes:
            was_held = axis.held
            if axis.tick(now_ns):
                self.voltages[axis.place] = axis.voltage
                new = True
            if axis.held and not was_held:
                # What the slew limit held back of a message is out of reach.
                self.counts.held_at_limit += 1
                self.counts.excursions += 1
        if not ramping:
            return new
        if self.mode is OperatingMode.RESETTING:
            reached = [axis.voltage for axis in self.axes]
            self._spans = [(min(low, v), max(high, v)) for (low, high), v in zip(self._spans, reached, strict=True)]
        if all(axis.ramp is None or axis.ramp.done for axis in self.axes):
            self._end_reset()
            for axis in self.axes:
                axis.stop_ramp()
            if self.mode in (OperatingMode.RAMPING, OperatingMode.RESETTING):
                self._end_ramping(now_ns)
        return new

    def _end_ramping(self, now_ns: int) -> None:
        if self.mode is OperatingMode.RESETTING:
            # The watchdog is suspended during a reset.
            self.watchdog.feed(now_ns)
        self.mode = OperatingMode.STREAMING

    def _end_reset(self) -> None:
        """Set the memory confidence of each axis after a completed or interrupted reset."""
        if self.mode is not OperatingMode.RESETTING:
            return
        for axis, span in zip(self.axes, self._spans, strict=True):
            axis.confidence = MemoryConfidence(doubt=INTERRUPTED)
            if axis.ramp and axis.ramp.done and axis.model:
                axis.confidence = MemoryConfidence(KNOWN, spanned=span).over(axis.model.hysteresis_range)
                if axis.zero.source != SENSOR:
                    axis.zero = Zero.now(RESET)

    def _release(self, but: Collection[Axis], now_ns: int) -> None:
        """End all ramps; axes in `but` follow new commands, the others decelerate to rest if in motion, then hold."""
        self._end_reset()
        for axis in self.axes:
            if axis not in but:
                if axis.in_motion:
                    axis.brake(now_ns)
                    continue
                axis.stop_ramp()
                axis.drop_goal()
                if self.ownership.owned:
                    axis.return_inside(now_ns)
            else:
                axis.stop_ramp()
        if self.mode is OperatingMode.RESETTING:
            self._end_ramping(now_ns)

    def _rest_all(self, now_ns: int) -> None:
        for axis in self.axes:
            axis.stop_ramp()
            axis.drop_goal()
            axis.given_ns = now_ns

    def _couple(self) -> None:
        """Set up the compensation of cross-coupling between the axes and update `voltages`."""
        assert self.model
        coupling = Coupling({axis.name: self.model.axis(axis.name).chain.gains for axis in self.axes})
        streams = {axis.name: axis.stream for axis in self.axes}
        self._stage = StageStream(streams, coupling, self.model.origins) if coupling.on else None
        for axis in self.axes:
            self.voltages[axis.place] = axis.voltage
