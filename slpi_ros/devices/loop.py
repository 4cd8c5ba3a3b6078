"""What the node `driver` does with a device, without ROS: the cycle, and what is asked of it."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from slpi_ros.compensator.monitor import Finding
from slpi_ros.compensator.statistics import Timing
from slpi_ros.devices.block import BUSY, Blocks
from slpi_ros.devices.link import State, Status, opened
from slpi_ros.devices.monitor import DeviceMonitor
from slpi_ros.devices.pace import Pace
from slpi_ros.devices.recent_readings import RecentReadings
from slpi_ros.devices.writer import LoopSettings, Writer
from slpi_ros.drivers.base import Device, DeviceError, Found, Reading
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import volts

# Longest wait of the thread for a command, seconds.
LONGEST_SLEEP = 0.05
# Time between two attempts to reach a device.
RETRY_NS = SECOND_NS // 4


@dataclass
class LoopCounts:
    """Counters of a `DeviceLoop`."""

    cycles: int = 0
    late: int = 0  # cycles that were left out, as the one before took too long
    rejected: int = 0  # commands
    losses: int = 0  # of the link


class DeviceLoop:
    """Reads a device and moves it within limits, in a thread of its own; no other thread ever waits for the device.

    Parameters
    ----------
    device : the device; used by the thread of `run` alone
    settings : axes, limits and rate
    on_reading : called by the thread with each reading
    on_found : called by the thread with what is found at each opening, before anything is read or written; an error
        other than a DeviceError ends `run`
    now_ns : the steady clock (ns)

    Cycles fall in step with commands that come steadily, so that these are not written up to a cycle late (`Pace`).

    The first opening raises its error out of `run`. Nothing is written before the first command, and the first voltage
    starts from the one that the device had. After an error the device is opened anew until it succeeds; then it is
    only read until `arm`, or armed at once with ``rearm``. Voltages pass a `Writer`, blocks are those of
    `Blocks`. A finding of the writer's monitor holds the device. Those of `monitor` are told; at the silence of the
    commands the device holds, or goes to ``silence_rest``, after which it is held unless ``rearm`` is set.
    """

    def __init__(
        self,
        device: Device,
        settings: LoopSettings,
        on_reading: Callable[[Reading], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
        on_found: Callable[[Found], None] = lambda found: None,
    ) -> None:
        self.counts, self.timing = LoopCounts(), Timing()
        self.found: Found | None = None
        self.latest: Reading | None = None
        self.recent = RecentReadings()
        self.answers: deque[tuple[str, bool, str]] = deque()  # request, whether it succeeded, text
        self._device, self._settings, self._on_reading, self._now_ns = device, settings, on_reading, now_ns
        self._on_found = on_found
        self.status, self._retry_ns = Status(State.OPENING), 0
        self._writer = Writer(settings)
        self.blocks = Blocks(device, settings, self._writer)
        self.monitor = DeviceMonitor(settings)
        self._resting = False  # on the way to rest, though held
        # Free once a command has come that no cycle has taken; an event would take several times longer.
        self._commanded = threading.Lock()
        self._commanded.acquire()
        self._requests: deque[str] = deque()
        self._ending = False

    # Called by other threads: none of them waits

    def command(self, voltages: Sequence[float]) -> str:
        """Take the voltages (V) of all axes as the goal; return why they are rejected, or ""."""
        axes = self._settings.axes
        status = self.status
        if len(voltages) != len(axes) or not all(map(math.isfinite, voltages)):
            reason = f"{list(voltages)[:8]}: send one finite voltage for each of the axes {', '.join(axes)}"
        elif not status.armed or self._ending:
            reason = status.reason or "the device is not open yet"
        elif self.blocks.busy:
            reason = BUSY
        else:
            self._writer.goal = tuple(voltages)
            self.monitor.commands.carried_out(self._now_ns())
            # It is free already if no cycle has taken the one before.
            with suppress(RuntimeError):
                self._commanded.release()
            return ""
        self.counts.rejected += 1
        return reason

    def request(self, what: str) -> None:
        """Ask for "arm" or "stop"; the outcome appears in `answers`."""
        self._requests.append(what)

    def end(self) -> None:
        """Ask the thread to end: after the ramp to rest, if there is one."""
        self._ending = True

    @property
    def written(self) -> tuple[float, ...]:
        """Voltages that were written last, or that the device had at the start, volts."""
        return self._writer.written

    @property
    def limited(self) -> tuple[str, ...]:
        """Axes whose commands were beyond the voltage limits lately."""
        return self._writer.limited(self._now_ns())

    # The thread

    def run(self) -> None:
        """Open the device and serve it until `end`; raise the error of the first opening."""
        pace = Pace(round(SECOND_NS / self._settings.rate), self._now_ns())
        try:
            while not self._ending or self._returning():
                self._wait(pace)
                began_ns = self._now_ns()
                if not self.status.lost:
                    self.timing.note(pace.due_ns, began_ns)
                pace.begin(began_ns)
                self.turn()
                self.counts.late += pace.leave_out(self._now_ns())
        finally:
            with suppress(DeviceError):
                self.blocks.stop("the driver has ended")
            self._device.close()

    def turn(self) -> None:
        """Do one cycle: open the device; write what is due, and read; or try to reach it again."""
        self._commanded.acquire(blocking=False)
        if self.status.state is State.OPENING:
            self._open(arm=True)
            return
        try:
            while self._requests:
                self._serve(self._requests.popleft())
            if not self.status.lost:
                self._cycle(self._now_ns())
            elif self._now_ns() >= self._retry_ns:
                self._open(arm=self._settings.rearm)
        except DeviceError as error:
            self._lose(error)

    def _cycle(self, now_ns: int) -> None:
        """Write what is due, read, and look at what was read. Raises DeviceError."""
        armed = self.status.armed and not self._ending
        if self.blocks.moving:
            self.monitor.commands.carried_out(now_ns)
        self.blocks.serve("" if armed else self.status.reason or "the driver ends", now_ns)
        reading = self._device.exchange(self._next(now_ns))
        self.counts.cycles += 1
        self.latest = reading
        self.recent.note(reading)
        self._on_reading(reading)
        self.blocks.note(reading)
        if self._moving and not self.blocks.by_device and (found := self._writer.compare(reading, now_ns)):
            reason = f"{self._device.name}: {found}"
            # It begins, or goes on, at another voltage than the one that is there.
            self.blocks.stop(reason)
            self._hold(reason)
        for new in self.monitor.look(reading, now_ns):
            if new.rule == "commands":
                self._fall_silent(new)
        self._resting &= self._writer.written != self._settings.silence_rest

    @property
    def _moving(self) -> bool:
        """Whether voltages may be written."""
        return self.status.armed or self._resting

    def _fall_silent(self, found: Finding) -> None:
        """Hold, or go to rest, as commands have ceased."""
        rest = self._settings.silence_rest
        self._writer.goal = rest
        if rest is not None and not self._settings.rearm:
            self._hold(f"{found}: goes to rest at {volts(*rest)} V; call ~/arm to go on", resting=True)

    def _hold(self, reason: str, *, resting: bool = False) -> None:
        """Follow no commands until the device is armed; go to the goal of a rest first."""
        self._resting = resting
        self.monitor.commands.forget()
        self._set(State.HELD, reason)

    def _next(self, now_ns: int) -> tuple[float, ...] | None:
        """Return the voltages (V) to write; None if they are those that were written last, or nothing is commanded."""
        goal = self._writer.goal
        if self._ending and self._settings.rest:
            goal = self._settings.rest
        elif self.blocks.moving:
            goal = self.blocks.goal(now_ns)
        if goal is None or not self._moving:
            return None
        return self._writer.step(goal, now_ns, gently=self._ending or goal is self._settings.silence_rest)

    def _wait(self, pace: Pace) -> None:
        """Wait until a cycle is due, which a command may bring forward."""
        while (wait := (pace.due_ns - self._now_ns()) * 1e-9) > 0.0 and not self._ending:
            if self._commanded.acquire(timeout=min(wait, LONGEST_SLEEP)):
                pace.note_command(self._now_ns())

    def _returning(self) -> bool:
        """Return whether the way to rest is not at its end yet."""
        rest = self._settings.rest
        if rest is not None and self.blocks.moving:
            try:
                self.blocks.stop("the driver ends")
            except DeviceError as error:
                self._lose(error)
        return rest is not None and self._moving and self._writer.written != rest

    # The link

    def _open(self, *, arm: bool) -> None:
        """Open the device, and go on from the voltages that it has; older goals are dropped. Raises DeviceError."""
        self.found, held = opened(self._device, self._settings, arm=arm, reason=self.status.reason)
        self._on_found(self.found)
        self.latest = reading = self.found.reading
        offsets = [v - setpoint for v, setpoint in zip(reading.voltages, self.found.setpoints, strict=True)]
        self._writer.start(self.found.setpoints, offsets)
        self._writer.goal = None
        self._resting = False
        self.monitor.begin(self.found)
        if arm:
            self._set(State.ARMED)
        else:
            self._hold(held)

    def _lose(self, error: DeviceError) -> None:
        self.blocks.drop(str(error))
        self.counts.losses += not self.status.lost
        self._device.close()
        self.monitor.commands.forget()
        self._resting = False
        self._set(State.LOST, str(error))
        self._retry_ns = self._now_ns() + RETRY_NS

    def _set(self, state: State, reason: str = "") -> None:
        """Set the state; it goes on since it began, if only its reason is another."""
        since = self.status.since if state is self.status.state else time.time()
        self.status = Status(state, reason, since)

    def _serve(self, what: str) -> None:
        """Do what was asked, or say why not. Raises DeviceError."""
        try:
            self.answers.append((what, *self._done(what)))
        except DeviceError as error:
            self.answers.append((what, False, str(error)))
            raise

    def _done(self, what: str) -> tuple[bool, str]:
        """Return whether a request succeeds, and what to answer."""
        if self.status.lost:
            return False, self.status.reason
        if what == "arm":
            if self.status.armed:
                return True, "it was armed"
            self._open(arm=True)
            return True, f"goes on from {volts(*self._writer.written)} V"
        stopped = self.blocks.stop("by ~/stop")
        self._hold("stopped by ~/stop; call ~/arm to go on")
        there = self._writer.written if stopped else self.latest.voltages if self.latest else ()
        return True, f"held at {volts(*there)} V; {stopped or 'no block was being played'}"
