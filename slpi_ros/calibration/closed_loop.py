"""Tuned feedback on the stage: the path that shows it, the loop around the voltages of a drive, and what it did."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.loop_design import Design
from slpi_ros.compensator.loop_margin import refusal
from slpi_ros.compensator.monitor import Finding
from slpi_ros.compensator.oscillation_rule import OscillationRule
from slpi_ros.errors import UsageError
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.sensor import StreamingSensor
from slpi_ros.model.stage_model import StageModel
from slpi_ros.verification.step_answers import HELD, StepAnswer

# Steps about the middle, and a raster, as shares of the displacement range; time of each setpoint, and of a period of
# the raster if the slew limit allows it, seconds; number of periods.
STEPS, RASTER, HOLD, PERIOD, PERIODS = (0.02, 0.1), 0.3, 1.0, 1.0, 2
# Share of the slew limit that a raster takes where the inverse has its mean slope.
SLEW_USED = 0.4
# Age from which a reading is ignored, seconds.
TIMEOUT = 0.3
# Time between two looks for an oscillation.
CHECK_NS = 50_000_000


@dataclass(frozen=True)
class LoopResult:
    """What tuning has found for one axis, and what its loop did on the stage."""

    design: Design | None
    told: str  # in words; without a design why there is none
    steps: tuple[StepAnswer, ...] = ()


def showing(settings: CalibrationSettings, model: StageModel) -> dict[str, FloatArray]:
    """Return desired displacements (m), (N,), of each axis in turn: steps of two sizes, up and down, and a raster."""
    parts = {}
    for name, limits in zip(settings.axes, settings.limits, strict=True):
        axis = model.axis(name)
        low, high = axis.displacement_range
        span, held = high - low, round(HOLD * settings.rate)
        sizes = [0.0, *(size for step in STEPS for size in (step, 0.0))]
        fastest = SLEW_USED * min(limits.slew, limits.mean_rate) / (axis.voltage_range[1] - axis.voltage_range[0])
        period = max(PERIOD, 2.0 * RASTER / fastest)
        phase = np.arange(round(PERIODS * period * settings.rate)) / (period * settings.rate) % 1.0
        raster = RASTER * (1.0 - np.abs(2.0 * phase - 1.0))
        parts[name] = 0.5 * (low + high) + span * np.concatenate([np.repeat(sizes, held), raster])
    counts = [part.size for part in parts.values()]
    return {
        name: np.pad(part, (sum(counts[:k]), sum(counts[k + 1 :])), mode="edge")
        for k, (name, part) in enumerate(parts.items())
    }


def moving(desired: FloatArray) -> slice:
    """Return where desired displacements (m), (N,), as read from the stage, move on for longest: in the raster."""
    changed = np.flatnonzero(np.diff(desired))
    longest = max(np.split(changed, np.flatnonzero(np.diff(changed) >= HELD) + 1), key=len)
    return slice(int(longest[0]), int(longest[-1]) + 2)


@dataclass(frozen=True)
class AxisLoop:
    """Gains of an axis, and what the loop has to know of it."""

    gains: PidGains
    sensor: StreamingSensor  # its own errors are taken out of the readings
    slope: float  # m/V
    span: float  # m
    noise: float  # m

    @classmethod
    def of(cls, gains: PidGains, axis: AxisModel) -> "AxisLoop":
        """Return the loop of an axis."""
        low, high = axis.displacement_range
        return cls(gains, axis.streaming_sensor(), axis.mean_slope, high - low, axis.quality.floor_rms)


class ClosedLoop:
    """The compensator's feedback around the voltages of a drive, on all axes; times: steady clock, ns.

    It corrects where there is a desired displacement; after that the correction decays. An oscillation that it sustains
    switches it off, which is then in `off`.
    """

    def __init__(
        self,
        loops: Sequence[AxisLoop],
        limits: Sequence[Limits],
        rate: float,
        voltages: Sequence[float],
        names: Sequence[str] = (),
    ) -> None:
        each = zip(loops, limits, voltages, names or [""] * len(loops), strict=True)
        self._axes = [_Corrected(own, RateLimiter(within, 1.0 / rate, v), name) for own, within, v, name in each]

    @property
    def off(self) -> str:
        """Why feedback of an axis was switched off; "": it was not."""
        return "; ".join(str(axis.off) for axis in self._axes if axis.off)

    def measure(self, displacements: Sequence[float], now_ns: int) -> None:
        """Take the readings (m) of all axes, NaN: none."""
        for axis, y in zip(self._axes, displacements, strict=True):
            if isfinite(y):
                axis.measure(y, now_ns)

    def goals(self, voltages: Sequence[float], desired: Sequence[float], now_ns: int) -> list[float]:
        """Return the voltages (V) of the drive, corrected; `desired` (m), NaN: none."""
        return [axis.step(v, y, now_ns) for axis, v, y in zip(self._axes, voltages, desired, strict=True)]


class _Corrected:
    """Feedback of one axis, and the rule that listens to it."""

    def __init__(self, loop: AxisLoop, pace: RateLimiter, name: str) -> None:
        self._loop, self._feedback = loop, Feedback(loop.gains, pace)
        self._rule = OscillationRule(loop.span, loop.noise, name)
        self._desired, self._checked_ns = nan, 0
        self.off: Finding | None = None

    def measure(self, y: float, now_ns: int) -> None:
        # No delay or lag of the sensor is known in a calibration: they count as the stage's.
        x = self._loop.sensor.correct(y)
        self._feedback.measure(x, now_ns)
        if isfinite(self._desired):
            moved = self._loop.slope * self._feedback.correction
            self._rule.take(x - self._desired, self._desired, moved, now_ns)

    def step(self, voltage: float, desired: float, now_ns: int) -> float:
        feedback, rule, self._desired = self._feedback, self._rule, desired
        on = isfinite(desired) and bool(feedback.gains.integral) and not self.off
        rule.watch(on, now_ns)
        if on and now_ns - self._checked_ns >= CHECK_NS:
            self._checked_ns, self.off = now_ns, rule.check(now_ns)
        on = on and not self.off
        feedback.listen(rule.held)
        feedback.switch(on)
        return feedback.step(desired, voltage, now_ns, TIMEOUT) if on else feedback.hold(now_ns, voltage)


def too_slow(axis: AxisModel, gains: PidGains, period: float) -> bool:
    """Return whether a loop that was computed once in a period (s) is not stable enough to be judged."""
    try:
        return bool(refusal(axis, gains, period))
    except UsageError:
        # A notch above half that rate.
        return True


def gains_of(found: Mapping[str, LoopResult]) -> dict[str, PidGains]:
    """Return the gains of each axis; none where there is no design."""
    return {name: one.design.gains if one.design else PidGains(0.0) for name, one in found.items()}


def loops_of(found: Mapping[str, LoopResult], model: StageModel) -> dict[str, AxisLoop]:
    """Return the loop of each axis."""
    return {name: AxisLoop.of(gains, model.axis(name)) for name, gains in gains_of(found).items()}
