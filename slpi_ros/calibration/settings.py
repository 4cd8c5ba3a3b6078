"""Settings of a calibration: the axes, their limits, the budget and the target."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.model.limits import Limits

# Durations of the drives, seconds for each axis that moves; those of separate effects take EFFECT.
CALIBRATION, EFFECT, CHECK, VERIFICATION, LOOP = 40.0, 25.0, 1.5, 20.0, 15.0


@dataclass(frozen=True)
class CalibrationSettings:
    """What a calibration may do and what it shall reach; tuples in the order of the voltages."""

    axes: tuple[str, ...]
    limits: tuple[Limits, ...]
    rest: tuple[float, ...]  # V, before and after every drive
    rate: float  # samples per second
    budget: float  # s, the largest sum of the durations of all drives
    target: float = 0.0  # m, mean error on a path not used for the model; 0: `times_repeatability` the repeatability
    times_repeatability: float = 3.0
    accept_units: bool = False  # whether a stroke or a noise that no stage has is taken for one
    seed: int = 0  # of the random parts of the drives
    tune: bool = False  # whether feedback at `rate` is tuned, and shown on the stage
    accept_stage: str = ""  # name of a stage whose kept bags are taken for those of this one
    # m, (N,), by axis at `rate`: the path that is to be covered, and on which models are verified; none: random ones
    path: Mapping[str, FloatArray] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        if not self.axes or not len(self.axes) == len(self.limits) == len(self.rest):
            raise UsageError(f"calibration: axes {list(self.axes)}; give each its limits and its rest voltage")
        for axis, limits, rest in zip(self.axes, self.limits, self.rest, strict=True):
            if not -math.inf < limits.lower < limits.upper < math.inf:
                raise UsageError(
                    f"calibration: axis '{axis}' has limits {limits.lower:g} V and {limits.upper:g} V; "
                    "give both, the lower one first"
                )
            if not limits.lower <= rest <= limits.upper:
                raise UsageError(
                    f"calibration: axis '{axis}' rests at {rest:g} V, outside {limits.lower:g} to {limits.upper:g} V; "
                    "move it inside first"
                )
        if not (0.0 <= self.target < math.inf and 0.0 < self.times_repeatability < math.inf):
            raise UsageError(
                f"calibration: target {self.target:g} m, {self.times_repeatability:g} times the rms; give positive ones"
            )
        if self.budget < self.least:
            raise UsageError(
                f"calibration: a budget of {self.budget:g} s; give at least {self.least:g} s for these axes"
            )

    @property
    def least(self) -> float:
        """Shortest time (s) in which a model can be identified and verified."""
        return len(self.axes) * (CALIBRATION + CHECK) + 2 * self.verification + self.loops

    @property
    def loops(self) -> float:
        """Time (s) in which tuned feedback is shown."""
        return LOOP * len(self.axes) if self.tune else 0.0

    @property
    def verification(self) -> float:
        """Time (s) of the path of a verification."""
        return max((y.size / self.rate for y in self.path.values()), default=VERIFICATION)

    def goal(self, repeatability_rms: float) -> float:
        """Return the target (m) of an axis whose repeatability is `repeatability_rms` (m)."""
        return self.target or self.times_repeatability * repeatability_rms
