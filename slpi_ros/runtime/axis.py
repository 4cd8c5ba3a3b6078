"""One axis at run time: its stamps, its limits, its model and memory, and the closed loop if there is one."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isfinite
from time import monotonic

from slpi_ros.errors import UsageError
from slpi_ros.model import AxisModel
from slpi_ros.runtime.clock import Stamps
from slpi_ros.runtime.health import Drift
from slpi_ros.runtime.loop import ClosedLoop, LoopSettings
from slpi_ros.runtime.ramp import Ramp
from slpi_ros.runtime.rejection import NOT_FINITE, OUT_OF_RANGE, RejectedError
from slpi_ros.runtime.swap import including, replay, take_over, turning_voltages, whole_way
from slpi_ros.stream import AxisStream, Limits, refusal

# What the memory is worth: nobody knows where the stage has been; being wiped; wiped since; kept over a restart.
ASSUMED, RESETTING, KNOWN, RESTORED = "assumed", "resetting", "known", "restored"


class Axis:
    """One axis.

    Parameters
    ----------
    name : str
    place : int
        Of its voltage among those of all axes.
    limits : Limits
        No model widens them.
    loop_settings : LoopSettings
    now : callable
        A clock that never jumps, seconds.

    Attributes
    ----------
    model : AxisModel or None
    stream : AxisStream
        Its feedforward; there once a model is.
    memory_state : str
        `ASSUMED`, `RESETTING`, `KNOWN` or `RESTORED`.
    driven : bool
        Whether it has had a model: before, nobody knows what voltage it has.
    held : bool
        Whether the last sample waits at a voltage limit.
    slewing : bool
        Whether the last sample is still on its way.
    """

    stream: AxisStream
    _ramp: Ramp

    def __init__(
        self, name: str, place: int, limits: Limits, loop_settings: LoopSettings, now: Callable[[], float] = monotonic
    ) -> None:
        self.name, self.place, self.limits = name, place, limits
        self.stamps = Stamps()
        self.model: AxisModel | None = None
        self.memory_state = ASSUMED
        self.held = self.slewing = False
        self._loop_settings = loop_settings
        self._loop: ClosedLoop | None = None
        self.driven = False
        self._now = now

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._loop.voltage if self._loop else self.stream.voltage

    @property
    def correction(self) -> float:
        """Part of the present voltage that comes from the feedback, volts."""
        return self._loop.correction if self._loop else 0.0

    @property
    def feedback(self) -> str:
        """What the feedback does: "off", "on", or "holding" where the last sample had no fresh measurement."""
        if not self._loop_settings.enabled:
            return "off"
        return "on" if self._loop and self._loop.acting else "holding"

    @property
    def drift(self) -> Drift | None:
        """What measurements say of the model; None while there are too few."""
        return self._loop.residuals.drift() if self._loop else None

    @property
    def went_through(self) -> tuple[float, ...]:
        """Voltages (V) at which the drive turned, oldest first, and last the present one."""
        return whole_way(self._loop.applied if self._loop else self.stream)

    def prepare(self, model: AxisModel, went_through: Sequence[float] | None = None) -> AxisStream:
        """Return the stream of a new model, for `use`.

        Parameters
        ----------
        model : AxisModel
        went_through : sequence of float, volts
            As `went_through` of this axis, which stands for None.

        Raises
        ------
        SlpiError
            If the model cannot serve.
        """
        if went_through is None:
            went_through = turning_voltages(self.stream.memory) if self.driven else ()
        return take_over(model, self.limits, went_through)

    def use(self, model: AxisModel, stream: AxisStream) -> None:
        """Go on with a new model; the voltage stays."""
        if self.driven:
            stream.resume(self.stream)
        self.model, self.stream, self.driven = model, stream, True
        if self._loop:
            memory = model.memory()
            replay(memory, turning_voltages(self._loop.applied.memory))
            limits = including(stream.limits, self._loop.voltage)
            applied = model.stream_from(memory, including(limits, memory.voltage))
            applied.resume(self._loop.applied)
            self._loop.swap(limits, applied)
        elif self._loop_settings.enabled:
            self._close_loop()

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
            if self._loop:
                self._loop.limit(including(allowed, self.voltage))

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

    def retune(self, settings: LoopSettings) -> None:
        """Go on with other settings of the closed loop, without a jump."""
        self._loop_settings = settings
        if self._loop:
            self._loop.retune(settings)
        elif settings.enabled and self.driven:
            self._close_loop()

    def check(self, y: float) -> None:
        """Reject a desired displacement (m) that is no number or far outside what the model was identified on.

        Raises
        ------
        RejectedError
            With the cause `not_finite` or `out_of_range`.
        """
        low, high = self.stream.accepted
        if low <= y <= high:
            return
        if not isfinite(y):
            raise RejectedError(NOT_FINITE, f"displacement is {y} m; send finite ones only")
        raise RejectedError(OUT_OF_RANGE, refusal(y, self.stream.accepted))

    def move(self, ahead: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `ahead` (s) after the last sample.

        Parameters
        ----------
        ahead : float, seconds
            Not more than 0: no time has passed. A pause frees no longer way than `LONGEST_STEP`.
        y : float, metres
        """
        stream = self.stream
        dt = stream.pace.counted(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.move(dt, y)
        if self._loop is not None:
            v = self._correct(ahead, dt, y, v)
        if stream.memory.displacement == stream.wish:
            self.held = self.slewing = False
        else:
            missed = stream.missed
            self.held = missed and stream.held
            self.slewing = missed and not self.held
        return v

    def follow(self, ahead: float, y: float, planned: float, planned_before: float) -> float:
        """Return the voltage (V) for a displacement `y` (m) whose voltage is planned.

        Parameters
        ----------
        ahead, y
            As in `move`.
        planned, planned_before : float, volts
            For this sample and the one before. The voltage comes as near as slew and acceleration allow.
        """
        stream = self.stream
        dt = stream.pace.counted(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.pace.step(stream.voltage, planned, dt, planned_before)
        stream.drive(v, dt)
        return self._correct(ahead, dt, y, v) if self._loop else v

    def measure(self, displacement: float) -> None:
        """Note a measured displacement (m)."""
        if not self.driven:
            return
        if self._loop is None:
            self._close_loop()
        self._loop.measure(displacement, self._now())  # type: ignore[union-attr]

    def start_drive(self, ramp: Ramp) -> None:
        """Leave the desired path, and go where a ramp leads with every `drive`."""
        if self._loop:
            self.stream.restore(replace(self._loop.applied.snapshot(), rate=self.stream.pace.rate))
        self._ramp = ramp

    @property
    def arrived(self) -> bool:
        """Whether the last drive has come to its end."""
        return self._ramp.done

    def drive(self, dt: float) -> bool:
        """Move on along the ramp, `dt` (s) later; return whether it has ended."""
        v = self._ramp.step(self.stream.voltage, dt, self.stream.pace)
        self.stream.drive(v, dt)
        if self._loop:
            self._loop.drive(v, dt)
        return self._ramp.done

    def stop_drive(self) -> None:
        """Take up desired displacements again, from where the axis is."""
        if self._loop:
            self._loop.settle()
        self.restart()

    def restart(self) -> None:
        """Let no time have passed at the next sample."""
        self.stamps.restart()
        if self.driven:
            self.stream.pace.rest()

    def _close_loop(self) -> None:
        stream = self.stream
        self._loop = ClosedLoop(self._loop_settings, including(stream.limits, stream.voltage), stream.twin())

    def _correct(self, ahead: float, dt: float, y: float, v: float) -> float:
        """Let measurements correct the voltage `v` (V)."""
        loop = self._loop
        assert loop
        loop.applied.coupled = self.stream.coupled
        if ahead > dt:
            loop.applied.wait(ahead - dt)
        return loop.correct(dt, y, v, self._now())
