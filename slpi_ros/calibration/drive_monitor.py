"""What a stage reports during a drive, held against the voltages that it is commanded, without a model of the stage."""

from collections.abc import Sequence
from math import isfinite, isnan

from slpi_ros.calibration.drive_rules import RelationRule, StampRule, StateRule
from slpi_ros.compensator.amplifier import Amplifier, VoltageLimits
from slpi_ros.compensator.monitor import Monitor
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits

# A displacement beyond this is none in metres.
FARTHEST = 0.1
# Reported voltages may be late by this share of the longest silence that is allowed.
LATE = 0.6
# Time of one step of the monitor that counts, ns: a process that was held up has not heard what was said.
MOST_STEP_NS = SECOND_NS // 20
# Stamps may depart from the clock by this more than at the begin, seconds; of a simulated clock by that.
JUMP, JUMP_SIMULATED = 0.5, 2.0


class DriveMonitor:
    """Hold the states of a stage against the voltages of a drive: a monitor of each axis, and one of the states.

    Of the time (steady clock, ns) between two calls at most 0.05 s count: a process that was held up does not take what
    it has not read yet for silence. Reported voltages may be late by `LATE` of `timeout` (s), the longest time without
    a valid state.
    """

    def __init__(
        self, axes: Sequence[str], limits: Sequence[Limits], timeout: float, *, simulated: bool = False
    ) -> None:
        self.fault = ""  # the first fault, with axis, value and limit
        self._axes = tuple(axes)
        self._stamps, self._states = StampRule(JUMP_SIMULATED if simulated else JUMP), StateRule(timeout)
        voltages = VoltageLimits(window_ns=int(LATE * timeout * SECOND_NS), then="")
        self._amplifiers = [Amplifier(each.span, voltages, axis) for axis, each in zip(axes, limits, strict=True)]
        self._relations = [RelationRule(each, axis) for axis, each in zip(axes, limits, strict=True)]
        self._each = [Monitor(*rules) for rules in zip(self._amplifiers, self._relations, strict=True)]
        self._monitors = (Monitor(self._stamps), *self._each, Monitor(self._states))
        self._now_ns, self._last_ns = 0, -1

    @property
    def refused(self) -> str:
        """Why the last state was not valid; "" if it was, or none has come."""
        return self._states.refused

    def begin(self, voltages: Sequence[float], now_ns: int) -> None:
        """Begin a drive from the given voltages (V); what was learned in earlier drives of the run stays."""
        self._attend(now_ns)
        self._states.begin(self._now_ns)
        self._stamps.begin()
        for amplifier, relation, v in zip(self._amplifiers, self._relations, voltages, strict=True):
            amplifier.begin(v, self._now_ns)
            relation.begin()

    def end(self) -> None:
        """End a drive: states are taken, but not held against anything."""
        self._states.driving = False
        for amplifier in self._amplifiers:
            amplifier.forget_output()

    def command(self, voltages: Sequence[float], now_ns: int) -> None:
        """Take voltages (V) that are published."""
        self._attend(now_ns)
        for monitor, v in zip(self._each, voltages, strict=True):
            monitor.output(v, self._now_ns)

    def started_from(self, now_ns: int, since_ns: int) -> list[float] | None:
        """Return the voltages (V) at which the amplifier is, of reports awaited since `since_ns`; None if unknown."""
        late = self._now_ns - (now_ns - since_ns)
        found = [amplifier.found(self._now_ns, late) for amplifier in self._amplifiers]
        known = [v for v in found if v is not None]
        return known if len(known) == len(found) else None

    def moves(self) -> bool:
        """Return whether the voltage of an axis moves, by the reports of the last second."""
        return any(amplifier.moves(self._now_ns) for amplifier in self._amplifiers)

    def refusal(self, v: Sequence[float], y: Sequence[float]) -> str:
        """Return which rule a state breaks, voltages `v` (V) and displacements `y` (m), with value and limit; or ""."""
        for axis, voltage, reading in zip(self._axes, v, y, strict=True):
            if isnan(voltage) and isnan(reading):
                return f"neither effort nor position of axis '{axis}'; name the axes as stage_state does"
            if not isfinite(voltage):
                return f"effort of axis '{axis}' is {voltage:g}; report its voltage in volts"
            if not isfinite(reading):
                return f"position of axis '{axis}' is {reading:g}; report its displacement in metres"
            if abs(reading) > FARTHEST:
                return (
                    f"position {reading:.4g} of axis '{axis}' is more than {FARTHEST:g} m; stage_state is in metres: "
                    "does the driver publish micrometres?"
                )
        return ""

    def state(self, stamp_ns: int, clock_ns: int, v: Sequence[float], y: Sequence[float], now_ns: int) -> bool:
        """Take a state with reported voltages (V) and displacements (m), NaN: not named; return whether it is valid."""
        self._attend(now_ns)
        self._states.refused = self.refusal(v, y)
        for monitor, voltage in zip(self._each, v, strict=True):
            monitor.report(voltage, self._now_ns)
        if self._states.refused:
            return False
        self._states.hear(self._now_ns)
        self._stamps.stamp(stamp_ns, clock_ns, self._states.driving, self._now_ns)
        if self._states.driving:
            for monitor, voltage, reading in zip(self._each, v, y, strict=True):
                monitor.read(voltage, reading, self._now_ns)
            self._look()
        return True

    def check(self, now_ns: int) -> str:
        """Return the first fault at `now_ns`, "" if there is none; call it a hundred times a second or so."""
        self._attend(now_ns)
        self._look()
        return self.fault

    def _look(self) -> None:
        for monitor in self._monitors:
            monitor.check(self._now_ns)
            if monitor.standing and not self.fault:
                self.fault = str(monitor.standing[0])

    def _attend(self, now_ns: int) -> None:
        if self._last_ns >= 0:
            self._now_ns += min(max(now_ns - self._last_ns, 0), MOST_STEP_NS)
        self._last_ns = max(now_ns, self._last_ns)
