"""A block of voltages for a device: checked as a whole, then played by the device's clock or streamed; without ROS."""

from collections import deque
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from slpi_ros.devices.writer import LoopSettings, Writer
from slpi_ros.drivers.base import Block, Device, Reading, Recording
from slpi_ros.io.messages import SECOND_NS, TrajectoryArrays
from slpi_ros.model.limits import volts

# Steps of a block may exceed the slew limit by rounding, and its samples miss the device's clock by this share.
ROUNDING, OFF_CLOCK = 1e-6, 1e-3
# The device is asked for its sample once in this time, and how far a block is is said that often.
ASK_NS = SECOND_NS // 20
BUSY = "a block is being played; wait for its end, or stop it with an empty trajectory"


class BlockPhase(Enum):
    """How far a block is, as `voltage_trajectory_state` says."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    PLAYING = "playing"
    ENDED = "ended"
    STOPPED = "stopped"


@dataclass(frozen=True)
class BlockState:
    """One state of a block."""

    phase: BlockPhase
    stamp_ns: int  # of the block
    sample: int  # number of samples that were played
    reason: str = ""


def block_values(values: Mapping[str, str]) -> tuple[int, int, str] | None:
    """Return stamp (ns), sample and reason of what a driver says of a block, None if it names no block."""
    seconds, _, rest = values.get("stamp", "").partition(".")
    sample = values.get("sample", "")
    if not (seconds.isdecimal() and rest.isdecimal() and sample.isdecimal()):
        return None
    return int(seconds) * SECOND_NS + int(rest), int(sample), values.get("reason", "")


def block_state(message: str, values: Mapping[str, str]) -> BlockState | None:
    """Return what a driver says on `voltage_trajectory_state`, None if it is no state of a block."""
    found = block_values(values)
    known = message in {phase.value for phase in BlockPhase}
    return BlockState(BlockPhase(message), *found) if known and found else None


def refusal(request: TrajectoryArrays, settings: LoopSettings, present: Sequence[float]) -> str:
    """Return why a block of voltages (V) may not be played from the `present` ones (V), "" if it may."""
    axes, times, values = settings.axes, request.time_from_start_ns, request.values
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
    # The first sample may be as far as one step of single voltages, whatever its time: a device that plays the block
    # knows no times, and begins with it at once.
    seconds = np.concatenate([[2.0 / settings.rate], np.diff(times) / SECOND_NS])
    for name, v in zip(request.names, values.T, strict=True):
        place = axes.index(name)
        own = settings.limits[place]
        beyond = (v < own.lower - ROUNDING) | (v > own.upper + ROUNDING)
        if beyond.any():
            at = int(np.argmax(beyond))
            return f"axis '{name}', sample {at}: {volts(v[at])} V is beyond {own.lower:g} to {own.upper:g} V"
        steps = np.abs(np.diff(v, prepend=present[place]))
        fast = steps > own.slew * seconds * (1.0 + OFF_CLOCK) + ROUNDING
        if fast.any():
            at = int(np.argmax(fast))
            if at == 0:
                return (
                    f"axis '{name}': it begins at {volts(v[0])} V, but the device is at {volts(present[place])} V; "
                    "begin at the present voltage"
                )
            return (
                f"axis '{name}', sample {at}: {steps[at] / seconds[at]:.4g} V/s, more than slew_limit {own.slew:g} V/s"
            )
    return ""


class BlockPlayer:
    """One block on its way: loaded and played by the device, or streamed where it cannot; used by one thread.

    What it does not name stays at the `present` voltages (V). `states` takes what becomes of it.
    """

    def __init__(
        self, request: TrajectoryArrays, axes: Sequence[str], present: tuple[float, ...], states: deque[BlockState]
    ) -> None:
        self.stamp_ns, self._times_ns, self._states = request.start_ns, request.time_from_start_ns, states
        self.voltages = np.tile(np.array(present), (self._times_ns.size, 1))
        for column, name in enumerate(request.names):
            self.voltages[:, axes.index(name)] = request.values[:, column]
        self.count, self.last = len(self.voltages), tuple(self.voltages[-1].tolist())
        self.by_device = self.ended = False
        self.sample = self.begun_ns = 0  # 0: not yet
        self.recording: Recording | None = None
        self.readings: list[Reading] = []  # while it is streamed: its record
        self._life: Generator[None] | None = None  # what the device still has to do
        self._how = ""  # why it is streamed
        self._asked_ns = self._now_ns = 0

    @property
    def done(self) -> bool:
        """Whether nothing of it is left to do."""
        return self.ended and self._life is None

    def tell(self, phase: BlockPhase, reason: str = "") -> None:
        """Say how far it is."""
        self._states.append(BlockState(phase, self.stamp_ns, self.sample, reason))

    def accept(self, device: Device, now_ns: int) -> None:
        """Choose how it is played, and say so."""
        self._how = self._prepare(device)
        self._tell_accepted(now_ns)

    def wait(self, now_ns: int) -> None:
        """Say again that it is accepted, while it is loaded or waits for that: whoever hears nothing gives it up."""
        if not self.begun_ns and not self.ended and now_ns - self._asked_ns >= ASK_NS:
            self._tell_accepted(now_ns)

    def _tell_accepted(self, now_ns: int) -> None:
        self._asked_ns = now_ns
        self.tell(BlockPhase.ACCEPTED, self._how)

    def _prepare(self, device: Device) -> str:
        """Choose how the block is played; return why it is streamed, "" if the device plays it."""
        if not device.block_period:
            return "the device plays no blocks: streamed"
        steps = np.diff(self._times_ns) / SECOND_NS
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
        self.by_device, self._life = True, self._play(device, cycles * device.block_period)
        return ""

    def turn(self, now_ns: int) -> None:
        """Do the next piece of what the device plays itself; DeviceError if it fails."""
        self._now_ns = now_ns
        if self._life is not None:
            next(self._life, None)
            self.wait(now_ns)

    def _play(self, device: Device, period: float) -> Generator[None]:
        """Load, play and read it, in pieces of one wait of the device each."""
        yield from device.load(Block(period, self.voltages))
        device.play()
        self._tell_playing()
        while not self.ended:
            yield
            if not self.ended and self._now_ns - self._asked_ns >= ASK_NS:
                self.sample = device.played()
                if self.sample < self.count:
                    self._tell_playing()
                else:
                    self.finish(BlockPhase.ENDED)
        yield
        self.recording, self._life = (yield from device.recorded()), None

    def _tell_playing(self) -> None:
        self.begun_ns, self._asked_ns = self.begun_ns or self._now_ns, self._now_ns
        self.tell(BlockPhase.PLAYING)

    def goal(self, now_ns: int) -> tuple[float, ...]:
        """Return the voltages (V) to stream now."""
        self._now_ns = now_ns
        if not self.begun_ns:
            self._tell_playing()
        elapsed = now_ns - self.begun_ns
        self.sample = int(np.searchsorted(self._times_ns, elapsed, "right"))
        if now_ns - self._asked_ns >= ASK_NS and self.sample < self.count:
            self._tell_playing()
        return tuple(float(np.interp(elapsed, self._times_ns, column)) for column in self.voltages.T)

    def finish(self, phase: BlockPhase, reason: str = "") -> None:
        """End it; what the device recorded is read by the next turns."""
        self.ended = True
        if not self.begun_ns:
            self._life = None
        if self.readings:
            times = np.array([each.read_ns - self.begun_ns for each in self.readings]) / SECOND_NS
            positions = np.array([each.positions for each in self.readings])
            self.recording = Recording(times, positions, np.array([each.voltages for each in self.readings]))
        self.tell(phase, reason)


class Blocks:
    """The blocks of a device, one at a time: taken or refused, played or streamed, stopped, and what was recorded.

    `submit` and `busy` are for any thread, the others for that of the device. Where a block ends, `writer` goes on. The
    next one may follow from then on: it waits until the device has told what it recorded of the one before.
    """

    def __init__(self, device: Device, settings: LoopSettings, writer: Writer) -> None:
        self.states: deque[BlockState] = deque()
        self.recorded: deque[BlockPlayer] = deque()  # that ended with a recording
        self._device, self._settings, self._writer = device, settings, writer
        self._submitted: deque[TrajectoryArrays] = deque()
        self._block: BlockPlayer | None = None
        self._next: BlockPlayer | None = None  # waits

    def submit(self, request: TrajectoryArrays) -> None:
        """Take a block of voltages (V) to play, or an empty one to stop; what becomes of it appears in `states`."""
        self._submitted.append(request)

    @property
    def _going(self) -> BlockPlayer | None:
        """The block that has not ended yet."""
        return next((each for each in (self._block, self._next) if each is not None and not each.ended), None)

    @property
    def moving(self) -> bool:
        """Whether a block is being played or streamed, or loaded for that."""
        return self._going is not None

    @property
    def busy(self) -> bool:
        """Whether single voltages have to wait."""
        return bool(self._submitted) or self.moving

    @property
    def by_device(self) -> bool:
        """Whether the device moves the voltages by itself now."""
        block = self._block
        return block is not None and block.by_device and block.begun_ns != 0 and not block.ended

    def serve(self, held: str, now_ns: int) -> None:
        """Begin with a block that has come, or say why not, as with the reason `held`; let the device play its own."""
        while self._submitted:
            request = self._submitted.popleft()
            if not request.time_from_start_ns.size:
                self.stop("by an empty trajectory")
                continue
            reason = held or (BUSY if self.moving else refusal(request, self._settings, self._writer.written))
            if reason:
                self.states.append(BlockState(BlockPhase.REFUSED, request.start_ns, 0, reason))
                continue
            self._next = BlockPlayer(request, self._settings.axes, self._writer.written, self.states)
            self._writer.goal = None
            self._next.accept(self._device, now_ns)
        if self._block is None:
            self._block, self._next = self._next, None
        if self._next is not None:
            self._next.wait(now_ns)
        if self._block is not None:
            moving = not self._block.ended
            self._block.turn(now_ns)
            if moving and self._block.ended:
                self._writer.start(self._block.last)

    def goal(self, now_ns: int) -> tuple[float, ...] | None:
        """Return the voltages (V) to stream now; None where the device plays the block."""
        return None if self._block is None or self._block.by_device else self._block.goal(now_ns)

    def note(self, reading: Reading) -> None:
        """Look at the block after a cycle: whether it has ended, and what was recorded."""
        block = self._block
        if block is None:
            return
        if block.begun_ns and not block.by_device and not block.ended:
            block.readings.append(reading)
            if block.sample >= block.count and self._writer.at(block.last):
                block.finish(BlockPhase.ENDED)
        self._put_away(block)

    def stop(self, reason: str) -> str:
        """Stop the block that is being played where it is; return which sample that is, "" if there is none."""
        block = self._going
        if block is None:
            return ""
        if self.by_device:
            block.sample = self._device.halt()
            self._writer.start(self._device.read().voltages)
        block.finish(BlockPhase.STOPPED, reason)
        if block is self._next:
            self._next = None
        else:
            self._put_away(block)
        return f"the block was stopped at sample {block.sample} of {block.count}"

    def drop(self, reason: str) -> None:
        """End the block, as the link is lost."""
        if (block := self._going) is not None:
            block.finish(BlockPhase.STOPPED, reason)
        self._block = self._next = None

    def _put_away(self, block: BlockPlayer) -> None:
        if block.done:
            if block.recording is not None:
                self.recorded.append(block)
            self._block = None
