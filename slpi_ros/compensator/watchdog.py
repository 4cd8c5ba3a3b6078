"""Watchdog of the commands: they have to keep coming."""

from slpi_ros.compensator.monitor import Finding, Rule, Silence
from slpi_ros.compensator.motion import Safety


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
        self.expired = self._found = False  # at the last `react` and `check`
        self.safe_voltages: tuple[float, ...] | None = None  # V, ends of the ramp at expiry; None: held

    def check(self, now_ns: int) -> Finding | None:
        """Return that no command has come within the timeout."""
        reason = self._silence.beyond(self.timeout, now_ns) if self.timeout > 0.0 else ""
        self._found = bool(reason)
        return Finding("commands", "silent", reason) if reason else None

    def react(self, safety: Safety) -> bool:
        """Return whether the last `check` found the timeout newly expired, or the reaction to it has changed."""
        before = self.expired, self.safe_voltages
        self.expired = self._found
        moves = self.expired and self.commanded and safety.ramps_on_timeout
        self.safe_voltages = safety.voltages if moves else None
        return self.expired and (self.expired, self.safe_voltages) != before

    def silence(self, now_ns: int) -> float:
        """Return the time (s) from the last command, or from `start`, to `now_ns` (ns)."""
        return self._silence.seconds(now_ns)
