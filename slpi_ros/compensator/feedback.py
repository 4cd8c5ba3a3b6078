"""Feedback of one axis: feedforward and PID together (second paper, Fig. 12), and how far the model is off."""

from array import array
from dataclasses import dataclass, fields
from math import exp, expm1, inf, isfinite, sqrt

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.model.limits import Limits, RateLimiter

# Measurements that the residuals are kept of.
WINDOW = 500
# Fewer than these say nothing.
ENOUGH = 50


@dataclass(frozen=True)
class PidGains:
    """Gains of the feedback, for a stage whose displacement grows with its voltage.

    Parameters
    ----------
    proportional : float, V/m
    integral : float, V/(m s)
    derivative : float, V s/m
        Acts on the measured displacement, not on the desired one.
    derivative_filter : float, seconds
        Time constant of the low-pass on the derivative; 0: none.

    Raises
    ------
    UsageError
        If one is negative or not finite.
    """

    proportional: float
    integral: float = 0.0
    derivative: float = 0.0
    derivative_filter: float = 0.0

    def __post_init__(self) -> None:
        """Refuse gains that make no controller."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value >= 0.0):
                raise UsageError(f"PID gain {field.name} is {value}; give a finite one that is not negative")


class Feedback:
    """Feedforward + PID of one axis: ``v = correct(t, desired, measured, feedforward)``; it starts disabled.

    Enabling, disabling and retuning make no jump: what would jump becomes an offset, which fades with `release_time`.
    So the error at the moment of enabling comes in softly, and at last in full.

    The integral grows only as far as the voltage can follow (conditional integration): unlike back-calculation, this
    forgets nothing it has learnt while the voltage is on its way, slew limited, to a distant feedforward.

    `step` does what `correct` and `hold` do, with the last measurement that `measure` was told: it acts once, and only
    while it is fresh. What counts is how far it was from what was desired when it came: what is desired now, nobody can
    have measured yet.

    Parameters
    ----------
    gains : PidGains
    limits : Limits
        Of the total voltage. They may be replaced at any time; a voltage outside of them goes inside as `RateLimiter`
        lets it, here as everywhere: as fast as slew and acceleration allow, and no faster.
    voltage : float, volts
        What the axis has at the start.
    release_time : float, seconds
        inf: the offset, or the correction of a disabled feedback, stays.
    longest_gap : float, seconds
        A longer gap between samples counts as this long where time is integrated: integral and fading.

    Attributes
    ----------
    pace : RateLimiter
        Of the total voltage.
    acting : bool
        Whether the last `step` had a measurement to act on.

    Raises
    ------
    UsageError
        If `voltage` is not finite, or a time is not positive.
    """

    def __init__(
        self,
        gains: PidGains,
        limits: Limits,
        voltage: float = 0.0,
        *,
        release_time: float = 0.1,
        longest_gap: float = 0.1,
    ) -> None:
        if not isfinite(voltage):
            raise UsageError(f"voltage at the start is {voltage} V; give the present one")
        if not release_time > 0.0:
            raise UsageError(f"release_time is {release_time} s; give a positive one")
        if not 0.0 < longest_gap < inf:
            raise UsageError(f"longest_gap is {longest_gap} s; give a positive, finite one")
        self.pace = RateLimiter(limits)
        self.acting = False
        self._gains = gains
        self._release_time = release_time
        self._longest_gap = longest_gap
        self._enabled = False
        self._taking_over = False
        self._t = -inf
        self._voltage = self._goal = voltage
        self._correction = 0.0
        self._integral = 0.0
        self._offset = 0.0
        self._measured_at = -inf
        self._measured = 0.0
        self._error = 0.0
        self._rate = 0.0
        # What `measure` was told last, when, and what was desired then.
        self._latest: tuple[float, int, float | None] | None = None
        self._desired: float | None = None

    @property
    def limits(self) -> Limits:
        """Limits of the total voltage."""
        return self.pace.limits

    @limits.setter
    def limits(self, limits: Limits) -> None:
        self.pace.limits = limits

    @property
    def enabled(self) -> bool:
        """Whether measurements act on the voltage."""
        return self._enabled

    @property
    def gains(self) -> PidGains:
        """Present gains."""
        return self._gains

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._voltage

    @property
    def correction(self) -> float:
        """What is added to the feedforward voltage, volts, as far as the voltage limits leave room for it."""
        return self._correction

    def enable(self) -> None:
        """Let the next measurement take over from the present correction; without effect when enabled."""
        if not self._enabled:
            self._enabled = self._taking_over = True

    def disable(self) -> None:
        """Let the correction fade from here on."""
        self._enabled = False

    def forget(self) -> None:
        """Forget the last measurement: the next one takes over from the present correction."""
        self._error = self._rate = 0.0
        self._measured_at = -inf
        self._taking_over = self._enabled

    def retune(self, gains: PidGains) -> None:
        """Go on with other gains.

        Raises
        ------
        UsageError
            If they are beyond reason; the ones before stay.
        """
        before, after = (self._direct(each, self._error, self._rate) for each in (self._gains, gains))
        offset = self._offset + (before - after)
        if not isfinite(offset):
            raise UsageError(f"{gains} give no finite voltage; check their units")
        self._gains, self._offset = gains, offset

    def correct(self, t: float, desired: float, measured: float, feedforward: float) -> float:
        """Return the voltage for a sample with a measurement.

        Parameters
        ----------
        t : float, seconds
            Not before the last sample.
        desired, measured : float, metres
        feedforward : float, volts
            What the inverse model gives for `desired`.

        Returns
        -------
        float, volts
            Within the limits, and within their slew of the last one.

        Raises
        ------
        UsageError
            If time runs backwards, or something is not finite. Nothing has moved then: `hold` may serve the sample.
        """
        self._check(t, feedforward)
        elapsed = t - self._measured_at
        error, rate = desired - measured, self._next_rate(elapsed, measured)
        direct = self._direct(self._gains, error, rate)
        if not isfinite(direct):
            raise UsageError(f"desired {desired} m, measured {measured} m gives no finite voltage; hold the sample")
        if self._enabled:
            reach = self.pace.reach(self._voltage, self._dt(t))
            integral, offset = self._next_integral_and_offset(elapsed, error, direct, feedforward, reach)
            self._give(t, feedforward, direct + offset + integral)
            self._integral, self._offset, self._taking_over = integral, offset, False
        else:
            self._give(t, feedforward, self._without_measurement(t))
        self._error, self._rate = error, rate
        if elapsed > 0.0:
            self._measured_at, self._measured = t, measured
        return self._voltage

    def hold(self, t: float, feedforward: float) -> float:
        """Return the voltage (V) for a sample without a measurement: the correction is kept, or fades when disabled.

        Raises
        ------
        UsageError
            If time (s) runs backwards, or something is not finite; nothing has moved then.
        """
        self._check(t, feedforward)
        self._give(t, feedforward, self._without_measurement(t))
        return self._voltage

    def measure(self, displacement: float, now_ns: int) -> None:
        """Note a measurement (m) that came at `now_ns` (ns, a clock that never jumps), for the next `step`."""
        self._latest = displacement, now_ns, self._desired

    def step(self, dt: float, desired: float, feedforward: float, now_ns: int, timeout: float) -> float:
        """Return the voltage (V) for a sample, corrected by the last measurement while that is fresh.

        Parameters
        ----------
        dt : float, seconds
            Since the last sample.
        desired : float, metres
        feedforward : float, volts
        now_ns : int, nanoseconds
            On the clock of `measure`.
        timeout : float, seconds
            An older measurement does not act; the correction stays.
        """
        t = self._t + dt if self._t > -inf else 0.0
        latest, self._latest = self._latest, None
        self.acting = latest is not None and (now_ns - latest[1]) * 1e-9 <= timeout
        self._desired = desired
        if latest and self.acting:
            aim = desired if latest[2] is None else latest[2]
            try:
                return self.correct(t, aim, latest[0], feedforward)
            except SlpiError:
                # A measurement beyond reason is none.
                self.acting = False
        return self.hold(t, feedforward)

    def _check(self, t: float, feedforward: float) -> None:
        if not (isfinite(t) and isfinite(feedforward)):
            raise UsageError(f"sample t = {t} s, feedforward = {feedforward} V is not finite; leave it out")
        if t < self._t:
            raise UsageError(f"time runs backwards: {t:.9g} s after {self._t:.9g} s; send samples in order")

    def _next_rate(self, elapsed: float, measured: float) -> float:
        """Low-pass the slope (m/s) of the line between two measurements: exact for whatever time is between them."""
        if elapsed == 0.0:
            return self._rate
        # At the first measurement an endless time has elapsed: the slope is 0.
        slope = (measured - self._measured) / elapsed
        time_constant = self._gains.derivative_filter
        if time_constant == 0.0:
            return slope
        return self._rate - (slope - self._rate) * expm1(-elapsed / time_constant)

    def _next_integral_and_offset(
        self, elapsed: float, error: float, direct: float, feedforward: float, reach: tuple[float, float]
    ) -> tuple[float, float]:
        """Return both (V); at the moment of taking over they leave the correction as it is."""
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
        """Return the correction that needs none."""
        if self._enabled:
            return self._correction
        return self._correction * exp(-min(t - self._t, self._longest_gap) / self._release_time)

    def _dt(self, t: float) -> float:
        """Return the time (s) since the last sample; at the first one none has passed, and the voltage stays."""
        return t - self._t if self._t > -inf else 0.0

    def _give(self, t: float, feedforward: float, correction: float) -> None:
        """Move to the voltage nearest to `feedforward` and `correction` together."""
        wanted = feedforward + correction
        if not isfinite(wanted):
            raise UsageError(f"feedforward {feedforward} V, correction {correction} V is not finite; check the gains")
        limits = self.pace.limits
        goal = limits.clip(wanted)
        self._voltage = self.pace.step(self._voltage, goal, self._dt(t), self._goal)
        self._t, self._goal = t, goal
        # Else a correction that no voltage ever showed would have to fade before one that did.
        self._correction = part_within(correction, limits.lower - feedforward, limits.upper - feedforward)


def part_within(step: float, low: float, high: float) -> float:
    """Return as much of `step` as leads no farther than `low` or `high`; none of it where it leads away from both."""
    return min(max(step, min(low, 0.0)), max(high, 0.0))


@dataclass(frozen=True)
class Drift:
    """How far measurements are off the model.

    Parameters
    ----------
    rms : float, metres
        Of the residual, over the last `WINDOW` measurements.
    mean : float, metres
        Of what was measured minus what was expected.
    samples : int
        Measurements in the window.
    """

    rms: float
    mean: float
    samples: int


class ResidualWindow:
    """The residuals of the last `WINDOW` measurements.

    A stage answers a little later than it is told. So what counts is how far a measurement lies outside of what the
    model expected at the last two samples, and between them: at rest that is the whole residual.
    """

    __slots__ = ("_before", "_expected", "_next", "_residuals", "_samples")

    def __init__(self, expected: float) -> None:
        self._residuals = array("d", bytes(8 * WINDOW))
        self._samples = self._next = 0
        self._before = self._expected = expected

    def expect(self, displacement: float) -> None:
        """Note what the model gives (m) for the voltage that is applied from now on."""
        self._before, self._expected = self._expected, displacement

    def measure(self, displacement: float) -> None:
        """Note what was measured (m)."""
        low, high = self._before, self._expected
        if low > high:
            low, high = high, low
        outside = displacement - min(max(displacement, low), high)
        self._residuals[self._next] = outside
        self._next = (self._next + 1) % WINDOW
        self._samples = min(self._samples + 1, WINDOW)

    def forget(self, expected: float) -> None:
        """Start anew: another model, or another memory."""
        self._samples = self._next = 0
        self._before = self._expected = expected

    def drift(self) -> Drift | None:
        """Return what the window says; None when it holds too little."""
        if self._samples < ENOUGH:
            return None
        residuals = self._residuals[: self._samples]
        count = len(residuals)
        return Drift(sqrt(sum(r * r for r in residuals) / count), sum(residuals) / count, count)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the feedback of one axis.

    Parameters
    ----------
    enabled : bool
        Whether measurements act on the voltage; if not, they only serve the health.
    gains : PidGains
    timeout : float, seconds
        An older measurement does not act.
    """

    enabled: bool
    gains: PidGains
    timeout: float
