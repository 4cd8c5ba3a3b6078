"""The voltages of a device: the last limits before the wire, and whether the device says that it follows."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from slpi_ros.compensator.amplifier import Amplifier, VoltageLimits
from slpi_ros.compensator.monitor import Monitor
from slpi_ros.drivers.base import Reading
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, StageLimiter

# Commands count as held at a limit for this time.
HELD_NS = SECOND_NS
# A voltage of the device's range may be off by rounding, volts.
ROUNDING = 1e-6
# A device reports the voltage that was written within this time; a gain or an offset of it is no calibration here.
REPORTED = VoltageLimits(
    window_ns=3 * SECOND_NS // 10,
    absurd=inf,
    calibrated=False,
    reason=(
        "is at {reported} V, but {last} V was written: the device limits the voltage, its command is not in volts, or "
        "somebody else moves it; find out which"
    ),
)


@dataclass(frozen=True)
class LoopSettings:
    """What the loop of a driver keeps to; voltages are those at the stage."""

    axes: tuple[str, ...]
    limits: tuple[Limits, ...]
    rate: float = 1000.0  # Hz
    take_over_servo: bool = False
    rearm: bool = False
    rest: tuple[float, ...] | None = None  # V, to ramp to at the end; None: hold
    silence: float = 0.0  # s without a command after which it holds; 0: it is no matter
    silence_rest: tuple[float, ...] | None = None  # V, to ramp to after such a silence; None: hold


class Writer:
    """Moves the voltages of a device from where they are to a goal, within the limits; what it says goes to `monitor`.

    `goal` is of the last command, V, None: none.
    """

    def __init__(self, settings: LoopSettings) -> None:
        axes, limits = settings.axes, settings.limits
        self.goal: tuple[float, ...] | None = None
        self._limits = dict(zip(axes, limits, strict=True))
        self._limiter = StageLimiter(limits, 1.0 / settings.rate)
        self._limited_ns = dict.fromkeys(axes, -(1 << 62))
        self._reports = [Amplifier(each.span, REPORTED, axis) for axis, each in zip(axes, limits, strict=True)]
        self.monitor = Monitor(*self._reports)

    @property
    def written(self) -> tuple[float, ...]:
        """Voltages that were written last, or that the device had at the start, volts."""
        return self._limiter.voltages

    def start(self, voltages: tuple[float, ...], offsets: Sequence[float] = ()) -> None:
        """Go on from voltages (V) that the device has; it may report others by offsets (V; none: as before)."""
        self._limiter.start(voltages)
        for rule, v in zip(self._reports, voltages, strict=True):
            rule.begin(v, 0)
        for rule, offset in zip(self._reports, offsets, strict=False):
            rule.slack = abs(offset)

    def step(self, goal: tuple[float, ...], now_ns: int, *, gently: bool = False) -> tuple[float, ...] | None:
        """Return the voltages (V) to write on the way to a goal (V); None if they were written last."""
        before, wanted = self.written, self._limiter.step(goal, now_ns, gently=gently)
        for (axis, limits), v in zip(self._limits.items(), goal, strict=True):
            if not limits.lower <= v <= limits.upper:
                self._limited_ns[axis] = now_ns
        if wanted == before:
            return None
        for rule, v in zip(self._reports, wanted, strict=True):
            rule.output(v, now_ns)
        return wanted

    def compare(self, reading: Reading, now_ns: int) -> str:
        """Return how the device contradicts what was written; "" while it agrees."""
        for rule, v in zip(self._reports, reading.voltages, strict=True):
            rule.report(v, now_ns)
        self.monitor.check(now_ns)
        return next((f"axis '{each.axis}' {each.reason}" for each in self.monitor.standing), "")

    def limited(self, now_ns: int) -> tuple[str, ...]:
        """Return the axes whose commands were beyond the voltage limits lately."""
        return tuple(axis for axis, last_ns in self._limited_ns.items() if now_ns - last_ns < HELD_NS)

    def at(self, voltages: Sequence[float]) -> bool:
        """Return whether these voltages (V) were written."""
        return all(abs(v - w) <= ROUNDING for v, w in zip(self.written, voltages, strict=True))
