"""What the node `driver` does with a device, without ROS: the cycle, the last limits, a lost link, the end."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

from slpi_ros.compensator.amplifier import FOREIGN_NS, FOREIGN_REPORTS, TOLERATED_SHARE
from slpi_ros.compensator.statistics import Timing
from slpi_ros.drivers.base import Device, DeviceError, Found, Reading, UnsuitableError
from slpi_ros.effects.excitation import MEAN_SPEED
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, RateLimiter, volts
from slpi_ros.nodes.device_block import BlockPlayer, BlockRequest, BlockState, Told, refusal
from slpi_ros.nodes.device_pace import Pace

# Time between two attempts to reach a device, and longest wait of the thread for a command, seconds.
RETRY, LONGEST_SLEEP = 0.25, 0.05
# A voltage that was written may be reported for this time.
BAND_NS = 3 * SECOND_NS // 10
# The commands are told to be held at a limit for this time.
HELD_NS = SECOND_NS
# A voltage of the device's range may be off by rounding, volts.
ROUNDING = 1e-6


class State(Enum):
    """State of a device."""

    OPENING = "opening"
    LOST = "lost"  # no link; it is tried again and again
    HELD = "held"  # read, but never written until it is armed
    ARMED = "armed"  # follows the commands


@dataclass(frozen=True)
class LoopSettings:
    """Settings of a `DeviceLoop`; voltages are those at the stage."""

    axes: tuple[str, ...]
    limits: tuple[Limits, ...]
    rate: float = 1000.0  # Hz
    take_over_servo: bool = False
    rearm: bool = False
    rest: tuple[float, ...] | None = None  # V, to ramp to at the end; None: hold


@dataclass(frozen=True)
class Status:
    """State of a device and its reason."""

    state: State
    reason: str = ""  # why it is not armed, and what to do
    since: float = 0.0  # s, system time at which the state began


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
    now_ns : the steady clock (ns)

    Cycles fall in step with commands that come steadily, so that these are not written up to a cycle late (`Pace`).

    The first opening raises its error out of `run`. Nothing is written before the first command, and the first voltage
    starts from the one that the device had. After an error the device is opened anew until it succeeds; then it is only
    read until `arm`, or armed at once with ``rearm``.
    """

    def __init__(
        self,
        device: Device,
        settings: LoopSettings,
        on_reading: Callable[[Reading], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.status, self.counts, self.timing = Status(State.OPENING), LoopCounts(), Timing()
        self.found: Found | None = None
        self.latest: Reading | None = None
        self.answers: deque[tuple[str, bool, str]] = deque()  # request, whether it succeeded, text
        self.block_states: deque[BlockState] = deque()
        self.recorded: deque[BlockPlayer] = deque()  # blocks that ended with a recording
        self._block: BlockPlayer | None = None
        self._submitted: deque[BlockRequest] = deque()
        self._device, self._settings, self._on_reading, self._now_ns = device, settings, on_reading, now_ns
        self._limiters = [RateLimiter(limits, 1.0 / settings.rate) for limits in settings.limits]
        spans = [limits.upper - limits.lower for limits in settings.limits]
        # At the end there is always a slew limit.
        self._fastest = [
            math.inf if each.slew < math.inf else MEAN_SPEED * span
            for each, span in zip(settings.limits, spans, strict=True)
        ]
        self._spans = spans
        self._lock = threading.Lock()
        # Free once a command has come that no cycle has taken; an event would take several times longer.
        self._commanded = threading.Lock()
        self._commanded.acquire()
        self._goal: tuple[float, ...] | None = None  # V, of the last command
        self._requests: set[str] = set()
        self._written: tuple[float, ...] = ()
        self._sent: deque[tuple[int, tuple[float, ...]]] = deque()
        self._offsets: tuple[float, ...] = ()
        self._outside, self._outside_ns = 0, 0
        self._limited_ns = [-(1 << 62)] * len(spans)
        self._retry_ns = 0
        self._ending = False

    # Called by other threads: none of them waits

    def command(self, voltages: Sequence[float]) -> str:
        """Take the voltages (V) of all axes as the goal; return why they are rejected, or ""."""
        axes = self._settings.axes
        status = self.status
        if len(voltages) != len(axes) or not all(map(math.isfinite, voltages)):
            reason = f"{list(voltages)[:8]}: send one finite voltage for each of the axes {', '.join(axes)}"
        elif status.state is not State.ARMED or self._ending:
            reason = status.reason or "the device is not open yet"
        elif self._submitted or self._playing:
            reason = "a block is being played; wait for its end, or stop it with an empty trajectory"
        else:
            with self._lock:
                self._goal = tuple(voltages)
                if self._commanded.locked():
                    self._commanded.release()
            return ""
        self.counts.rejected += 1
        return reason

    def request(self, what: str) -> None:
        """Ask for "arm" or "stop"; the outcome appears in `answers`."""
        with self._lock:
            self._requests.add(what)

    def submit(self, request: BlockRequest) -> None:
        """Take a block to play, or an empty one to stop; what becomes of it appears in `block_states`."""
        self._submitted.append(request)

    def end(self) -> None:
        """Ask the thread to end: after the ramp to rest, if there is one."""
        self._ending = True

    @property
    def limited(self) -> tuple[str, ...]:
        """Axes whose commands were beyond the voltage limits lately."""
        now_ns = self._now_ns()
        pairs = zip(self._settings.axes, self._limited_ns, strict=True)
        return tuple(axis for axis, last_ns in pairs if now_ns - last_ns < HELD_NS)

    # The thread

    def run(self) -> None:
        """Open the device and serve it until `end`; raise the error of the first opening."""
        pace = Pace(round(SECOND_NS / self._settings.rate), self._now_ns())
        try:
            while not self._ending or self._returning():
                self._wait(pace)
                began_ns = self._now_ns()
                if not self._lost:
                    self.timing.note(pace.due_ns, began_ns)
                pace.begin(began_ns)
                self.turn()
                self.counts.late += pace.leave_out(self._now_ns())
        finally:
            with suppress(DeviceError):
                self._stop_block("the driver has ended")
            self._device.close()

    def turn(self) -> None:
        """Do one cycle: open the device; write what is due, and read; or try to reach it again."""
        self._commanded.acquire(blocking=False)
        if self.status.state is State.OPENING:
            self._open(first=True)
            return
        if self._lost:
            self._refuse_requests()
            if self._now_ns() >= self._retry_ns:
                self._try_again()
            return
        self._serve_requests()
        if self._lost:
            return
        now_ns = self._now_ns()
        try:
            self._serve_blocks()
            block = self._block
            if block is not None and block.by_device:
                self._play(block, now_ns)
            reading = self._device.exchange(self._next(now_ns))
        except DeviceError as error:
            self._lose(error)
            return
        self.counts.cycles += 1
        self.latest = reading
        self._on_reading(reading)
        if block is not None:
            self._after(block, reading)
        if self.status.state is State.ARMED and not (block and block.playing_by_device):
            self._compare(reading, now_ns)

    @property
    def _lost(self) -> bool:
        return self.status.state is State.LOST

    def _wait(self, pace: Pace) -> None:
        """Wait until a cycle is due, which a command may bring forward."""
        while (wait := (pace.due_ns - self._now_ns()) * 1e-9) > 0.0 and not self._ending:
            if self._commanded.acquire(timeout=min(wait, LONGEST_SLEEP)):
                pace.note_command(self._now_ns())

    # Blocks

    @property
    def _playing(self) -> bool:
        return self._block is not None and not self._block.ended

    def _serve_blocks(self) -> None:
        """Begin with a block that has come, or say why not; stop the present one for an empty one."""
        while self._submitted:
            request = self._submitted.popleft()
            if not request.times_ns.size:
                self._stop_block("by an empty trajectory")
                continue
            axes, limits = self._settings.axes, self._settings.limits
            if self.status.state is not State.ARMED or self._ending:
                reason = self.status.reason or "the driver ends"
            elif self._block is not None:
                reason = "a block is being played; wait for its end, or stop it with an empty trajectory"
            else:
                reason = refusal(request, axes, limits, self._written, 1.0 / self._settings.rate)
            if reason:
                self.block_states.append(BlockState(Told.REFUSED, request.stamp_ns, 0, reason))
                continue
            with self._lock:
                self._goal = None
            block = BlockPlayer(request, axes, self._written, self.block_states)
            block.tell(Told.ACCEPTED, block.prepare(self._device))
            self._block = block

    def _play(self, block: BlockPlayer, now_ns: int) -> None:
        """Let the device go on with a block that it plays itself."""
        ended = block.ended
        block.turn(self._device, now_ns)
        if block.ended and not ended:
            self._resume(tuple(block.voltages[-1].tolist()))

    def _after(self, block: BlockPlayer, reading: Reading) -> None:
        """Look at a block after a cycle: whether it has ended, and what was recorded."""
        block.note(reading)
        if not block.by_device and not block.ended and block.sample >= block.count:
            last = tuple(block.voltages[-1].tolist())
            if all(abs(v - w) <= ROUNDING for v, w in zip(self._written, last, strict=True)):
                block.finish(Told.ENDED)
        if block.done:
            if block.recording is not None:
                self.recorded.append(block)
            self._block = None

    def _stop_block(self, reason: str) -> str:
        """Stop the block that is being played where it is; return which sample that is, "" if there is none."""
        block = self._block
        if block is None or block.ended:
            return ""
        if block.playing_by_device:
            block.sample = self._device.halt()
            self._resume(self._device.read().voltages)
        block.finish(Told.STOPPED, reason, self._device)
        if block.done:
            if block.recording is not None:
                self.recorded.append(block)
            self._block = None
        return f"the block was stopped at sample {block.sample} of {block.count}"

    def _resume(self, voltages: tuple[float, ...]) -> None:
        """Go on from the voltages (V) at which the device has ended a block."""
        for limiter, v in zip(self._limiters, voltages, strict=True):
            limiter.start(v)
        self._written = voltages
        self._sent.clear()
        self._outside = 0

    # Opening

    def _open(self, *, first: bool = False, arm: bool = False) -> None:
        """Open the device and check it; afterwards it is armed or held. Raises DeviceError."""
        found = self._device.open()
        self._require_range(found)
        reason = ""
        # Releasing the servo may move the stage a little: only where somebody has agreed to motion.
        arm = arm or first or self._settings.rearm
        if any(found.servo):
            axes = [axis for axis, on in zip(self._settings.axes, found.servo, strict=True) if on]
            told = (
                f"{self._device.name}: the servo of axis {', '.join(axes)} is on: the device moves the voltage itself"
            )
            if not self._settings.take_over_servo:
                raise UnsuitableError(f"{told}; switch it off, or set take_over_servo")
            if arm:
                found = self._device.release_servo()
                if any(found.servo):
                    raise UnsuitableError(f"{told}, and it does not switch it off; do so at the device")
            else:
                reason = f"{told}; ~/arm switches it off and goes on"
        self.found, self.latest = found, found.reading
        self._start(found)
        if arm:
            self._set(State.ARMED)
        else:
            lost = self.status.reason
            self._set(State.HELD, reason or f"the link was lost ({lost}) and is back; call ~/arm to go on")

    def _start(self, found: Found) -> None:
        """Start from the voltages that the device has; older goals are dropped."""
        with self._lock:
            self._goal = None
        for limiter, v in zip(self._limiters, found.setpoints, strict=True):
            limiter.start(v)
        self._written = found.setpoints
        self._sent.clear()
        self._outside = 0
        pairs = zip(found.reading.voltages, found.setpoints, strict=True)
        self._offsets = tuple(abs(told - setpoint) for told, setpoint in pairs)

    def _require_range(self, found: Found) -> None:
        """Raise UnsuitableError where the limits are beyond the device's own range."""
        for axis, limits, low, high in zip(
            self._settings.axes, self._settings.limits, found.lowest, found.highest, strict=True
        ):
            if limits.lower < low - ROUNDING or limits.upper > high + ROUNDING:
                raise UnsuitableError(
                    f"{self._device.name}: axis '{axis}': voltage_min {limits.lower:g} and voltage_max "
                    f"{limits.upper:g} V are beyond the device's own range, {low:g} to {high:g} V; give limits within"
                )

    def _try_again(self) -> None:
        try:
            self._open()
        except DeviceError as error:
            self._device.close()
            self._set(State.LOST, str(error))
            self._retry_ns = self._now_ns() + round(RETRY * SECOND_NS)

    def _lose(self, error: SlpiError) -> None:
        if self._block is not None:
            if not self._block.ended:
                self._block.finish(Told.STOPPED, str(error))
            self._block = None
        self._device.close()
        self.counts.losses += 1
        self._set(State.LOST, str(error))
        self._retry_ns = self._now_ns() + round(RETRY * SECOND_NS)

    def _set(self, state: State, reason: str = "") -> None:
        """Set the state; it goes on since it began, if only its reason is another."""
        since = self.status.since if state is self.status.state else time.time()
        self.status = Status(state, reason, since)
        if state is not State.ARMED:
            with self._lock:
                self._goal = None

    # Requests

    def _taken(self) -> set[str]:
        with self._lock:
            requests, self._requests = self._requests, set()
        return requests

    def _refuse_requests(self) -> None:
        for what in self._taken():
            self.answers.append((what, False, self.status.reason))

    def _serve_requests(self) -> None:
        if not self._requests:
            return
        requests = self._taken()
        if "stop" in requests:
            try:
                stopped = self._stop_block("by ~/stop")
            except DeviceError as error:
                self._lose(error)
                self.answers.append(("stop", False, str(error)))
                return
            self._set(State.HELD, "stopped by ~/stop; call ~/arm to go on")
            told = self._written if stopped else self.latest.voltages if self.latest else ()
            self.answers.append(("stop", True, f"held at {volts(*told)} V; {stopped or 'no block was being played'}"))
        if "arm" not in requests:
            return
        if self.status.state is State.ARMED:
            self.answers.append(("arm", True, "it was armed"))
            return
        try:
            self._open(arm=True)
        except DeviceError as error:
            self._lose(error)
            self.answers.append(("arm", False, str(error)))
        else:
            self.answers.append(("arm", True, f"goes on from {volts(*self._written)} V"))

    # Voltages

    def _next(self, now_ns: int) -> tuple[float, ...] | None:
        """Return the voltages (V) to write; None if they are those that were written last, or nothing is commanded."""
        block = self._block
        goal = self._goal
        if self._ending and self._settings.rest:
            goal = self._settings.rest
        elif block is not None and not block.ended:
            # Until the device has played it, nothing is written.
            goal = None if block.by_device or self.status.state is not State.ARMED else block.goal(now_ns)
        if goal is None or self.status.state is not State.ARMED:
            return None
        fastest = self._fastest if self._ending else [math.inf] * len(goal)
        wanted = tuple(
            limiter.step(v, now_ns, rate) for limiter, v, rate in zip(self._limiters, goal, fastest, strict=True)
        )
        for place, (v, limits) in enumerate(zip(goal, self._settings.limits, strict=True)):
            if not limits.lower <= v <= limits.upper:
                self._limited_ns[place] = now_ns
        if wanted == self._written:
            return None
        self._sent.append((now_ns, self._written))
        self._written = wanted
        return wanted

    def _returning(self) -> bool:
        """Return whether the way to rest is not at its end yet."""
        rest = self._settings.rest
        if rest is not None and self._playing:
            try:
                self._stop_block("the driver ends")
            except DeviceError as error:
                self._lose(error)
        return rest is not None and self.status.state is State.ARMED and self._written != rest

    def _compare(self, reading: Reading, now_ns: int) -> None:
        """Hold if the device says, again and again, another voltage than what was written."""
        # Then its command is not in volts, its own limits are narrower, or somebody else moves it.
        while self._sent and now_ns - self._sent[0][0] > BAND_NS:
            self._sent.popleft()
        for place, told in enumerate(reading.voltages):
            band = [self._written[place], *(v[place] for _, v in self._sent)] if self._differs(place, told) else [told]
            tolerated = TOLERATED_SHARE * self._spans[place] + self._offsets[place]
            if not min(band) - tolerated <= told <= max(band) + tolerated:
                break
        else:
            self._outside = 0
            return
        if not self._outside:
            self._outside_ns = now_ns
        self._outside += 1
        if self._outside >= FOREIGN_REPORTS and now_ns - self._outside_ns >= FOREIGN_NS:
            self._set(
                State.HELD,
                f"{self._device.name}: axis '{self._settings.axes[place]}' is at {volts(told)} V, but "
                f"{volts(self._written[place])} V was written: the device limits the voltage, its command is not in "
                "volts, or somebody else moves it; find out which, then call ~/arm",
            )

    def _differs(self, place: int, told: float) -> bool:
        """Return whether a report is off by more than what means nothing, without a look at the past."""
        return abs(told - self._written[place]) > TOLERATED_SHARE * self._spans[place]
