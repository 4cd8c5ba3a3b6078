"""Steps: sudden jumps of the zero that stay."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import Additive, Candidate, EffectContext, FitContext
from slpi_ros.effects.excitation import DriveLimits, DrivePath, Excitation, move, remaining
from slpi_ros.effects.jumps import follows_drive, jumps, sudden
from slpi_ros.effects.parameters import Fit, parameter, require

# Numbers of jumps of the candidates.
COUNTS = (1, 2, 3, 5, 8, 12)


def _draw(path: DrivePath, limits: DriveLimits) -> None:
    levels = (0.1, 0.3, 0.5, 0.7, 0.9, 0.6, 0.2)
    for level in levels:
        move(path, level)
        path.hold(0.9 * remaining(limits) / len(levels))


@dataclass(frozen=True)
class Steps(Additive):
    """Jumps of the zero, ``y = x + sum of the sizes at times up to t``, on the record's clock."""

    side = "record"
    what = "sudden jumps of the zero that stay: slips of the mount or the sensor, fringe jumps"
    compensated = "no"
    needs_feedback = True
    excitation = Excitation(
        "Rest at seven levels: nothing is commanded, so what jumps there within one sample and stays is the zero, "
        "where creep and drift are gradual and line interference comes back.",
        _draw,
    )

    times: tuple[float, ...] = parameter("s", "times of the jumps from the record's start", -1e9, 1e9, count=(0, 10000))
    sizes: tuple[float, ...] = parameter(
        "m", "sizes of the jumps", -1e3, 1e3, count=(0, 10000), fit=Fit("linear", 1e-9)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        rising = all(a < b for a, b in zip(self.times, self.times[1:], strict=False))
        require(
            self,
            ("times", rising, "strictly increasing"),
            ("sizes", len(self.sizes) == len(self.times), "one for each time"),
        )

    def joined(self, other: "Steps") -> "Steps":
        """Return the jumps of both in order of time."""
        pairs = sorted((*zip(self.times, self.sizes, strict=True), *zip(other.times, other.sizes, strict=True)))
        sums = [(t, sum(size for _, size in same)) for t, same in groupby(pairs, key=lambda pair: pair[0])]
        return Steps(tuple(t for t, _ in sums), tuple(size for _, size in sums))

    def plausible(self, context: FitContext) -> bool:
        """Return whether all jumps are sudden, and not where the voltage turns or jumps by more than chance."""
        return all(self._sudden(context)) and not follows_drive(np.searchsorted(context.t, self.times), context.v)

    def only_plausible(self, context: FitContext) -> "Steps":
        """Return the jumps that are sudden: one that was none at first may have been found with others."""
        kept = zip(self.times, self.sizes, self._sudden(context), strict=True)
        pairs = [(t, size) for t, size, one in kept if one]
        return Steps(tuple(t for t, _ in pairs), tuple(size for _, size in pairs))

    def _sudden(self, context: FitContext) -> list[bool]:
        places = np.searchsorted(context.t, self.times).tolist()
        left = np.interp(context.t, context.t[context.used], context.left_without(self.name)[context.used])
        return [sudden(left, k, size) for k, size in zip(places, self.sizes, strict=True)]

    def added(self, around: EffectContext) -> FloatArray:
        """Return the sum of the jumps so far, shape (N,), metres."""
        return np.append(0.0, np.cumsum(self.sizes))[np.searchsorted(self.times, around.t, side="right")]

    @classmethod
    def fit(cls, context: FitContext) -> Iterator[Candidate]:
        """Yield the clearest jumps of the residual, in increasing number."""
        left = np.interp(context.t, context.t[context.used], context.residual[context.used])
        found = [k for k, _ in jumps(left, COUNTS[-1])]
        counts = [min(count, len(found)) for count in COUNTS]
        # Of several records each has as many forms, some without a jump.
        for count in sorted(set(counts) - {0}) if context.around.records else counts:
            yield Candidate(
                (np.arange(context.t.size)[:, None] >= sorted(found[:count])).astype(np.float64),
                partial(cls._at, context.t, left, sorted(found[:count])),
            )

    @classmethod
    def _at(cls, t: FloatArray, left: FloatArray, places: Sequence[int], sizes: FloatArray) -> "Steps | None":
        if len(places) != sizes.size:
            return None
        # The rest are of the hysteresis, which has bent towards the jumps that were not there before.
        kept = [(k, size) for k, size in zip(places, sizes.tolist(), strict=True) if sudden(left, k, size)]
        # Between two samples.
        found = cls(tuple(float(t[k - 1] + t[k]) / 2 for k, _ in kept), tuple(size for _, size in kept))
        return found if kept or not places else None

    def describe(self) -> str:
        """Describe the largest jump, and how many there are."""
        if not self.times:
            return "the zero does not jump in this record"
        size, t = max(zip(self.sizes, self.times, strict=True), key=lambda pair: abs(pair[0]))
        jump = f"by {size * 1e6:.3g} µm at {t:.5g} s of this record"
        return f"the zero jumps {jump}" if len(self.times) == 1 else (
            f"the zero jumps {len(self.times)} times, at most {jump}"
        )  # fmt: skip
