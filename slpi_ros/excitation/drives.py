"""Excitation drives of a stage: calibration, sweep, or one for a single effect, one axis at a time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.excitation import FEWEST_STEPS, MEAN_SPEED
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.errors import UsageError
from slpi_ros.excitation.calibration import calibration, sweep
from slpi_ros.excitation.effects import effect_path, for_effect
from slpi_ros.excitation.legs import DriveSpec, Path

CALIBRATION, SWEEP = "calibration", "sweep"
# Default slew limit: the voltage range in this time, seconds. Share of a slew limit that drives use: a late sample is
# followed by an early one.
CROSSING, SLEW_USED = 0.1, 0.8
DRIVES = (CALIBRATION, SWEEP, *EFFECTS)
# Purpose of the drives that are not specific to an effect.
_WHY = {
    CALIBRATION: "A sweep over the whole range that makes the memory known, reversal curves from both ends and loops "
    "within loops, at several speeds and with holds: they visit all that a path may visit.",
    SWEEP: "Once over the whole range, up and down: whatever moved the stage before is forgotten, and its memory is "
    "known.",
}


@dataclass(frozen=True)
class Drive:
    """Voltage signals of all axes of a stage, shape (N,): times from 0, evenly spaced (s), and voltages by axis (V)."""

    t: FloatArray
    # They start and end at the rest voltage of the axis.
    voltage: dict[str, FloatArray]
    # With the duration of the whole drive.
    specs: dict[str, DriveSpec]
    # Purpose of the drive in one sentence.
    why: str

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(self.voltage)

    @property
    def rate(self) -> float:
        """Samples per second, hertz."""
        return self.specs[self.axes[0]].rate


def excite(
    axes: Sequence[str] = ("x",),
    *,
    voltage_min: float | Sequence[float],
    voltage_max: float | Sequence[float],
    slew_limit: float | Sequence[float] = 0.0,
    start: float | Sequence[float] | None = None,
    duration: float = 30.0,
    rate: float = 200.0,
    seed: int = 0,
    drive: str = CALIBRATION,
) -> Drive:
    """Return the voltages (V), for `duration` (s) at `rate` (Hz), of one of `DRIVES` that identify a stage."""
    # The axes move one after the other and share the duration: the cross coupling, which would resemble hysteresis
    # during simultaneous motion, appears on the axes at rest. Voltages (V) and `slew_limit` (V/s; 0: none) are one
    # value, or one for each axis; `start` is the rest voltage before and after the motion, by default `voltage_min`.
    _check(axes, drive)
    lows, highs, slews = (
        _each(name, given, axes)
        for name, given in (("voltage_min", voltage_min), ("voltage_max", voltage_max), ("slew_limit", slew_limit))
    )
    rests = lows if start is None else _each("start", start, axes)
    specs = {
        axis: DriveSpec(low, high, duration, rate, slew)
        for axis, low, high, slew in zip(axes, lows, highs, slews, strict=True)
    }
    steps = specs[axes[0]].steps
    turns = np.linspace(0, steps, len(axes) + 1).round().astype(int).tolist()
    voltage = {}
    for number, (axis, rest) in enumerate(zip(axes, rests, strict=True)):
        begin, end = turns[number], turns[number + 1]
        turn = replace(specs[axis], duration=(end - begin) / rate)
        voltage[axis] = np.full(steps + 1, rest)
        voltage[axis][begin : end + 1] = _turn(turn, rest, drive, generator(seed, number))
    return Drive(np.arange(steps + 1) / rate, voltage, specs, _why(drive))


def slew_limits(
    given: Sequence[float] | None, voltage_min: Sequence[float], voltage_max: Sequence[float]
) -> tuple[float, ...]:
    """Return the slew limit (V/s) of each axis, 0 for none: as given, or by default the voltage range in 0.1 s."""
    if given is not None:
        return tuple(given)
    return tuple(
        (high - low) / CROSSING if high > low else 0.0 for low, high in zip(voltage_min, voltage_max, strict=True)
    )


def calibration_drive(
    voltage_min: float, voltage_max: float, *, duration: float, rate: float, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and voltages (V), shape (N,), of the calibration drive of one axis without a slew limit."""
    drive = excite(voltage_min=voltage_min, voltage_max=voltage_max, duration=duration, rate=rate, seed=seed)
    return drive.t, drive.voltage["x"]


