"""Watchdog of the commands: they have to keep coming."""

from slpi_ros.compensator.motion import Safety


class CommandWatchdog:
    """Detect that no command has arrived within the command timeout."""

    def __init__(self) -> None:
        self.start(0)

    def start(self, now_ns: int) -> None:
        """Restart the timeout at `now_ns` (ns) and clear all flags."""
        self.commanded = self.expired = False  # since activation, before which no axis moves; at the last `update`
        self.safe_voltages: tuple[float, ...] | None = None  # V, ends of the ramp at expiry; None: held
        self._heard_ns = now_ns

    def feed(self, now_ns: int) -> None:
        """Restart the timeout at `now_ns` (ns) because a command has arrived."""
        self._heard_ns = now_ns
        self.expired, self.safe_voltages = False, None

    def update(self, safety: Safety, now_ns: int, waiting: bool) -> bool:
        """Update `expired`, only if `waiting`; return True at expiry, and if the reaction changes afterwards."""
        before = self.expired, self.safe_voltages
        self.expired = waiting and 0.0 < safety.command_timeout < self.silence(now_ns)
        moves = self.expired and self.commanded and safety.ramps_on_timeout
        self.safe_voltages = safety.voltages if moves else None
        return self.expired and (self.expired, self.safe_voltages) != before

    def silence(self, now_ns: int) -> float:
        """Return the time (s) from the last command, or from `start`, to `now_ns` (ns)."""
        return (now_ns - self._heard_ns) * 1e-9
