"""Whether anybody still commands a device."""

from slpi_ros.compensator.monitor import Finding, Rule, Silence


class CommandSilence(Rule):
    """Commands keep coming within `timeout` (s; 0: they need not) from one that was carried out on.

    Before the first, and after `forget`, nothing is awaited.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._silence: Silence | None = None

    def carried_out(self, now_ns: int) -> None:
        """Take that a command was carried out, or is being."""
        if self._silence is None:
            self._silence = Silence(now_ns, lambda seconds: f"no voltage_command for {seconds:.1f} s")
        self._silence.hear(now_ns)

    def forget(self) -> None:
        """Await nothing until the next command."""
        self._silence = None

    def check(self, now_ns: int) -> Finding | None:
        """Return that no command has come within the timeout."""
        silence = self._silence
        reason = silence.beyond(self._timeout, now_ns) if silence is not None and self._timeout > 0.0 else ""
        return Finding("commands", "silent", reason) if reason else None