def _turn(spec: DriveSpec, rest: float, drive: str, rng: np.random.Generator) -> FloatArray:
    """Return the voltages (V) of one axis during its motion, shape (spec.steps + 1,), from and to the rest voltage."""
    if not spec.low <= rest <= spec.high:
        raise UsageError(f"drive: it starts at {rest:g} V; give a voltage within {spec.low:g} to {spec.high:g} V")
    start = (rest - spec.low) / spec.span
    approach = max(start / MEAN_SPEED, spec.quickest(start))
    if 2 * approach >= spec.duration:
        raise UsageError(
            f"drive: the way from {rest:g} V to {spec.low:g} V and back takes {2 * approach:.3g} s of "
            f"{spec.duration:g} s; give more time"
        )
    path = Path(start)
    if start:
        path.to(0.0, approach)
    within = replace(spec, duration=spec.duration - 2 * approach)
    match drive:
        case "calibration":
            inner = calibration(within, rng)
        case "sweep":
            inner = sweep(within)
        case _:
            inner = effect_path(drive, within)
    path.legs += inner.legs
    if start:
        path.to(start, approach)
    return path.voltages(spec)


def _check(axes: Sequence[str], drive: str) -> None:
    if not axes or not all(axes) or len(set(axes)) != len(axes):
        raise UsageError(f"drive: axes are {list(axes)}; name at least one, each by a name of its own")
    if drive not in (known := (*_WHY, *EFFECTS)):
        raise UsageError(f"no drive '{drive}'; choose one of {', '.join(known)}")
    least = 1 if drive in _WHY else for_effect(drive).least_axes
    if len(axes) < least:
        raise UsageError(f"drive '{drive}': it takes {least} axes, not {len(axes)}; name them")


def _each(name: str, given: float | Sequence[float], axes: Sequence[str]) -> list[float]:
    """Return one value per axis."""
    values = [given] * len(axes) if isinstance(given, int | float) else list(given)
    if len(values) != len(axes):
        raise UsageError(f"drive: {len(values)} values of {name} for {len(axes)} axes; give one, or one for each")
    return [float(value) for value in values]


def generator(seed: int, number: int) -> np.random.Generator:
    """Return the random numbers of the axis of a number; UsageError for a negative seed."""
    if seed < 0:
        raise UsageError(f"drive: seed {seed}; give 0 or more")
    return np.random.default_rng([seed, number])


def _why(drive: str) -> str:
    return _WHY[drive] if drive in _WHY else for_effect(drive).why


class Playback:
    """Playback of a drive sample by sample, within its limits; with `repeat` it restarts at the end until stopped."""

    # After `stop` it is `stopping` while the axes return to their rest voltages.
    def __init__(self, drive: Drive, *, repeat: bool = False) -> None:
        self.drive, self.stopping = drive, False
        self._repeat = repeat
        self._samples = np.column_stack(list(drive.voltage.values()))
        self._next = 0

    @property
    def done(self) -> bool:
        """Whether the last sample has been returned."""
        return self._next == len(self._samples)

    @property
    def samples_left(self) -> FloatArray:
        """Remaining voltages, shape (n, axes), volts."""
        return self._samples[self._next :]

    @property
    def seconds_left(self) -> float:
        """Remaining time, seconds."""
        return len(self.samples_left) / self.drive.rate

    def next(self) -> list[float]:
        """Return the voltages (V) of the next sample in the order of the drive's axes; after the end the last ones."""
        sample: list[float] = self._samples[min(self._next, len(self._samples) - 1)].tolist()
        if not self.done:
            self._next += 1
        if self.done and self._repeat and not self.stopping:
            self._next = 0
        return sample

    def stop(self, present: Sequence[float]) -> None:
        """Let the rest be the way from `present` voltages (V), where the axes are, to the rest voltages."""
        self.stopping = True
        within = zip(self.drive.specs.values(), present, strict=True)
        there = np.array([min(max(v, spec.low), spec.high) for spec, v in within])
        self._samples, self._next = np.vstack([there, self._return_path(there)]), 0

    def _return_path(self, present: FloatArray) -> FloatArray:
        """Return the voltages (V) from `present` to the rest voltages, shape (n, axes), all axes moving at once."""
        moves = [
            (spec, (now - spec.low) / spec.span, (voltage[0] - spec.low) / spec.span)
            for spec, now, voltage in zip(
                self.drive.specs.values(), present.tolist(), self.drive.voltage.values(), strict=True
            )
        ]
        spans = [(spec, abs(end - start)) for spec, start, end in moves]
        # A margin for rounding to whole steps.
        seconds = (
            max(max(span / MEAN_SPEED, spec.quickest(span)) for spec, span in spans) + FEWEST_STEPS / self.drive.rate
        )
        columns = []
        for spec, start, end in moves:
            path = Path(start)
            path.to(end, seconds)
            columns.append(path.voltages(replace(spec, duration=seconds))[1:])
        return np.column_stack(columns)
