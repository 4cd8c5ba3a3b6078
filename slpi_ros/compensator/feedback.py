"""Feedback of one axis: feedforward plus PID (MPI paper, Fig. 12), and residuals measured - model."""

from array import array
from dataclasses import dataclass, fields
from math import exp, expm1, inf, isfinite, sqrt

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.model.limits import MAX_DT, Limits, RateLimiter
from slpi_ros.model.streaming import nanoseconds

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

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value >= 0.0):
                raise UsageError(f"PID gain {field.name} is {value}; give a finite value that is not negative")


class Feedback:
    """Feedforward plus PID of one axis: ``v = correct(t, desired, measured, feedforward)``; initially disabled."""

    # Enabling, disabling and retuning are bumpless: an offset cancels the step of the correction and then decays with
    # the time constant `release_time` (s), so that the error at the moment of enabling is corrected completely.
    #
    # Windup is avoided by conditional integration: the integral grows only as far as the voltage can follow. Unlike
    # back-calculation, this keeps the integral while the voltage is slew limited on the way to a distant feedforward.
    #
    # The error refers to the setpoint at the time of the measurement, not to the present one, and for a sensor with a
    # known delay or lag to the setpoint as that sensor would tell it, see `slpi_ros.model.sensor.Sensed`.
    def __init__(
        self,
        gains: PidGains,
        limits: Limits,
        voltage: float = 0.0,
        *,
        release_time: float = 0.1,
        longest_gap: float = 0.1,
        correction_limit: float = inf,
    ) -> None:
        if not isfinite(voltage):
            raise UsageError(f"voltage at the start is {voltage} V; give the present voltage")
        if not release_time > 0.0:
            raise UsageError(f"release_time is {release_time} s; give a positive value")
        if not 0.0 < longest_gap < inf:
            raise UsageError(f"longest_gap is {longest_gap} s; give a positive, finite value")
        self.pace = RateLimiter(limits, MAX_DT / 2, voltage)  # a compensator sets that of its output
        self.acting = False  # whether a recent measurement corrected the last `step`
        self.correction_limit = correction_limit  # V, in each direction
        self._gains = gains
        self._release_time = release_time
        self._longest_gap = longest_gap  # s; longer intervals count as this long
        self._enabled = False
        self._taking_over = False
        self._t = -inf
        self._correction = 0.0
        self._integral = 0.0
        self._offset = 0.0
        self._measured_at = -inf
        self._measured = 0.0
        self._error = 0.0
        self._rate = 0.0
        # Last measurement (m), its time (ns), and the setpoint (m) at that time.
        self._latest: tuple[float, int, float | None] | None = None
        # Time of the last measurement that was used, nanoseconds.
        self._latest_ns: int | None = None
        self._desired: float | None = None
        self._begun_ns = 0

    @property
    def limits(self) -> Limits:
        """Limits of the total voltage."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.pace.limits = limits

    @property
    def enabled(self) -> bool:
        """Whether measurements correct the voltage."""
        return self._enabled

    @property
    def gains(self) -> PidGains:
        """Present gains."""
        return self._gains

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self.pace.voltage

    @property
    def correction(self) -> float:
        """Correction added to the feedforward voltage, volts, after clipping to its limit and the voltage limits."""
        return self._correction

    @property
    def saturated(self) -> bool:
        """Whether the correction is at its limit."""
        return abs(self._correction) >= self.correction_limit

    def enable(self) -> None:
        """Enable the PID without a voltage step at the next measurement; no effect if it is enabled already."""
        if not self._enabled:
            self._enabled = self._taking_over = True

    def disable(self) -> None:
        """Disable the PID; the correction decays with `release_time`."""
        self._enabled = False

    def forget(self) -> None:
        """Discard the last measurement; the PID restarts without a voltage step at the next one."""
        self._error = self._rate = 0.0
        self._measured_at = -inf
        self._taking_over = self._enabled

    def retune(self, gains: PidGains) -> None:
        """Replace the gains without a voltage step, or raise and keep them if they give no finite voltage."""
        before, after = (self._direct(each, self._error, self._rate) for each in (self._gains, gains))
        offset = self._offset + (before - after)
        if not isfinite(offset):
            raise UsageError(f"{gains} give no finite voltage; check their units")
        self._gains, self._offset = gains, offset

    def correct(
        self, t: float, desired: float, measured: float, feedforward: float, now_ns: int | None = None
    ) -> float:
        """Return the voltage (V) for desired and measured displacement (m), within all limits, or raise unchanged."""
        # `t` (s) is not before the last one; `now_ns` is on the clock of `pace`, by default `t`.
        now_ns = self._check(t, feedforward, now_ns)
        elapsed = t - self._measured_at
        error, rate = desired - measured, self._next_rate(elapsed, measured)
        direct = self._direct(self._gains, error, rate)
        if not isfinite(direct):
            raise UsageError(f"desired {desired} m, measured {measured} m gives no finite voltage; hold the sample")
        if self._enabled:
            low, high = self.pace.reach(now_ns)
            most = self.correction_limit
            reach = max(low, min(feedforward - most, high)), min(high, max(feedforward + most, low))
            integral, offset = self._next_integral_and_offset(elapsed, error, direct, feedforward, reach)
            self._output(t, feedforward, direct + offset + integral, now_ns)
            self._integral, self._offset, self._taking_over = integral, offset, False
        else:
            self._output(t, feedforward, self._without_measurement(t), now_ns)
        self._error, self._rate = error, rate
        if elapsed > 0.0:
            self._measured_at, self._measured = t, measured
        return self.voltage

    def hold(self, t: float, feedforward: float, now_ns: int | None = None) -> float:
        """Return the voltage (V) without measurement, or raise unchanged: the correction is kept, or decays."""
        now_ns = self._check(t, feedforward, now_ns)
        self._output(t, feedforward, self._without_measurement(t), now_ns)
        return self.voltage

    def measure(self, displacement: float, now_ns: int, desired: float | None = None) -> None:
        """Store a displacement (m), and the setpoint it refers to as the sensor would tell it; default: the last."""
        self._latest = displacement, now_ns, self._desired if desired is None else desired

    def begin(self, now_ns: int) -> None:
        """Begin at `now_ns` (steady clock), without a correction."""
        self._begun_ns = now_ns
        self.hold(0.0, self.voltage)

    def step(self, desired: float, feedforward: float, now_ns: int, timeout: float | None) -> float:
        """Return the voltage (V), corrected by the last measurement unless it is used or older than `timeout` (s).

        None: with the present correction, as it is not time for another one.
        """
        t = (now_ns - self._begun_ns) * 1e-9
        self._desired = desired
        if timeout is None:
            return self.hold(t, feedforward, now_ns)
        latest, self._latest = self._latest, None
        if latest is not None:
            self._latest_ns = latest[1]
        # Between two measurements the correction is held.
        self.acting = self._latest_ns is not None and (now_ns - self._latest_ns) * 1e-9 <= timeout
        if latest and self.acting:
            aim = desired if latest[2] is None else latest[2]
            try:
                return self.correct(t, aim, latest[0], feedforward, now_ns)
            except SlpiError:
                # A measurement that gives no finite voltage is ignored.
                self._latest_ns, self.acting = None, False
        return self.hold(t, feedforward, now_ns)

    def _check(self, t: float, feedforward: float, now_ns: int | None) -> int:
        """Return the time (ns) on the clock of `pace`; raise UsageError if the sample is not valid."""
        if not (isfinite(t) and isfinite(feedforward)):
            raise UsageError(f"sample t = {t} s, feedforward = {feedforward} V is not finite; omit the sample")
        if t < self._t:
            raise UsageError(f"time runs backwards: {t:.9g} s after {self._t:.9g} s; send samples in order")
        if now_ns is None:
            # Rate limits count from the last sample, whether the voltage changed or not; before the first, no time.
            now_ns = nanoseconds(t)
            self.pace.begin(now_ns if self._t == -inf else nanoseconds(self._t))
        return now_ns

    def _next_rate(self, elapsed: float, measured: float) -> float:
        """Return the low-pass filtered rate (m/s) of the measured displacement, exact for any sampling period."""
        if elapsed == 0.0:
            return self._rate
        # At the first measurement the elapsed time is infinite and the slope is 0.
        slope = (measured - self._measured) / elapsed
        time_constant = self._gains.derivative_filter
        if time_constant == 0.0:
            return slope
        return self._rate - (slope - self._rate) * expm1(-elapsed / time_constant)

    def _next_integral_and_offset(
        self, elapsed: float, error: float, direct: float, feedforward: float, reach: tuple[float, float]
    ) -> tuple[float, float]:
        """Return the next integral and offset (V); when enabled, both are set such that the correction is unchanged."""
        if self._taking_over:
            return self._correction, -direct
        dt = min(elapsed, self._longest_gap)
        offset = self._offset * exp(-dt / self._release_time)
        wanted = feedforward + direct + offset + self._integral
        step = self._gains.integral * error * dt
        return self._integral + part_within(step, reach[0] - wanted, reach[1] - wanted), offset

    @staticmethod
    def _direct(gains: PidGains, error: float, rate: float) -> float:
        return gains.proportional * error - gains.derivative * rate

    def _without_measurement(self, t: float) -> float:
        """Return the correction (V) for a sample without measurement at time `t` (s)."""
        if self._enabled:
            return self._correction
        return self._correction * exp(-min(t - self._t, self._longest_gap) / self._release_time)

    def _output(self, t: float, feedforward: float, correction: float, now_ns: int) -> None:
        """Move to `feedforward` + `correction` (V) as far as all limits allow."""
        correction = min(max(correction, -self.correction_limit), self.correction_limit)
        wanted = feedforward + correction
        if not isfinite(wanted):
            raise UsageError(f"feedforward {feedforward} V, correction {correction} V is not finite; check the gains")
        limits = self.pace.limits
        self.pace.step(limits.clip(wanted), now_ns)
        self._t = t
        # A correction beyond the voltage limits is discarded, so that it does not have to decay later.
        self._correction = part_within(correction, limits.lower - feedforward, limits.upper - feedforward)


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
    __slots__ = ("_before", "_expected", "_next", "_residuals", "_samples")

    def __init__(self, expected: float) -> None:
        self._residuals = array("d", bytes(8 * WINDOW))
        self._samples = self._next = 0
        self._before = self._expected = expected

    def expect(self, displacement: float) -> None:
        """Store the model displacement (m) for the voltage applied from now on."""
        self._before, self._expected = self._expected, displacement

    def measure(self, displacement: float) -> None:
        """Store the residual of a measured displacement (m)."""
        low, high = self._before, self._expected
        if low > high:
            low, high = high, low
        outside = displacement - min(max(displacement, low), high)
        self._residuals[self._next] = outside
        self._next = (self._next + 1) % WINDOW
        self._samples = min(self._samples + 1, WINDOW)

    def forget(self, expected: float) -> None:
        """Discard all residuals: the model or its state has changed, its displacement is now `expected` (m)."""
        self._samples = self._next = 0
        self._before = self._expected = expected

    def drift(self) -> Drift | None:
        """Return the statistics of the window; None with fewer than `ENOUGH` measurements."""
        if self._samples < ENOUGH:
            return None
        residuals = self._residuals[: self._samples]
        count = len(residuals)
        return Drift(sqrt(sum(r * r for r in residuals) / count), sum(residuals) / count, count)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the feedback of one axis."""

    enabled: bool  # if not, measurements are used for the diagnostics only
    gains: PidGains
    timeout: float  # s, the age from which measurements are ignored
    correction_limit: float = inf  # V
