"""Watchdog of the commands: they have to keep coming."""

from slpi_ros.compensator.monitor import Finding, Rule, Silence
from slpi_ros.compensator.ramps import Safety


class CommandWatchdog(Rule):
    """Commands keep coming within `timeout` (s; 0: they need not), from the last one, or from `start`, on."""

    def __init__(self) -> None:
        self.start(0)

    def start(self, now_ns: int) -> None:
        """Restart the timeout at `now_ns` (ns) and clear all flags."""
        self.commanded, self.timeout = False, 0.0  # since activation, before which no axis moves
        self._silence = Silence(now_ns, lambda s: f"no command{'' if self.commanded else ' yet'} for {s:.3g} s")
        self.feed(now_ns)

    def feed(self, now_ns: int) -> None:
        """Restart the timeout at `now_ns` (ns) because a command has arrived."""
        self._silence.hear(now_ns)
        self.expired = False  # at the last `update`
        self.safe_voltages: tuple[float, ...] | None = None  # V, ends of the ramp at expiry; None: held

    def check(self, now_ns: int) -> Finding | None:
        """Return that no command has come within the timeout."""
        reason = self._silence.beyond(self.timeout, now_ns) if self.timeout > 0.0 else ""
        return Finding("commands", "silent", reason) if reason else None

    def update(self, safety: Safety, now_ns: int, waiting: bool) -> bool:
        """Update `expired`, only if `waiting`; return True at expiry, and if the reaction changes afterwards."""
        before = self.expired, self.safe_voltages
        self.timeout = safety.command_timeout if waiting else 0.0
        self.expired = self.check(now_ns) is not None
        moves = self.expired and self.commanded and safety.ramps_on_timeout
        self.safe_voltages = safety.voltages if moves else None
        return self.expired and (self.expired, self.safe_voltages) != before

    def silence(self, now_ns: int) -> float:
        """Return the time (s) from the last command, or from `start`, to `now_ns` (ns)."""
        return self._silence.seconds(now_ns)
