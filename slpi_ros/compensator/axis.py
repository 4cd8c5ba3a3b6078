"""One axis of a compensator: its model and memory, its output, and what it is doing."""

from collections.abc import Sequence
from math import inf

from slpi_ros.compensator.amplifier import BAND_NS, Amplifier
from slpi_ros.compensator.feedback import LoopSettings
from slpi_ros.compensator.loop import Loop
from slpi_ros.compensator.model_swap import InitialState, require_near, take_over, turning_voltages, voltage_history
from slpi_ros.compensator.motion import Brake, Idle, Kind, Motion, Ramp, follow
from slpi_ros.compensator.path_watch import PathWatch
from slpi_ros.compensator.persistence import (
    INTERRUPTED,
    KNOWN,
    RESET,
    RESETTING,
    RESTORED,
    SENSOR,
    MemoryConfidence,
    SavedAxis,
    Zero,
)
from slpi_ros.compensator.samples import SOONEST_HOLD_NS, Samples
from slpi_ros.compensator.statistics import TrackingStatistics
from slpi_ros.compensator.uncertainty import Uncertainty
from slpi_ros.compensator.validation import implausible
from slpi_ros.errors import UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import AxisModel, StartMemory
from slpi_ros.model.limits import PERIOD, Limits, RateLimiter, volts
from slpi_ros.model.streaming import StreamingInverse

# Decimals of saved distances (m).
KEPT_DIGITS = 10


