"""Sensor and feedback of one axis: readings correct its voltage, and are held against its model."""

from collections.abc import Callable
from functools import lru_cache, partial
from math import isfinite

from slpi_ros.compensator import loop_margin
from slpi_ros.compensator.feedback import Drift, Feedback, LoopSettings, PidGains, ResidualWindow
from slpi_ros.compensator.model_swap import continue_from
from slpi_ros.compensator.monitor import Finding
from slpi_ros.compensator.oscillation_rule import OscillationRule
from slpi_ros.compensator.sensor_rule import SensorRule
from slpi_ros.compensator.statistics import TrackingStatistics
from slpi_ros.compensator.zero_offsets import ZeroOffsets
from slpi_ros.errors import SlpiError
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter
from slpi_ros.model.sensor import Sensed, StreamingSensor
from slpi_ros.model.streaming import StreamingInverse

# The kind of a fault: the loop of the model is not stable enough.
UNSTABLE = "unstable"


class Loop:
    """Closed loop of one axis, from its first reading on.

    A second inverse, `applied`, follows the total voltage, so that it tells where the stage is; the inverse of the axis
    follows the setpoint, so that the noise of the sensor causes no reversals of its memory. The correction is computed
    once in each period of `output`, on the steady clock: with the first setpoint that is answered in the period, or at
    its end. So it does not depend on how often setpoints come. Without `settings.enabled` the readings are used for
    what is reported only. Times: steady clock, ns.
    """

    _sensor: StreamingSensor  # from the first model on
    # While `follows_total`.
    _applied: StreamingInverse
    _feedback: Feedback
    _residuals: ResidualWindow

    def __init__(self, settings: LoopSettings, output: RateLimiter, axis: str = "") -> None:
        self.settings, self._output = settings, output
        self.follows_total = False  # from the first reading on, or at once with feedback
        self.active = False  # whether readings correct it
        self.fault: Finding | None = None  # for which the feedback is off
        self.sensor = SensorRule(1.0, axis=axis)  # whether its readings follow the model
        self.oscillation = OscillationRule(1.0, axis=axis)  # whether feedback sustains one
        # Why gains are not used with the model at an output period (s); "": they are.
        self._refusal: Callable[[PidGains, float], str] = lambda gains, period: ""
        self.offsets = ZeroOffsets()  # measured - model
        # Setpoint and displacement of the model as a sensor with delay or lag reads them; None without these. Points of
        # a trajectory are output earlier by the delay of the stage.
        self._setpoint: Sensed | None = None
        self._expected: Sensed | None = None
        self._corrected_ns = 0  # begin of the last period with a correction
        self.due_ns = 0  # when the next `tick` is due
        self.driven_ns, self._between = 0, 0.0  # last step of `applied`; time (s) of its steps without the axis

    # State

    @property
    def correction(self) -> float:
        """Correction contained in the present voltage, volts."""
        return self._feedback.correction if self.follows_total else 0.0

    @property
    def state(self) -> str:
        """One of "off", "on", "saturated", "holding" (no recent measurement) or "fault"."""
        if not self.settings.enabled:
            return "off"
        if self.fault:
            return "fault"
        if not (self.follows_total and self._feedback.acting):
            return "holding"
        return "saturated" if abs(self.correction) >= self.settings.correction_limit else "on"

    @property
    def drift(self) -> Drift | None:
        """Residual (measured - model) statistics; None if there are too few measurements."""
        return self._residuals.drift() if self.follows_total else None

    def applied(self, stream: StreamingInverse) -> StreamingInverse:
        """Return the inverse that follows the total voltage: that of the axis, `stream`, before the first reading."""
        return self._applied if self.follows_total else stream

    # Model and settings

    def use(self, model: AxisModel, allowed: Limits, stream: StreamingInverse, now_ns: int) -> None:
        """Follow another `model` with the inverse `stream` of the axis; the voltage is unchanged."""
        low, high = model.displacement_range
        for rule in (self.sensor, self.oscillation):
            rule.span, rule.noise = high - low, model.quality.floor_rms
        self._refusal = lru_cache(maxsize=4)(partial(loop_margin.refusal, model))
        self._sensor = model.streaming_sensor()
        late = self._sensor.late or model.chain.delay > 0.0
        self._setpoint = Sensed(self._sensor, stream.uncoupled_displacement) if late else None
        if self.follows_total:
            self._applied = continue_from(model, allowed, self._applied)
            self._forget_residuals()
            if self.fault is None or self.fault.kind == UNSTABLE:
                self.fault = self._unstable()
                self._feedback.switch(self.settings.enabled and not self.fault)
        elif self.settings.enabled:
            self.fault = self._unstable()
            self.close(stream, now_ns)

    def refusal(self, settings: LoopSettings, period: float) -> str:
        """Return why settings are not used with the model at this output period (s), and which gain would; "": none."""
        before = self.settings
        anew = settings.enabled and not before.enabled
        if (settings.gains, settings.forced, period) == (before.gains, before.forced, self._output.period) and not anew:
            return ""
        return "" if settings.forced else self._refusal(settings.gains, period)

    def _unstable(self) -> Finding | None:
        """Return what is wrong with the loop of the model, if that counts."""
        settings = self.settings
        counts = settings.enabled and not settings.forced
        reason = self._refusal(settings.gains, self._output.period) if counts else ""
        return Finding("loop", UNSTABLE, reason, self.sensor.axis) if reason else None

    def retune(self, settings: LoopSettings, stream: StreamingInverse | None, now_ns: int) -> None:
        """Replace the settings without a voltage step; feedback that was switched off for a fault resumes."""
        if self.fault:
            # What the sensor told before does not count any more.
            self.sensor.begin()
        self.settings, self.active = settings, self.follows_total and settings.enabled
        self.fault = self._unstable()
        self.oscillation.begin(now_ns)
        if not self.follows_total:
            if settings.enabled and stream is not None:
                self.close(stream, now_ns)
            return
        feedback = self._feedback
        feedback.correction_limit = settings.correction_limit
        try:
            feedback.retune(settings.gains)
        except SlpiError:
            # The last measurement gives no finite voltage with the new gains.
            feedback.forget()
            feedback.retune(settings.gains)
        feedback.switch(settings.enabled and not self.fault)

    def close(self, stream: StreamingInverse, now_ns: int) -> None:
        """Start to follow the total voltage, at present that of the inverse `stream` of the axis."""
        self._applied = stream.copy()
        self._forget_residuals()
        self.restart(stream, now_ns)

    def restart(self, stream: StreamingInverse, now_ns: int) -> None:
        """Restart the feedback at the present voltage and rate, without a correction."""
        settings = self.settings
        self._feedback = Feedback(settings.gains, self._output, settings.correction_limit)
        # The feedforward has a rate limiter of its own, beside that of the total voltage.
        stream.pace = self._output.copy()
        self.sensor.begin()
        self.oscillation.begin(now_ns)
        self.follows_total, self.active = True, settings.enabled
        self.driven_ns = self.due_ns = now_ns
        self._between = 0.0
        self._feedback.switch(settings.enabled and not self.fault)

    def leave(self, stream: StreamingInverse) -> None:
        """Let the inverse of the axis go on from the total voltage."""
        if self.follows_total:
            stream.restore(self._applied.snapshot())
        stream.pace = self._output

    def settle(self, stream: StreamingInverse, now_ns: int) -> None:
        """Start again after motion without setpoints."""
        if self.follows_total:
            self.restart(stream, now_ns)
            self._forget_residuals()
        if self._setpoint:
            self._setpoint.restart(stream.uncoupled_displacement + stream.coupled)

    # Readings

    def read(
        self, y: float, expected: float, now_ns: int, fresh: bool, within: bool, swing: int = 0, age: float = 0.0
    ) -> float:
        """Take a reading (m) of an `age` (s); return the displacement (m) without the sensor's own errors.

        `expected` (m) is where the model is. Only a `fresh` one, stamped now, counts for the zero, and only one
        `within` the accepted displacements is corrected; `swing`: of a reset, with a known memory.
        """
        x = self._sensor.correct(y) if within else y
        sensed = self._expected.span(now_ns) if self._expected else ()
        if fresh and isfinite(x):
            self.offsets.take(x, sensed[-1] if sensed else expected, swing, now_ns, age)
        return x

    def measure(self, x: float, expected: float, now_ns: int, watched: bool, tracking: TrackingStatistics) -> None:
        """Compare a displacement (m) from `read` with model and setpoint; `watched`: a fault of the sensor counts."""
        sensed = self._expected.span(now_ns) if self._expected else ()
        for each in sensed:
            self._residuals.expect(each)
        if sensed or not self._expected:
            self._residuals.measure(x)
        if watched:
            self.sensor.read(sensed[-1] if sensed else expected, x, now_ns)
        desired = self._setpoint.at(now_ns) if self._setpoint else None
        if desired is not None or not self._setpoint:
            if not self.fault:
                self._feedback.measure(x, now_ns, desired)
            if self.active:
                aim = tracking.desired if desired is None else desired
                if aim is not None:
                    self.oscillation.take(x - aim, aim, (sensed[-1] if sensed else expected) - aim, now_ns)
            tracking.measure(x, desired)

    def switch_off(self, fault: Finding) -> None:
        """Switch the feedback off because of a fault."""
        self.fault = fault
        self._feedback.switch(False)

    def judge(self, fault_time: float, on: bool, now_ns: int) -> None:
        """Let the rules judge sensor (for `fault_time`, s) and oscillation, if feedback is `on`."""
        on = on and self.active and not self.fault
        self.sensor.fault_time = fault_time if on else 0.0
        self.oscillation.watch(on, now_ns)
        self.sensor.excused = self.oscillation.noticed

    def listen(self) -> None:
        """Hold the correction while the rule of oscillations listens, and go on without a voltage step."""
        if self.follows_total:
            self._feedback.listen(self.oscillation.held)

    # Voltages

    def correct(self, dt: float, y: float, v: float, coupled: float, now_ns: int) -> float:
        """Return the total voltage (V) for a setpoint `y` (m) with feedforward `v` (V), `dt` (s) after the last one."""
        dt, self._between = max(dt - self._between, 0.0), 0.0
        return self._output_with(dt, y, v, coupled, now_ns)

    def tick(self, y: float, v: float, coupled: float, now_ns: int) -> float:
        """Return the total voltage (V) at the end of a period, with the same setpoint (m) and feedforward (V)."""
        dt = max((now_ns - self.driven_ns) * 1e-9, 0.0)
        self._between += dt
        # The correction is that of the period that has ended.
        return self._output_with(dt, y, v, coupled, now_ns, self._output.period_ns)

    def _output_with(self, dt: float, y: float, v: float, coupled: float, now_ns: int, early_ns: int = 0) -> float:
        applied, period_ns = self._applied, self._output.period_ns
        begin_ns = (now_ns - early_ns) // period_ns * period_ns
        first, self._corrected_ns = begin_ns > self._corrected_ns, max(begin_ns, self._corrected_ns)
        applied.coupled = coupled
        if dt > MAX_DT:
            applied.wait(dt - MAX_DT)
            dt = MAX_DT
        v = self._feedback.step(y, v, now_ns, self.settings.timeout if first else None)
        self.driven_ns = now_ns
        # At the end of the period after this one; a voltage that moves within an acceleration limit goes on in each.
        self.due_ns = self._corrected_ns + 2 * period_ns
        if self._output.in_motion:
            self.due_ns = min(self.due_ns, now_ns + period_ns)
        self._expect(applied.drive(v, dt), now_ns, anew=not early_ns)
        return v

    def follow(self, voltage: float, dt: float, now_ns: int) -> None:
        """Follow a voltage (V) without setpoint, `dt` (s) after the last one."""
        if self.follows_total:
            self.driven_ns, self._between = now_ns, 0.0
            self._expect(self._applied.drive(voltage, dt), now_ns)

    def setpoint(self, y: float, now_ns: int, early_ns: int) -> None:
        """Take a setpoint (m) that has been output, by `early_ns` before its time."""
        if self._setpoint:
            self._setpoint.hold(y, now_ns, early_ns)

    def _expect(self, displacement: float, now_ns: int, anew: bool = True) -> None:
        """Set the displacement of the model (m) with which readings are compared from `now_ns` (ns) on."""
        if self._expected:
            self._expected.hold(displacement, now_ns)
        else:
            self._residuals.expect(displacement, anew)

    def _forget_residuals(self) -> None:
        """Discard the residuals, as the model or the state of its hysteresis has changed."""
        displacement = self._applied.uncoupled_displacement
        self._residuals = ResidualWindow(displacement)
        self._expected = Sensed(self._sensor, displacement + self._applied.coupled) if self._sensor.late else None
