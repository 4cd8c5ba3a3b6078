"""Feedback of one axis: feedforward plus PID (MPI paper, Fig. 12), and residuals measured - model."""

from collections import deque
from dataclasses import dataclass, fields
from math import exp, expm1, inf, isfinite, sqrt

from slpi_ros.compensator.loop_filter import Filtered, LoopFilter, Notch
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.model.limits import MAX_DT, RateLimiter

# Number of measurements in the residual window.
WINDOW = 500
# Minimum number of measurements for residual statistics.
ENOUGH = 50


@dataclass(frozen=True)
class PidGains:
    """PID gains, for a stage whose displacement increases with its voltage."""

    proportional: float  # V/m
    integral: float = 0.0  # V/(m s)
    derivative: float = 0.0  # V s/m; on the measured displacement only, not on the setpoint
    derivative_filter: float = 0.0  # s, time constant of its low-pass filter; 0: none
    measurement_filter: float = 0.0  # s, time constant of the low-pass filter of the readings; 0: none
    notches: tuple[Notch, ...] = ()  # of the readings

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name == "notches":
                continue
            value = getattr(self, field.name)
            if not (isfinite(value) and value >= 0.0):
                raise UsageError(f"PID gain {field.name} is {value}; give a finite value that is not negative")

    @property
    def filters(self) -> bool:
        """Whether readings are filtered."""
        return bool(self.notches or self.measurement_filter)

    def direct(self, error: float, rate: float) -> float:
        """Return the part of the correction (V) that an error (m) and a measured rate (m/s) make at once."""
        return self.proportional * error - self.derivative * rate


