"""Whether somebody else commands a stage, before the first voltage."""

import random
from collections.abc import Callable, Sequence

from slpi_ros.compensator.monitor import Finding, Rule
from slpi_ros.io.messages import SECOND_NS

# The graph is looked at this time after the first stage_state, or after the begin where there is none.
LOOK_NS, LOOK_WITHOUT_NS = SECOND_NS // 2, 7 * SECOND_NS // 2
# A voltage counts for this time. Whoever has commanded a stage repeats its voltage within REPEAT_NS.
QUIET_NS, REPEAT_NS = 3 * SECOND_NS // 2, 4 * SECOND_NS // 5
# Of several that listen to each other, the one with the smallest random part begins.
RANDOM_NS = SECOND_NS // 2


def graph_known(now_ns: int, begun_ns: int, state_ns: int) -> bool:
    """Return whether a node that began at `begun_ns`, and first heard the stage at `state_ns` (0: never), may look."""
    return now_ns - state_ns >= LOOK_NS if state_ns else now_ns - begun_ns >= LOOK_WITHOUT_NS


class Listening(Rule):
    """Nobody else commands the stage: listens from `begin` on until the first voltage, on the steady clock, ns.

    `others` returns the other publishers of the topic of the voltages that the graph knows now. One of them that is
    silent may be a process that was killed.
    """

    def __init__(self, others: Callable[[], Sequence[str]]) -> None:
        self.beside: Sequence[str] = ()  # the other publishers at the last look
        self.playing = False  # a driver plays a block
        self._others = others
        self._first_ns = self._state_ns = 0  # the first `begin`, and when the stage was heard first
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Listen from now on."""
        self._first_ns = self._first_ns or now_ns
        self._begun_ns, self._heard_ns = now_ns, 0
        self._patience_ns = QUIET_NS + random.randrange(RANDOM_NS)
        self._alone = False

    def state(self, now_ns: int) -> None:
        """Take that the stage has reported."""
        self._state_ns = self._state_ns or now_ns

    def hear(self, now_ns: int) -> None:
        """Take a voltage that somebody else has commanded."""
        self._heard_ns = now_ns

    def check(self, now_ns: int) -> Finding | None:
        """Return what holds the first voltage back, None if nothing does."""
        if self.playing:
            return self._finding("the driver plays a block; wait for its end")
        if self._heard_ns and now_ns - self._heard_ns < QUIET_NS:
            self.beside = self._others()
            return self._finding(f"{self._named} commands the stage; end it, or do not use this node")
        if self._alone or now_ns - self._begun_ns >= self._patience_ns and self.looks(now_ns):
            return None
        if not self.looks(now_ns):
            return self._finding("looking who else commands the stage; send it again")
        self.beside = self._others()
        self._alone = not self.beside and not self._heard_ns
        if self._alone:
            return None
        return self._finding(f"listening whether {self._named} commands the stage; send it again")

    def looks(self, now_ns: int) -> bool:
        """Return whether the others have had the time to be known."""
        return graph_known(now_ns, self._first_ns, self._state_ns)

    @property
    def _named(self) -> str:
        return ", ".join(self.beside) or "another node"

    @staticmethod
    def _finding(reason: str) -> Finding:
        return Finding("company", "commanded", reason)
