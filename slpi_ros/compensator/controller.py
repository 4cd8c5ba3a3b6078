"""The compensator without ROS: desired displacements in, the voltages of all axes out.

One sample takes one way: `Controller.update` checks it as a whole, then moves every axis it names. Points of
trajectories take the same way when they are due. What moves axes without desired displacements (ramps to safe voltages,
the reset of the memory, braking) does so with every `advance`. What the stage as a whole is doing is its `mode`.

All times `now_ns` are nanoseconds on a clock that never jumps; `clock_ns` is the clock of trajectories, the same one or
a simulated one.
"""

from array import array
from collections.abc import Collection, Mapping, Sequence
from enum import Enum

from numpy.typing import ArrayLike

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.persistence import INTERRUPTED, KNOWN, RESETTING, MemoryConfidence, SavedAxis
from slpi_ros.compensator.ramps import PERIOD, Ramp, Safety
from slpi_ros.compensator.statistics import Counts
from slpi_ros.compensator.trajectory import Trajectory, TrajectoryExecutor
from slpi_ros.compensator.validation import RejectedError, TimestampRules, require_names
from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import StartMemory
from slpi_ros.model.limits import MAX_DT, Limits, decaying_turns
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.streaming import StageStream

OPEN_LOOP = LoopSettings(False, PidGains(0.0), 0.1)
PERIOD_NS, MAX_DT_NS = int(PERIOD * SECOND_NS), int(MAX_DT * SECOND_NS)


