"""What is noticed of a device beside the voltages it says it has: commands that cease, and positions that are none."""

from collections.abc import Sequence
from math import nan

from slpi_ros.compensator.monitor import Finding, Monitor
from slpi_ros.compensator.plausible import PlausibleRule
from slpi_ros.devices.silence import CommandSilence
from slpi_ros.devices.writer import LoopSettings
from slpi_ros.drivers.base import Found, Reading
from slpi_ros.io.messages import SECOND_NS

# Time between two looks.
LOOK_NS = SECOND_NS // 20


class DeviceMonitor(Monitor):
    """Holds the rules about commands and units of a device; `standing` is what to tell."""

    def __init__(self, settings: LoopSettings) -> None:
        self.commands = CommandSilence(settings.silence)
        self._units = [PlausibleRule(each, axis) for axis, each in zip(settings.axes, settings.limits, strict=True)]
        super().__init__(self.commands, *self._units)
        self._looked_ns = 0

    def begin(self, found: Found) -> None:
        """Begin with a device that was opened."""
        self.commands.forget()
        travel: Sequence[float] = found.travel or [nan] * len(self._units)
        for rule, each in zip(self._units, travel, strict=True):
            rule.begin(each)

    def look(self, reading: Reading, now_ns: int) -> list[Finding]:
        """Take a reading; return what is newly found, of a look in twenty a second."""
        for rule, v, y in zip(self._units, reading.voltages, reading.positions, strict=True):
            rule.read(v, y, now_ns)
        if now_ns - self._looked_ns < LOOK_NS:
            return []
        self._looked_ns = now_ns
        return self.check(now_ns)
