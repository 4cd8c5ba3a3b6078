"""A block of voltages for a device: checked as a whole, then played by the device's clock or streamed; without ROS."""

from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.drivers.base import Block, Device, Reading, Recording
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, volts

# Steps of a block may exceed the slew limit by rounding, and its samples miss the device's clock by this share.
ROUNDING, OFF_CLOCK = 1e-6, 1e-3
# The device is asked for its sample once in this time.
ASK_NS = SECOND_NS // 20


class Told(Enum):
    """What `voltage_trajectory_state` tells of a block."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    PLAYING = "playing"
    ENDED = "ended"
    STOPPED = "stopped"


@dataclass(frozen=True)
class BlockState:
    """One state of a block."""

    told: Told
    stamp_ns: int  # of the block
    sample: int  # number of samples that were played
    reason: str = ""


@dataclass(frozen=True)
class BlockRequest:
    """A block as it arrived: `voltages` of some axes at `times_ns` since its start; without samples: stop."""

    stamp_ns: int
    names: tuple[str, ...]
    times_ns: IntArray  # (N,)
    voltages: FloatArray  # V, (N, names)


def refusal(
    request: BlockRequest, axes: Sequence[str], limits: Sequence[Limits], present: Sequence[float], period: float
) -> str:
    """Return why a block may not be played from the `present` voltages (V), "" if it may; `period` (s) of a cycle."""
    times, values = request.times_ns, request.voltages
    if not request.names or len(set(request.names)) != len(request.names):
        return f"it names the axes {', '.join(request.names) or 'not'}; name each once"
    if unknown := [name for name in request.names if name not in axes]:
        return f"there is no axis '{unknown[0]}'; this driver moves {', '.join(axes)}"
    if values.shape != (times.size, len(request.names)):
        return f"it has voltages of shape {values.shape} for {times.size} samples; give each an effort for each axis"
    if times[0] < 0 or (times[1:] <= times[:-1]).any():
        return "its times do not increase; give each sample its own time"
    if not np.isfinite(values).all():
        return "a voltage is not finite"
    for column, name in enumerate(request.names):
        own, place = limits[axes.index(name)], axes.index(name)
        v = values[:, column]
        if v.min() < own.lower - ROUNDING or v.max() > own.upper + ROUNDING:
            at = int(np.argmax((v < own.lower - ROUNDING) | (v > own.upper + ROUNDING)))
            return f"axis '{name}', sample {at}: {volts(v[at])} V is beyond {own.lower:g} to {own.upper:g} V"
        steps = np.abs(np.diff(v, prepend=present[place]))
        # The first sample may be as far as one cycle of single voltages.
        allowed = own.slew * np.diff(times, prepend=min(0, times[0] - round(2.0 * period * SECOND_NS))) / SECOND_NS
        fast = steps > allowed * (1.0 + OFF_CLOCK) + ROUNDING
        if fast.any():
            at = int(np.argmax(fast))
            if at == 0:
                return (
                    f"axis '{name}': it begins at {volts(v[0])} V, but the device is at {volts(present[place])} V; "
                    "begin at the present voltage"
                )
            rate = steps[at] / (times[at] - times[at - 1]) * SECOND_NS
            return f"axis '{name}', sample {at}: {rate:.4g} V/s, more than slew_limit {own.slew:g} V/s"
    return ""


@dataclass
class BlockPlayer:
    """One block on its way: loaded and played by the device, or streamed where it cannot; used by one thread."""

    request: BlockRequest
    axes: Sequence[str]
    present: tuple[float, ...]  # V, of all axes at the start: where those stay that the block does not name
    states: deque[BlockState]
    by_device: bool = False
    ended: bool = False
    sample: int = 0
    begun_ns: int = 0  # 0: not yet
    recording: Recording | None = None
    _readings: list[Reading] = field(default_factory=list)
    _loading: Generator[None] | None = None
    _reading: Generator[None, None, Recording | None] | None = None
    _asked_ns: int = 0

    def __post_init__(self) -> None:
        self.voltages = np.tile(np.array(self.present), (self.request.times_ns.size, 1))
        for column, name in enumerate(self.request.names):
            self.voltages[:, self.axes.index(name)] = self.request.voltages[:, column]

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.voltages)

    @property
    def playing_by_device(self) -> bool:
        """Whether the device moves the voltages by itself now."""
        return self.by_device and self.begun_ns != 0 and not self.ended

    def tell(self, told: Told, reason: str = "") -> None:
        """Tell a state."""
        self.states.append(BlockState(told, self.request.stamp_ns, self.sample, reason))

    def prepare(self, device: Device) -> str:
        """Choose how the block is played; return why it is streamed, "" if the device plays it."""
        if not device.block_period:
            return "the device plays no blocks: streamed"
        steps = np.diff(self.request.times_ns) / SECOND_NS
        if not steps.size:
            return "a single sample: streamed"
        period = float(np.mean(steps))
        cycles = round(period / device.block_period)
        if cycles < 1 or abs(period / device.block_period - cycles) > OFF_CLOCK * cycles:
            return f"{period:g} s is no multiple of the {device.block_period:g} s of the device's clock: streamed"
        if np.abs(steps - period).max() > OFF_CLOCK * period:
            return "its samples are not evenly spaced: streamed"
        if self.count > device.longest_block:
            return f"{self.count} samples are more than the {device.longest_block} of the device: streamed"
        self.by_device = True
        self._loading = device.load(Block(cycles * device.block_period, self.voltages))
        return ""

    def turn(self, device: Device, now_ns: int) -> None:
        """Do the next piece of what the device plays itself; DeviceError if it fails."""
        if self._loading is not None:
            try:
                next(self._loading)
            except StopIteration:
                self._loading = None
                device.play()
                self.begun_ns = self._asked_ns = now_ns
                self.tell(Told.PLAYING)
        elif self.ended:
            self._read()
        elif now_ns - self._asked_ns >= ASK_NS:
            self._asked_ns, self.sample = now_ns, device.played()
            if self.sample >= self.count:
                self.finish(Told.ENDED, device=device)
            else:
                self.tell(Told.PLAYING)

    def goal(self, now_ns: int) -> tuple[float, ...]:
        """Return the voltages (V) to stream now."""
        if not self.begun_ns:
            self.begun_ns = self._asked_ns = now_ns
            self.tell(Told.PLAYING)
        elapsed, times = now_ns - self.begun_ns, self.request.times_ns
        self.sample = int(np.searchsorted(times, elapsed, "right"))
        if now_ns - self._asked_ns >= ASK_NS and self.sample < self.count:
            self._asked_ns = now_ns
            self.tell(Told.PLAYING)
        columns = range(self.voltages.shape[1])
        return tuple(float(np.interp(elapsed, times, self.voltages[:, column])) for column in columns)

    def note(self, reading: Reading) -> None:
        """Keep a reading of a block that is streamed, as its record."""
        if self.begun_ns and not self.by_device and not self.ended:
            self._readings.append(reading)

    def finish(self, told: Told, reason: str = "", device: Device | None = None) -> None:
        """End it; what was recorded is read by the next turns if a device is given."""
        self.ended = True
        if self.by_device and device is not None and self.begun_ns:
            self._reading = device.recorded()
        elif self._readings:
            times = np.array([each.read_ns - self.begun_ns for each in self._readings]) / SECOND_NS
            positions, voltages = (
                np.array([getattr(each, name) for each in self._readings]) for name in ("positions", "voltages")
            )
            self.recording = Recording(times, positions, voltages)
        self.tell(told, reason)

    def _read(self) -> None:
        if self._reading is None:
            return
        try:
            next(self._reading)
        except StopIteration as stop:
            self._reading, self.recording = None, stop.value

    @property
    def done(self) -> bool:
        """Whether nothing of it is left to do."""
        return self.ended and self._reading is None
