"""Who owns the voltages of a stage: where they start, and whether somebody else moves it."""

from collections.abc import Mapping, Sequence

from slpi_ros.compensator.amplifier import MUTE_NS, STEADY_NS
from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.listening import Listening
from slpi_ros.compensator.monitor import Finding, Monitor
from slpi_ros.compensator.reporters import SoleReporter, WhoseStage
from slpi_ros.compensator.validation import NOT_ARMED, STARTING, RejectedError
from slpi_ros.model.limits import volts

# Start voltages: as reported, or else as saved or recorded; as reported only; as saved or recorded; or a number (V).
AUTO, MEASURED, SAVED = "auto", "measured", "saved"
STARTS = (AUTO, MEASURED, SAVED)
# A reported voltage this many voltage ranges beyond the limits is none of this amplifier.
BEYOND = 2.0


class Ownership:
    """Whether voltages may be output: it is this stage that reports, and nobody else moves it.

    `listening`, if there is one, may hold the first voltage back.
    """

    def __init__(
        self, axes: Sequence[Axis], starts: Sequence[str | float] = (), stage: WhoseStage | None = None
    ) -> None:
        self.left: Mapping[str, float] | None = None  # V, where this node left the stage, if that is known
        self.reporting = self.started = False  # ``stage_state`` has a publisher; a voltage was output
        self.obstacle: tuple[str, str] | None = None  # cause and reason why no voltage may be output
        self.notes: dict[str, str] = {}  # by axis: what is not certain about the voltage at the start
        self.stage = stage or WhoseStage()
        self.reporters = {axis.name: SoleReporter(axis.name) for axis in axes}
        self.listening: Listening | None = None
        # What they find stops the output until `arm`: who reports, and what.
        self.identity = Monitor(self.stage, *self.reporters.values())
        self.monitor = Monitor(*(axis.amplifier for axis in axes))
        self._axes = axes
        self._starts = list(starts) or [AUTO] * len(axes)  # `AUTO`, `MEASURED`, `SAVED`, or volts
        self.begun_ns = 0  # when the output began
        self._since_ns, self._heard_ns, self._ever = 0, 0, False

    @property
    def armed(self) -> bool:
        """Whether nobody else moves the stage, as far as is known."""
        return self.obstacle is None or self.obstacle[0] != NOT_ARMED

    @property
    def owned(self) -> bool:
        """Whether voltages are being output."""
        return self.started and self.obstacle is None

    def hear(self, now_ns: int) -> None:
        """Take that `stage_state` has come."""
        self._heard_ns = self._heard_ns or now_ns

    def await_start(self, now_ns: int) -> None:
        """Find the voltages anew before the next output."""
        self.started, self._since_ns, self._heard_ns = False, now_ns, 0
        self.obstacle = STARTING, "the voltages at the start are not known yet; send it again"

    def locate(self, now_ns: int) -> None:
        """Move the axes of the model to where their amplifiers are found, once it is known who is there."""
        if self.listening and any(axis.amplifier.moves(now_ns) for axis in self._axes):
            # Somebody commands it whom the middleware may not have found yet.
            self.listening.hear(now_ns)
        if self.listening:
            self.listening.thorough = not self._is_as_left(now_ns)
        if found := self._stranger(now_ns) or (self.listening and self.listening.check(now_ns)):
            self.obstacle = STARTING, str(found)
            return
        missing = ""
        for axis, start in zip(self._axes, self._starts, strict=True):
            at, self.notes[axis.name] = self._find(axis, start, now_ns)
            if at is None:
                missing = missing or f"axis '{axis.name}': {self.notes[axis.name]}"
                continue
            axis.locate(at, now_ns)
        self.obstacle = (STARTING, missing) if missing else None

    def _is_as_left(self, now_ns: int) -> bool:
        """Return whether the amplifiers are where this node left them: nobody else has moved the stage since."""
        found = [(axis, axis.amplifier.found(now_ns, self._since_ns)) for axis in self._axes]
        left = self.left or {}
        return all(
            v is not None and axis.name in left and abs(v - left[axis.name]) <= axis.amplifier.tolerance()
            for axis, v in found
        )

    def _find(self, axis: Axis, start: str | float, now_ns: int) -> tuple[float | None, str]:
        """Return the voltage (V) at which an axis starts, and what is not certain about it; None: not known yet."""
        v = axis.voltage
        if isinstance(start, float):
            # Later, the voltage of this node is known better.
            return (v if self._ever else start), ""
        if start == SAVED:
            return v, ""
        found = axis.amplifier.found(now_ns, self._since_ns)
        if found is not None:
            if reason := self._impossible(axis, found):
                return None, reason
            # The last output is known better than a noisy report of it.
            same = self._ever and abs(found - v) <= axis.amplifier.scatter
            return (v if same else found), ""
        # Of a publisher that has said nothing it is not known what it reports.
        mute = self._heard_ns and now_ns - self._heard_ns >= MUTE_NS and axis.amplifier.latest is None
        awaited = self.reporting and not mute
        if start == MEASURED or awaited:
            return None, (
                "waiting for the voltage of the amplifier (effort of stage_state); check its driver, or set "
                "start_voltage"
            )
        if self._ever:
            return v, ""
        why, at, checked = "nobody reports the voltage of the amplifier (effort of stage_state)", volts(v), "that"
        if self.reporting:
            why, at, checked = "stage_state holds no usable voltage of this axis (effort)", f"{v:.4g}", "the driver"
        taken = f"it is taken to be at {at} V: check {checked} before you send anything, or set start_voltage"
        return v, f"{why}; {taken}"

    def begin_output(self, now_ns: int) -> None:
        """Find the voltages at the start once more, and take them to be those of the amplifiers, or reject."""
        if not self.started and self.armed:
            self.locate(now_ns)
        if self.obstacle:
            raise RejectedError(*self.obstacle)
        if not self.started:
            self.started, self._ever, self.begun_ns = True, True, now_ns
            for axis in self._axes:
                self._take(axis, now_ns)

    def lost(self, now_ns: int) -> bool:
        """Return whether somebody else has begun to move or to report an axis; nothing is then output until `arm`."""
        if not (self.started and self.armed):
            return False
        found = self._stranger(now_ns) or (self.listening and self.listening.heard_since(self.begun_ns))
        if found and self.listening and self.listening.on:
            # Somebody who was there before and is found only now, or who has begun at the same time.
            self.listening.give_way(now_ns)
            self.await_start(now_ns)
            return True
        if not found:
            self.monitor.check(now_ns)
            found = next(iter(self.monitor.standing), None)
        if found:
            self.obstacle = NOT_ARMED, str(found)
        return bool(found)

    def _stranger(self, now_ns: int) -> Finding | None:
        """Return that another stage reports, or somebody else does."""
        self.identity.check(now_ns)
        return next(iter(self.identity.standing), None)

    def arm(self, now_ns: int, steady_ns: int = STEADY_NS) -> str:
        """Continue from the steady voltages that are reported; return the reason if there are none, else ""."""
        if stranger := self._stranger(now_ns):
            return str(stranger)
        found: list[float] = []
        for axis in self._axes:
            voltage = axis.amplifier.steady(now_ns, steady_ns)
            if voltage is None:
                return f"axis '{axis.name}': stage_state reports no steady voltage (effort); stop what moves the stage"
            if reason := self._impossible(axis, voltage):
                return f"axis '{axis.name}': {reason}"
            found.append(voltage)
        self.begun_ns = now_ns
        for axis, voltage in zip(self._axes, found, strict=True):
            # The last output of an axis that nobody moved is known better than a noisy report of it.
            if axis.amplifier.foreign or abs(voltage - axis.voltage) > axis.amplifier.scatter:
                axis.locate(voltage, now_ns)
            self._take(axis, now_ns)
        self.obstacle = None
        return ""

    @staticmethod
    def _impossible(axis: Axis, voltage: float) -> str:
        """Return why no amplifier of these limits can be at a voltage (V): `BEYOND` ranges outside; "" if it can."""
        margin = BEYOND * axis.limits.span
        if axis.limits.lower - margin <= voltage <= axis.limits.upper + margin:
            return ""
        return (
            f"stage_state reports {voltage:.6g} V (effort), more than {BEYOND:g} voltage ranges beyond the limits; "
            "correct its unit, or the limits"
        )

    @staticmethod
    def _take(axis: Axis, now_ns: int) -> None:
        """Take the voltage of an axis to be that of its amplifier from now on."""
        axis.rest(now_ns)
        axis.amplifier.begin(axis.voltage, now_ns)
        axis.return_inside(now_ns)