class Mode(Enum):
    """What the stage as a whole is doing."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    # Desired displacements are answered.
    STREAMING = "streaming"
    # Points of a trajectory are to come.
    TRAJECTORY = "trajectory"
    # On the way to the safe voltages, which a desired displacement ends.
    RAMPING = "ramping"
    # The memory is being reset, which nothing but the end of activity ends.
    RESETTING = "resetting"


class CommandWatchdog:
    """Tells when no command has come for too long.

    Attributes
    ----------
    commanded : bool
        Whether there has been a command since the activation: before, nothing moves.
    expired : bool
        Whether it has been too long at the last look.
    safe_voltages : tuple of float, volts, or None
        Where the axes were sent then; None: they are held.
    """

    def __init__(self) -> None:
        self.start(0)

    def start(self, now_ns: int) -> None:
        """Start anew: there has been no command yet."""
        self.commanded = self.expired = False
        self.safe_voltages: tuple[float, ...] | None = None
        self._heard_ns = now_ns

    def feed(self, now_ns: int) -> None:
        """Count from now."""
        self._heard_ns = now_ns
        self.expired, self.safe_voltages = False, None

    def look(self, safety: Safety, now_ns: int, waiting: bool) -> bool:
        """Look at the clock; return whether it has become too long, or `safety` has changed what happens then.

        Parameters
        ----------
        safety : Safety
        now_ns : int, nanoseconds
        waiting : bool
            Whether commands are waited for.
        """
        before = self.expired, self.safe_voltages
        self.expired = waiting and 0.0 < safety.command_timeout < self.silence(now_ns)
        moves = self.expired and self.commanded and safety.ramps_on_timeout
        self.safe_voltages = safety.voltages if moves else None
        return self.expired and (self.expired, self.safe_voltages) != before

    def silence(self, now_ns: int) -> float:
        """Return the time without a command, seconds."""
        return (now_ns - self._heard_ns) * 1e-9


class Controller:
    """All axes of one compensator.

    Parameters
    ----------
    axes : sequence of str
        Names, in the order of the voltages.
    limits : sequence of Limits
        One for each axis. No model widens them.
    hardware_id : str
        The stage; models of another one are refused. "": any will do.
    time : TimeRules
    loops : sequence of LoopSettings, optional
        One for each axis; without them there is no feedback.

    Attributes
    ----------
    axes : list of Axis
    voltages : array of float, shape (axes,), volts
        The present ones, always the same array. An axis that a message does not name keeps its voltage.
    mode : Mode
    counts : Counts
    model : StageModel or None
    trajectory : TrajectoryExecutor
    watchdog : CommandWatchdog
    """

    def __init__(
        self,
        axes: Sequence[str],
        limits: Sequence[Limits],
        hardware_id: str = "",
        time: TimestampRules | None = None,
        loops: Sequence[LoopSettings] = (),
    ) -> None:
        self.names = list(axes)
        loops = loops or [OPEN_LOOP] * len(self.names)
        self.axes = [Axis(name, place, limits[place], loops[place]) for place, name in enumerate(self.names)]
        self.voltages = array("d", [0.0] * len(self.axes))
        self.mode = Mode.UNCONFIGURED
        self.counts = Counts()
        self.model: StageModel | None = None
        self.trajectory = TrajectoryExecutor()
        self.watchdog = CommandWatchdog()
        self._stage: StageStream | None = None
        self._hardware_id = hardware_id
        self._by_name = {axis.name: axis for axis in self.axes}
        self._last_names: Sequence[str] | None = None
        self._last_axes: list[Axis] = []
        # Lowest and highest voltage (V) of each axis during a reset.
        self._spans: list[tuple[float, float]] = []
        self._next_step_ns = 0
        # Of the clock of trajectories against the other one, when both were seen last.
        self._clock_ahead_ns = 0
        self.use_time(time or TimestampRules())

    # Life and models

    @property
    def active(self) -> bool:
        """Whether messages are answered."""
        return self.mode not in (Mode.UNCONFIGURED, Mode.INACTIVE)

    @property
    def driven(self) -> bool:
        """Whether there has been a model: before, the voltages of the axes are not known."""
        return self.axes[0].driven

    def configure(self) -> None:
        """Wait to be activated."""
        self.mode = Mode.INACTIVE

    def cleanup(self) -> None:
        """Forget the model; the voltages stay."""
        self.mode, self.model = Mode.UNCONFIGURED, None

    def activate(self, now_ns: int) -> None:
        """Answer messages from now on, starting at the present voltages."""
        self.mode = Mode.STREAMING
        self.watchdog.start(now_ns)
        self._rest_all(now_ns)

    def deactivate(self, now_ns: int) -> None:
        """Answer no more messages."""
        self.hold(now_ns)
        self._rest_all(now_ns)
        self.mode = Mode.INACTIVE

    def use_model(
        self, model: StageModel, saved: Mapping[str, SavedAxis] | None = None, start_memory: StartMemory = "end"
    ) -> None:
        """Take a model over; the voltages stay as they are.

        Parameters
        ----------
        model : StageModel
        saved : mapping of axis name to SavedAxis, optional
            Where the axes were when the node last ended; for the first model only.
        start_memory : str
            The memory of the model that axes start with which were not saved.

        Raises
        ------
        SlpiError
            If the model lacks an axis or cannot serve within the limits; the one before works on.
        """
        if self._hardware_id and model.hardware_id and model.hardware_id != self._hardware_id:
            raise UsageError(
                f"the model is of the stage '{model.hardware_id}', this is '{self._hardware_id}'; "
                "give a model of this stage, or correct hardware_id"
            )
        prepared = []
        for axis in self.axes:
            one = model.axis(axis.name)
            try:
                turns = saved[axis.name].reversal_voltages if saved else None
                prepared.append((axis, one, axis.prepare(one, turns, start_memory)))
            except SlpiError as error:
                raise type(error)(f"axis '{axis.name}': {error}") from None
        for axis, one, stream in prepared:
            if not axis.driven:
                axis.start_memory = None if saved else start_memory
            axis.use(one, stream)
            if saved:
                axis.confidence = saved[axis.name].confidence(one.voltage_range)
        self.model = model
        self._couple()

    # Settings

    def check_limits(self, limits: Sequence[Limits]) -> None:
        """Raise what `use_limits` would raise."""
        for axis, new in zip(self.axes, limits, strict=True):
            axis.check_limits(new)

    def use_limits(self, limits: Sequence[Limits]) -> None:
        """Take new limits over; memory and voltages stay.

        Raises
        ------
        UsageError
            If an axis is outside of them, or the model has no voltage inside.
        """
        self.check_limits(limits)
        for axis, new in zip(self.axes, limits, strict=True):
            axis.use_limits(new)

    def use_loops(self, loops: Sequence[LoopSettings]) -> None:
        """Go on with other settings of the feedback, without a jump."""
        for axis, settings in zip(self.axes, loops, strict=True):
            axis.retune(settings)

    def use_time(self, rules: TimestampRules) -> None:
        """Judge stamps by these rules from now on."""
        self._jump, self._max_age_ns = rules.jump, int(rules.max_age * SECOND_NS)
        for axis in self.axes:
            axis.stamps.jump_ns = int(rules.jump * SECOND_NS)

    # Desired and measured displacements

    @property
    def needs_arrival(self) -> bool:
        """Whether `update` has to know when a message arrived though it has a stamp."""
        return self._max_age_ns > 0

    def update(
        self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float], now_ns: int, arrival_ns: int = 0
    ) -> bool:
        """Move the named axes to their desired displacements; `voltages` holds the answer.

        Parameters
        ----------
        stamp_ns : int, nanoseconds
            0: the message has none and counts from its arrival.
        names : sequence of str
        displacements : sequence of float, metres
            One for each name.
        now_ns : int, nanoseconds
        arrival_ns : int, nanoseconds
            The arrival, on the clock of the stamps; for messages without stamp and where `needs_arrival`.

        Returns
        -------
        bool
            Whether an axis could not reach its displacement and waits at a voltage limit.

        Raises
        ------
        RejectedError
            If the message cannot be answered as a whole; it is counted, and no axis has moved.
        """
        counts = self.counts
        counts.received += 1
        try:
            axes = self._axes_of(names, len(displacements), now_ns)
            self._check(axes, stamp_ns, displacements, arrival_ns)
        except RejectedError as error:
            counts.by_cause[error.cause] += 1
            raise
        if self.ramping:
            self._let_go(axes, now_ns)
            self.mode = Mode.STREAMING
        aheads = [axis.stamps.accept(stamp_ns) if stamp_ns else axis.stamps.arrive(arrival_ns) for axis in axes]
        held, slewing = self._move(axes, names, displacements, aheads, now_ns)
        counts.accepted += 1
        if held or slewing:
            counts.held_at_limit += held
            counts.slew_limited += slewing
        for ahead in aheads:
            if not 0.0 <= ahead <= self._jump:
                counts.gaps += max(aheads) > self._jump
                counts.time_jumps += min(aheads) < 0.0
                break
        return held

    def measure(self, names: Sequence[str], displacements: Sequence[float], now_ns: int) -> list[Axis]:
        """Note measured displacements (m) of the axes among the names.

        Returns
        -------
        list of Axis
            Those whose memory is taken for another one since, see `Axis.measure`.

        Raises
        ------
        RejectedError
            If an axis cannot be there; that is counted and not used, the others are.
        """
        rejected: RejectedError | None = None
        changed = []
        for name, y in zip(names, displacements, strict=False):
            axis = self._by_name.get(name)
            if axis:
                try:
                    if axis.measure(y, now_ns):
                        changed.append(axis)
                except RejectedError as error:
                    self.counts.measured_by_cause[error.cause] += 1
                    rejected = RejectedError(error.cause, f"axis '{name}': {error}")
        if changed:
            self._couple()
        if rejected:
            raise rejected
        return changed

    def _axes_of(self, names: Sequence[str], count: int, now_ns: int) -> list[Axis]:
        """Return the named axes; RejectedError unless they take `count` desired displacements now."""
        if self.mode is not Mode.STREAMING or self.model is None:
            self._require_ready()
            if self.mode is Mode.TRAJECTORY:
                raise RejectedError(rejection.FOLLOWING, f"{self.doing(now_ns)}; wait, or cancel it with an empty one")
        if count != len(names):
            raise RejectedError(rejection.LENGTH, f"{len(names)} axes but {count} displacements; send one for each")
        return self._named(names)

    def _named(self, names: Sequence[str]) -> list[Axis]:
        """Return the named axes; RejectedError as `require_names`."""
        # Most senders name the same axes every time.
        if names != self._last_names:
            require_names(names, self._by_name)
            self._last_axes = [self._by_name[name] for name in names]
            # What may change is copied.
            self._last_names = names[:]
        return self._last_axes

    def _check(self, axes: Sequence[Axis], stamp_ns: int, displacements: Sequence[float], arrival_ns: int) -> None:
        """Reject what an axis would refuse: first for what is asked, then for when."""
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
        """Reject whatever is desired while nothing can be answered."""
        if not self.active:
            raise RejectedError(rejection.INACTIVE, "the compensator is not active; activate it")
        if self.model is None:
            raise RejectedError(rejection.NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        if self.mode is Mode.RESETTING:
            raise RejectedError(rejection.RESETTING, "the memory is being reset; wait until reset_memory answers")

    def _move(
        self,
        axes: Sequence[Axis],
        names: Sequence[str],
        displacements: Sequence[float],
        aheads: Sequence[float],
        now_ns: int,
    ) -> tuple[bool, bool]:
        """Move axes to displacements (m), each so long (s) after its last sample; return whether held, and slewing."""
        if self._stage:
            self._stage.decouple(dict(zip(names, displacements, strict=True)))
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
        """Let a trajectory take over: at once, or when its first point is due; one without points cancels.

        Parameters
        ----------
        names : sequence of str, length K
        time_from_start_ns : array_like of int, shape (N,), nanoseconds
        positions : array_like, shape (N, K), metres
        start_ns : int, nanoseconds
            On the clock of trajectories; 0: at once.
        now_ns, clock_ns : int, nanoseconds

        Raises
        ------
        RejectedError
            If it cannot be followed; it is counted, and what was being followed goes on.
        """
        self.counts.trajectories += 1
        try:
            if not len(time_from_start_ns):  # type: ignore[arg-type]
                self.cancel(now_ns)
                return
            self._require_ready()
            path = Trajectory.of(names, time_from_start_ns, positions, start_ns, axes=self.names)
            path.check_reach({axis.name: axis.stream.accepted for axis in self.axes})
            delays = {axis.name: axis.model.chain.delay for axis in self.axes if axis.model}
            self.trajectory.start(path, clock_ns, delays)
        except RejectedError:
            self.counts.trajectories_rejected += 1
            raise
        self.mode, self._clock_ahead_ns = Mode.TRAJECTORY, clock_ns - now_ns
        self.watchdog.feed(now_ns)
        soon = (self.trajectory.next_deadline_ns or 0) - clock_ns <= MAX_DT_NS
        going = self.trajectory.names if soon or self.trajectory.begun else ()
        self._let_go([axis for axis in self.axes if axis.name in going], now_ns)

    def doing(self, now_ns: int) -> str:
        """Return what is being done, in words."""
        if self.mode is Mode.RESETTING:
            return "resetting the memory"
        deadline_ns = self.trajectory.next_deadline_ns
        if deadline_ns is None:
            return "compensating"
        wait = (deadline_ns - self._clock_ahead_ns - now_ns) * 1e-9
        if wait < 1.0:
            return "following a trajectory"
        return f"waiting for a trajectory that {'goes on' if self.trajectory.begun else 'begins'} in {wait:.0f} s"

    def cancel(self, now_ns: int) -> None:
        """Forget the trajectory, if there is one; its axes stay or come to rest."""
        self.watchdog.feed(now_ns)
        if self.mode is Mode.TRAJECTORY:
            self._end_trajectory()
            self._let_go((), now_ns)

    def _end_trajectory(self) -> None:
        self.trajectory.cancel()
        self.mode = Mode.STREAMING
        for axis in self.axes:
            axis.stamps.restart()
            axis.point_ns = None

    def _step_trajectory(self, now_ns: int, clock_ns: int) -> bool:
        """Give the point that is due, if there is one; return whether there was."""
        tracks = self.trajectory.tracks
        point = self.trajectory.due(clock_ns)
        if point is None:
            return False
        axes = self._named(point.names)
        aheads = []
        for axis in axes:
            if axis.ramp:
                axis.stop_ramp(now_ns)
            since = axis.point_ns if axis.point_ns is not None else clock_ns - (now_ns - axis.given_ns)
            aheads.append((point.deadline_ns - since) * 1e-9)
            axis.point_ns = point.deadline_ns
        held, slewing = self._move(axes, point.names, point.displacements, aheads, now_ns)
        self.counts.points_held += held
        self.counts.points_slewing += slewing
        if not self.trajectory.on:
            self._end_trajectory()
            self._let_go((), now_ns)
        elif self.trajectory.tracks < tracks:
            # What comes next may not name the axes that are in motion now.
            going = self.trajectory.names
            self._let_go([axis for axis in self.axes if axis.name in going], now_ns)
        return True

    # What moves without desired displacements

    @property
    def ramping(self) -> bool:
        """Whether an axis goes somewhere by itself."""
        for axis in self.axes:  # noqa: SIM110, quicker than any() by a microsecond in every command
            if axis.ramp is not None:
                return True
        return False

    def next_due_ns(self, now_ns: int, clock_ns: int) -> int | None:
        """Return when `advance` is to be called next, on the clock of `now_ns`; None: not until something is asked."""
        step = self._next_step_ns if self.ramping else None
        point = self.trajectory.next_deadline_ns
        if point is None:
            return step
        point += now_ns - clock_ns
        return point if step is None else min(point, step)

    def advance(self, now_ns: int, clock_ns: int) -> bool:
        """Do what is due by now: one step of all ramps, one point of a trajectory; return whether voltages are new."""
        new, self._clock_ahead_ns = False, clock_ns - now_ns
        if self.ramping and now_ns >= self._next_step_ns:
            self._step_ramps(now_ns)
            new = True
        if self.mode is Mode.TRAJECTORY:
            new = self._step_trajectory(now_ns, clock_ns) or new
        return new

    def hold(self, now_ns: int) -> None:
        """End whatever is being done: the axes stay where they are, or come to rest with the next `advance`."""
        self.cancel(now_ns)
        self._let_go((), now_ns)
        if self.active:
            self.mode = Mode.STREAMING

    def ramp(self, voltages: Sequence[float], rate: float, now_ns: int) -> None:
        """Start to go to voltages (V), or as near as limits allow, at a rate (V/s)."""
        self._start_ramps([Ramp([voltage], rate) for voltage in voltages], Mode.RAMPING, now_ns)

    def reset_memory(self, cycles: int, rate: float, finals: Sequence[float], now_ns: int) -> None:
        """Start the decaying oscillation that wipes the memory.

        Parameters
        ----------
        cycles : int
        rate : float, V/s
        finals : sequence of float, volts
            Where the axes end, or as near as their limits allow.
        now_ns : int, nanoseconds
        """
        ramps = []
        for axis, final in zip(self.axes, finals, strict=True):
            limits = axis.stream.limits
            ramps.append(Ramp(decaying_turns(limits, limits.clip(final), cycles), rate))
        self._start_ramps(ramps, Mode.RESETTING, now_ns)
        for axis in self.axes:
            axis.confidence = MemoryConfidence(RESETTING)
        self._spans = [(axis.stream.voltage,) * 2 for axis in self.axes]

    def watch(self, safety: Safety, now_ns: int) -> bool:
        """Hold the voltages, or go to the safe ones, once no command has come for too long; return whether that is new.

        A trajectory is a command until its last point; a reset of the memory is none and no silence either.
        """
        waiting = self.mode in (Mode.STREAMING, Mode.RAMPING)
        before = self.watchdog.safe_voltages
        news = self.watchdog.look(safety, now_ns, waiting)
        if news and self.watchdog.safe_voltages != before:
            if self.watchdog.safe_voltages:
                self.ramp(safety.voltages, safety.rate, now_ns)
            else:
                self._let_go((), now_ns)
                self.mode = Mode.STREAMING
        return news

    def _start_ramps(self, ramps: Sequence[Ramp], mode: Mode, now_ns: int) -> None:
        if self.mode is Mode.TRAJECTORY:
            self._end_trajectory()
        self._end_reset()
        for axis, ramp in zip(self.axes, ramps, strict=True):
            axis.start_ramp(ramp, now_ns)
        self.mode, self._next_step_ns = mode, now_ns + PERIOD_NS

    def _step_ramps(self, now_ns: int) -> None:
        self._next_step_ns = now_ns + PERIOD_NS
        for axis in self.axes:
            axis.step_ramp(now_ns)
            if axis.ramp:
                self.voltages[axis.place] = axis.voltage
        if self.mode is Mode.RESETTING:
            reached = [axis.stream.voltage for axis in self.axes]
            self._spans = [(min(low, v), max(high, v)) for (low, high), v in zip(self._spans, reached, strict=True)]
        if all(axis.ramp is None or axis.ramp.done for axis in self.axes):
            self._end_reset()
            for axis in self.axes:
                axis.stop_ramp(now_ns)
            if self.mode in (Mode.RAMPING, Mode.RESETTING):
                self._end_ramping(now_ns)

    def _end_ramping(self, now_ns: int) -> None:
        if self.mode is Mode.RESETTING:
            # It was no command, but no silence either.
            self.watchdog.feed(now_ns)
        self.mode = Mode.STREAMING

    def _end_reset(self) -> None:
        """Say what the memory is worth after a reset that ends now, whether it has come to its end or not."""
        if self.mode is not Mode.RESETTING:
            return
        for axis, span in zip(self.axes, self._spans, strict=True):
            axis.confidence = MemoryConfidence(doubt=INTERRUPTED)
            if axis.ramp and axis.ramp.done and axis.model:
                axis.confidence = MemoryConfidence(KNOWN, spanned=span).over(axis.model.voltage_range)

    def _let_go(self, but: Collection[Axis], now_ns: int) -> None:
        """End all ramps: the axes `but` have somewhere to go, the others stay or come to rest as soon as they may."""
        self._end_reset()
        ramped = self.ramping
        for axis in self.axes:
            if axis not in but and axis.in_motion(now_ns):
                axis.brake(now_ns)
                continue
            axis.stop_ramp(now_ns)
            if axis not in but:
                axis.rest()
        if not ramped:
            self._next_step_ns = now_ns + PERIOD_NS
        if self.mode is Mode.RESETTING:
            self._end_ramping(now_ns)

    def _rest_all(self, now_ns: int) -> None:
        for axis in self.axes:
            axis.stamps.restart()
            axis.rest()
            axis.given_ns, axis.point_ns, axis.ramp = now_ns, None, None

    def _couple(self) -> None:
        """Let the streams of the axes know of each other, and show their voltages."""
        assert self.model
        coupling = Coupling({axis.name: self.model.axis(axis.name).chain.gains for axis in self.axes})
        streams = {axis.name: axis.stream for axis in self.axes}
        self._stage = StageStream(streams, coupling, self.model.origins) if coupling.on else None
        for axis in self.axes:
            self.voltages[axis.place] = axis.voltage
