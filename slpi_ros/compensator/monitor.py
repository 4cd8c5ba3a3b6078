"""One monitor of what is commanded against what comes back: a list of rules, each of which notices one thing."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What a rule has noticed: the rule, its kind, the reason in one line with numbers, and the axis, "" of all."""

    rule: str
    kind: str
    reason: str
    axis: str = ""

    def __str__(self) -> str:
        return f"axis '{self.axis}': {self.reason}" if self.axis else self.reason


class Rule:
    """Notices one thing; times are those of the steady clock, ns.

    Of what happens a rule overrides what it needs: voltages that are output, voltages that are reported, and readings
    of a sensor beside the displacement that was expected. `check` says what is wrong now, None if nothing is. A rule
    gets its limits when it is made, and never moves anything: what follows a finding is up to the owner of the monitor.
    """

    def output(self, voltage: float, now_ns: int) -> None:
        """Take a voltage (V) that is output."""

    def report(self, voltage: float, now_ns: int) -> None:
        """Take a voltage (V) that is reported."""

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Take a reading (m), and the displacement (m) that was expected at that time."""

    def check(self, now_ns: int) -> Finding | None:
        """Return what is wrong at `now_ns`, None if nothing is."""
        raise NotImplementedError


class Monitor:
    """Holds rules, and says what each newly finds; a further thing to notice is a further rule."""

    def __init__(self, *rules: Rule) -> None:
        self.rules = rules
        self.standing: tuple[Finding, ...] = ()  # what was wrong at the last `check`

    def output(self, voltage: float, now_ns: int) -> None:
        """Pass on a voltage (V) that is output."""
        for rule in self.rules:
            rule.output(voltage, now_ns)

    def report(self, voltage: float, now_ns: int) -> None:
        """Pass on a voltage (V) that is reported."""
        for rule in self.rules:
            rule.report(voltage, now_ns)

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Pass on a reading (m), and the displacement (m) that was expected."""
        for rule in self.rules:
            rule.read(expected, reading, now_ns)

    def check(self, now_ns: int) -> list[Finding]:
        """Return what was not wrong at the last check, and is now."""
        before = {(each.rule, each.kind, each.axis) for each in self.standing}
        self.standing = tuple(found for rule in self.rules if (found := rule.check(now_ns)))
        return [each for each in self.standing if (each.rule, each.kind, each.axis) not in before]


class Lasting:
    """Whether something goes on: of the same kind at least `count` times in a row (`seen` so far), over some time."""

    __slots__ = ("_count", "_kind", "_since_ns", "seen")

    def __init__(self, count: int = 1) -> None:
        self._count = count
        self._kind, self.seen, self._since_ns = "", 0, 0

    def note(self, kind: str, now_ns: int, for_ns: int = 0) -> bool:
        """Take the kind that is seen at `now_ns`, "": none; return whether it has lasted for `for_ns`."""
        if kind != self._kind:
            self._kind, self.seen, self._since_ns = kind, 0, now_ns
        self.seen += 1
        return bool(kind) and self.seen >= self._count and now_ns - self._since_ns >= for_ns

    def forget(self) -> None:
        """Begin anew."""
        self._kind, self.seen, self._since_ns = "", 0, 0


class Silence:
    """The time since something came that has to keep coming, awaited from `now_ns` on; `reason` takes these seconds."""

    def __init__(self, now_ns: int, reason: Callable[[float], str]) -> None:
        self._reason = reason
        self.hear(now_ns)

    def hear(self, now_ns: int) -> None:
        """Take that it has come, or is awaited from now on."""
        self._heard_ns = now_ns

    def seconds(self, now_ns: int) -> float:
        """Return the time (s) since it came."""
        return (now_ns - self._heard_ns) * 1e-9

    def beyond(self, limit: float, now_ns: int) -> str:
        """Return the reason if it has not come for `limit` (s), else ""."""
        seconds = self.seconds(now_ns)
        return self._reason(seconds) if seconds >= limit else ""
