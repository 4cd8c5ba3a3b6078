"""Changes of a stage over time: steps and drifts of a series of measurements, with their chance."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from slpi_ros.arrays import FloatArray, IntArray

# A change is told if noise alone would show one in a series with this probability at most.
CHANCE = 1e-3
# Fewest values of a series; of longer ones, only the latest values are used.
FEWEST, MOST = 3, 2000
# Largest number of terms, and values for each of them.
TERMS, VALUES_PER_TERM = 12, 4
# Number of values to which the given deviations are worth in the estimate of the noise.
PRIOR = 4
DRIFT, STEP = "drift", "step"


@dataclass(frozen=True)
class Change:
    """A change of a series."""

    kind: str  # "step" or "drift"
    date_ns: int  # Unix time of the first bag after a step, or of a significant drift
    before_ns: int  # of the bag before
    size: float  # by the step, or by the drift from the first to the last bag
    uncertainty: float  # standard deviation
    chance: float  # that noise alone shows such a change anywhere in the series


def find_changes(date_ns: IntArray, values: FloatArray, deviations: FloatArray) -> list[Change]:
    """Find the steps and the drift of a series, in order of time; none if there are fewer than `FEWEST` values."""
    # The series is a constant, plus a linear drift, plus steps. The terms that reduce the sum of squares most are added
    # one after the other; then those are removed that noise may explain, with a correction for the number of possible
    # steps. Noise is estimated from the given standard deviations and from what the largest set of terms leaves.
    if values.size < FEWEST:
        return []
    date_ns, values, deviations = date_ns[-MOST:], values[-MOST:], deviations[-MOST:]
    series = _Series(date_ns, values, deviations)
    terms = series.best_terms(max(1, min(TERMS, (values.size - 1) // VALUES_PER_TERM)))
    series.estimate_noise(terms)
    while terms:
        worst = max(terms, key=lambda term: series.chance(terms, term))
        if series.chance(terms, worst) <= CHANCE:
            break
        terms.remove(worst)
    return sorted(series.changes(terms), key=lambda change: change.date_ns)


class _Series:
    """A series and its weighted least squares; term 0 is a drift, term k a step before value k."""

    def __init__(self, date_ns: IntArray, values: FloatArray, deviations: FloatArray) -> None:
        self._date_ns, self._deviations = date_ns, deviations
        self._share = (date_ns - date_ns[0]) / max(float(date_ns[-1] - date_ns[0]), 1.0)
        steps = np.tri(values.size)
        # The step before value 0 would be the constant: its place is that of the drift.
        steps[:, 0] = self._share
        self._columns, self._constant = steps / deviations[:, None], 1.0 / deviations
        self._target = values / deviations
        self._scatter, self._degrees = 1.0, float(PRIOR)

    def best_terms(self, count: int) -> list[int]:
        """Return `count` terms, each of which reduces the sum of squares most beside those before it."""
        chosen: list[int] = []
        left, columns = self._target.copy(), self._columns.copy()
        direction = self._constant
        for _ in range(count + 1):
            unit = direction / np.linalg.norm(direction)
            left -= unit * (unit @ left)
            columns -= np.outer(unit, unit @ columns)
            size = np.sum(columns**2, axis=0)
            gains = np.divide((left @ columns) ** 2, size, out=np.zeros(size.size), where=size > 1e-9 * size.max())
            gains[chosen] = 0.0
            best = int(np.argmax(gains))
            if len(chosen) == count or gains[best] <= 0.0:
                break
            chosen.append(best)
            direction = columns[:, best]
        return chosen

    def estimate_noise(self, terms: list[int]) -> None:
        """Estimate the noise as what `terms` leave; each chosen term counts twice, for its size and for its place."""
        degrees = PRIOR + max(0, self._target.size - 1 - 2 * len(terms))
        scatter = float(np.sqrt((PRIOR + self._solve(terms)[2]) / degrees))
        self._scatter, self._degrees = max(scatter, 1.0), float(degrees)

    def _solve(self, terms: list[int]) -> tuple[FloatArray, FloatArray, float]:
        """Return coefficients of constant and terms, their standard deviations, and the weighted sum of squares."""
        matrix = np.column_stack([self._constant, self._columns[:, terms]])
        inverse = np.linalg.pinv(matrix)
        x = inverse @ self._target
        left = float(np.sum((matrix @ x - self._target) ** 2))
        return x, self._scatter * np.linalg.norm(inverse, axis=1), left

    def chance(self, terms: list[int], term: int) -> float:
        """Return the probability that noise alone shows a term as large as `term`, in any of the possible places."""
        x, deviations, _ = self._solve(terms)
        place = 1 + terms.index(term)
        ratio = abs(x[place]) / max(deviations[place], 1e-300)
        one = 2.0 * float(stats.t.sf(ratio, self._degrees))
        return float(min(1.0, one * self._target.size))

    def changes(self, terms: list[int]) -> Iterator[Change]:
        """Yield the changes that the terms describe."""
        x, deviations, _ = self._solve(terms)
        for place, term in enumerate(terms, 1):
            size, uncertainty, at = float(x[place]), float(deviations[place]), term
            if not term:
                limit = stats.norm.isf(CHANCE) * self._scatter * self._deviations
                at = max(int(np.argmax(abs(size) * self._share > limit)), 1)
            before, date = int(self._date_ns[at - 1]), int(self._date_ns[at])
            yield Change(STEP if term else DRIFT, date, before, size, uncertainty, self.chance(terms, term))
