"""When the cycles of a driver begin: steadily, and in step with commands that come steadily; without a clock."""

# A command that comes by this share of a cycle too early is taken at once; after one, the next cycle waits so long for
# another that comes too late. By the second share of a period cycles may follow each other faster, to get in step.
SLACK, CATCH_UP = 0.2, 0.05


class Pace:
    """Plan of the cycles, all times in ns by one steady clock.

    Between two cycles there is at most `SLACK` more than a period, and there are by at most `CATCH_UP` more cycles than
    periods, however often commands come. Commands that come steadily, and not more often than that, begin a cycle each.
    """

    def __init__(self, period_ns: int, now_ns: int) -> None:
        self.due_ns = now_ns  # the next cycle begins then
        self._period_ns = period_ns
        self._slack_ns, self._catch_up_ns = (round(share * period_ns) for share in (SLACK, CATCH_UP))
        self._earliest_ns = now_ns
        self._command_ns: int | None = None  # when the command came for which the next cycle begins

    def note_command(self, now_ns: int) -> None:
        """Bring the next cycle forward for a command that comes now."""
        due_ns = max(now_ns, self._earliest_ns)
        if due_ns < self.due_ns:
            self.due_ns, self._command_ns = due_ns, now_ns

    def begin(self, now_ns: int) -> None:
        """Plan the next cycle, as one begins now."""
        self._earliest_ns = max(self._earliest_ns - self._catch_up_ns, now_ns - self._slack_ns) + self._period_ns
        if self._command_ns is None:
            self.due_ns += self._period_ns
        else:
            self.due_ns = max(self._command_ns + self._period_ns + self._slack_ns, self._earliest_ns)
        self._command_ns = None

    def leave_out(self, now_ns: int) -> int:
        """Leave out the cycles that are past, so that none are made up in a burst; return how many."""
        behind = max((now_ns - self.due_ns) // self._period_ns, 0)
        self.due_ns += behind * self._period_ns
        return behind
