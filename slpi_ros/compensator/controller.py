"""The compensator without ROS: a desired message in, the voltages of all axes out, or nothing moved."""

from array import array
from collections.abc import Callable, Collection, Mapping, Sequence
from time import monotonic

from slpi_ros.compensator import validation as rejection
from slpi_ros.compensator.admission import check, match
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.driving import Driving
from slpi_ros.compensator.feedback import LoopSettings, PidGains
from slpi_ros.compensator.persistence import SavedAxis
from slpi_ros.compensator.statistics import Counts
from slpi_ros.compensator.trajectory import Following
from slpi_ros.compensator.validation import RejectedError, TimeRules
from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.streaming import StageStream

OPEN_LOOP = LoopSettings(False, PidGains(0.0), 0.1)


class Compensation:
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
    now : callable
        A clock that never jumps, seconds.

    Attributes
    ----------
    axes : list of Axis
    voltages : array of float, shape (axes,), volts
        The present ones, always the same array. An axis that a message does not name keeps its voltage.
    active : bool
        Whether messages are answered.
    counts : Counts
    model : StageModel or None
    driving : Driving
        What moves the axes on their own.
    following : Following
        What moves them along trajectories.
    """

    def __init__(
        self,
        axes: Sequence[str],
        limits: Sequence[Limits],
        hardware_id: str = "",
        time: TimeRules | None = None,
        loops: Sequence[LoopSettings] = (),
        now: Callable[[], float] = monotonic,
    ) -> None:
        self.names = list(axes)
        loops = loops or [OPEN_LOOP] * len(self.names)
        self.axes = [Axis(name, place, limits[place], loops[place], now) for place, name in enumerate(self.names)]
        self.voltages = array("d", [0.0] * len(self.axes))
        self.active = False
        self.driving = Driving(self.axes)
        self.following = Following({axis.name: axis for axis in self.axes}, self._decouple)
        self._stage: StageStream | None = None
        self.counts = Counts()
        self.model: StageModel | None = None
        self._hardware_id = hardware_id
        self._by_name = {axis.name: axis for axis in self.axes}
        self._last_names: Sequence[str] | None = None
        self._last_axes: list[Axis] = []
        self.use_time(time or TimeRules())

    # Models

    def use_model(self, model: StageModel, saved: Mapping[str, SavedAxis] | None = None) -> None:
        """Take a model over; the voltages stay as they are.

        Parameters
        ----------
        model : StageModel
        saved : mapping of axis name to SavedAxis, optional
            Where the axes were when the node last ended; for the first model only.

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
                prepared.append((axis, one, axis.prepare(one, turns)))
            except SlpiError as error:
                raise type(error)(f"axis '{axis.name}': {error}") from None
        for axis, one, stream in prepared:
            axis.use(one, stream)
            if saved:
                axis.trust = saved[axis.name].trust(one.voltage_range)
        self.model = model
        coupling = Coupling({axis.name: model.axis(axis.name).chain.gains for axis in self.axes})
        streams = {axis.name: axis.stream for axis in self.axes}
        self._stage = StageStream(streams, coupling, model.origins) if coupling.on else None
        self._show()

    def forget_model(self) -> None:
        """Reject everything until the next model; the voltages stay."""
        self.model = None

    @property
    def driven(self) -> bool:
        """Whether there has been a model: before, nobody knows what voltages the axes have."""
        return self.axes[0].driven

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

    def use_time(self, rules: TimeRules) -> None:
        """Judge stamps by these rules from now on."""
        self._jump, self._max_age_ns = rules.jump, int(rules.max_age * SECOND_NS)
        for axis in self.axes:
            axis.stamps.jump_ns = int(rules.jump * SECOND_NS)

    def activate(self, active: bool) -> None:
        """Answer messages from now on, starting at the present voltages, or no longer."""
        self.active = active
        for axis in self.axes:
            axis.stamps.restart()
            axis.rest()

    # Messages

    @property
    def needs_arrival(self) -> bool:
        """Whether `move` has to know when a message arrived though it has a stamp."""
        return self._max_age_ns > 0

    def move(self, stamp_ns: int, names: Sequence[str], displacements: Sequence[float], now_ns: int = 0) -> bool:
        """Move the named axes to their desired displacements; `voltages` holds the answer.

        Parameters
        ----------
        stamp_ns : int, nanoseconds
            0: the message has none and counts from its arrival.
        names : sequence of str
        displacements : sequence of float, metres
            One for each name.
        now_ns : int, nanoseconds
            The arrival, on the clock of the stamps; needed for messages without stamp and where `max_age` counts.

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
            axes = self._axes_of(names, len(displacements))
            check(axes, stamp_ns, displacements, now_ns, self._max_age_ns)
        except RejectedError as error:
            counts.by_cause[error.cause] += 1
            raise
        if self._stage:
            self._decouple(dict(zip(names, displacements, strict=True)))
        held = slewing = gap = jump = began = False
        if self.driving.on:
            self.driving.hold(but=axes)
        for axis, y in zip(axes, displacements, strict=True):
            ahead = axis.stamps.accept(stamp_ns) if stamp_ns else axis.stamps.arrive(now_ns)
            was_held = axis.held
            self.voltages[axis.place] = axis.move(ahead, y)
            if axis.held:
                held, began = True, began or not was_held
            elif axis.slewing:
                slewing = True
            if ahead > self._jump:
                gap = True
            elif ahead < 0.0:
                jump = True
        counts.accepted += 1
        if held or slewing or gap or jump:
            counts.held_at_limit += held
            counts.slew_limited += slewing
            counts.excursions += began
            counts.gaps += gap
            counts.time_jumps += jump
        return held

    def measure(self, names: Sequence[str], displacements: Sequence[float]) -> None:
        """Note measured displacements (m) of the axes among the names.

        Raises
        ------
        RejectedError
            If an axis cannot be there; that is counted and not used, the others are.
        """
        rejected: RejectedError | None = None
        for name, y in zip(names, displacements, strict=False):
            axis = self._by_name.get(name)
            if axis:
                try:
                    axis.measure(y)
                except RejectedError as error:
                    self.counts.measured_by_cause[error.cause] += 1
                    rejected = RejectedError(error.cause, f"axis '{name}': {error}")
        if rejected:
            raise rejected

    def drive(self, dt: float) -> bool:
        """Move all axes on where they are driven, `dt` (s) later; return whether all have arrived."""
        arrived = self.driving.step(dt)
        self._show()
        return arrived

    def hold(self, but: Collection[str] = ()) -> None:
        """Leave the axes where they are or come to rest, but those named, which have somewhere to go."""
        self.driving.hold([axis for axis in self.axes if axis.name in but])

    def follow(self, now_ns: int) -> None:
        """Move on to the points of trajectories that are due, nanoseconds on their clock."""
        self.following.step(now_ns)
        names = self.following.names
        if not names or any(axis.in_motion and axis.name not in names for axis in self.axes):
            self.hold(but=names)
        self._show()

    def _decouple(self, desired: Mapping[str, float]) -> None:
        """Let each axis know what the others will add once the named ones are at their displacements (m)."""
        if self._stage:
            self._stage.decouple(desired)

    def _show(self) -> None:
        for axis in self.axes:
            self.voltages[axis.place] = axis.voltage

    # Checks

    def _axes_of(self, names: Sequence[str], count: int) -> list[Axis]:
        """Return the named axes."""
        if not self.active:
            raise RejectedError(rejection.INACTIVE, "the compensator is not active; activate it")
        if self.model is None:
            raise RejectedError(rejection.NO_MODEL, "there is no model yet; give model_file, or publish stage_model")
        if self.driving.resetting:
            raise RejectedError(rejection.RESETTING, "the memory is being reset; wait until reset_memory answers")
        if self.following.on:
            raise RejectedError(rejection.FOLLOWING, self.following.busy)
        if count != len(names):
            raise RejectedError(rejection.LENGTH, f"{len(names)} axes but {count} displacements; send one for each")
        # Most senders name the same axes every time.
        if names != self._last_names:
            self._last_axes = match(names, self._by_name)
            # What may change is copied.
            self._last_names = names[:]
        return self._last_axes