class Feedback:
    """Feedforward plus PID of one axis: ``v = correct(now_ns, desired, measured, feedforward)``; initially disabled.

    Times: steady clock, ns, not decreasing. The voltage is that of `pace`, within whose limits it is moved on.
    """

    # Enabling, disabling and retuning are bumpless: an offset cancels the step of the correction and then decays with
    # the time constant `release_time` (s), so that the error at the moment of enabling is corrected completely.
    #
    # Windup is avoided by conditional integration: the integral grows only as far as the voltage can follow. Unlike
    # back-calculation, this keeps the integral while the voltage is slew limited on the way to a distant feedforward.
    #
    # Notches and low pass take the error, reading and setpoint alike, so that their lag is no error while the stage
    # moves. They step once in each period of `pace`, whose filters they are, also over periods without a measurement.
    #
    # The error refers to the setpoint at the time of the measurement, not to the present one, and for a sensor with a
    # known delay or lag to the setpoint as that sensor would tell it, see `slpi_ros.model.sensor.Sensed`.
    release_time = 0.1  # s
    longest_gap = MAX_DT  # s; longer intervals count as this long

    def __init__(self, gains: PidGains, pace: RateLimiter, correction_limit: float = inf) -> None:
        if not isfinite(pace.voltage):
            raise UsageError(f"voltage at the start is {pace.voltage} V; give the present voltage")
        self.gains, self.pace = gains, pace
        self.enabled = False  # whether measurements correct the voltage
        self.acting = False  # whether a recent measurement corrected the last `step`
        self.correction_limit = correction_limit  # V, in each direction
        # Added to the feedforward voltage, V, after clipping to its limit and the voltage limits.
        self.correction = 0.0
        self._held = self._taking_over = False
        self._integral = self._offset = 0.0
        self._measured = self._error = self._rate = 0.0
        # Of the last sample, of the last measurement that was used, and of the last one that came.
        self._last_ns = self._measured_ns = self._latest_ns = -inf
        self._latest: tuple[float, float | None] | None = None  # that one (m), and the setpoint (m) at that time
        self._desired: float | None = None
        # Filter of the gains at the period of `pace`, and what it has come to.
        self._filter: LoopFilter | None = None
        self._filtered: Filtered

    def switch(self, on: bool) -> None:
        """Enable the PID without a voltage step at the next measurement; once it is off, the correction decays."""
        if on and not self.enabled:
            self._taking_over = True
        self.enabled = on

    def forget(self) -> None:
        """Discard the last measurement; the PID restarts without a voltage step at the next one."""
        self._error = self._rate = 0.0
        self._measured_ns = -inf
        self._taking_over = self.enabled

    def listen(self, held: bool) -> None:
        """Hold the correction while it is to be `held`, and go on without a voltage step after that."""
        if self._held and not held:
            self.forget()
        self._held = held

    def retune(self, gains: PidGains) -> None:
        """Replace the gains without a voltage step, or raise and keep them if they give no finite voltage."""
        error, rate = self._error, self._rate
        if (gains.notches, gains.measurement_filter) != (self.gains.notches, self.gains.measurement_filter):
            self._filter = None
        offset = self._offset + (self.gains.direct(error, rate) - gains.direct(error, rate))
        if not isfinite(offset):
            raise UsageError(f"{gains} give no finite voltage; check their units")
        self.gains, self._offset = gains, offset

    def correct(self, now_ns: int, desired: float, measured: float, feedforward: float) -> float:
        """Return the voltage (V) for desired and measured displacement (m), within all limits, or raise unchanged."""
        self._require_order(now_ns)
        elapsed = (now_ns - self._measured_ns) * 1e-9
        error = desired - measured
        if filtered := self._filter_next(now_ns, elapsed, error, measured):
            error, measured = filtered.error, filtered.reading
        rate = self._next_rate(elapsed, measured)
        direct = self.gains.direct(error, rate)
        if not isfinite(direct):
            raise UsageError(f"desired {desired} m, measured {measured} m gives no finite voltage; hold the sample")
        if self.enabled:
            low, high = self.pace.reach(now_ns)
            most = self.correction_limit
            reach = max(low, min(feedforward - most, high)), min(high, max(feedforward + most, low))
            integral, offset = self._next_integral_and_offset(elapsed, error, direct, feedforward, reach)
            v = self._output(feedforward, direct + offset + integral, now_ns)
            self._integral, self._offset, self._taking_over = integral, offset, False
        else:
            v = self.hold(now_ns, feedforward)
        self._error, self._rate = error, rate
        if elapsed > 0.0:
            self._measured_ns, self._measured = now_ns, measured
        if filtered:
            self._filtered = filtered
        return v

    def _filter_next(self, now_ns: int, elapsed: float, error: float, measured: float) -> Filtered | None:
        """Return error and reading (m) after the filter; None if there is none."""
        gains, pace = self.gains, self.pace
        if not (gains.filters and self.enabled) or not isfinite(error):
            self._filter = None
            return None
        found = self._filter
        if found is None or found.period != pace.period:
            found = self._filter = LoopFilter(gains.notches, gains.measurement_filter, pace.period)
            # Without a step: as if the last filtered error had always been there.
            self._filtered = found.resting(self._error, self._measured, max(now_ns - pace.period_ns, 0))
        before = self._filtered
        if elapsed > self.longest_gap:
            return found.resting(error, measured, now_ns)
        if elapsed == 0.0:
            return before
        steps = max(round((now_ns - before.now_ns) / pace.period_ns), 1)
        end_ns = min(before.now_ns + steps * pace.period_ns, now_ns + pace.period_ns)
        error, errors = found.after(before.errors, error, steps)
        # Only the derivative takes the reading itself.
        readings = before.readings
        if gains.derivative:
            measured, readings = found.after(readings, measured, steps)
        return Filtered(error, measured, errors, readings, end_ns)

    def hold(self, now_ns: int, feedforward: float) -> float:
        """Return the voltage (V) without measurement, or raise unchanged: the correction is kept, or decays."""
        self._require_order(now_ns)
        correction = self.correction
        if not self.enabled:
            correction *= exp(-min((now_ns - self._last_ns) * 1e-9, self.longest_gap) / self.release_time)
        return self._output(feedforward, correction, now_ns)

    def measure(self, displacement: float, now_ns: int, desired: float | None = None) -> None:
        """Store a displacement (m), and the setpoint it refers to as the sensor would tell it; default: the last."""
        self._latest, self._latest_ns = (displacement, self._desired if desired is None else desired), now_ns

    def step(self, desired: float, feedforward: float, now_ns: int, timeout: float | None) -> float:
        """Return the voltage (V), corrected by the last measurement unless it is used or older than `timeout` (s).

        None, or while it is held: with the present correction.
        """
        self._desired = desired
        if timeout is None or self._held:
            return self.hold(now_ns, feedforward)
        latest, self._latest = self._latest, None
        # Between two measurements the correction is held.
        self.acting = (now_ns - self._latest_ns) * 1e-9 <= timeout
        if latest and self.acting:
            measured, aim = latest
            try:
                return self.correct(now_ns, desired if aim is None else aim, measured, feedforward)
            except SlpiError:
                # A measurement that gives no finite voltage is ignored.
                self._latest_ns, self.acting = -inf, False
        return self.hold(now_ns, feedforward)

    def _require_order(self, now_ns: int) -> None:
        if now_ns < self._last_ns:
            back = (self._last_ns - now_ns) * 1e-9
            raise UsageError(f"time runs {back:.9g} s backwards; send samples in order")

    def _next_rate(self, elapsed: float, measured: float) -> float:
        """Return the low-pass filtered rate (m/s) of the measured displacement, exact for any sampling period."""
        if elapsed == 0.0:
            return self._rate
        # At the first measurement the elapsed time is infinite and the slope is 0.
        slope = (measured - self._measured) / elapsed
        time_constant = self.gains.derivative_filter
        if time_constant == 0.0:
            return slope
        return self._rate - (slope - self._rate) * expm1(-elapsed / time_constant)

    def _next_integral_and_offset(
        self, elapsed: float, error: float, direct: float, feedforward: float, reach: tuple[float, float]
    ) -> tuple[float, float]:
        """Return the next integral and offset (V); when enabled, both are set such that the correction is unchanged."""
        if self._taking_over:
            return self.correction, -direct
        dt = min(elapsed, self.longest_gap)
        offset = self._offset * exp(-dt / self.release_time)
        wanted = feedforward + direct + offset + self._integral
        step = self.gains.integral * error * dt
        return self._integral + part_within(step, reach[0] - wanted, reach[1] - wanted), offset

    def _output(self, feedforward: float, correction: float, now_ns: int) -> float:
        """Move to `feedforward` + `correction` (V) as far as all limits allow; return the voltage (V)."""
        correction = min(max(correction, -self.correction_limit), self.correction_limit)
        wanted = feedforward + correction
        if not isfinite(wanted):
            raise UsageError(f"feedforward {feedforward} V, correction {correction} V is not finite; check the gains")
        limits = self.pace.limits
        v = self.pace.step(limits.clip(wanted), now_ns)
        self._last_ns = now_ns
        # A correction beyond the voltage limits is discarded, so that it does not have to decay later.
        self.correction = part_within(correction, limits.lower - feedforward, limits.upper - feedforward)
        return v


