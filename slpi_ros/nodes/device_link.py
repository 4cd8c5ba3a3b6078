"""The link to a device: opened and checked, lost and tried again; whether it may be moved."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from slpi_ros.drivers.base import Device, Found, UnsuitableError
from slpi_ros.errors import SlpiError
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.nodes.device_writer import ROUNDING, LoopSettings

# Time between two attempts to reach a device.
RETRY_NS = SECOND_NS // 4


class State(Enum):
    """State of a device."""

    OPENING = "opening"
    LOST = "lost"  # no link; it is tried again and again
    HELD = "held"  # read, but never written until it is armed
    ARMED = "armed"  # follows the commands


@dataclass(frozen=True)
class Status:
    """State of a device and its reason."""

    state: State
    reason: str = ""  # why it is not armed, and what to do
    since: float = 0.0  # s, system time at which the state began


class Link:
    """A device that is opened before it is read, and armed before it is written.

    After an error it is `LOST`, until it is opened again once it is `due`; a servo that is on is refused, or with
    `take_over_servo` switched off where motion was agreed to.
    """

    def __init__(self, device: Device, settings: LoopSettings, now_ns: Callable[[], int]) -> None:
        self.status = Status(State.OPENING)
        self._device, self._settings = device, settings
        self._now_ns, self._retry_ns = now_ns, 0

    @property
    def armed(self) -> bool:
        """Whether voltages may be written."""
        return self.status.state is State.ARMED

    @property
    def lost(self) -> bool:
        """Whether there is no link."""
        return self.status.state is State.LOST

    @property
    def due(self) -> bool:
        """Whether it is time to try again."""
        return self._now_ns() >= self._retry_ns

    def lose(self, error: SlpiError) -> None:
        """Close the device for an error."""
        self._device.close()
        self.set(State.LOST, str(error))
        self._retry_ns = self._now_ns() + RETRY_NS

    def set(self, state: State, reason: str = "") -> None:
        """Set the state; it goes on since it began, if only its reason is another."""
        since = self.status.since if state is self.status.state else time.time()
        self.status = Status(state, reason, since)

    def open(self, arm: bool) -> tuple[Found, str]:
        """Open and check the device to be armed, or only read; return what is found, and why to hold. DeviceError."""
        found = self._device.open()
        self._require_range(found)
        if not any(found.servo):
            return found, f"the link was lost ({self.status.reason}) and is back; call ~/arm to go on"
        axes = [axis for axis, on in zip(self._settings.axes, found.servo, strict=True) if on]
        what = f"{self._device.name}: the servo of axis {', '.join(axes)} is on: the device moves the voltage itself"
        if not self._settings.take_over_servo:
            raise UnsuitableError(f"{what}; switch it off, or set take_over_servo")
        # Releasing the servo may move the stage a little: only where somebody has agreed to motion.
        if arm and any((found := self._device.release_servo()).servo):
            raise UnsuitableError(f"{what}, and it does not switch it off; do so at the device")
        return found, f"{what}; ~/arm switches it off and goes on"

    def _require_range(self, found: Found) -> None:
        """Raise UnsuitableError where the limits are beyond the device's own range."""
        every = zip(self._settings.axes, self._settings.limits, found.lowest, found.highest, strict=True)
        for axis, limits, low, high in every:
            if limits.lower < low - ROUNDING or limits.upper > high + ROUNDING:
                raise UnsuitableError(
                    f"{self._device.name}: axis '{axis}': voltage_min {limits.lower:g} and voltage_max "
                    f"{limits.upper:g} V are beyond the device's own range, {low:g} to {high:g} V; give limits within"
                )