class Axis:
    """Inverse hysteresis compensation, with optional feedback, of one axis. Times: steady clock, ns.

    Setpoints (`update`) and `tick` move it, each along the straight line `stream` (inverse of the model), `loop`
    (feedback), `output` (rate limiter). `motion` is what it is doing. The memory of `stream` follows the setpoint, not
    the corrected voltage, so that sensor noise causes no reversals. A loaded model cannot relax the limits.
    """

    stream: StreamingInverse  # feedforward; available once a model is loaded

    def __init__(self, name: str, limits: Limits, loop_settings: LoopSettings, period: float = PERIOD) -> None:
        self.name, self.limits = name, limits
        self.output = RateLimiter(limits, period, limits.clip(0.0))  # the voltage, and where it may go
        self.amplifier = Amplifier(limits.upper - limits.lower, axis=name)  # what is reported of the voltage
        self.loop = Loop(loop_settings, self.output, name)
        self.motion: Motion = Idle()
        self.samples = Samples()
        self.model: AxisModel | None = None
        self.initial = InitialState()
        self.confidence = MemoryConfidence()
        self.zero = Zero()
        self.held = self.slewing = False  # at a voltage limit; slew limited
        self.tracking = TrackingStatistics()  # measured - desired displacement
        self.path = PathWatch()  # desired displacements against the record of the model
        self.surroundings: dict[str, float] = {}  # values of quantities in use
        self.uncertainty = Uncertainty()  # of where the axis is, while somebody asks for it

    # State

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self.output.voltage

    @property
    def holds(self) -> bool:
        """Whether the voltage of a constant displacement changes: because of effects, other axes, or feedback."""
        return self.loop.active or not self.stream.timeless

    @property
    def reversal_voltages(self) -> tuple[float, ...]:
        """Voltages (V) of the remembered reversals, oldest first, followed by the present voltage."""
        turns = voltage_history(self.loop.applied(self.stream))
        return turns if turns[-1] == self.voltage else (*turns, self.voltage)

    @property
    def expected(self) -> float:
        """Where the axis is according to the model, metres."""
        return self.loop.applied(self.stream).uncoupled_displacement + self.stream.coupled

    @property
    def setpoint(self) -> float:
        """Displacement (m) of the model for the feedforward voltage."""
        return self.stream.uncoupled_displacement + self.stream.coupled

    @property
    def aim(self) -> float:
        """The last setpoint (m); where the axis is, without one or with a model that does not accept it."""
        desired, (low, high) = self.tracking.desired, self.stream.accepted
        return self.setpoint if desired is None or not low <= desired <= high else desired

    def saved(self, now_ns: int) -> SavedAxis:
        """Return what is to be kept over a restart."""
        relaxing = self.loop.applied(self.stream).relaxing(max((now_ns - self.samples.given_ns) * 1e-9, 0.0))
        # Rounded, so that a stage at rest is saved once.
        rounded = {name: tuple(round(each, KEPT_DIGITS) for each in distances) for name, distances in relaxing.items()}
        certain = self.confidence.state in (KNOWN, RESTORED)
        return SavedAxis(self.reversal_voltages, certain, zero=self.zero, relaxing=rounded)

    # Model and limits

    def prepare(
        self, model: AxisModel, reversal_voltages: Sequence[float] | None = None, start_memory: StartMemory = "end"
    ) -> StreamingInverse:
        """Return the streaming inverse of a new model, see `take_over`; default: the reversals of this axis (V)."""
        if reversal_voltages is None:
            reversal_voltages = turning_voltages(self.stream.memory) if self.model else ()
            if self.model:
                require_near(self.voltage, self.limits.within(model.voltage_range))
        return take_over(model, self.limits, reversal_voltages, start_memory)

    def use(self, model: AxisModel, stream: StreamingInverse) -> None:
        """Replace the model by `model` with its streaming inverse from `prepare`; the voltage is unchanged."""
        allowed, pace = stream.limits, self.output
        if self.model:
            stream.resume(self.stream)
            pace = self.stream.pace
        else:
            self.output.start(stream.voltage)
        self.model, self.stream, self.zero = model, stream, Zero()
        self.path = PathWatch(model)
        stream.pace = pace
        self._restrict(allowed)
        self.confidence = self.confidence.over(model.hysteresis_range)
        seconds = sum(effect.settling_time for effect in model.effects)
        self.amplifier.window_ns = BAND_NS + int(seconds * SECOND_NS)
        self.loop.use(model, allowed, stream, self.samples.given_ns)
        self.surround(self.surroundings)

    def surround(self, values: dict[str, float]) -> None:
        """Take values of quantities that the stage follows; they count from the next sample on."""
        self.surroundings |= values
        self.motion.wake()
        self.stream.surround(values)
        if self.loop.follows_total:
            self.loop.applied(self.stream).surround(values)
        self.uncertainty.surround(values)

    def move_zero(self, zero: Zero, model: AxisModel) -> None:
        """Continue with the same `model` with another zero, at the present voltage, after `stop`."""
        self.loop.leave(self.stream)
        self.use(model, self.prepare(model))
        self.zero = zero
        self.loop.offsets.forget()
        if self.loop.follows_total:
            self.loop.close(self.stream, self.samples.given_ns)

    def check_limits(self, limits: Limits) -> Limits:
        """Return new limits, restricted to the identified voltages of the model; UsageError if it has none there."""
        return limits.within(self.model.voltage_range) if self.model else limits

    def use_limits(self, limits: Limits, period: float) -> None:
        """Replace limits and output period (s), or raise as `check_limits`; memory and voltage are unchanged."""
        allowed = self.check_limits(limits)
        self.limits = limits
        self.amplifier.span = limits.upper - limits.lower
        self._restrict(allowed, period)

    def _restrict(self, allowed: Limits, period: float | None = None) -> None:
        if self.model:
            self.stream.limits = allowed = self.stream.restricted(allowed)
            self.stream.pace.change(allowed, period)
        self.output.change(allowed, period)
        self.motion.wake()

    def use_checked(self, checked: bool) -> None:
        """Take whether what comes next is a path that is known to keep the mean rate, and so is not slowed for it."""
        self.output.checked = checked
        if self.model:
            self.stream.pace.checked = checked

    def check_loop(self, settings: LoopSettings, period: float) -> None:
        """Raise UsageError if other feedback settings or another output period (s) make the model's loop unstable."""
        if reason := self.loop.refusal(settings, period):
            raise UsageError(f"axis '{self.name}': {reason}")

    def retune(self, settings: LoopSettings) -> None:
        """Replace the feedback settings without a voltage step; feedback that was switched off for a fault resumes."""
        self.loop.retune(settings, self.stream if self.model else None, self.samples.given_ns)

    def locate(self, voltage: float, now_ns: int) -> None:
        """Continue from a voltage (V) at which the amplifier was found; a move to it that is no noise is remembered.

        When it moved is not known: the effects are taken to be in equilibrium there. Before the first voltage, the
        measurements choose among the initial states.
        """
        assert self.model
        moved = abs(voltage - self.stream.voltage) > self.amplifier.tolerance()
        if moved:
            offset = self.loop.offsets.latest(now_ns)
            measured = None if offset is None else self.expected + offset
            self.loop.leave(self.stream)
            self.stream.rest_at(voltage, measured)
            if self.confidence.state != RESETTING:
                self.confidence = MemoryConfidence(
                    doubt=f"moved to {volts(voltage)} V by something else since its memory was known"
                )
        if voltage != self.output.voltage:
            self.output.start(voltage)
        self.stream.pace = self.output
        if self.loop.follows_total and moved:
            self.loop.close(self.stream, self.samples.given_ns)
        elif self.loop.follows_total:
            self.loop.restart(self.stream, self.samples.given_ns)
        chosen, confidence = self.initial.choose(self.model, self.limits, self.stream, self.surroundings, now_ns)
        self.confidence = confidence or self.confidence
        if chosen:
            chosen.pace, chosen.limits = self.stream.pace, self.output.limits
            self.stream = chosen
            if self.loop.follows_total:
                self.loop.close(chosen, self.samples.given_ns)

    # Motion

    @property
    def due_ns(self) -> int | None:
        """When the next `tick` is due, steady clock; None if nothing follows."""
        due = self.motion.due_ns
        if self.loop.active and self.motion.follows:
            return self.loop.due_ns if due is None else min(due, self.loop.due_ns)
        return due

    def begin(self, motion: Motion, now_ns: int) -> None:
        """End the present motion, and begin another one that follows no setpoint."""
        self.motion.end(self, now_ns)
        self.motion = motion
        self.held = self.slewing = False
        self.tracking.desired = None
        self.samples.restart()
        if motion.drives:
            self.loop.offsets.leave_reset()
            self.loop.leave(self.stream)
            self.initial.assumed = None
        if isinstance(motion, Ramp):
            motion.due_ns = now_ns + self.output.period_ns

    def stop(self, now_ns: int) -> None:
        """End the present motion: an axis that moves within an acceleration limit brakes to rest, then it stays."""
        if self.motion.kind is Kind.FAULT:
            return
        if not self.output.in_motion:
            self.begin(Idle(), now_ns)
        elif not isinstance(self.motion, Brake):
            self.begin(Brake(), now_ns)

    def rest(self, now_ns: int) -> None:
        """Stay at the present voltage, whatever the axis is doing."""
        self.begin(Idle(), now_ns)
        self.samples.given_ns = now_ns

    def end_ramp(self, now_ns: int) -> None:
        """End a ramp, if there is one, for a setpoint."""
        if isinstance(self.motion, Ramp):
            self.motion.end(self, now_ns)
            self.motion = Idle()

    def return_inside(self, now_ns: int) -> None:
        """Go to the nearest voltage limit of the node if the voltage is outside of them."""
        outside = self.model and not self.limits.lower <= self.voltage <= self.limits.upper
        if outside and not self.motion.drives:
            self.begin(Ramp([self.limits.clip(self.voltage)], inf), now_ns)

    def settle(self, now_ns: int) -> None:
        """Let setpoints go on from the present voltage, after motion without them."""
        self.amplifier.output(self.voltage, now_ns)
        self.loop.settle(self.stream, self.samples.given_ns)
        self.samples.restart()

    def note_reset(self, spanned: tuple[float, float] | None) -> None:
        """Set the confidence in the memory after a reset over voltages (V); None: it was interrupted."""
        self.confidence = MemoryConfidence(doubt=INTERRUPTED)
        if not spanned:
            self.loop.offsets.leave_reset()
        if spanned and self.model:
            self.confidence = MemoryConfidence(KNOWN, spanned=spanned).over(self.model.hysteresis_range)
            if self.zero.source != SENSOR:
                self.zero = Zero.now(RESET)

    def tick(self, now_ns: int, moved: bool = False) -> bool:
        """Do what is due of the motion and of the feedback; return whether voltage or rate changed.

        `moved`: setpoints of a trajectory move the axis on.
        """
        # Once the axis rests, limits that have waited for that are in force.
        before, rate, moving = self.voltage, self.output.rate, self.output.in_motion
        if self.motion.due_ns is not None and self.motion.due_ns <= now_ns:
            if moved and self.motion.follows:
                self.motion.due_ns = None
            else:
                self.motion.step(self, now_ns)
        desired = self.tracking.desired
        if self.loop.active and self.motion.follows and self.loop.due_ns <= now_ns and desired is not None:
            v = self.loop.tick(self.aim, self.stream.voltage, self.stream.coupled, now_ns)
            self.amplifier.output(v, now_ns)
        return self.voltage != before or (moving and self.output.rate != rate)

    # Voltages

    def check(self, y: float, kind: str = "desired") -> None:
        """Reject a displacement (m; "desired" or "measured") that is not finite or far outside the model range."""
        low, high = self.stream.accepted
        if not low <= y <= high:
            raise implausible(y, (low, high), kind)

    def update(self, ahead: float | None, y: float, now_ns: int, early: bool = False) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `ahead` (s) after the last one by its stamp.

        `early`: it is output before its time by the delay of the stage.
        """
        dt = self.samples.sample(ahead, now_ns, self.output.period)
        self.tracking.desired, self.tracking.learned = y, 0.0
        self.path.sample(dt, y)
        v = self._sample(dt, y, now_ns, early)
        follow(self, now_ns, now_ns + SOONEST_HOLD_NS)
        return v

    def hold(self, now_ns: int) -> None:
        """Output the voltage for `aim` now, as far as the limits allow."""
        self._sample(self.samples.step(now_ns), self.aim, now_ns)

    def drive(self, voltage: float, now_ns: int) -> None:
        """Let memory and effects follow a voltage (V) of a motion without setpoints, which `output` has made."""
        dt = self.samples.step(now_ns)
        self.stream.drive(voltage, dt)
        self.loop.follow(voltage, dt, now_ns)
        self.uncertainty.sample(dt, self.expected, voltage)
        self.amplifier.output(voltage, now_ns)

    def play(self, voltages: Sequence[float], period: float, now_ns: int) -> None:
        """Let memory and effects follow voltages (V) that a device has played, `period` (s) apart."""
        self.output.play(voltages, period, now_ns)
        for v in voltages:
            self.stream.drive(v, period)
            self.loop.follow(v, period, now_ns)
        self.samples.given_ns = now_ns

    def _sample(self, dt: float, y: float, now_ns: int, early: bool = False) -> float:
        """Output and return the voltage (V) for the desired displacement `y` (m), `dt` (s) after the last step."""
        stream = self.stream
        v = stream.move(dt, y, now_ns)
        if self.loop.follows_total:
            v = self.loop.correct(dt, y, v, stream.coupled, now_ns)
        self.held = self.slewing = False
        if stream.missed:
            self.held = stream.held
            self.slewing = not self.held
        self.amplifier.output(v, now_ns)
        self.initial.assumed = None
        self.loop.offsets.leave_reset()
        if self.loop.follows_total:
            assert self.model
            self.loop.setpoint(y, now_ns, max(round(self.model.chain.delay * SECOND_NS), 0) if early else 0)
        if self.uncertainty.on:
            self.uncertainty.sample(dt, y, v)
        return v

    # Readings

    def measure(self, displacement: float, now_ns: int, fresh: bool = True, age: float = 0.0) -> None:
        """Take a reading (m) of an `age` (s), `fresh`: stamped now; RejectedError if it is implausible.

        To feedback that is on, what is older than its timeout is no reading: its sensor is silent.
        """
        if self.model is None:
            return
        low, high = self.stream.accepted
        expected = self.expected
        within = low <= displacement <= high
        x = self.loop.read(displacement, expected, now_ns, fresh, within, self.motion.swing, age)
        self.check(displacement, "measured")
        if self.initial.assumed:
            if fresh:
                self.initial.read(x, now_ns)
            return
        late = self.loop.settings.enabled and age > self.loop.settings.timeout
        self.loop.sensor.stale = age if late else 0.0
        if late:
            return
        if not self.loop.follows_total:
            self.loop.close(self.stream, self.samples.given_ns)
        self.loop.measure(x, expected, now_ns, not self.motion.drives, self.tracking)
