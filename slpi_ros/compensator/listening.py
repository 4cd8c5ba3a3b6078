"""Whether somebody else commands a stage, before the first voltage."""

import random
from collections.abc import Callable, Sequence

from slpi_ros.compensator.block import PATIENCE_NS
from slpi_ros.compensator.monitor import Finding, Rule
from slpi_ros.io.messages import SECOND_NS

# The graph is looked at this time after the first stage_state where this node has left the stage as it is, otherwise
# after the begin: the middleware repeats what a busy machine has missed of its discovery after 3 s.
LOOK_NS, LOOK_WITHOUT_NS = SECOND_NS // 2, 7 * SECOND_NS // 2
# A voltage counts for this time. Whoever has commanded a stage repeats its voltage within REPEAT_NS.
QUIET_NS, REPEAT_NS = 3 * SECOND_NS // 2, 4 * SECOND_NS // 5
# Of several that listen to each other, the one with the smallest random part begins.
RANDOM_NS = SECOND_NS // 2


def all_found(now_ns: int, begun_ns: int) -> bool:
    """Return whether the middleware has had the time to find everybody since `begun_ns`, on a busy machine too."""
    return now_ns - begun_ns >= LOOK_WITHOUT_NS


def graph_known(now_ns: int, begun_ns: int, state_ns: int) -> bool:
    """Return whether a node that began at `begun_ns`, and first heard the stage at `state_ns` (0: never), may look."""
    return now_ns - state_ns >= LOOK_NS if state_ns else all_found(now_ns, begun_ns)


class Listening(Rule):
    """Nobody else commands the stage, or the first voltage is held back: listens from `begin` on; steady clock, ns.

    Others are being found since `found_from_ns`, by default since the first `begin`.
    `others` returns the other publishers of the topic of the voltages that the graph knows now. One that is silent,
    from when it was known on, may be a process that was killed.
    """

    def __init__(self, others: Callable[[], Sequence[str]], found_from_ns: int = 0) -> None:
        self.thorough = True  # nothing moves before the middleware has found everybody, on a busy machine too
        self._others = others
        self._beside: Sequence[str] = ()  # the others at the last look
        self._begun_ns, self._state_ns = found_from_ns, 0  # of the search, and when the stage was heard first
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Listen from now on, until `end`."""
        self.on = True  # voltages of others are heard
        self._begun_ns = self._begun_ns or now_ns
        self._heard_ns: int | None = None
        self._played_ns: int | None = None  # when a driver has told last that it plays a block
        self.give_way(now_ns)

    def give_way(self, now_ns: int) -> None:
        """Listen anew, for a time of which a part is drawn: of two that speak at once, one begins before the other."""
        self._known_ns = now_ns  # since when all of them have been known
        self._patience_ns = QUIET_NS + random.randrange(RANDOM_NS)

    def state(self, now_ns: int) -> None:
        """Take that the stage has reported."""
        self._state_ns = self._state_ns or now_ns

    def hear(self, now_ns: int) -> None:
        """Take a voltage that somebody else has commanded."""
        self._heard_ns = now_ns

    def play(self, plays: bool, now_ns: int) -> None:
        """Take whether a driver plays a block; it goes on telling so, or it has ended itself."""
        self._played_ns = now_ns if plays else None

    def check(self, now_ns: int) -> Finding | None:
        """Return what holds the first voltage back, None if nothing does."""
        others = self._others()
        if set(others) - set(self._beside):
            self._known_ns = now_ns
        self._beside = others
        named = ", ".join(others) or "another node"
        if self._played_ns is not None and now_ns - self._played_ns < PATIENCE_NS:
            return self._finding("the driver plays a block; wait for its end")
        if self._heard_ns is not None and now_ns - self._heard_ns < QUIET_NS:
            return self._finding(f"{named} commands the stage; end it, or do not use this node")
        if not self.looks(now_ns):
            return self._finding("looking who else commands the stage; send it again")
        if (others or self._heard_ns is not None) and now_ns - self._known_ns < self._patience_ns:
            return self._finding(f"listening whether {named} commands the stage; send it again")
        return None

    def may_end(self, now_ns: int, begun_ns: int) -> bool:
        """Return whether everybody is found, and who began when the output did, at a time (ns), has been heard."""
        return self.found_all(now_ns) and now_ns - begun_ns >= QUIET_NS

    def end(self) -> None:
        """Listen no more: whoever speaks later has begun beside this node."""
        self.on = False

    def heard_since(self, begun_ns: int) -> Finding | None:
        """Return that somebody else has commanded the stage since the output began at a time (ns)."""
        if not self.on or self._heard_ns is None or self._heard_ns <= begun_ns:
            return None
        named = ", ".join(self._others()) or "another node"
        return self._finding(f"{named} commands the stage too; end it, then call ~/arm")

    def found_all(self, now_ns: int) -> bool:
        """Return whether the middleware has had the time to find everybody."""
        return all_found(now_ns, self._begun_ns)

    def looks(self, now_ns: int) -> bool:
        """Return whether the others have had the time to be known."""
        return self.found_all(now_ns) if self.thorough else graph_known(now_ns, self._begun_ns, self._state_ns)

    @staticmethod
    def _finding(reason: str) -> Finding:
        return Finding("company", "commanded", reason)