def part_within(step: float, low: float, high: float) -> float:
    """Return `step` limited to low..high, or 0 if `step` points away from that interval."""
    return min(max(step, min(low, 0.0)), max(high, 0.0))


@dataclass(frozen=True)
class Drift:
    """Rms and mean (m) of the residual measured - model over the last `WINDOW` measurements, and their number."""

    rms: float
    mean: float
    samples: int


class ResidualWindow:
    """Residuals (m) measured - model of the last `WINDOW` measurements."""

    # Because the stage responds with a delay, the residual is the signed distance of a measurement from the interval
    # between the model displacements of the last two samples; at rest it is measured - model.
    __slots__ = ("_before", "_expected", "_residuals")

    def __init__(self, expected: float) -> None:
        self._residuals: deque[float] = deque(maxlen=WINDOW)
        self._before = self._expected = expected

    def expect(self, displacement: float, anew: bool = True) -> None:
        """Store the model displacement (m) for the voltage applied from now on; `anew`: of another sample."""
        if anew:
            self._before = self._expected
        self._expected = displacement

    def measure(self, displacement: float) -> None:
        """Store the residual of a measured displacement (m)."""
        low, high = self._before, self._expected
        if low > high:
            low, high = high, low
        self._residuals.append(displacement - min(max(displacement, low), high))

    def drift(self) -> Drift | None:
        """Return the statistics of the window; None with fewer than `ENOUGH` measurements."""
        residuals, count = self._residuals, len(self._residuals)
        if count < ENOUGH:
            return None
        return Drift(sqrt(sum(r * r for r in residuals) / count), sum(residuals) / count, count)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the feedback of one axis."""

    enabled: bool  # if not, measurements are used for the diagnostics only
    gains: PidGains
    timeout: float  # s, the age from which measurements are ignored
    correction_limit: float = inf  # V
    forced: bool = False  # whether gains are taken with which the loop of the model is not stable enough
