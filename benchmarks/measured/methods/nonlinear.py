"""Methods with a few parameters that are not linear: modified and generalised Prandtl-Ishlinskii, and Bouc-Wen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, lsq_linear, minimize

from benchmarks.measured.methods import operators
from benchmarks.measured.methods.base import (
    MOST_ROWS,
    SEARCH_ROWS,
    FloatArray,
    Prepared,
    Series,
    search_lag,
)
from benchmarks.measured.methods.linear import (
    BLOCKS,
    IntArray,
    LinearModel,
    Plays,
    Problem,
    solve,
    solve_with_ridge,
)

# Steps of a simplex search, for each of its starts.
STEPS = 250
# Least slope of the memoryless part of the modified model, as a share of the mean slope.
LEAST_SLOPE = 0.05
# Penalty on the wider play operators and on the bends of the memoryless part of the modified model, of range squared:
# the one that predicts blocks left out best. Else nothing settles loops that are wider than the fitted ones.
PENALTIES = (0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)


@dataclass(frozen=True)
class EnvelopePlays:
    """Generalised PI (Al Janaideh, Rakheja and Su 2009, doi:10.1016/j.mechatronics.2009.02.008).

    Play operators between envelopes ``tanh(a u + b) + c u``, one for the rising and one for the falling input.
    """

    shape: tuple[float, ...] = (0.1, 0.0, 1.0, 0.1, 0.0, 1.0)
    name: str = "generalised PI"
    count: int = 25
    free: int = 1

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the voltage and the states of the play operators."""
        a, b, c, d, e, f = self.shape
        rising, falling = np.tanh(a * u + b) + c * u, np.tanh(d * u + e) + f * u
        # The largest radius is half of the range of the envelopes.
        half = 0.5 * max(float(np.ptp(rising)), float(np.ptp(falling)), 1e-9)
        radii = half * np.arange(self.count) / self.count
        return np.hstack([u[rows, None], operators.envelope_plays(rising, falling, radii, rows)])


@dataclass(frozen=True)
class BoucWen:
    """Bouc-Wen model (Wen 1976): the hysteretic variable, and a cubic polynomial of the voltage."""

    shape: tuple[float, ...] = (1.0, 0.0, 1.0)
    name: str = "Bouc-Wen"
    free: int = 4

    def columns(self, prepared: Prepared, u: FloatArray, rows: IntArray) -> FloatArray:
        """Return the powers of the voltage and the hysteretic variable."""
        beta, gamma, power = self.shape
        z = operators.bouc_wen(u, np.exp(beta), np.tanh(gamma) * np.exp(beta), 0.5 + np.exp(np.clip(power, -4.0, 2.0)))
        return np.stack([u[rows], u[rows] ** 2, u[rows] ** 3, z[rows]], axis=1)


@dataclass(frozen=True)
class ShapedMethod:
    """A method whose shape is searched by a simplex, and whose weights are solved for each shape."""

    features: EnvelopePlays | BoucWen
    starts: tuple[tuple[float, ...], ...]
    name: str

    def fit(self, records: Sequence[Series]) -> LinearModel:
        """Search the shape without lag, then delay and lag, then both shape and lag together."""
        coarse = Problem.of(records, SEARCH_ROWS)

        def cost(shape: Sequence[float], delay: float, lag: float) -> float:
            if not np.all(np.abs(shape) < 20.0):
                return 1e3
            found = coarse.cost(type(self.features)(tuple(float(x) for x in shape)), delay, lag)
            return found if np.isfinite(found) else 1e3

        delay, lag = search_lag(lambda d, x: coarse.cost(Plays(count=15), d, x), coarse.period)
        found = []
        for d, x in {(0.0, 0.0), (delay, lag)}:
            for start in self.starts:

                def own(shape: FloatArray, d: float = d, x: float = x) -> float:
                    return cost(shape.tolist(), d, x)

                best = minimize(own, start, method="Nelder-Mead", options={"maxfev": STEPS, "adaptive": True})
                found.append((float(best.fun), tuple(float(p) for p in best.x), d, x))
        _, shape, delay, lag = min(found)
        features = type(self.features)(shape)
        delay, lag = _refined_lag(coarse, features, delay, lag)
        problem = Problem.of(records, MOST_ROWS)
        columns = problem.columns(features, delay, lag)
        weights, constants, _ = solve_with_ridge(columns, problem.y, problem.record, features.free)
        own_constants = {one.name: float(c) for one, c in zip(records, constants, strict=True)}
        return LinearModel(features, problem.scale, weights, own_constants, delay, lag)


