"""Tuned feedback on the stage: the path that shows it, the loop around the voltages of a drive, and what it did."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.settings import CalibrationSettings
from slpi_ros.compensator.feedback import Feedback, PidGains
from slpi_ros.compensator.loop_design import Design
from slpi_ros.diagnosis.step_answers import StepAnswer
from slpi_ros.model.limits import Limits, RateLimiter
from slpi_ros.model.sensor import StreamingSensor
from slpi_ros.model.stage_model import StageModel

# Steps about the middle, and a raster, as shares of the displacement range; time of each set point, and of a period of
# the raster if the slew limit allows it, seconds; number of periods.
STEPS, RASTER, HOLD, PERIOD, PERIODS = (0.02, 0.1), 0.3, 1.0, 1.0, 2
# Share of the slew limit that a raster takes where the inverse has its mean slope.
SLEW_USED = 0.4
# Age from which a reading is ignored, seconds.
TIMEOUT = 0.3


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
        raster = RASTER * (0.5 - np.abs(phase - 0.5))
        parts[name] = 0.5 * (low + high) + span * np.concatenate([np.repeat(sizes, held), raster])
    counts = [part.size for part in parts.values()]
    return {
        name: np.pad(part, (sum(counts[:k]), sum(counts[k + 1 :])), mode="edge")
        for k, (name, part) in enumerate(parts.items())
    }


@dataclass(frozen=True)
class AxisLoop:
    """Gains of an axis, and its sensor, whose own errors are taken out of the readings."""

    gains: PidGains
    sensor: StreamingSensor


class ClosedLoop:
    """The compensator's feedback around the voltages of a drive, on all axes; times: steady clock, ns.

    It corrects where there is a desired displacement; after that the correction decays.
    """

    def __init__(
        self, loops: Sequence[AxisLoop], limits: Sequence[Limits], rate: float, voltages: Sequence[float]
    ) -> None:
        each = zip(loops, limits, voltages, strict=True)
        self._axes = [Feedback(own.gains, RateLimiter(within, 1.0 / rate, v)) for own, within, v in each]
        self._sensors = [own.sensor for own in loops]

    def measure(self, displacements: Sequence[float], now_ns: int) -> None:
        """Take the readings (m) of all axes, NaN: none."""
        for feedback, sensor, y in zip(self._axes, self._sensors, displacements, strict=True):
            if isfinite(y):
                # No delay or lag of the sensor is known in a calibration: they count as the stage's.
                feedback.measure(sensor.correct(y), now_ns)

    def goals(self, voltages: Sequence[float], desired: Sequence[float], now_ns: int) -> list[float]:
        """Return the voltages (V) of the drive, corrected; `desired` (m), NaN: none."""
        return [self._step(*each, now_ns) for each in zip(self._axes, voltages, desired, strict=True)]

    def _step(self, feedback: Feedback, voltage: float, desired: float, now_ns: int) -> float:
        on = isfinite(desired) and bool(feedback.gains.integral)
        feedback.switch(on)
        return feedback.step(desired, voltage, now_ns, TIMEOUT) if on else feedback.hold(now_ns, voltage)


def gains_of(found: Mapping[str, LoopResult]) -> dict[str, PidGains]:
    """Return the gains of each axis; none where there is no design."""
    return {name: one.design.gains if one.design else PidGains(0.0) for name, one in found.items()}


def loops_of(found: Mapping[str, LoopResult], model: StageModel) -> dict[str, AxisLoop]:
    """Return the loop of each axis."""
    return {name: AxisLoop(gains, model.axis(name).streaming_sensor()) for name, gains in gains_of(found).items()}
