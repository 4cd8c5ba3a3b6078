"""Excitation drives that separate one effect from the others, for cases in which the calibration drive cannot."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.excitation.calibration import MEAN_SPEED
from slpi_ros.excitation.legs import FEWEST_STEPS, STEEPEST, DriveSpec, Path

# Share of the duration for the initial hold and the full loop that resets the hysteresis state.
WIPED = 0.15
# Largest speed in ranges per second at the steepest point, even without a slew limit.
FASTEST = 5.0


@dataclass(frozen=True)
class EffectDrive:
    """An excitation drive for one effect.

    Parameters
    ----------
    effect : str
        Name of the effect.
    why : str
        One sentence on the motion, and on why it separates the effect from others.
    draw : callable
        Function that appends the legs of the drive to a path, after the initial full loop of `path`.
    least_axes : int
        Smallest number of axes.
    """

    effect: str
    why: str
    draw: Callable[[Path, DriveSpec], None]
    least_axes: int = 1

    def path(self, spec: DriveSpec) -> Path:
        """Return the path of the drive from and to the low end; an initial full loop sets a known hysteresis state."""
        path = Path()
        full = max(WIPED * spec.duration / 3, _safe_duration(1.0))
        path.hold(WIPED * spec.duration / 3)
        path.to(1.0, full)
        path.to(0.0, full)
        self.draw(path, spec)
        path.to(0.0, max(path.at, 0.1) / MEAN_SPEED)
        return path


def for_effect(name: str) -> EffectDrive:
    """Return the excitation drive for an effect.

    Parameters
    ----------
    name : str
        One of `EFFECTS`.

    Raises
    ------
    UsageError
        If there is no drive for this effect.
    """
    if name not in EFFECTS:
        raise UsageError(f"no drive for the effect '{name}'; choose one of {', '.join(EFFECTS)}")
    return EFFECTS[name]


def _safe_duration(span: float) -> float:
    """Return a duration (s), safe for any stage, of a move over a `span` of the range (share)."""
    return abs(span) * STEEPEST / FASTEST


def _remaining(spec: DriveSpec) -> float:
    """Return the time (s) that remains after the initial hold and full loop."""
    return (1.0 - WIPED) * spec.duration


def _move(path: Path, share: float) -> None:
    path.to(share, max(abs(share - path.at), 0.05) / MEAN_SPEED)


def _loops(path: Path, low: float, high: float, seconds: float, count: int, *, straight: bool = False) -> None:
    """Append `count` loops between two shares of the range, with legs of `seconds` each."""
    for _ in range(count):
        path.to(high, seconds, straight=straight)
        path.to(low, seconds, straight=straight)


def _leg_durations(slowest: float, quickest: float, count: int) -> list[float]:
    """Return `count` geometrically spaced leg durations (s), the slowest first."""
    return [float(seconds) for seconds in np.geomspace(max(slowest, quickest), quickest, count)]


def _at_speeds(path: Path, spec: DriveSpec, low: float, high: float, *, straight: bool) -> None:
    """Append one loop at increasing speeds, with about the same time and at least two repeats at each speed."""
    count = 6
    each = _remaining(spec) / count
    span = high - low
    quickest = max(spec.quickest(span, straight), _safe_duration(span), 8 / spec.rate)
    _move(path, low)
    for seconds in _leg_durations(each / 4, quickest, count):
        _loops(path, low, high, seconds, max(2, round(each / (2 * seconds))), straight=straight)


def _delay(path: Path, spec: DriveSpec) -> None:
    _at_speeds(path, spec, 0.35, 0.65, straight=True)


def _lag(path: Path, spec: DriveSpec) -> None:
    _at_speeds(path, spec, 0.45, 0.55, straight=False)


def _rate_dependence(path: Path, spec: DriveSpec) -> None:
    spans, doublings, loops = (0.6, 0.3, 0.15), 3, 2
    # Loops of one span take 2 (1 + 2 + 4) times the shortest leg.
    quickest = _remaining(spec) / (len(spans) * loops * 2 * (2**doublings - 1))
    quickest = max(quickest, spec.quickest(spans[0]), _safe_duration(spans[0]))
    for span in spans:
        _move(path, 0.5 - span / 2)
        for doubling in range(doublings):
            _loops(path, 0.5 - span / 2, 0.5 + span / 2, quickest * 2**doubling, loops)


def _saturation(path: Path, spec: DriveSpec) -> None:
    for near in (0.2, 0.1, 0.05, 0.0):
        for seconds in (_remaining(spec) / 12, _remaining(spec) / 48):
            for end in (1.0 - near, near):
                path.to(end, max(seconds, _safe_duration(1.0)))
                path.hold(0.01 * spec.duration)


def _creep(path: Path, spec: DriveSpec) -> None:
    levels, shares = (0.8, 0.2, 0.6, 0.9, 0.4), (1, 2, 4, 8, 8)
    for level, share in zip(levels, shares, strict=True):
        path.to(level, _safe_duration(level - path.at))
        path.hold(_remaining(spec) * share / sum(shares))


def _resonance(path: Path, spec: DriveSpec) -> None:
    step, levels, repeats = 0.1, (0.2, 0.5, 0.8), 3
    ring = 0.5 * _remaining(spec) / (len(levels) * (1 + 2 * repeats))
    for level in levels:
        _move(path, level)
        path.hold(ring)
        for _ in range(repeats):
            for to in (level + step, level):
                path.to(to, 0.0, straight=True)
                path.hold(ring)
    # In the sweep each half-wave is one sample shorter than the previous one; two loops of each take 0.3 of the time.
    _move(path, 0.5)
    longest = int(math.sqrt(0.3 * _remaining(spec) * spec.rate / 2))
    for steps in range(longest, FEWEST_STEPS - 1, -1):
        _loops(path, 0.5 - step / 4, 0.5 + step / 4, steps / spec.rate, 2)


def _cross_coupling(path: Path, spec: DriveSpec) -> None:
    spans = ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0), (0.25, 0.75))
    seconds = _remaining(spec) / (len(spans) * 2 * (1 + 2))
    for low, high in spans:
        _move(path, low)
        for each in (2 * seconds, seconds):
            _loops(path, low, high, each, 1)
            path.hold(seconds / 4)


def _thermal_drift(path: Path, spec: DriveSpec) -> None:
    # Motion takes 0.6 of each cycle.
    shortest = 2 * max(spec.quickest(1.0), _safe_duration(1.0)) / 0.6
    repeats = min(max(int(_remaining(spec) / shortest), 3), 8)
    each = _remaining(spec) / repeats
    for _ in range(repeats):
        path.to(1.0, 0.3 * each)
        path.hold(0.2 * each)
        path.to(0.0, 0.3 * each)
        path.hold(0.2 * each)


def _gain_drift(path: Path, spec: DriveSpec) -> None:
    shortest = 2 * max(spec.quickest(1.0), _safe_duration(1.0))
    repeats = min(max(int(_remaining(spec) / shortest), 3), 60)
    _loops(path, 0.0, 1.0, _remaining(spec) / (2 * repeats), repeats)


def _sensor_periodic(path: Path, spec: DriveSpec) -> None:
    for share in (1 / 6, 1 / 3):
        _loops(path, 0.0, 1.0, share * _remaining(spec), 1, straight=True)


def _hum(path: Path, spec: DriveSpec) -> None:
    for level in (0.1, 0.5, 0.9):
        _move(path, level)
        path.hold(_remaining(spec) / 3)


EFFECTS = {
    drive.effect: drive
    for drive in (
        EffectDrive(
            "delay",
            "The same triangle at six speeds: a delay shifts its sharp corners by one time at every speed and leaves "
            "them sharp, where a lag rounds them and rate dependence changes the loop between them.",
            _delay,
        ),
        EffectDrive(
            "lag",
            "The same small loop as a sine, slow to fast: hysteresis stays as it is, the phase of a delay grows with "
            "frequency at full amplitude, and a lag also loses amplitude.",
            _lag,
        ),
        EffectDrive(
            "saturation",
            "Peaks that come up to both limits in steps, slow and fast, with a hold at each: a clipped amplifier stops "
            "at one voltage at any speed, where hysteresis and lag go on to the peak.",
            _saturation,
        ),
        EffectDrive(
            "rate_dependence",
            "Loops of three sizes at three speeds each, some of different size at the same volts per second: a linear "
            "filter treats these alike, loops that widen with the drive rate do not.",
            _rate_dependence,
        ),
        EffectDrive(
            "creep",
            "Quick moves up and down, each followed by a hold, the later ones longer: at constant voltage hysteresis, "
            "lag and delay are still, and only creep goes on, in proportion to the move and in its direction.",
            _creep,
        ),
        EffectDrive(
            "resonance",
            "Small steps as fast as allowed with time to ring down, at three levels, then a sweep up to a sixth of the "
            "sampling rate: only a resonance rings on, at one frequency (sample at six times that or more).",
            _resonance,
        ),
        EffectDrive(
            "gain_drift",
            "Full loops one after the other, all alike and without a rest: voltage, memory and creep repeat, so a "
            "stroke that grows or shrinks is the sensitivity, where a drift moves both ends of each loop by the same "
            "(give it several minutes, or start after a rest).",
            _gain_drift,
        ),
        EffectDrive(
            "cross_coupling",
            "One axis moves while all others rest: what a resting axis shows then is coupling, and neither its own "
            "hysteresis nor its own dynamics.",
            _cross_coupling,
            least_axes=2,
        ),
        EffectDrive(
            "thermal_drift",
            "The same full loop over and over, with the same holds: voltage, memory and creep repeat, so what differs "
            "from one repeat to the next follows time alone.",
            _thermal_drift,
        ),
        EffectDrive(
            "sensor_periodic",
            "Slow ramps of constant speed over the whole range, at two speeds: an error of the sensor has the same "
            "period in displacement at both speeds, hum the same in time, and hysteresis is smooth.",
            _sensor_periodic,
        ),
        EffectDrive(
            "hum",
            "Rest at three levels: nothing is commanded, so what oscillates there at one frequency comes from outside; "
            "an error of the sensor does not, at rest (sample at more than twice the mains frequency).",
            _hum,
        ),
    )
}
