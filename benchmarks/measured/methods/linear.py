"""Methods that are linear in their weights behind a delay and a lag: line, Prandtl-Ishlinskii models, Preisach.

The weights that hysteresis asks to be non-negative are so (non-negative least squares), others are free. Every fitted
record has a constant of its own. Delay and lag of the input, and a rate parameter where there is one, are searched.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar, nnls

from benchmarks.measured.methods import operators
from benchmarks.measured.methods.base import (
    BEYOND,
    MOST_ROWS,
    SEARCH_ROWS,
    FloatArray,
    Prepared,
    Scale,
    Series,
    advanced,
    chosen_history,
    delayed,
    invert_by_iteration,
    possible_histories,
    prepare,
    rows_of,
    search_lag,
)

IntArray = NDArray[np.int64]

# Ridge on the weights, as a share of the mean square of their columns: settles weights that no sample tells apart. The
# first is that of the searches; that of the fit predicts blocks left out best, or, for play operators alone, is the
# largest within one standard error of it (Breiman et al. 1984): the weights of loops wider than the fitted ones rest on
# it. With creep operators that would cost them a tenth to a half.
RIDGES, BLOCKS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2), 5


class Features(Protocol):
    """The columns of a method that is linear in its weights."""

    @property
    def name(self) -> str:
        """Name of the method."""
        ...

    @property
    def free(self) -> int:
        """Number of first columns whose weights may be negative."""
        ...

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the columns at `rows` for a scaled voltage `u` behind delay and lag, (R, C)."""
        ...


@dataclass(frozen=True)
class Line:
    """The best straight line: no hysteresis."""

    name: str = "line"
    free: int = 1

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the voltage."""
        return u[rows, None]


@dataclass(frozen=True)
class Plays:
    """Classical Prandtl-Ishlinskii model (Kuhnen 2003, doi:10.3166/ejc.9.407-418): play operators."""

    name: str = "PI"
    count: int = 30
    free: int = 0

    @property
    def radii(self) -> FloatArray:
        """Return the radii, (K,), shares of half the voltage range; the first is 0: the reversible part."""
        return np.arange(self.count) / self.count

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the states of the play operators."""
        return operators.plays(u, self.radii, rows)


@dataclass(frozen=True)
class Creep:
    """PI with creep operators (Kuhnen and Janocha 1998): linear creep of the voltage and of some play operators."""

    name: str = "PI, creep"
    count: int = 25
    free: int = 0
    creeping: tuple[float, ...] = (0.0, 0.15, 0.4)
    decades: int = 6
    times: tuple[float, ...] = (0.1, 1.0, 10.0)  # s

    def over(self, prepared: Sequence[Prepared]) -> "Creep":
        """Return the method with time constants from a few samples to half of the longest record."""
        period = min(one.period for one in prepared)
        longest = max(float(one.t[-1] - one.t[one.skipped]) for one in prepared)
        times = np.geomspace(3.0 * period, max(longest / 2.0, 10.0 * period), self.decades)
        return replace(self, times=tuple(times.tolist()))

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return play operators, and the lags of some of them."""
        own = operators.plays(u, np.arange(self.count) / self.count, rows)
        shares = -np.expm1(-np.diff(prepared.t, prepend=prepared.t[0])[:, None] / np.array(self.times))
        every = np.arange(u.size)
        slow = [
            operators.relaxations(operators.plays(u, np.array([radius]), every)[:, 0], shares, rows)
            for radius in self.creeping
        ]
        return np.hstack([own, *slow])


@dataclass(frozen=True)
class RatePlays:
    """Rate-dependent PI (Al Janaideh and Krejci 2013, doi:10.1109/TMECH.2012.2205265): radii ``r + b |du/dt|``."""

    widening: float = 0.0
    name: str = "rate-dependent PI"
    count: int = 30
    free: int = 0

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the states of the play operators; `widening` in seconds, the voltage being scaled."""
        rate = np.abs(np.gradient(u, prepared.t))
        # The rate of a noisy voltage is that over five samples.
        smooth = np.convolve(np.pad(rate, 2, mode="edge"), np.full(5, 0.2), "valid")
        return operators.rate_plays(u, self.widening * smooth, np.arange(self.count) / self.count, rows)