def _refined_lag(problem: Problem, features: EnvelopePlays | BoucWen, delay: float, lag: float) -> tuple[float, float]:
    """Return delay and lag (s) anew, with the shape that was found, if they are better so."""
    again = search_lag(lambda d, x: problem.cost(features, d, x), problem.period)
    return min((again, (delay, lag)), key=lambda pair: problem.cost(features, *pair))


GENERALISED_PI = ShapedMethod(
    EnvelopePlays(), ((0.5, 0.0, 1.0, 0.5, 0.0, 1.0), (1.5, -0.5, 0.3, 1.5, 0.5, 0.3)), "generalised PI"
)
BOUC_WEN = ShapedMethod(BoucWen(), ((0.7, 0.0, 0.0), (2.0, 1.0, -0.7), (0.0, -1.0, 0.5)), "Bouc-Wen")


@dataclass(frozen=True)
class ModifiedModel:
    """A classical model behind which a monotone memoryless function stands: ``y = S(H[u])``."""

    base: LinearModel
    knots: FloatArray
    values: FloatArray
    penalty: float  # one of `PENALTIES`

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        scale = self.base.scale
        inner = scale.displacement(self.base.simulate(name, t, v, history))
        # The constant of a record is added behind the function.
        constant = self.base.constant(name)
        return scale.back(_bent(inner - constant, self.knots, self.values) + constant)

    def invert(self, name: str, t: FloatArray, y: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the voltage, shape (N,): the function undone, then the play operators."""
        scale = self.base.scale
        constant = self.base.constant(name)
        inner = _bent(scale.displacement(y) - constant, self.values, self.knots)
        return self.base.invert(name, t, scale.back(inner + constant), history)


def _bent(h: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Return a piecewise linear function, continued with the slopes of its ends."""
    first, last = np.diff(values)[[0, -1]] / np.diff(knots)[[0, -1]]
    y = np.interp(h, knots, values)
    y = np.where(h < knots[0], values[0] + first * (h - knots[0]), y)
    return np.asarray(np.where(h > knots[-1], values[-1] + last * (h - knots[-1]), y), dtype=np.float64)


@dataclass(frozen=True)
class ModifiedMethod:
    """Modified PI (Kuhnen 2003, doi:10.3166/ejc.9.407-418): play operators, then superposed dead-zone operators.

    As in the paper the first fit is that of the generalised error ``H[u] - S'(y)``, linear in all weights, where S' is
    the inverse of S. The error of y is then made least by Gauss-Newton steps from there.
    """

    name: str = "modified PI"
    plays: int = 20
    knots: int = 10

    def fit(self, records: Sequence[Series]) -> ModifiedModel:
        """Search delay and lag with a classical model, then fit both parts together."""
        coarse = Problem.of(records, SEARCH_ROWS)
        features = Plays(count=self.plays)
        delay, lag = search_lag(lambda d, x: coarse.cost(features, d, x), coarse.period)
        columns = coarse.columns(features, delay, lag)
        errors = np.zeros(len(PENALTIES))
        for left_out in np.array_split(np.arange(coarse.y.size), BLOCKS):
            kept = np.delete(np.arange(coarse.y.size), left_out)
            # A block may hold a whole record: numbers without gaps.
            _, number = np.unique(coarse.record[kept], return_inverse=True)
            for k, share in enumerate(PENALTIES):
                one = self._best(columns[kept], coarse.y[kept], number, share)
                bent = _bent(columns[left_out] @ one.weights, one.knots, one.values)
                errors[k] += float(np.var(bent - coarse.y[left_out]))
        penalty = PENALTIES[int(np.argmin(errors))]
        best = self._best(columns, coarse.y, coarse.record, penalty)
        own_constants = {one.name: float(c) for one, c in zip(records, best.constants, strict=True)}
        base = LinearModel(features, coarse.scale, best.weights, own_constants, delay, lag)
        return ModifiedModel(base, best.knots, best.values, penalty)

    def _best(self, columns: FloatArray, y: FloatArray, record: IntArray, share: float) -> "_Bent":
        """Return the fit with this penalty: the better one of two starts."""
        weights, constants, _ = solve(columns, y, record, 0)
        inner = columns @ weights
        straight = np.linspace(float(inner.min()), float(inner.max()), self.knots + 1)
        ends = [
            _refined(columns, y, record, first, share)
            for first in (
                _Bent(weights, straight, straight, constants),
                self._of_generalised_error(columns, y, record, constants),
            )
        ]
        return min(ends, key=lambda end: end[0])[1]

    def _of_generalised_error(
        self, columns: FloatArray, y: FloatArray, record: IntArray, constants: FloatArray
    ) -> "_Bent":
        """Return the fit of the generalised error, with the records' constants known."""
        y = y - constants[record]
        edges = np.linspace(float(y.min()), float(y.max()), self.knots + 1)
        ramps = np.clip(y[:, None] - edges[:-1], 0.0, np.diff(edges))
        # A row that keeps the mean slope of S' at 1: else all weights zero would be best.
        heavy = 1e3 * np.sqrt(y.size)
        system = np.vstack(
            [
                np.hstack([columns, -ramps, np.ones((y.size, 1))]),
                np.concatenate([np.zeros(self.plays), np.full(self.knots, heavy / self.knots), [0.0]]),
            ]
        )
        low = np.concatenate([np.zeros(self.plays), np.full(self.knots, LEAST_SLOPE), [-np.inf]])
        found = lsq_linear(system, np.append(np.zeros(y.size), heavy), bounds=(low, np.inf)).x
        slopes = found[self.plays : -1]
        knots = np.concatenate([[0.0], np.cumsum(slopes * np.diff(edges))]) - found[-1]
        return _Bent(found[: self.plays], knots, edges, constants)


@dataclass(frozen=True)
class _Bent:
    """Weights (K,) of play operators, knots and values (J,) of the function behind them, and constants of records."""

    weights: FloatArray
    knots: FloatArray
    values: FloatArray
    constants: FloatArray


def _refined(columns: FloatArray, y: FloatArray, record: IntArray, first: _Bent, share: float) -> tuple[float, _Bent]:
    """Return the mean square error, with a penalty, and the fit after Gauss-Newton steps for the error of y."""
    plays, spacing = columns.shape[1], np.diff(first.knots)
    slopes = np.diff(first.values) / spacing
    start = np.concatenate([first.weights, slopes, first.values[:1], first.constants])

    def made(parameters: FloatArray) -> _Bent:
        bends = parameters[plays : plays + spacing.size]
        values = parameters[plays + spacing.size] + np.concatenate([[0.0], np.cumsum(bends * spacing)])
        return _Bent(parameters[:plays], first.knots, values, parameters[plays + spacing.size + 1 :])

    def residual(parameters: FloatArray) -> FloatArray:
        one = made(parameters)
        bent = _bent(columns @ one.weights, one.knots, one.values)
        heavy = np.sqrt(share * y.size)
        bends = np.diff(parameters[plays : plays + spacing.size])
        return np.concatenate([bent + one.constants[record] - y, heavy * parameters[1:plays], heavy * bends])

    low = np.full(start.size, -np.inf)
    low[:plays] = 0.0
    low[plays : plays + spacing.size] = LEAST_SLOPE
    # Strictly inside of the bounds, as the solver asks for.
    start = np.maximum(start, np.where(np.isfinite(low), low + 1e-6, -np.inf))
    found = least_squares(residual, start, bounds=(low, np.inf), max_nfev=40, x_scale="jac").x
    return float(np.mean(residual(found) ** 2)), made(found)


MODIFIED_PI = ModifiedMethod()
