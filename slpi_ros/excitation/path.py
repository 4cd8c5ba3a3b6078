"""A drive that covers a path: the calibration drive, then the path at its own pace and at a slower one."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.excitation import FEWEST_STEPS, MEAN_SPEED
from slpi_ros.excitation.drives import Drive
from slpi_ros.excitation.legs import DriveSpec, Path

# The path is driven again this much slower: the same turns at another rate tell hysteresis from what time does.
SLOWER = 3.0
WHY = "The calibration drive, then the path itself, at its own rate and at a third of it: its range, rates and turns."


def with_path(drive: Drive, path: Mapping[str, FloatArray]) -> Drive:
    """Return a drive followed by a path, voltages by axis (V), (N,), one axis after the other.

    The path has the sampling rate of the drive. Where it leaves the limits of the drive, or is faster than its slew
    limit, the voltage stays at the limit, or follows late. The slower pass is cut at the duration of the drive.
    """
    parts = {axis: [voltage] for axis, voltage in drive.voltage.items()}
    for axis in drive.axes:
        if axis not in path:
            continue
        spec, rest = drive.specs[axis], float(drive.voltage[axis][-1])
        within = np.clip(path[axis], spec.low, spec.high)
        slow = np.interp(np.arange(min(within.size * SLOWER, spec.steps)) / SLOWER, np.arange(within.size), within)
        pieces = [np.array([rest])]
        for part in (within, slow):
            part = _limited(part, spec)
            pieces += [_move(spec, float(pieces[-1][-1]), float(part[0])), part]
        pieces.append(_move(spec, float(pieces[-1][-1]), rest))
        own = np.concatenate(pieces)[1:]
        for other, voltages in parts.items():
            voltages.append(own if other == axis else np.full(own.size, drive.voltage[other][-1]))
    voltage = {axis: np.concatenate(each) for axis, each in parts.items()}
    size = voltage[drive.axes[0]].size
    specs = {axis: replace(spec, duration=(size - 1) / spec.rate) for axis, spec in drive.specs.items()}
    return Drive(np.arange(size) / drive.rate, voltage, specs, WHY)


def _move(spec: DriveSpec, begin: float, end: float) -> FloatArray:
    """Return the voltages (V) from one level to another, without the first, as a raised cosine."""
    start, to = ((v - spec.low) / spec.span for v in (begin, end))
    path = Path(start)
    path.to(to, abs(to - start) / MEAN_SPEED)
    steps = max(int(path.wanted_steps(spec)[0]), FEWEST_STEPS)
    return path.voltages(replace(spec, duration=steps / spec.rate))[1:]


def _limited(v: FloatArray, spec: DriveSpec) -> FloatArray:
    """Return voltages (V), (N,), that follow within the slew limit."""
    step = spec.slew_limit / spec.rate
    if not step or np.abs(np.diff(v)).max(initial=0.0) <= step:
        return v
    out = [float(v[0])]
    for goal in v[1:].tolist():
        out.append(out[-1] + min(max(goal - out[-1], -step), step))
    return np.array(out)