@dataclass(frozen=True)
class Preisach:
    """Classical Preisach model: density constant in each cell of the plane, and a reversible part.

    The plane has so many relays that a twin with a continuous one leaves hardly more or less.
    """

    cells: int = 24
    fine: int = 24
    name: str = "Preisach"
    free: int = 0

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the share of each cell that is switched on."""
        return np.hstack([u[rows, None], operators.relays(u, self.cells, self.fine, rows)])


@dataclass(frozen=True)
class LinearModel:
    """A fitted method of this kind."""

    features: Features
    scale: Scale
    weights: FloatArray
    constants: dict[str, float]
    delay: float
    lag: float

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        before = [float(x) for x in self.scale.voltage(np.asarray(history, dtype=np.float64))]
        prepared = prepare(t, self.scale.voltage(v), before)
        u = delayed(prepared, self.delay, self.lag)
        rows = np.arange(prepared.skipped, u.size)
        return self.scale.back(self.features.columns(prepared, u, rows) @ self.weights + self.constant(name))

    def constant(self, name: str) -> float:
        """Return the constant of a fitted record, or the mean of all for another one."""
        return self.constants.get(name, float(np.mean(list(self.constants.values()))))

    def invert(self, name: str, t: FloatArray, y: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the voltage, shape (N,): what gives `y` without delay and lag, then delay and lag undone."""
        still = replace(self, delay=0.0, lag=0.0)
        if not isinstance(self.features, Plays):
            v = invert_by_iteration(still, self.scale, name, t, y, history)
        else:
            wanted = self.scale.displacement(y) - self.constant(name)
            corners = self.scale.voltage(np.asarray(history, dtype=np.float64))
            # Never moved: all operators rest at the first voltage.
            first = corners if corners.size else wanted[:1] / np.sum(self.weights)
            states = operators.plays(first, self.features.radii, np.array([first.size - 1]))[0]
            v = self.scale.volts(operators.inverse_plays(wanted, self.features.radii, self.weights, states, BEYOND))
        return advanced(t, v, self.delay, self.lag)


def solve(
    columns: FloatArray, y: FloatArray, record: IntArray, free: int, share: float = RIDGES[0]
) -> tuple[FloatArray, FloatArray, float]:
    """Return weights, the constant of each record, and the rms error.

    Parameters
    ----------
    columns : ndarray, shape (R, C)
    y : ndarray, shape (R,)
    record : ndarray of int, shape (R,)
        Number of the record of each row.
    free : int
        Number of first columns whose weights may be negative.
    share : float
        Ridge, see `RIDGES`.
    """
    count = int(record.max()) + 1
    # A constant of each record: taken out as the mean.
    sizes = np.bincount(record, minlength=count)
    means = np.array([np.bincount(record, column, count) / sizes for column in columns.T]).T
    y_means = np.bincount(record, y, count) / sizes
    a, b = columns - means[record], y - y_means[record]
    a = np.hstack([a, -a[:, :free]])
    # The normal equations, as a square root: the time then does not depend on the number of rows.
    gram = a.T @ a
    ridge = share * float(np.mean(np.diag(gram))) + 1e-300
    root = np.linalg.cholesky(gram + ridge * np.eye(gram.shape[0])).T
    try:
        found, _ = nnls(root, np.linalg.solve(root.T, a.T @ b), maxiter=20 * gram.shape[0])
    except RuntimeError:
        # The iteration limit: a bounded solver instead.
        from scipy.optimize import lsq_linear

        found = lsq_linear(root, np.linalg.solve(root.T, a.T @ b), bounds=(0.0, np.inf)).x
    weights = found[: columns.shape[1]].copy()
    weights[:free] -= found[columns.shape[1] :]
    error = columns @ weights - y
    constants = -np.bincount(record, error, count) / sizes
    return weights, constants, float(np.sqrt(np.mean((error + constants[record]) ** 2)))


def solve_with_ridge(
    columns: FloatArray, y: FloatArray, record: IntArray, free: int, *, largest: bool = False
) -> tuple[FloatArray, FloatArray, float]:
    """Return weights and constants as `solve` does, and the mean square error of blocks left out.

    The ridge is the one that predicts blocks left out best, or the `largest` that is as good.
    """
    errors = np.zeros((len(RIDGES), BLOCKS))
    for block, left_out in enumerate(np.array_split(np.arange(y.size), BLOCKS)):
        kept = np.ones(y.size, dtype=np.bool_)
        kept[left_out] = False
        # A block may hold a whole record: numbers without gaps.
        _, number = np.unique(record[kept], return_inverse=True)
        for k, share in enumerate(RIDGES):
            weights, _, _ = solve(columns[kept], y[kept], number, free, share)
            # Without its mean, as the errors of the table.
            errors[k, block] = np.var(columns[left_out] @ weights - y[left_out])
    mean = errors.mean(axis=1)
    chosen = int(np.argmin(mean))
    if largest:
        limit = mean[chosen] + float(np.std(errors[chosen], ddof=1)) / np.sqrt(BLOCKS)
        chosen = int(np.flatnonzero(mean <= limit)[-1])
    weights, constants, _ = solve(columns, y, record, free, RIDGES[chosen])
    return weights, constants, float(mean[chosen])


