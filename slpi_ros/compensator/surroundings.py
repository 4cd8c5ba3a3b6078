"""Quantities that the stage follows, as they come in use: which values are taken, and what is wrong with the others."""

from collections.abc import Mapping, Sequence
from math import nan

from slpi_ros.compensator.axis import Axis
from slpi_ros.effects.base import Followed
from slpi_ros.model.stage_model import StageModel

# A value beyond the recorded range by more than this share of it is not used: the model knows nothing there, and a
# broken sensor must not move the stage.
BEYOND = 0.25
# A value is old after this many of its usual intervals, and not before this time, nanoseconds; the weight of a new
# interval in the usual one.
OLD, LEAST_NS, WEIGHT = 10, 2_000_000_000, 0.1


class Surrounding:
    """One quantity: its last value in use, how old that is, and what was refused since."""

    def __init__(self, followed: Followed) -> None:
        self.followed = followed
        self.value = nan  # in use; NaN: none came, the reference value is
        self.refused: float | None = None  # the last value, if it was not used
        self._came_ns: int | None = None
        self._interval_ns = 0.0

    def note(self, value: float, now_ns: int) -> bool:
        """Take a value that came at `now_ns` (ns, steady clock); return whether it is used."""
        low, high = self.accepted
        if not low <= value <= high:
            self.refused = value
            return False
        if self._came_ns is not None:
            passed = now_ns - self._came_ns
            self._interval_ns += (WEIGHT if self._interval_ns else 1.0) * (passed - self._interval_ns)
        self._came_ns, self.value, self.refused = now_ns, value, None
        return True

    @property
    def accepted(self) -> tuple[float, float]:
        """Lowest and highest value that is used."""
        margin = BEYOND * (self.followed.highest - self.followed.lowest)
        return self.followed.lowest - margin, self.followed.highest + margin

    def age_ns(self, now_ns: int) -> int | None:
        """Return the age (ns) of the value in use at `now_ns`; None without one."""
        return None if self._came_ns is None else now_ns - self._came_ns

    def problem(self, now_ns: int) -> str:
        """Return what is wrong at `now_ns` (ns), in one sentence; "" if nothing."""
        key, age = self.followed.key, self.age_ns(now_ns)
        if self.refused is not None:
            low, high = self.accepted
            used = f"the last one, {self.value:.5g}" if age is not None else f"{self.followed.reference:.5g}"
            return (
                f"{key} is {self.refused:.5g}, far outside of what was recorded ({low:.5g} to {high:.5g} are taken); "
                f"{used}, stays in use: check its sensor, or identify with such values"
            )
        if age is None:
            return (
                f"no value of {key}: its reference, {self.followed.reference:.5g}, is in use; start its publisher, or "
                "name its topic (parameter surroundings)"
            )
        if age > max(OLD * self._interval_ns, LEAST_NS):
            return f"{key} is {age * 1e-9:.3g} s old: the last one, {self.value:.5g}, stays in use; check its publisher"
        return ""


class Surroundings(dict[str, Surrounding]):
    """The quantities that the model in use follows, by name, and the axes that follow them."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        super().__init__()
        self._axes = axes

    def use(self, model: StageModel) -> None:
        """Follow the quantities of a model; what is known of those that the last one followed as well stays."""
        known = dict(self)
        self.clear()
        for followed in (each for axis in model.axes.values() for each in axis.followed):
            before = known.get(followed.key)
            self[followed.key] = before if before and before.followed == followed else Surrounding(followed)

    def problems(self, refused: Mapping[str, str], now_ns: int) -> dict[str, str]:
        """Return what is wrong with a quantity, by name; `refused`: why its topic cannot be followed."""
        found = {key: refused.get(key) or quantity.problem(now_ns) for key, quantity in self.items()}
        return {key: problem for key, problem in found.items() if problem}

    def take(self, key: str, value: float, now_ns: int) -> bool:
        """Take a value of a quantity that came at `now_ns` (ns); return whether it is used."""
        if key not in self or not self[key].note(value, now_ns):
            return False
        for axis in self._axes:
            axis.surround({key: value})
        return True
