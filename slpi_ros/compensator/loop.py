"""The closed loop of one axis: its measurements correct the voltage, and say how healthy the model is."""

from dataclasses import dataclass
from math import inf

from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.health import ResidualWindow
from slpi_ros.errors import SlpiError
from slpi_ros.model.stream import AxisStream, Limits, Pace


@dataclass(frozen=True)
class LoopSettings:
    """What the closed loop of one axis is told.

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


class ClosedLoop:
    """Feedback of one axis, and the model that follows the voltage it is really given.

    The inverse model's own memory follows the desired path, as if there were no correction: noise of the sensor must
    not turn it.

    Parameters
    ----------
    settings : LoopSettings
    limits : Limits
        Of the voltage in total.
    applied : AxisStream
        In its present state; owned by the loop from here on, which drives it.

    Attributes
    ----------
    applied : AxisStream
    pace : Pace
        Of the voltage in total.
    """

    def __init__(self, settings: LoopSettings, limits: Limits, applied: AxisStream) -> None:
        self.applied = applied
        self.residuals = ResidualWindow(applied.own)
        self._settings = settings
        self.pace = Pace(limits)
        self.pace.go_on(applied.pace)
        self._t, self._wanted = 0.0, applied.voltage
        self._desired: float | None
        self._aim: float | None
        self._start()

    @property
    def voltage(self) -> float:
        """Present voltage in total, volts."""
        return self.applied.voltage

    @property
    def correction(self) -> float:
        """Part of the present voltage that comes from the feedback, volts."""
        return self._feedback.correction

    @property
    def acting(self) -> bool:
        """Whether the last sample had a measurement to act on."""
        return self._acting

    def swap(self, limits: Limits, applied: AxisStream) -> None:
        """Go on with another model; the correction stays."""
        self.limit(limits)
        self.applied = applied
        self.residuals.forget(applied.own)

    def settle(self, pace: Pace) -> None:
        """Start anew where the axis is, going on at a pace, without a correction."""
        self.pace.go_on(pace)
        self._start()
        self.residuals.forget(self.applied.own)

    def retune(self, settings: LoopSettings) -> None:
        """Go on with other settings, without a jump."""
        self._settings = settings
        try:
            self._feedback.retune(settings.gains)
        except SlpiError:
            # The last measurement was beyond reason, which other gains did not show.
            self._feedback.forget()
            self._feedback.retune(settings.gains)
        if settings.enabled:
            self._feedback.enable()
        else:
            self._feedback.disable()

    def limit(self, limits: Limits) -> None:
        """Go on within other limits."""
        self._feedback.limits = self.pace.limits = limits

    def measure(self, displacement: float, now: float) -> None:
        """Note a finite measurement (m) that came at `now` (s): it shows what became of the last sample."""
        self._measured, self._measured_at, self._aim = displacement, now, self._desired
        self.residuals.measure(displacement)

    def correct(self, dt: float, desired: float, feedforward: float, now: float) -> float:
        """Return the voltage in total (V).

        A measurement acts once, and only while it is fresh; without one the correction stays. What counts is how far it
        was from what was desired when it came: what is desired now, nobody can have measured yet.

        Parameters
        ----------
        dt : float, seconds
            Since the last sample.
        desired : float, metres
        feedforward : float, volts
        now : float, seconds
            On the clock of `measure`.
        """
        self._t += dt
        before = self.applied.voltage
        self._acting = now - self._measured_at <= self._settings.timeout
        v = wanted = self._give(desired if self._aim is None else self._aim, feedforward)
        if self.pace.limits.acceleration < inf:
            v = self.pace.step(before, wanted, dt, self._wanted)
        self._wanted, self._desired = wanted, desired
        self._measured_at = -inf
        self.residuals.expect(self.applied.drive(v, dt))
        return v

    def drive(self, voltage: float, dt: float) -> None:
        """Go to a voltage (V), `dt` (s) after the last one, whatever is desired or measured."""
        self.residuals.expect(self.applied.drive(voltage, dt))

    def _start(self) -> None:
        """Forget corrections and measurements."""
        voltage = self.applied.voltage
        self._t, self._wanted = 0.0, voltage
        self._desired = self._aim = None
        self._measured, self._measured_at, self._acting = 0.0, -inf, False
        self._feedback = Feedback(self._settings.gains, self.pace.limits, voltage)
        self._feedback.hold(0.0, voltage)
        if self._settings.enabled:
            self._feedback.enable()

    def _give(self, desired: float, feedforward: float) -> float:
        if self._acting:
            try:
                return self._feedback.correct(self._t, desired, self._measured, feedforward)
            except SlpiError:
                # A measurement beyond reason is none.
                self._acting = False
        return self._feedback.hold(self._t, feedforward)