@dataclass(frozen=True)
class Problem:
    """Scaled records, their histories, and the rows that are fitted."""

    records: tuple[Series, ...]
    scale: Scale
    prepared: tuple[Prepared, ...]
    rows: tuple[IntArray, ...]
    y: FloatArray = field(repr=False)
    record: IntArray = field(repr=False)

    @classmethod
    def of(cls, records: Sequence[Series], most: int) -> "Problem":
        """Prepare records, each with its history."""
        scale = Scale.of(records)
        rows = rows_of(records, most)
        prepared = tuple(
            prepare(one.t, scale.voltage(one.v), [float(x) for x in scale.voltage(np.asarray(one.history))])
            for one in records
        )
        y = np.concatenate([scale.displacement(one.y[at]) for one, at in zip(records, rows, strict=True)])
        number = np.concatenate([np.full(at.size, k) for k, at in enumerate(rows)])
        moved = tuple(at + one.skipped for at, one in zip(rows, prepared, strict=True))
        return cls(tuple(records), scale, prepared, moved, y, number)

    @property
    def period(self) -> float:
        """Shortest sampling period, s."""
        return min(one.period for one in self.prepared)

    def columns(self, features: Features, delay: float, lag: float) -> FloatArray:
        """Return the columns at the fitted rows."""
        return np.vstack(
            [
                features.columns(one, delayed(one, delay, lag), at)
                for one, at in zip(self.prepared, self.rows, strict=True)
            ]
        )

    def cost(self, features: Features, delay: float, lag: float) -> float:
        """Return the rms error of the fit."""
        return solve(self.columns(features, delay, lag), self.y, self.record, features.free)[2]


def likely_history(records: Sequence[Series], one: Series) -> tuple[float, ...]:
    """Return the history of one of the fitted records, V: chosen by the error with which a classical model fits it."""
    v = float(one.v[np.isfinite(one.v)][0])
    costs = [
        Problem.of([replace(one, history=history)], SEARCH_ROWS).cost(Plays(count=15), 0.0, 0.0)
        for history in possible_histories(records, v)
    ]
    return chosen_history(records, v, costs)


@dataclass(frozen=True)
class LinearMethod:
    """A method of this kind.

    Parameters
    ----------
    features : Features
    name : str
    with_lag : bool
        Whether delay and lag are fitted.
    search : Features, optional
        Coarser columns for the search of delay and lag. Default: the same.
    others : tuple of Features, optional
        Columns that are tried in the place of `features`: those are kept that predict blocks left out best.
    """

    features: Features
    name: str
    with_lag: bool = True
    search: Features | None = None
    others: tuple[Features, ...] = ()

    def fit(self, records: Sequence[Series]) -> LinearModel:
        """Search delay, lag and rate parameter, then solve for the weights."""
        coarse = Problem.of(records, SEARCH_ROWS)
        features, delay, lag = self.features, 0.0, 0.0
        rough = self.search or features
        if self.with_lag:
            delay, lag = search_lag(lambda d, x: coarse.cost(rough, d, x), coarse.period)
        if isinstance(features, RatePlays):
            features, delay, lag = _with_rate(features, coarse, delay, lag)
        problem, found = Problem.of(records, MOST_ROWS), []
        for tried in (features, *self.others):
            one = tried.over(problem.prepared) if isinstance(tried, Creep) else tried
            columns = problem.columns(one, delay, lag)
            largest = isinstance(one, Plays | RatePlays)
            weights, constants, error = solve_with_ridge(columns, problem.y, problem.record, one.free, largest=largest)
            found.append((error, one, weights, constants))
        _, features, weights, constants = min(found, key=lambda each: each[0])
        own = {one.name: float(c) for one, c in zip(records, constants, strict=True)}
        return LinearModel(features, problem.scale, weights, own, delay, lag)


def _with_rate(features: RatePlays, problem: Problem, delay: float, lag: float) -> tuple[RatePlays, float, float]:
    """Search the widening, with the lag that was found and without: both widen loops at one frequency."""
    found: list[tuple[float, float, float, float]] = []
    rates = [np.abs(np.gradient(one.u, one.t)) for one in problem.prepared]
    fastest = max(float(np.percentile(rate, 95.0)) for rate in rates)
    for d, x in {(delay, lag), (delay, 0.0), (0.0, 0.0)}:

        def cost(widening: float, d: float = d, x: float = x) -> float:
            return problem.cost(replace(features, widening=widening), d, x)

        best = minimize_scalar(cost, bounds=(0.0, 0.3 / fastest), method="bounded", options={"maxiter": 15})
        found += [(float(best.fun), float(best.x), d, x), (cost(0.0), 0.0, d, x)]
    _, widening, delay, lag = min(found)
    return replace(features, widening=widening), delay, lag


LINE = LinearMethod(Line(), "line", with_lag=False)
PI = LinearMethod(Plays(), "PI", with_lag=False)
PI_LAG = LinearMethod(Plays(), "PI, lag")
PI_CREEP = LinearMethod(Creep(), "PI, creep", search=Plays(count=15), others=(Creep(decades=3),))
PI_RATE = LinearMethod(RatePlays(), "rate-dep. PI", search=Plays(count=15))
PREISACH = LinearMethod(Preisach(), "Preisach", search=Preisach(8, 4), others=(Preisach(12, 48), Preisach(8, 72)))
