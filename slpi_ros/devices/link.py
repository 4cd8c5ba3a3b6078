"""The link to a device: its state, and how it is opened and checked."""

from dataclasses import dataclass
from enum import Enum

from slpi_ros.devices.writer import ROUNDING, LoopSettings
from slpi_ros.drivers.base import Device, Found, UnsuitableError


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

    @property
    def armed(self) -> bool:
        """Whether voltages may be written."""
        return self.state is State.ARMED

    @property
    def lost(self) -> bool:
        """Whether there is no link."""
        return self.state is State.LOST


def opened(device: Device, settings: LoopSettings, *, arm: bool, reason: str) -> tuple[Found, str]:
    """Open and check a device, to be armed or only read; return what is found, and why it is held if it is not armed.

    The `reason` is that of the link that was lost. A servo that is on is refused, or with `take_over_servo` switched
    off where motion was agreed to. Raises DeviceError.
    """
    found = device.open()
    _require_range(device, settings, found)
    if not any(found.servo):
        return found, f"the link was lost ({reason}) and is back; call ~/arm to go on"
    axes = [axis for axis, on in zip(settings.axes, found.servo, strict=True) if on]
    what = f"{device.name}: the servo of axis {', '.join(axes)} is on: the device moves the voltage itself"
    if not settings.take_over_servo:
        raise UnsuitableError(f"{what}; switch it off, or set take_over_servo")
    # Releasing the servo may move the stage a little: only where somebody has agreed to motion.
    if arm and any((found := device.release_servo()).servo):
        raise UnsuitableError(f"{what}, and it does not switch it off; do so at the device")
    return found, f"{what}; ~/arm switches it off and goes on"


def _require_range(device: Device, settings: LoopSettings, found: Found) -> None:
    """Raise UnsuitableError where the limits are beyond the device's own range."""
    every = zip(settings.axes, settings.limits, found.lowest, found.highest, strict=True)
    for axis, limits, low, high in every:
        if limits.lower < low - ROUNDING or limits.upper > high + ROUNDING:
            raise UnsuitableError(
                f"{device.name}: axis '{axis}': voltage_min {limits.lower:g} and voltage_max "
                f"{limits.upper:g} V are beyond the device's own range, {low:g} to {high:g} V; give limits within"
            )
