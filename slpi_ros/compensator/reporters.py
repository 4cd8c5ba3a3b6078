"""Who reports the state of a stage: of which stage it is, and whether one publisher alone reports an axis."""

from collections.abc import Callable, Sequence
from itertools import combinations

from slpi_ros.compensator.monitor import Finding, Rule
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.io.stage_name import same_stage, stage_name

# A report counts for this time after the last one of its kind: of another stage, or of a second publisher.
STANDS_NS = 2 * SECOND_NS
# Two publishers are alive if each of them was heard again after the other.
TURNS = 2


class WhoseStage(Rule):
    """The stage that reports, the model and the stage that is expected have one name, as far as they have names.

    What is named `accepted` is taken for this stage. `model` is the name that the model in use gives.
    """

    def __init__(self, expected: str = "", accepted: str = "") -> None:
        self.expected, self.accepted, self.model = expected, accepted, ""
        self.reported = ""  # the last name
        self._heard = False
        self._other: tuple[str, int] = "", 0  # name of another stage, and when it was reported last

    def hear(self, frame: str, now_ns: int) -> None:
        """Take the name of the stage in a report."""
        self.reported, self._heard = frame, True
        if self.difference(reported=frame):
            self._other = frame, now_ns

    def difference(self, model: str | None = None, reported: str | None = None) -> str:
        """Return which two names differ, "" if none do; default: the names of the model in use and of the reports."""
        named = (
            ("the model is of", self.model if model is None else model),
            ("stage_state is of", self.reported if reported is None else reported),
            ("hardware_id says", self.expected),
        )
        for (what, name), (other_what, other) in combinations(named, 2):
            if not same_stage(name, other, self.accepted):
                return f"{what} stage '{name}', {other_what} '{other}'"
        return ""

    @property
    def doubt(self) -> str:
        """Which name is missing to tell whether the model in use is of the stage that reports; "" if none is."""
        model, reported = stage_name(self.model), stage_name(self.reported)
        if not self._heard or bool(model) == bool(reported):
            return ""
        unnamed, named = ("model", reported) if reported else ("stage_state", model)
        return f"the {unnamed} names no stage, so that nothing shows whether it is of stage '{named}'"

    def check(self, now_ns: int) -> Finding | None:
        """Return that the stage that reports now, or lately did, is another one."""
        other, at_ns = self._other
        said = self.difference()
        if not said and other and now_ns - at_ns < STANDS_NS:
            said = self.difference(reported=other)
        advice = "use the model of this stage, or accept_stage"
        return Finding("stage", "other", f"{said}; {advice}") if said else None


class SoleReporter(Rule):
    """One publisher alone reports an axis.

    Each publisher numbers its messages: two that are alive go on with their own numbers in turn. Where the middleware
    gives no numbers, the names of the stages do that. `publishers` returns those that the graph knows.
    """

    def __init__(self, axis: str, publishers: Callable[[], Sequence[str]] = tuple) -> None:
        self.publishers, self._axis = publishers, axis
        # The last numbers, or names, of up to two publishers, the one that was heard last at the end.
        self._numbers: list[int] = []
        self._names: list[str] = []
        self._turns, self._turned_ns = 0, 0

    def hear(self, number: int | None, frame: str, now_ns: int) -> None:
        """Take a message that reports the axis, with its number, None: not known, and the name of its stage."""
        turned = self._of_number(number) if number else self._of_name(frame)
        if turned:
            self._turns, self._turned_ns = self._turns + 1, now_ns

    def _of_number(self, number: int) -> bool:
        """Return whether a number goes on with that of the publisher that was not heard last."""
        below = [each for each in self._numbers if each < number]
        if not below:
            # A publisher that has begun, for the first time or again.
            self._numbers, self._turns = [*self._numbers[-1:], number], 0
            return False
        nearest = max(below)
        # Equal numbers: the one that was heard last goes on.
        turned = nearest != self._numbers[-1]
        self._numbers.remove(nearest)
        self._numbers.append(number)
        return turned

    def _of_name(self, frame: str) -> bool:
        turned = frame in self._names[:-1]
        self._names = [*[each for each in self._names if each != frame][-1:], frame]
        return turned

    def check(self, now_ns: int) -> Finding | None:
        """Return that two publishers report the axis."""
        if self._turns < TURNS:
            return None
        if now_ns - self._turned_ns > STANDS_NS:
            self._turns = 0
            return None
        named = ", ".join(self.publishers())
        said = f"two publishers of stage_state report it{': ' if named else ''}{named}; end one"
        return Finding("reporter", "two", said, self._axis)
