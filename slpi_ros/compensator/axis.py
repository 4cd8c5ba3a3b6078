"""Run-time state of one axis: time stamps, limits, model and memory, feedback, ramps."""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from math import inf, isfinite
from statistics import median

from slpi_ros.compensator.amplifier import BAND_NS, Amplifier
from slpi_ros.compensator.feedback import Drift, Feedback, LoopSettings, ResidualWindow
from slpi_ros.compensator.model_swap import continue_from, require_near, take_over, turning_voltages, voltage_history
from slpi_ros.compensator.monitor import Finding, Monitor
from slpi_ros.compensator.path_watch import PathWatch
from slpi_ros.compensator.persistence import KNOWN, RESETTING, RESTORED, MemoryConfidence, SavedAxis, Zero
from slpi_ros.compensator.ramps import Brake, Ramp
from slpi_ros.compensator.sensor_rule import SensorRule
from slpi_ros.compensator.statistics import TrackingStatistics
from slpi_ros.compensator.uncertainty import UncertaintyWatch
from slpi_ros.compensator.validation import Stamps, implausible
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import START_MEMORIES, AxisModel, StartMemory
from slpi_ros.model.limits import MAX_DT, PERIOD, Limits, RateLimiter, volts
from slpi_ros.model.sensor import Sensed, StreamingSensor
from slpi_ros.model.streaming import StreamingInverse

# An initial state matches the first measurements if its error is at most this fraction of the identified displacement
# range, or this multiple of the held-out error: more than overnight drift, less than the error of a wrong history.
FIT_SHARE, FIT_SIGMAS = 0.005, 4.0
# The median of this many measurements of at most this age decides on the initial state.
FIRST_READINGS, FIRST_AGE_NS = 5, SECOND_NS // 5
# Decimals of saved distances (m).
KEPT_DIGITS = 10
# Most measurements for the offset of an axis.
OFFSETS = 50
# A hold begins after this many intervals between samples, and after times between these.
HOLD_INTERVALS, SOONEST_HOLD_NS, LATEST_HOLD_NS = 3, SECOND_NS // 50, 3 * SECOND_NS
# A held voltage is at rest if it changes by less than this share of the range per second over this time; it is then
# looked at once in this time.
REST_SHARE, REST_NS, RESTING_NS = 1e-5, SECOND_NS // 10, SECOND_NS


