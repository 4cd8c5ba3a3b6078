"""One axis at run time: its stamps, its limits, its model and memory, and the closed loop if there is one."""

from collections.abc import Callable, Sequence
from time import monotonic

from slpi_ros.compensator.feedback import ClosedLoop, Drift, LoopSettings
from slpi_ros.compensator.model_swap import go_on, including, take_over, turning_voltages, whole_way
from slpi_ros.compensator.persistence import MemoryConfidence
from slpi_ros.compensator.ramps import Brake, Ramp
from slpi_ros.compensator.validation import Stamps, implausible
from slpi_ros.errors import UsageError
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import Limits
from slpi_ros.model.streaming import StreamingInverse


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
    trust : MemoryTrust
        What the memory is worth.
    driven : bool
        Whether it has had a model: before, nobody knows what voltage it has.
    on_ramp : bool
        Whether it is driven on its own.
    held, slewing : bool
        Whether the last sample waits at a voltage limit, or is still on its way.
    """

    stream: StreamingInverse
    _ramp: Ramp | Brake

    def __init__(
        self, name: str, place: int, limits: Limits, loop_settings: LoopSettings, now: Callable[[], float] = monotonic
    ) -> None:
        self.name, self.place, self.limits = name, place, limits
        self.stamps = Stamps()
        self.model: AxisModel | None = None
        self.trust = MemoryConfidence()
        self.held = self.slewing = False
        self._loop_settings = loop_settings
        self._loop: ClosedLoop | None = None
        self.driven = self.on_ramp = False
        self._given_at = 0.0
        self._now = now

    @property
    def voltage(self) -> float:
        """Present voltage, volts."""
        return self._loop.voltage if self._loop else self.stream.voltage

    @property
    def memory_state(self) -> str:
        """What the memory is worth, in a word."""
        return self.trust.state

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
    def reversal_voltages(self) -> tuple[float, ...]:
        """Voltages (V) at which the drive turned, oldest first, and last the present one."""
        return whole_way(self._loop.applied if self._loop else self.stream)

    def prepare(self, model: AxisModel, reversal_voltages: Sequence[float] | None = None) -> StreamingInverse:
        """Return the stream of a new model, for `use`.

        Parameters
        ----------
        model : AxisModel
        went_through : sequence of float, volts
            As `reversal_voltages` of this axis, which stands for None.

        Raises
        ------
        SlpiError
            If the model cannot serve.
        """
        if reversal_voltages is None:
            reversal_voltages = turning_voltages(self.stream.memory) if self.driven else ()
        return take_over(model, self.limits, reversal_voltages)

    def use(self, model: AxisModel, stream: StreamingInverse) -> None:
        """Go on with a new model; the voltage stays."""
        if self.driven:
            stream.resume(self.stream)
        self.model, self.stream, self.driven = model, stream, True
        self.trust = self.trust.over(model.voltage_range)
        if self._loop:
            self._loop.swap(*go_on(model, stream.limits, self._loop.applied))
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

    def move(self, ahead: float, y: float) -> float:
        """Return the voltage (V) for the desired displacement `y` (m), `ahead` (s) after the last sample.

        Parameters
        ----------
        ahead : float, seconds
            Not more than 0: no time has passed. A pause frees no longer way than `MAX_DT`.
        y : float, metres
        """
        stream = self.stream
        dt = stream.pace.clamp_dt(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.move(dt, y)
        if self._loop is not None:
            v = self._correct(ahead, dt, y, v)
        if stream.memory.displacement == stream.desired:
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
        dt = stream.pace.clamp_dt(ahead)
        if ahead > dt:
            stream.wait(ahead - dt)
        v = stream.pace.step(stream.voltage, planned, dt, planned_before)
        stream.drive(v, dt)
        return self._correct(ahead, dt, y, v) if self._loop else v

    def measure(self, displacement: float) -> None:
        """Note a measured displacement (m).

        Raises
        ------
        RejectedError
            As `check`; it is not used then.
        """
        if not self.driven:
            return
        self.check(displacement, "measured")
        if self._loop is None:
            self._close_loop()
        self._loop.measure(displacement, self._now())  # type: ignore[union-attr]

    @property
    def in_motion(self) -> bool:
        """Whether the limit of acceleration forbids to leave it where it is."""
        return self.driven and (self._loop if self._loop and not self.on_ramp else self.stream).pace.in_motion

    def start_drive(self, ramp: Ramp | Brake) -> None:
        """Leave the desired path, and go where a ramp leads with every `drive`."""
        if not self.on_ramp:
            self._given_at = self._now()
            if self._loop:
                self.stream.restore(self._loop.applied.snapshot())
                self.stream.pace.go_on(self._loop.pace)
        self._ramp, self.on_ramp = ramp, True

    def brake(self) -> None:
        """Come to rest with every `drive`, as gently as the limit of acceleration asks for."""
        if not (self.on_ramp and isinstance(self._ramp, Brake)):
            self.start_drive(Brake())

    @property
    def arrived(self) -> bool:
        """Whether the last drive has come to its end."""
        return self._ramp.done

    def drive(self, dt: float) -> bool:
        """Move on along the ramp, `dt` (s) later; return whether there is nowhere to go."""
        if not self.on_ramp:
            return True
        v = self._ramp.step(self.stream.voltage, dt, self.stream.pace)
        self.stream.drive(v, dt)
        if self._loop:
            self._loop.drive(v, dt)
        self._given_at = self._now()
        if self._ramp.done:
            self.stream.pace.rest()
        return self._ramp.done

    def stop_drive(self) -> None:
        """Take up desired displacements again, from where the axis is and as fast as it is; without effect when off."""
        if not self.on_ramp:
            return
        self.on_ramp = False
        if self._loop:
            self._loop.settle(self.stream.pace)
        # A voltage at rest has time; one in motion goes on.
        self.stamps.restart(self._now() - self._given_at if self.in_motion else 0.0)

    def rest(self) -> None:
        """Start from a voltage at rest at the next sample."""
        if self.driven:
            self.stream.pace.rest()
        if self._loop:
            self._loop.pace.rest()

    def _close_loop(self) -> None:
        stream = self.stream
        self._loop = ClosedLoop(self._loop_settings, including(stream.limits, stream.voltage), stream.copy())

    def _correct(self, ahead: float, dt: float, y: float, v: float) -> float:
        """Let measurements correct the voltage `v` (V)."""
        loop = self._loop
        assert loop
        loop.applied.coupled = self.stream.coupled
        if ahead > dt:
            loop.applied.wait(ahead - dt)
            loop.pace.rest()
        return loop.correct(dt, y, v, self._now())
