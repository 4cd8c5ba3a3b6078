"""One axis at run time: its stamps and limits, its model and memory, its feedback, and where it goes by itself."""

from collections.abc import Sequence

from slpi_ros.compensator.feedback import Drift, Feedback, LoopSettings, ResidualWindow
from slpi_ros.compensator.model_swap import go_on, take_over, turning_voltages, whole_way
from slpi_ros.compensator.persistence import MemoryConfidence
from slpi_ros.compensator.ramps import Brake, Ramp
from slpi_ros.compensator.validation import Stamps, implausible
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import START_MEMORIES, AxisModel, StartMemory
from slpi_ros.model.limits import MAX_DT, Limits
from slpi_ros.model.streaming import StreamingInverse

MAX_DT_NS = int(MAX_DT * SECOND_NS)
# A first measurement fits a memory within this share of the identified displacements, or this many times the error that
# the model was identified with: what a sensor's zero, creep and temperature do overnight is less, another history more.
FIT_SHARE, FIT_SIGMAS = 0.005, 4.0


class Axis:
    """One axis. All times are nanoseconds on a clock that never jumps, unless said otherwise.

    Parameters
    ----------
    name : str
    place : int
        Of its voltage among those of all axes.
    limits : Limits
        No model widens them.
    loop_settings : LoopSettings

    Attributes
    ----------
    model : AxisModel or None
    stream : StreamingInverse
        Its feedforward; there once a model is. Its memory follows the desired path as if there were no feedback: noise
        of the sensor must not turn it.
    confidence : MemoryConfidence
        How far the memory is to be trusted.
    driven : bool
        Whether it has had a model: before, its voltage is not known.
    ramp : Ramp or Brake or None
        Where the axis goes by itself; None: where desired displacements lead.
    held, slewing : bool
        Whether the last sample waits at a voltage limit, or is still on its way.
    start_memory : str or None
        Which of the model's memories it was started with, while nothing but the model speaks for it; None once it has
        been given a voltage, or was restored.
    given_ns : int
        When its voltage was given last.
    point_ns : int or None
        When its last sample was due, on the clock of trajectories; None: that was no point of one.
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
        self._loop_settings = loop_settings
        self._feedback: Feedback | None = None

    # What it is doing

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._applied.voltage if self._feedback else self.stream.voltage

    @property
    def correction(self) -> float:
        """Part of the present voltage that comes from the feedback, volts."""
        return self._feedback.correction if self._feedback else 0.0

    @property
    def feedback_state(self) -> str:
        """What the feedback does: "off", "on", or "holding" where the last sample had no fresh measurement."""
        if not self._loop_settings.enabled:
            return "off"
        return "on" if self._feedback and self._feedback.acting else "holding"

    @property
    def drift(self) -> Drift | None:
        """How far measurements are off the model; None while there are too few."""
        return self._residuals.drift() if self._feedback else None

    @property
    def reversal_voltages(self) -> tuple[float, ...]:
        """Voltages (V) at which the drive turned, oldest first, and last the present one."""
        return whole_way(self._applied if self._feedback else self.stream)

    def in_motion(self, now_ns: int) -> bool:
        """Whether the limit of acceleration forbids to leave it where it is."""
        if not self.driven or now_ns - self.given_ns > MAX_DT_NS:
            return False
        return (self._feedback if self._feedback and not self.ramp else self.stream).pace.in_motion

    # Model, limits, settings

    def prepare(
        self, model: AxisModel, reversal_voltages: Sequence[float] | None = None, start_memory: StartMemory = "end"
    ) -> StreamingInverse:
        """Return the stream of a new model, for `use`.

        Parameters
        ----------
        model : AxisModel
        reversal_voltages : sequence of float, volts
            As `reversal_voltages` of this axis, which stands for None.
        start_memory : str
            Of the model's memories, the one that an axis without a past starts with.

        Raises
        ------
        SlpiError
            If the model cannot serve.
        """
        if reversal_voltages is None:
            reversal_voltages = turning_voltages(self.stream.memory) if self.driven else ()
        return take_over(model, self.limits, reversal_voltages, start_memory)

    def use(self, model: AxisModel, stream: StreamingInverse) -> None:
        """Go on with a new model; the voltage stays."""
        if self.driven:
            stream.resume(self.stream)
        self.model, self.stream, self.driven = model, stream, True
        self.confidence = self.confidence.over(model.voltage_range)
        if self._feedback:
            self._applied = go_on(model, stream.limits, self._applied)
            self._feedback.limits = stream.limits
            self._residuals.forget(self._applied.uncoupled_displacement)
        elif self._loop_settings.enabled:
            self._close_loop()

    def check_limits(self, limits: Limits) -> Limits:
        """Return new limits, narrowed to what the model was identified on.

        Raises
        ------
        UsageError
            If the axis is outside of them, or the model has no voltage inside.
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
        """Go on within other limits; memory and voltage stay.

        Raises
        ------
        UsageError
            As `check_limits`; the old ones stay then.
        """
        allowed = self.check_limits(limits)
        self.limits = limits
        if self.driven:
            self.stream.limits = allowed
            if self._feedback:
                self._feedback.limits = allowed

    def retune(self, settings: LoopSettings) -> None:
        """Go on with other settings of the feedback, without a jump."""
        self._loop_settings = settings
        feedback = self._feedback
        if feedback is None:
            if settings.enabled and self.driven:
                self._close_loop()
            return
        try:
            feedback.retune(settings.gains)
        except SlpiError:
            # The last measurement was beyond reason, which other gains did not show.
            feedback.forget()
            feedback.retune(settings.gains)
        if settings.enabled:
            feedback.enable()
        else:
            feedback.disable()

    # Samples

    def check(self, y: float, kind: str = "desired") -> None:
        """Reject a displacement (m), desired or measured, that is no number or far outside what was identified.

        Raises
        ------
        RejectedError
            With the cause `not_finite` or `out_of_range`.
        """
        low, high = self.stream.accepted
        if not low <= y <= high:
            raise implausible(y, (low, high), kind)

    def update(self, ahead: float, y: float, now_ns: int) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `ahead` (s) after the last sample.

        Parameters
        ----------
        ahead : float, seconds
            Not more than 0: no time has passed. Of a pause no more than `MAX_DT` counts.
        y : float, metres
        now_ns : int
        """
        stream = self.stream
        dt = stream.pace.clamp_dt(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.move(dt, y)
        if self._feedback is not None:
            v = self._correct(ahead, dt, y, v, now_ns)
        missed = stream.missed
        self.held = missed and stream.held
        self.slewing = missed and not self.held
        self.given_ns = now_ns
        self.start_memory = None
        return v

    def measure(self, displacement: float, now_ns: int) -> bool:
        """Note a measured displacement (m); return whether it has changed what is taken for the memory.

        Raises
        ------
        RejectedError
            As `check`; it is not used then.
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
        return self.confidence is not before

    def _choose_memory(self, measured: float) -> None:
        """Choose among the model's memories the one that fits a displacement (m) measured before any voltage was given.

        The assumed one stays unless another fits better by more than the noise.
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
            tried = ", ".join(f"{name} {error * 1e6:.4g} um" for name, error in errors.items())
            self.confidence = MemoryConfidence(
                doubt=f"what is measured fits no memory of the model (off by: {tried}); call ~/reset_memory",
                contradicted=True,
            )
        elif errors[assumed] > errors[best] + noise:
            self.stream = streams[best]
            if self._feedback:
                self._close_loop()
            self.confidence = MemoryConfidence(doubt=f"as measured: start_memory '{best}', not '{assumed}'")

    def _correct(self, ahead: float, dt: float, y: float, v: float, now_ns: int) -> float:
        """Return the voltage in total (V) where the feedforward is `v` (V)."""
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
        """Let measurements count from now on; another stream follows the voltage that is really given."""
        self._applied = self.stream.copy()
        self._residuals = ResidualWindow(self._applied.uncoupled_displacement)
        self._restart_feedback()

    def _restart_feedback(self) -> None:
        """Begin where the axis is, as fast as it is, without a correction."""
        settings, voltage = self._loop_settings, self._applied.voltage
        self._feedback = feedback = Feedback(settings.gains, self.stream.limits, voltage)
        feedback.hold(0.0, voltage)
        feedback.pace.go_on(self.stream.pace)
        if settings.enabled:
            feedback.enable()

    # Ramps

    def start_ramp(self, ramp: Ramp | Brake, now_ns: int) -> None:
        """Leave the desired path, and go where a ramp leads with every `step_ramp`."""
        moving = self.in_motion(now_ns)
        if not self.ramp and self._feedback:
            self.stream.restore(self._applied.snapshot())
            self.stream.pace.go_on(self._feedback.pace)
        if now_ns - self.given_ns > MAX_DT_NS:
            self.rest()
        if not moving:
            # Its time begins now.
            self.given_ns = now_ns
        self.ramp, self.point_ns, self.start_memory = ramp, None, None

    def brake(self, now_ns: int) -> None:
        """Come to rest with every `step_ramp`, as gently as the limit of acceleration asks for."""
        if not isinstance(self.ramp, Brake):
            self.start_ramp(Brake(), now_ns)

    def step_ramp(self, now_ns: int) -> None:
        """Move on along the ramp, if there is one."""
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
        """Take up desired displacements again, from where the axis is and as fast as it is, if there is a ramp."""
        if not self.ramp:
            return
        self.ramp = None
        if self._feedback:
            self._restart_feedback()
            self._residuals.forget(self._applied.uncoupled_displacement)
        # A voltage at rest has time; one in motion goes on.
        self.stamps.restart((now_ns - self.given_ns) * 1e-9 if self.in_motion(now_ns) else 0.0)

    def rest(self) -> None:
        """Start from a voltage at rest at the next sample."""
        if self.driven:
            self.stream.pace.rest()
        if self._feedback:
            self._feedback.pace.rest()
