"""Run-time state of one axis: time stamps, limits, model and memory, feedback, ramps."""

from collections.abc import Sequence

from slpi_ros.compensator.feedback import Drift, Feedback, LoopSettings, ResidualWindow
from slpi_ros.compensator.model_swap import continue_from, take_over, turning_voltages, voltage_history
from slpi_ros.compensator.persistence import MemoryConfidence
from slpi_ros.compensator.ramps import Brake, Ramp
from slpi_ros.compensator.statistics import TrackingError
from slpi_ros.compensator.validation import Stamps, implausible
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import START_MEMORIES, AxisModel, StartMemory
from slpi_ros.model.limits import MAX_DT, Limits
from slpi_ros.model.streaming import StreamingInverse

MAX_DT_NS = int(MAX_DT * SECOND_NS)
# An initial history matches the first measurement if its error is at most this fraction of the identified displacement
# range, or this multiple of the held-out error: more than overnight drift, less than the error of a wrong history.
FIT_SHARE, FIT_SIGMAS = 0.005, 4.0


class Axis:
    """Inverse hysteresis compensation, with optional feedback, of one axis.

    All times are nanoseconds on a monotonic clock unless stated otherwise.

    Parameters
    ----------
    name : str
    place : int
        Index of the axis in the voltage command.
    limits : Limits
        Voltage limits. A loaded model cannot relax these limits.
    loop_settings : LoopSettings
        Settings of the feedback.

    Attributes
    ----------
    model : AxisModel or None
    stream : StreamingInverse
        Feedforward; available once a model is loaded. Its memory follows the setpoint, not the corrected voltage, so
        that sensor noise causes no reversals.
    confidence : MemoryConfidence
    driven : bool
        Whether a model has ever been loaded; before that, the voltage is unknown.
    ramp : Ramp or Brake or None
        Active motion without desired displacements.
    held, slewing : bool
        Whether the last sample is held at a voltage limit, or slew limited.
    start_memory : str or None
        Assumed initial history; None after the first output voltage or when the memory was restored.
    given_ns : int, nanoseconds
        Time of the last output voltage.
    point_ns : int or None, nanoseconds
        Deadline of the last sample on the trajectory clock; None if it was not a trajectory point.
    tracking : TrackingError
        Statistics of measured - desired displacement.
    """

    stream: StreamingInverse
    _applied: StreamingInverse
    _residuals: ResidualWindow

    def __init__(self, name: str, place: int, limits: Limits, loop_settings: LoopSettings) -> None:
        self.name, self.place, self.limits = name, place, limits
        self.stamps = Stamps()
        self.model: AxisModel | None = None
        self.confidence = MemoryConfidence()
        self.held = self.slewing = self.driven = False
        self.ramp: Ramp | Brake | None = None
        self.start_memory: StartMemory | None = None
        self.given_ns = 0
        self.point_ns: int | None = None
        self.tracking = TrackingError()
        self._loop_settings = loop_settings
        self._feedback: Feedback | None = None

    # State

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._applied.voltage if self._feedback else self.stream.voltage

    @property
    def correction(self) -> float:
        """Feedback correction contained in the present voltage, volts."""
        return self._feedback.correction if self._feedback else 0.0

    @property
    def feedback_state(self) -> str:
        """State of the feedback: "off", "on", or "holding" if the last sample had no recent measurement."""
        if not self._loop_settings.enabled:
            return "off"
        return "on" if self._feedback and self._feedback.acting else "holding"

    @property
    def drift(self) -> Drift | None:
        """Residual (measured - model) statistics; None if there are too few measurements."""
        return self._residuals.drift() if self._feedback else None

    @property
    def reversal_voltages(self) -> tuple[float, ...]:
        """Voltages (V) of the remembered reversals, oldest first, followed by the present voltage."""
        return voltage_history(self._applied if self._feedback else self.stream)

    def in_motion(self, now_ns: int) -> bool:
        """Whether the voltage changes so fast that the acceleration limit prevents a stop at the next sample."""
        if not self.driven or now_ns - self.given_ns > MAX_DT_NS:
            return False
        return (self._feedback if self._feedback and not self.ramp else self.stream).pace.in_motion

    # Model, limits, settings

    def prepare(
        self, model: AxisModel, reversal_voltages: Sequence[float] | None = None, start_memory: StartMemory = "end"
    ) -> StreamingInverse:
        """Return the streaming inverse of a new model, for `use`.

        Parameters
        ----------
        model : AxisModel
        reversal_voltages : sequence of float, volts
            Voltages of the reversals to replay, oldest first, then the present one; default: those of this axis.
        start_memory : str
            Initial history of an axis without known reversals; default "end".

        Raises
        ------
        SlpiError
            If the model cannot be used within the limits, see `take_over`.
        """
        if reversal_voltages is None:
            reversal_voltages = turning_voltages(self.stream.memory) if self.driven else ()
        return take_over(model, self.limits, reversal_voltages, start_memory)

    def use(self, model: AxisModel, stream: StreamingInverse) -> None:
        """Replace the model by `model` with its streaming inverse from `prepare`; the voltage is unchanged."""
        if self.driven:
            stream.resume(self.stream)
        self.model, self.stream, self.driven = model, stream, True
        self.confidence = self.confidence.over(model.hysteresis_range)
        if self._feedback:
            self._applied = continue_from(model, stream.limits, self._applied)
            self._feedback.limits = stream.limits
            self._residuals.forget(self._applied.uncoupled_displacement)
        elif self._loop_settings.enabled:
            self._close_loop()

    def check_limits(self, limits: Limits) -> Limits:
        """Return new limits, restricted to the identified voltages of the model.

        Raises
        ------
        UsageError
            If the present voltage is outside the limits, or the model was identified entirely outside them.
        """
        if not self.driven:
            return limits
        if not limits.lower <= self.voltage <= limits.upper:
            raise UsageError(
                f"axis '{self.name}' has {self.voltage:g} V, outside the new limits {limits.lower:g}.."
                f"{limits.upper:g} V; move it inside first"
            )
        return limits.within(self.model.voltage_range) if self.model else limits

    def use_limits(self, limits: Limits) -> None:
        """Replace the limits; hysteresis memory and voltage are unchanged.

        Raises
        ------
        UsageError
            As `check_limits`; the old limits remain in force.
        """
        allowed = self.check_limits(limits)
        self.limits = limits
        if self.driven:
            self.stream.limits = allowed
            if self._feedback:
                self._feedback.limits = allowed

    def retune(self, settings: LoopSettings) -> None:
        """Replace the feedback settings without a voltage step."""
        self._loop_settings = settings
        feedback = self._feedback
        if feedback is None:
            if settings.enabled and self.driven:
                self._close_loop()
            return
        try:
            feedback.retune(settings.gains)
        except SlpiError:
            # The last measurement gives no finite voltage with the new gains.
            feedback.forget()
            feedback.retune(settings.gains)
        if settings.enabled:
            feedback.enable()
        else:
            feedback.disable()

    # Samples

    def check(self, y: float, kind: str = "desired") -> None:
        """Reject a displacement (m; `kind` "desired" or "measured") that is not finite or far outside the model range.

        Raises
        ------
        RejectedError
            With the cause `not_finite` or `out_of_range`.
        """
        low, high = self.stream.accepted
        if not low <= y <= high:
            raise implausible(y, (low, high), kind)

    def update(self, ahead: float, y: float, now_ns: int) -> float:
        """Return the voltage (V) for the desired displacement `y`, `ahead` after the last sample.

        Parameters
        ----------
        ahead : float, seconds
            Zero or negative counts as no elapsed time. The slew limit takes at most `MAX_DT` into account.
        y : float, metres
        now_ns : int, nanoseconds
        """
        stream = self.stream
        dt = stream.pace.clamp_dt(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.move(dt, y)
        if self._feedback is not None:
            v = self._correct(ahead, dt, y, v, now_ns)
        if stream.missed:
            self.held = stream.held
            self.slewing = not self.held
        else:
            self.held = self.slewing = False
        self.given_ns = now_ns
        self.start_memory = None
        self.tracking.desired = y
        return v

    def measure(self, displacement: float, now_ns: int) -> bool:
        """Store a measured displacement (m); return whether it has changed the assumed hysteresis memory.

        Raises
        ------
        RejectedError
            As `check`; the measurement is not used.
        """
        if not self.driven:
            return False
        self.check(displacement, "measured")
        before = self.confidence
        if self.start_memory:
            self._choose_memory(displacement)
        if self._feedback is None:
            self._close_loop()
        assert self._feedback
        self._feedback.measure(displacement, now_ns)
        self._residuals.measure(displacement)
        self.tracking.measure(displacement)
        return self.confidence is not before

    def _choose_memory(self, measured: float) -> None:
        """Choose the initial history that matches a displacement (m) measured before the first output voltage.

        The assumed initial history is kept unless another one matches better by more than the noise.
        """
        assert self.model and self.start_memory
        quality, (low, high) = self.model.quality, self.model.displacement_range
        noise = FIT_SIGMAS * max(quality.held_out_rms, quality.floor_rms)
        assumed, streams, errors = self.start_memory, {}, {}
        for name in START_MEMORIES:
            streams[name] = stream = take_over(self.model, self.limits, (), name)
            stream.coupled = self.stream.coupled
            errors[name] = abs(measured - stream.drive(stream.voltage))
        best = min(START_MEMORIES, key=lambda name: errors[name])
        self.start_memory = None
        if errors[best] > max(noise, FIT_SHARE * (high - low)):
            tried = ", ".join(f"{name} {error * 1e6:.4g} µm" for name, error in errors.items())
            self.confidence = MemoryConfidence(
                doubt=f"the measurement matches no initial history of the model (errors: {tried}); call ~/reset_memory",
                contradicted=True,
            )
        elif errors[assumed] > errors[best] + noise:
            self.stream = streams[best]
            if self._feedback:
                self._close_loop()
            self.confidence = MemoryConfidence(doubt=f"chosen by measurement: start_memory '{best}', not '{assumed}'")

    def _correct(self, ahead: float, dt: float, y: float, v: float, now_ns: int) -> float:
        """Return the total voltage (V), feedforward `v` (V) and correction, for the desired displacement `y` (m)."""
        feedback, applied = self._feedback, self._applied
        assert feedback
        applied.coupled = self.stream.coupled
        if ahead > dt:
            applied.wait(ahead - dt)
            feedback.pace.rest()
        v = feedback.step(dt, y, v, now_ns, self._loop_settings.timeout)
        self._residuals.expect(applied.drive(v, dt))
        return v

    def _close_loop(self) -> None:
        """Start the feedback; a second streaming inverse follows the total voltage."""
        self._applied = self.stream.copy()
        self._residuals = ResidualWindow(self._applied.uncoupled_displacement)
        self._restart_feedback()

    def _restart_feedback(self) -> None:
        """Restart the feedback at the present voltage and rate, without a correction."""
        settings, voltage = self._loop_settings, self._applied.voltage
        self._feedback = feedback = Feedback(settings.gains, self.stream.limits, voltage)
        feedback.hold(0.0, voltage)
        feedback.pace.go_on(self.stream.pace)
        if settings.enabled:
            feedback.enable()

    # Ramps

    def start_ramp(self, ramp: Ramp | Brake, now_ns: int) -> None:
        """Start a ramp from the present voltage at `now_ns` (ns); `step_ramp` executes it."""
        moving = self.in_motion(now_ns)
        if not self.ramp and self._feedback:
            self.stream.restore(self._applied.snapshot())
            self.stream.pace.go_on(self._feedback.pace)
        if now_ns - self.given_ns > MAX_DT_NS:
            self.rest()
        if not moving:
            # The ramp starts at `now_ns`.
            self.given_ns = now_ns
        self.ramp, self.point_ns, self.start_memory, self.tracking.desired = ramp, None, None, None

    def brake(self, now_ns: int) -> None:
        """Start to decelerate to rest within the acceleration limit; `step_ramp` executes it."""
        if not isinstance(self.ramp, Brake):
            self.start_ramp(Brake(), now_ns)

    def step_ramp(self, now_ns: int) -> None:
        """Execute one step of the active ramp, if any."""
        if self.ramp is None or self.ramp.done:
            return
        dt, stream = (now_ns - self.given_ns) * 1e-9, self.stream
        v = self.ramp.step(stream.voltage, dt, stream.pace)
        stream.drive(v, dt)
        if self._feedback:
            self._residuals.expect(self._applied.drive(v, dt))
        self.given_ns = now_ns
        if self.ramp.done:
            stream.pace.rest()

    def stop_ramp(self, now_ns: int) -> None:
        """End the active ramp, if any; desired displacements continue from the present voltage and rate."""
        if not self.ramp:
            return
        self.ramp = None
        if self._feedback:
            self._restart_feedback()
            self._residuals.forget(self._applied.uncoupled_displacement)
        # For a voltage in motion, the time since its last output counts.
        self.stamps.restart((now_ns - self.given_ns) * 1e-9 if self.in_motion(now_ns) else 0.0)

    def rest(self) -> None:
        """Set the rate of the voltage to zero, so that the next sample starts from rest."""
        if self.driven:
            self.stream.pace.rest()
        if self._feedback:
            self._feedback.pace.rest()
