"""Drives of a whole stage: calibration, or for one effect; every axis in its turn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slpi_ros.errors import UsageError
from slpi_ros.excitation.calibration import PACE, calibration
from slpi_ros.excitation.effects import EFFECTS, for_effect
from slpi_ros.excitation.legs import FloatArray, Path, Room

CALIBRATION = "calibration"
DRIVES = (CALIBRATION, *EFFECTS)
_WHY_CALIBRATION = (
    "Full loops that wipe the memory, reversal curves from both ends and loops within loops, at several speeds and "
    "with holds: they visit all that a path may visit."
)


@dataclass(frozen=True)
class Drive:
    """Voltages of all axes of a stage.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        From 0, evenly spaced.
    voltage : dict of axis name to ndarray, shape (N,), volts
        Each begins and ends where the axis rests.
    rooms : dict of axis name to Room
        What each axis was allowed, with the duration of the whole drive.
    why : str
        One sentence: what it is good for.
    """

    t: FloatArray
    voltage: dict[str, FloatArray]
    rooms: dict[str, Room]
    why: str

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(self.voltage)

    @property
    def rate(self) -> float:
        """Samples per second, hertz."""
        return self.rooms[self.axes[0]].rate


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
    """Draw the voltages by which to identify a stage.

    One axis moves at a time, and the axes share the duration: coupling between them, which would look like hysteresis
    when they move together, shows on those that rest.

    Parameters
    ----------
    axes : sequence of str
        Names, in the order in which they move.
    voltage_min, voltage_max : float or sequence of float, volts
        Never left; one value, or one for each axis.
    slew_limit : float or sequence of float, V/s
        Fastest change; 0: none.
    start : float or sequence of float, volts, optional
        Where the axes rest before and after they move; by default at `voltage_min`.
    duration : float, seconds
        Time of the last sample.
    rate : float, hertz
        Samples per second.
    seed : int
        The same seed gives the same drive.
    drive : str
        One of `DRIVES`: ``calibration``, or the effect that is to be separated from others.

    Returns
    -------
    Drive

    Raises
    ------
    UsageError
        If a value makes no sense, or the duration is too short for what is to be shown.
    """
    _check(axes, drive)
    lows, highs, slews = (
        _each(name, given, axes)
        for name, given in (("voltage_min", voltage_min), ("voltage_max", voltage_max), ("slew_limit", slew_limit))
    )
    rests = lows if start is None else _each("start", start, axes)
    rooms = {
        axis: Room(low, high, duration, rate, slew)
        for axis, low, high, slew in zip(axes, lows, highs, slews, strict=True)
    }
    steps = rooms[axes[0]].steps
    turns = np.linspace(0, steps, len(axes) + 1).round().astype(int).tolist()
    voltage = {}
    for number, (axis, rest) in enumerate(zip(axes, rests, strict=True)):
        begin, end = turns[number], turns[number + 1]
        turn = replace(rooms[axis], duration=(end - begin) / rate)
        voltage[axis] = np.full(steps + 1, rest)
        voltage[axis][begin : end + 1] = _turn(turn, rest, drive, _generator(seed, number))
    return Drive(np.arange(steps + 1) / rate, voltage, rooms, _why(drive))


def calibration_drive(
    voltage_min: float, voltage_max: float, *, duration: float, rate: float, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and voltages (V), shape (N,), of the calibration drive of one axis without a slew limit."""
    drive = excite(voltage_min=voltage_min, voltage_max=voltage_max, duration=duration, rate=rate, seed=seed)
    return drive.t, drive.voltage["x"]


def _turn(room: Room, rest: float, drive: str, rng: np.random.Generator) -> FloatArray:
    """Return the voltages of one axis while it moves, shape (room.steps + 1,), volts, from where it rests and back."""
    if not room.low <= rest <= room.high:
        raise UsageError(f"drive: it starts at {rest:g} V; give a voltage within {room.low:g} to {room.high:g} V")
    start = (rest - room.low) / room.span
    approach = max(start / PACE, room.quickest(start))
    if 2 * approach >= room.duration:
        raise UsageError(
            f"drive: the way from {rest:g} V to {room.low:g} V and back takes {2 * approach:.3g} s of "
            f"{room.duration:g} s; give more time"
        )
    path = Path(start)
    if start:
        path.to(0.0, approach)
    within = replace(room, duration=room.duration - 2 * approach)
    inner = calibration(within, rng) if drive == CALIBRATION else for_effect(drive).path(within)
    path.legs += inner.legs
    if start:
        path.to(start, approach)
    return path.voltages(room)


def _check(axes: Sequence[str], drive: str) -> None:
    if not axes or not all(axes) or len(set(axes)) != len(axes):
        raise UsageError(f"drive: axes are {list(axes)}; name at least one, each by a name of its own")
    if drive not in DRIVES:
        raise UsageError(f"no drive '{drive}'; choose one of {', '.join(DRIVES)}")
    if drive != CALIBRATION and len(axes) < for_effect(drive).least_axes:
        raise UsageError(f"drive '{drive}': it takes {for_effect(drive).least_axes} axes, not {len(axes)}; name them")


def _each(name: str, given: float | Sequence[float], axes: Sequence[str]) -> list[float]:
    """Return one value for each axis."""
    values = [given] * len(axes) if isinstance(given, int | float) else list(given)
    if len(values) != len(axes):
        raise UsageError(f"drive: {len(values)} values of {name} for {len(axes)} axes; give one, or one for each")
    return [float(value) for value in values]


def _generator(seed: int, number: int) -> np.random.Generator:
    if seed < 0:
        raise UsageError(f"drive: seed {seed}; give 0 or more")
    return np.random.default_rng([seed, number])


def _why(drive: str) -> str:
    return _WHY_CALIBRATION if drive == CALIBRATION else for_effect(drive).why