class Axis:
    """Inverse hysteresis compensation, with optional feedback, of one axis. Times: steady clock, ns."""

    # A loaded model cannot relax the limits. The memory of the feedforward `stream` follows the setpoint, not the
    # corrected voltage, so that sensor noise causes no reversals.
    stream: StreamingInverse  # feedforward; available once a model is loaded
    _applied: StreamingInverse
    _residuals: ResidualWindow
    _sensor: StreamingSensor

    def __init__(
        self, name: str, place: int, limits: Limits, loop_settings: LoopSettings, period: float = PERIOD
    ) -> None:
        self.name, self.place, self.limits = name, place, limits
        self.stamps = Stamps()
        self.output = RateLimiter(limits, period, limits.clip(0.0))  # the voltage, and where it may go
        self.amplifier = Amplifier(limits.upper - limits.lower, axis=name)  # what is reported of the voltage
        self.model: AxisModel | None = None
        self.confidence = MemoryConfidence()
        self.zero = Zero()
        self.held = self.slewing = self.driven = False  # at a voltage limit; slew limited; ever had a model
        self.ramp: Ramp | Brake | None = None  # an active motion without desired displacements
        self.start_memory: StartMemory | None = None  # assumed; None once output, or if restored
        self.given_ns = 0  # of the last sample or step
        self.due_ns: int | None = None  # of the next `tick`; None if nothing follows
        self.point_ns: int | None = None  # deadline of the last trajectory point on its clock, None if it was none
        self.tracking = TrackingStatistics()  # measured - desired displacement
        self.path = PathWatch()  # desired displacements against the record of the model
        self.fault: Finding | None = None  # for which the feedback was switched off
        self._loop_settings = loop_settings
        self._feedback: Feedback | None = None
        self._sensor_rule = SensorRule(1.0, axis=name)
        self._monitor = Monitor(self._sensor_rule)  # what switches the feedback off
        self._first_readings: deque[tuple[int, float]] = deque(maxlen=FIRST_READINGS)
        # Measured - model, with the time (ns), also where the measurement is refused.
        self._offsets: deque[tuple[int, float]] = deque(maxlen=OFFSETS)
        # Arrival of the last samples; whether the displacement is held, and since when the voltage is nearly at rest.
        self._arrivals: tuple[int, ...] = ()
        self._holding = False
        self._rest: tuple[int, float, float] | None = None
        # Time (s) for which ticks have moved the effects on since the last sample.
        self._ticked = 0.0
        self._in_block = False  # a device moves the axis by itself
        self._replaced = False  # a new model, for which the voltage of the last sample is not known yet
        # Setpoint and displacement of the model as a sensor with delay or lag tells them; None without these.
        self._setpoint: Sensed | None = None
        self._expected: Sensed | None = None
        self.surroundings: dict[str, float] = {}  # values of quantities in use
        # Uncertainty of where the axis is, while somebody asks for it, and the model, memory and zero that it is of.
        self._uncertainty: UncertaintyWatch | None = None
        self._uncertainty_of: tuple[AxisModel | None, str, Zero] | None = None

    # State

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self.output.voltage

    @property
    def correction(self) -> float:
        """Feedback correction contained in the present voltage, volts."""
        return self._feedback.correction if self._feedback else 0.0

    @property
    def feedback_state(self) -> str:
        """One of "off", "on", "saturated", "holding" (no recent measurement) or "fault" (of the sensor)."""
        if not self._loop_settings.enabled:
            return "off"
        if self.fault:
            return "fault"
        if not (self._feedback and self._feedback.acting):
            return "holding"
        return "saturated" if self._feedback.saturated else "on"

    @property
    def drift(self) -> Drift | None:
        """Residual (measured - model) statistics; None if there are too few measurements."""
        return self._residuals.drift() if self._feedback else None

    @property
    def reversal_voltages(self) -> tuple[float, ...]:
        """Voltages (V) of the remembered reversals, oldest first, followed by the present voltage."""
        turns = voltage_history(self._applied if self._feedback else self.stream)
        return turns if turns[-1] == self.voltage else (*turns, self.voltage)

    def saved(self, now_ns: int) -> SavedAxis:
        """Return what is to be kept over a restart."""
        stream = self._applied if self._feedback else self.stream
        relaxing = stream.relaxing(max((now_ns - self.given_ns) * 1e-9, 0.0))
        # Rounded, so that a stage at rest is saved once.
        rounded = {name: tuple(round(each, KEPT_DIGITS) for each in distances) for name, distances in relaxing.items()}
        certain = self.confidence.state in (KNOWN, RESTORED)
        return SavedAxis(self.reversal_voltages, certain, zero=self.zero, relaxing=rounded)

    @property
    def in_motion(self) -> bool:
        """Whether the voltage has to brake before it rests, because of the acceleration limit."""
        return self.output.in_motion

    @property
    def _period_ns(self) -> int:
        return round(self.output.period * SECOND_NS)

    # Model, limits, settings

    def prepare(
        self, model: AxisModel, reversal_voltages: Sequence[float] | None = None, start_memory: StartMemory = "end"
    ) -> StreamingInverse:
        """Return the streaming inverse of a new model, see `take_over`; default: the reversals of this axis (V)."""
        if reversal_voltages is None:
            reversal_voltages = turning_voltages(self.stream.memory) if self.driven else ()
            if self.driven:
                require_near(self.voltage, self.limits.within(model.voltage_range))
        return take_over(model, self.limits, reversal_voltages, start_memory)

    def use(self, model: AxisModel, stream: StreamingInverse) -> None:
        """Replace the model by `model` with its streaming inverse from `prepare`; the voltage is unchanged."""
        allowed = stream.limits
        if self.driven:
            stream.resume(self.stream)
        else:
            self.output.start(stream.voltage)
        planned = self.stream.pace if self._feedback and not self.ramp else self.output
        self.model, self.stream, self.driven, self.zero = model, stream, True, Zero()
        self.path = PathWatch(model)
        stream.pace = planned
        self._set_limits(allowed)
        self.confidence = self.confidence.over(model.hysteresis_range)
        seconds = sum(effect.settling_time for effect in model.effects)
        self.amplifier.window_ns = BAND_NS + int(seconds * SECOND_NS)
        low, high = model.displacement_range
        self._sensor_rule.span, self._sensor_rule.noise = high - low, model.quality.floor_rms
        self._sensor = model.streaming_sensor()
        self._setpoint = Sensed(self._sensor, stream.uncoupled_displacement) if self._sensor.late else None
        self._replaced = True
        if self._feedback:
            self._applied = continue_from(model, allowed, self._applied)
            self._forget_residuals()
        elif self._loop_settings.enabled:
            self._close_loop()
        for one in self._streams:
            one.surround(self.surroundings)

    def surround(self, key: str, value: float) -> None:
        """Take a value of a quantity that the stage follows; it counts from the next sample on."""
        self.surroundings[key] = value
        for stream in self._streams:
            stream.surround({key: value})
        if self._uncertainty:
            self._uncertainty.surround(key, value)

    @property
    def _streams(self) -> tuple[StreamingInverse, ...]:
        return (self.stream, self._applied) if self._feedback else (self.stream,)

    def locate(self, voltage: float) -> None:
        """Continue from a voltage (V) at which the amplifier was found; a move to it that is no noise is remembered."""
        if abs(voltage - self.stream.voltage) > self.amplifier.tolerance:
            self._leave_feedback()
            self.stream.drive(voltage)
            state = self.confidence.state
            if state != RESETTING:
                self.confidence = MemoryConfidence(
                    doubt=f"moved to {volts(voltage)} V by something else since its memory was known"
                )
        if voltage != self.output.voltage:
            self.output.start(voltage)
        self.stream.pace = self.output
        if self._feedback:
            self._restart_feedback()

    def check_limits(self, limits: Limits) -> Limits:
        """Return new limits, restricted to the identified voltages of the model; UsageError if it has none there."""
        return limits.within(self.model.voltage_range) if self.model else limits

    def use_limits(self, limits: Limits, period: float) -> None:
        """Replace limits and output period (s), or raise as `check_limits`; memory and voltage are unchanged."""
        allowed = self.check_limits(limits)
        self.limits = limits
        self.amplifier.span = limits.upper - limits.lower
        self._set_limits(allowed, period)

    def return_inside(self, now_ns: int) -> None:
        """Go to the nearest voltage limit of the node if the voltage is outside of them."""
        if self.driven and self.ramp is None and not self.limits.lower <= self.voltage <= self.limits.upper:
            self.start_ramp(Ramp([self.limits.clip(self.voltage)], inf), now_ns)

    def _set_limits(self, allowed: Limits, period: float | None = None) -> None:
        if self.driven:
            self.stream.limits = allowed = self.stream.restricted(allowed)
            self.stream.pace.change(allowed, period)
        self.output.change(allowed, period)

    def retune(self, settings: LoopSettings) -> None:
        """Replace the feedback settings without a voltage step; feedback that was switched off for a fault resumes."""
        if self.fault:
            # What the sensor told before does not count any more.
            self._sensor_rule.begin(self.given_ns)
        self._loop_settings, self.fault = settings, None
        feedback = self._feedback
        if feedback is None:
            if settings.enabled and self.driven:
                self._close_loop()
            return
        feedback.correction_limit = settings.correction_limit
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
        """Reject a displacement (m; "desired" or "measured") that is not finite or far outside the model range."""
        low, high = self.stream.accepted
        if not low <= y <= high:
            raise implausible(y, (low, high), kind)

    def update(self, ahead: float | None, y: float, now_ns: int) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `ahead` (s) after the last sample."""
        # By the stamps, of which the ticks since the last sample have used up a part: a sample that is not later counts
        # as one output period later. None: the time on the steady clock since the last step.
        if ahead is None:
            dt = max((now_ns - self.given_ns) * 1e-9, 0.0)
        else:
            dt = ahead - self._ticked
            if dt <= 0.0:
                dt = self.output.period if self._arrivals else 0.0
        self._ticked = 0.0
        self._arrivals = (*self._arrivals[-3:], now_ns)
        self.tracking.desired, self.tracking.learned = y, 0.0
        self.path.sample(dt, y)
        v = self._sample(dt, y, now_ns)
        self._follow_later(now_ns)
        return v

    def _sample(self, dt: float, y: float, now_ns: int) -> float:
        """Output and return the voltage (V) for the desired displacement `y` (m), `dt` (s) after the last step."""
        stream = self.stream
        v = stream.move(dt, y, now_ns)
        if self._feedback is not None:
            v = self._correct(dt, y, v, now_ns)
        if stream.missed:
            self.held = stream.held
            self.slewing = not self.held
        else:
            self.held = self.slewing = False
        self.given_ns = now_ns
        self.start_memory, self._replaced = None, False
        if self._uncertainty is not None:
            self._uncertainty.sample(dt, y, v)
        self.amplifier.output(v, now_ns)
        if self._setpoint:
            self._setpoint.hold(y, now_ns)
        return v

    def _follow_later(self, now_ns: int) -> None:
        """Plan the next tick: at once for what the limits hold back, later for a hold."""
        self._holding, self._rest = False, None
        if self.slewing or self.in_motion:
            self.due_ns = now_ns + self._period_ns
        else:
            self.due_ns = now_ns + SOONEST_HOLD_NS if self.holds else None

    @property
    def holds(self) -> bool:
        """Whether the voltage of a constant displacement changes: because of effects, other axes, or feedback."""
        return self._feedback is not None and self._loop_settings.enabled or not self.stream.timeless

    @property
    def holding(self) -> bool:
        """Whether the displacement is held, because no sample came for some intervals."""
        return self._holding

    def tick(self, now_ns: int) -> bool:
        """Make a step of a ramp, of what the limits held back, or a hold; return whether voltage or rate changed."""
        before, rate = self.voltage, self.output.rate
        if self.ramp:
            self.step_ramp(now_ns)
        elif self._holding:
            self._hold(now_ns)
        elif self.slewing or self.in_motion:
            self._approach(now_ns)
        else:
            self._begin_hold(now_ns)
        return self.voltage != before or (self.output.rate != rate and self.output.limits.acceleration < inf)

    def wake(self, now_ns: int) -> None:
        """Look at a held voltage again soon, because another axis moves."""
        if self._holding:
            self._rest, self.due_ns = None, now_ns + self._period_ns

    def drop_goal(self) -> None:
        """Stay at the present voltage: nothing follows."""
        self.due_ns, self.ramp, self.point_ns, self._holding = None, None, None, False
        self.slewing = self.held = False
        self.tracking.desired = None
        self.stamps.restart()

    def _approach(self, now_ns: int) -> None:
        """Go on towards the voltage of the last sample."""
        dt, desired, (low, high) = self._passed(now_ns), self.tracking.desired, self.stream.accepted
        if self._replaced and desired is not None and low <= desired <= high:
            self._sample(dt, desired, now_ns)
        else:
            v = self.stream.approach(dt, now_ns)
            if self._feedback is not None:
                v = self._correct(dt, self.stream.desired if desired is None else desired, v, now_ns)
            self.slewing = self.stream.missed and not self.stream.held
            self.held = self.stream.held
            if self._uncertainty is not None:
                self._uncertainty.sample(dt, self.expected, v)
            self.amplifier.output(v, now_ns)
        self.due_ns = now_ns + self._period_ns
        if not (self.slewing or self.in_motion):
            self.due_ns = now_ns + SOONEST_HOLD_NS if self.holds else None

    def _begin_hold(self, now_ns: int) -> None:
        """Begin to hold the displacement, if no sample has come for long enough."""
        if self.tracking.desired is None or not self.holds:
            self.due_ns = None
            return
        steps = sorted(later - earlier for earlier, later in pairwise(self._arrivals))
        usual_ns = steps[len(steps) // 2] if steps else 0
        begin_ns = self._arrivals[-1] + min(max(HOLD_INTERVALS * usual_ns, SOONEST_HOLD_NS), LATEST_HOLD_NS)
        if now_ns < begin_ns:
            self.due_ns = begin_ns
            return
        self._holding, self._rest = True, None
        self._hold(now_ns)

    def _hold(self, now_ns: int) -> None:
        """Output the voltage that holds the last desired displacement now."""
        desired = self.tracking.desired
        assert desired is not None
        v = self._sample(self._passed(now_ns), desired, now_ns)
        low, high = self.output.limits.lower, self.output.limits.upper
        since_ns, lowest, highest = self._rest or (now_ns, v, v)
        lowest, highest = min(lowest, v), max(highest, v)
        still_ns = now_ns - since_ns
        self._rest = since_ns, lowest, highest
        if (highest - lowest) > REST_SHARE * (high - low) * max(still_ns, REST_NS) * 1e-9:
            self._rest = now_ns, v, v
            still_ns = 0
        self.due_ns = now_ns + (RESTING_NS if still_ns >= REST_NS else self._period_ns)

    def _passed(self, now_ns: int) -> float:
        """Return the time (s) since the last step, and count it for the next sample."""
        dt = max((now_ns - self.given_ns) * 1e-9, 0.0)
        self.given_ns = now_ns
        self._ticked += dt
        return dt

    def measure(self, displacement: float, now_ns: int, fresh: bool = True) -> None:
        """Store a displacement (m) without the sensor's known errors; only those stamped now choose the history."""
        if not self.driven:
            return
        low, high = self.stream.accepted
        x = self._sensor.correct(displacement) if low <= displacement <= high else displacement
        expected = self._expected.span(now_ns) if self._expected and self._feedback else ()
        told = expected[-1] if expected else self.expected
        if fresh and isfinite(x):
            self._offsets.append((now_ns, x - told))
        self.check(displacement, "measured")
        if self.start_memory:
            if fresh:
                self._first_readings.append((now_ns, x))
            return
        if self._feedback is None:
            self._close_loop()
            expected, told = (), self.expected
        assert self._feedback
        for each in expected:
            self._residuals.expect(each)
        if expected or not self._expected:
            self._residuals.measure(x)
        if self.ramp is None and not self._in_block:
            self._monitor.read(told, x, now_ns)
        desired = self._setpoint.at(now_ns) if self._setpoint else None
        if desired is not None or not self._setpoint:
            if not self.fault:
                self._feedback.measure(x, now_ns, desired)
            self.tracking.measure(x, desired)

    def offset(self, now_ns: int) -> float | None:
        """Return the present measured - model displacement (m); None without a measurement in the last 0.2 s."""
        recent = [offset for t, offset in self._offsets if now_ns - t <= FIRST_AGE_NS]
        return median(recent) if recent else None

    def move_zero(self, zero: Zero, model: AxisModel) -> None:
        """Continue with the same `model` with another zero, at the present voltage and without a goal."""
        self._leave_feedback()
        self.use(model, self.prepare(model))
        self.zero = zero
        self.drop_goal()
        self._offsets.clear()
        if self._feedback:
            self._close_loop()

    def choose_memory(self, now_ns: int) -> None:
        """Choose the initial state that matches the first measurements; the voltage is unchanged."""
        # The assumed one is kept unless another one matches better by more than the noise, and without enough recent
        # measurements that agree.
        recent = [y for t, y in self._first_readings if now_ns - t <= FIRST_AGE_NS]
        if not self.start_memory or len(recent) < FIRST_READINGS:
            return
        assert self.model
        measured, quality, (low, high) = median(recent), self.model.quality, self.model.displacement_range
        noise = FIT_SIGMAS * max(quality.held_out_rms, quality.floor_rms)
        allowed = max(noise, FIT_SHARE * (high - low))
        if max(recent) - min(recent) > 2.0 * allowed:
            return
        assumed, streams, errors = self.start_memory, {}, {}
        present = self.stream.voltage
        for name in START_MEMORIES:
            streams[name] = stream = take_over(self.model, self.limits, (), name)
            stream.coupled = self.stream.coupled
            stream.surround(self.surroundings)
            errors[name] = abs(measured - stream.drive(present))
        best = min(START_MEMORIES, key=lambda name: errors[name])
        self.start_memory = None
        self._first_readings.clear()
        if errors[best] > allowed:
            tried = ", ".join(f"{name} {error * 1e6:.4g} µm" for name, error in errors.items())
            self.confidence = MemoryConfidence(
                doubt=f"the measurement matches no initial state of the model (errors: {tried}); call ~/reset_memory",
                contradicted=True,
            )
        elif errors[assumed] > errors[best] + noise:
            stream = streams[best]
            stream.pace = self.stream.pace
            stream.limits = self.output.limits
            self.stream = stream
            if self._feedback:
                self._close_loop()
            self.confidence = MemoryConfidence(doubt=f"chosen by measurement: start_memory '{best}', not '{assumed}'")

    @property
    def expected(self) -> float:
        """Where the axis is according to the model, metres."""
        own = self._applied if self._feedback else self.stream
        return own.uncoupled_displacement + self.stream.coupled

    @property
    def uncertainty(self) -> float | None:
        """Standard uncertainty of `expected`, metres, by the model alone; None if nobody asks for it."""
        return self._uncertainty.present if self._uncertainty else None

    def watch_uncertainty(self, wanted: bool, age: float, now_ns: int) -> None:
        """Follow the uncertainty, or no longer; `age` (s) is that of the zero. ModelError if it is not known."""
        if not wanted or self.model is None:
            self._uncertainty = self._uncertainty_of = None
            return
        of = self.model, self.confidence.state, self.zero
        if (
            self._uncertainty is None
            or self._uncertainty_of is None
            or any(one is not other for one, other in zip(of, self._uncertainty_of, strict=True))
        ):
            known = self.confidence.state in (KNOWN, RESTORED)
            self._uncertainty = None
            self._uncertainty = UncertaintyWatch(self.model, self.stream, known, age, self.surroundings)
            self._uncertainty_of = of
        self._uncertainty.wait((now_ns - self.given_ns) * 1e-9, self.expected, self.voltage)

    def watch_sensor(self, fault_time: float, now_ns: int) -> Finding | None:
        """Switch the feedback off if its sensor has been faulty for `fault_time` (s); return a new fault."""
        feedback = self._feedback
        if not (self._loop_settings.enabled and feedback and fault_time) or self.fault or self.ramp or self._in_block:
            return None
        self._sensor_rule.fault_time = fault_time
        self._monitor.check(now_ns)
        self.fault = next(iter(self._monitor.standing), None)
        if self.fault:
            feedback.disable()
        return self.fault

    def _correct(self, dt: float, y: float, v: float, now_ns: int) -> float:
        """Return the total voltage (V), feedforward `v` (V) and correction, for the desired displacement `y` (m)."""
        feedback, applied = self._feedback, self._applied
        assert feedback
        applied.coupled = self.stream.coupled
        if dt > MAX_DT:
            applied.wait(dt - MAX_DT)
            dt = MAX_DT
        v = feedback.step(dt, y, v, now_ns, self._loop_settings.timeout)
        self._expect(applied.drive(v, dt), now_ns)
        return v

    def _expect(self, displacement: float, now_ns: int) -> None:
        """Set the displacement of the model (m) with which measurements are compared from `now_ns` (ns) on."""
        if self._expected:
            self._expected.hold(displacement, now_ns)
        else:
            self._residuals.expect(displacement)

    def _forget_residuals(self) -> None:
        """Discard the residuals, as the model or the state of its hysteresis has changed."""
        displacement = self._applied.uncoupled_displacement
        self._residuals.forget(displacement)
        self._expected = Sensed(self._sensor, displacement + self._applied.coupled) if self._sensor.late else None

    def _close_loop(self) -> None:
        """Start the feedback; a second streaming inverse follows the total voltage."""
        self._applied = self.stream.copy()
        self._residuals = ResidualWindow(self._applied.uncoupled_displacement)
        self._forget_residuals()
        self._restart_feedback()

    def _restart_feedback(self) -> None:
        """Restart the feedback at the present voltage and rate, without a correction."""
        settings, output = self._loop_settings, self.output
        self._feedback = feedback = Feedback(
            settings.gains, output.limits, output.voltage, correction_limit=settings.correction_limit
        )
        feedback.hold(0.0, output.voltage)
        # The feedforward has a rate limiter of its own, beside that of the total voltage.
        feedback.pace, self.stream.pace = output, output.copy()
        self._sensor_rule.begin(self.given_ns)
        if settings.enabled and not self.fault:
            feedback.enable()

    def _leave_feedback(self) -> None:
        """Let the feedforward continue from the total voltage."""
        if self._feedback and not self.ramp:
            self.stream.restore(self._applied.snapshot())
        self.stream.pace = self.output

    # Blocks

    def begin_block(self) -> None:
        """Hold while a device plays a block by itself; nothing follows."""
        self._leave_feedback()
        self.drop_goal()
        self.start_memory, self._in_block = None, True

    def play(self, voltages: Sequence[float], period: float, now_ns: int) -> None:
        """Let memory and effects follow voltages (V) that were played, `period` (s) apart."""
        for v in voltages:
            self.stream.drive(v, period)
            if self._feedback:
                self._applied.drive(v, period)
        if voltages:
            self.output.start(voltages[-1])
        self.given_ns = now_ns

    def end_block(self, now_ns: int) -> None:
        """Go on with commands, from the voltage that was played last."""
        self._in_block = False
        self.given_ns = now_ns
        self.amplifier.output(self.voltage, now_ns)
        self._settle()

    # Ramps

    def start_ramp(self, ramp: Ramp | Brake, now_ns: int) -> None:
        """Start a ramp from the present voltage at `now_ns` (ns); ticks execute it."""
        self._leave_feedback()
        self.ramp, self.point_ns, self.start_memory, self.tracking.desired = ramp, None, None, None
        self._holding = self.held = self.slewing = False
        self.due_ns = now_ns + self._period_ns

    def brake(self, now_ns: int) -> None:
        """Start to decelerate to rest within the acceleration limit; ticks execute it."""
        if not isinstance(self.ramp, Brake):
            self.start_ramp(Brake(), now_ns)

    def step_ramp(self, now_ns: int) -> None:
        """Execute one step of the active ramp, if any."""
        if self.ramp is None or self.ramp.done:
            return
        dt, stream = self._passed(now_ns), self.stream
        v = self.ramp.step(self.output, now_ns)
        stream.drive(v, dt)
        if self._feedback:
            self._expect(self._applied.drive(v, dt), now_ns)
        if self._uncertainty is not None:
            self._uncertainty.sample(dt, self.expected, v)
        self.amplifier.output(v, now_ns)
        self.due_ns = now_ns + self._period_ns

    def stop_ramp(self) -> None:
        """End the active ramp, if any; desired displacements continue from the present voltage and rate."""
        if not self.ramp:
            return
        self.ramp, self.due_ns = None, None
        self._settle()

    def _settle(self) -> None:
        """Go on from the present voltage after motion without desired displacements."""
        if self._feedback:
            self._restart_feedback()
            self._forget_residuals()
        if self._setpoint:
            self._setpoint.restart(self.stream.uncoupled_displacement + self.stream.coupled)
        self.stamps.restart()
