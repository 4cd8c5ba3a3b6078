"""Hypothesis strategies: random hysteresis models of every kind, and random paths for them.

``SLPI_EXAMPLES=5000`` looks longer for counter-examples.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from slpi_ros.hysteresis.kinds import Hysteresis, to_document
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]

# Drawing a model and a path takes a while; on a slow machine that is no mistake.
settings.register_profile(
    "models", settings.default, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.load_profile("models")
# For a property that runs several times: once for each way, start or kind.
repeated = settings(max_examples=max(settings.default.max_examples // 2, 1))

KINDS = ("pi", "slpi")
# Displacement per volt: metres on a real stage, and micrometres, as the papers have it.
UNITS = (1e-7, 0.1)


@dataclass(frozen=True)
class Case:
    """A model, and where its memory starts."""

    shape: Hysteresis
    rest: tuple[float, float]
    primed: bool
    span: tuple[float, float]
    landmarks: tuple[float, ...]

    def memory(self) -> Memory:
        return Memory(self.shape, *self.rest, primed=self.primed)

    @property
    def width(self) -> float:
        return self.span[1] - self.span[0]

    @cached_property
    def slopes(self) -> tuple[float, float]:
        """The smallest and the largest slope that a branch can have."""
        shape = self.shape
        if isinstance(shape, PrandtlIshlinskii):
            slopes = np.cumsum(shape.weights)
        else:
            cells = np.diff(shape.grid)
            rows, columns = np.tril_indices(cells.size)
            slopes = np.concatenate([
                (np.diff(shape.everett, axis=0)[rows, columns]) / cells[rows],
                (-np.diff(shape.everett, axis=1)[rows + 1, columns]) / cells[columns],
                np.diff(shape.rise) / cells,
                [shape.edge_gain],
            ])  # fmt: skip
        return float(slopes.min()), float(slopes.max())

    @cached_property
    def height(self) -> float:
        """Displacement of the outermost loop."""
        shape = self.shape
        if isinstance(shape, PrandtlIshlinskii):
            return float(shape.weights @ np.maximum(self.width - 2 * shape.thresholds, 0))
        return float(shape.everett[-1, 0])

    def displacements(self, v: FloatArray) -> FloatArray:
        """Turn a path of voltages into one of displacements that the model reaches somewhere."""
        return self.rest[1] + (v - self.rest[0]) * float(np.sqrt(np.prod(self.slopes)))


def fractions(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


@st.composite
def prandtl_ishlinskii(draw: st.DrawFn) -> PrandtlIshlinskii:
    """Draw an invertible PI model; some weights are zero or negative."""
    unit = draw(st.sampled_from(UNITS))
    spacing = draw(st.lists(fractions(0.5, 15), max_size=8))
    slopes = draw(st.lists(fractions(0.1, 2), min_size=len(spacing) + 1, max_size=len(spacing) + 1))
    for i in draw(st.sets(st.integers(1, 8), max_size=2)):
        slopes[i : i + 1] = slopes[i - 1 : i][: len(slopes) - i]
    weights = np.diff([0.0, *slopes]) * unit
    return PrandtlIshlinskii(np.cumsum([0.0, *spacing]), weights)


@st.composite
def loop_families(draw: st.DrawFn) -> LoopFamily:
    """Draw an Everett function on a grid that need not be uniform nor start at 0."""
    unit = draw(st.sampled_from(UNITS))
    first = draw(st.sampled_from((0.0, -40.0, 20.0)) | fractions(-150, 150))
    if draw(st.booleans()):
        grid = first + 15.0 * np.arange(draw(st.integers(2, 7)))
    else:
        cells = draw(st.lists(fractions(1, 8), min_size=1, max_size=6))
        grid = first + np.cumsum([0.0, *cells]) * 80 / sum(cells)
    n = grid.size
    steps = draw(st.lists(fractions(0.1, 1), min_size=7, max_size=7))
    cells = np.diff(grid)
    everett = np.zeros((n, n))
    for i in range(1, n):
        for j in range(i - 1, -1, -1):
            step = unit * steps[(3 * i + 5 * j) % 7] * min(cells[i - 1], cells[j])
            everett[i, j] = max(everett[i - 1, j], everett[i, j + 1]) + step
    rise = np.cumsum([0.0, *(cells * unit * steps[: n - 1])]) + unit * draw(fractions(-50, 50))
    return LoopFamily(grid, everett, rise, unit * draw(fractions(0.2, 1)))


@st.composite
def cases(draw: st.DrawFn, kinds: tuple[str, ...] = KINDS) -> Case:
    """Draw a model of one of `kinds` and a start: rest inside or outside the grid, never moved or primed."""
    shape: Hysteresis
    if draw(st.sampled_from(kinds)) == "pi":
        shape = draw(prandtl_ishlinskii())
        low = draw(st.sampled_from((0.0, -50.0, 12.5)))
        span = (low, low + 100.0)
        landmarks = tuple((low + 2.0 * shape.thresholds).tolist())
    else:
        shape = draw(loop_families())
        span = (float(shape.grid[0]), float(shape.grid[-1]))
        landmarks = tuple(shape.grid.tolist())
    width = span[1] - span[0]
    rest = draw(st.sampled_from(landmarks) | fractions(-0.3, 1.3).map(lambda share: span[0] + share * width))
    height = width * (shape.weights[0] if isinstance(shape, PrandtlIshlinskii) else shape.edge_gain)
    return Case(
        shape, (rest, float(height) * draw(st.sampled_from((0.0, -1.0, 0.3)))), draw(st.booleans()), span, landmarks
    )


TARGETS = ("anywhere", "nested", "spiral", "landmark", "revisit", "near", "mirror", "stay")


@st.composite
def paths(
    draw: st.DrawFn, case: Case, low: float | None = None, high: float | None = None, max_size: int = 16
) -> FloatArray:
    """Draw a path of voltages, shape (N,), N >= 1: jumps, walks and long smooth runs, by and beyond the grid.

    It turns on and off vertices, comes back to earlier points exactly and by tiny steps, and rests. `low` and `high`
    bound it.
    """
    bottom = case.span[0] - 0.4 * case.width if low is None else low
    top = case.span[1] + 0.4 * case.width if high is None else high
    move = st.tuples(st.sampled_from(TARGETS), fractions(0, 1), st.sampled_from((1, 1, 1, 2, 7, 40, 75)))
    stops = [min(max(case.rest[0], bottom), top)]
    stretches = []
    for target, share, count in draw(st.lists(move, min_size=3, max_size=max_size)):
        last = stops[-1]
        goal = bottom + share * (top - bottom)
        if target == "landmark":
            goal = case.landmarks[int(share * (len(case.landmarks) - 1))]
        elif target == "revisit":
            goal = stops[int(share * (len(stops) - 1))]
        elif target == "nested" and len(stops) > 1:
            goal = last + share * (stops[-2] - last)
        elif target == "near":
            goal = last + np.copysign(case.width * 10 ** (-20 * abs(share - 0.5)), share - 0.5)
        elif target == "mirror":
            goal = 2 * case.rest[0] - last
        elif target == "stay":
            goal = last
        elif target == "spiral":
            # Loops within loops, until the memory is deep.
            turns = goal + (last - goal) * (-0.8) ** np.arange(1, 3 + count % 9)
            stops.extend(np.clip(turns, bottom, top).tolist())
            stretches.append(np.array(stops[-turns.size :]))
            continue
        goal = float(min(max(goal, bottom), top))
        stretch = np.linspace(last, goal, count + 1)[1:]
        stretch[-1] = goal
        stretches.append(np.clip(stretch, min(last, goal), max(last, goal)))
        stops.append(goal)
    return np.concatenate(stretches)


@st.composite
def cases_and_paths(draw: st.DrawFn, kinds: tuple[str, ...] = KINDS) -> tuple[Case, FloatArray]:
    case = draw(cases(kinds))
    return case, draw(paths(case))


def stream_forward(memory: Memory, v: FloatArray) -> FloatArray:
    return np.array([memory.forward(x) for x in v.tolist()])


def stream_inverse(memory: Memory, y: FloatArray, lower: float = -np.inf, upper: float = np.inf) -> FloatArray:
    return np.array([memory.inverse(x, lower, upper) for x in y.tolist()])


def axis_model(case: Case, history: tuple[float, ...] = ()) -> AxisModel:
    """Wrap a case as the model of an axis, identified on its span."""
    kind = "pi" if isinstance(case.shape, PrandtlIshlinskii) else "slpi"
    y_rest, (low, high) = case.rest[1], case.span
    reach = (y_rest - 2 * case.height, y_rest + 2 * case.height)
    quality = FitQuality(8.1e-9, 3.3e-8, 8.4e-9, 8e-9, 1234, 0.75, "bag/öffnung \N{MICRO SIGN}m")
    return AxisModel(kind, case.shape, Start(*case.rest, history), (low, high), reach, quality)


@st.composite
def axis_models(draw: st.DrawFn) -> AxisModel:
    """Draw the model of an axis that has never been moved, or whose drive turned at some voltages before."""
    case = draw(cases())
    turn = fractions(-0.2, 1.2).map(lambda share: case.span[0] + share * case.width)
    return axis_model(case, tuple(draw(st.lists(turn, max_size=4))))


# Rest at 0 V and 2 um, 0 to 100 V, 10 um of stroke with wide loops.
FAMILY_CASE = Case(
    LoopFamily(
        np.array([0.0, 50.0, 100.0]),
        1e-6 * np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [10.0, 5.0, 0.0]]),
        1e-6 * np.array([0.0, 5.0, 12.0]),
        1e-7,
    ),
    (0.0, 2e-6),
    False,
    (0.0, 100.0),
    (0.0, 50.0, 100.0),
)  # fmt: skip
PI_CASE = Case(
    PrandtlIshlinskii(np.array([0.0, 4.0]), np.array([1e-7, 2e-8])), (0.0, 0.0), False, (0.0, 80.0), (0.0, 8.0)
)


def two_axes() -> StageModel:
    """One of each kind."""
    axes = {"x": axis_model(FAMILY_CASE, (0.0, 60.0, 20.0)), "y": axis_model(PI_CASE)}
    return StageModel(axes, "stage 7 \N{GREEK SMALL LETTER MU}", "2024-05-06T07:08:09Z")


def assert_same_model(one: StageModel, other: StageModel) -> None:
    """Equal to the last bit."""
    assert (one.hardware_id, one.created, list(one.axes)) == (other.hardware_id, other.created, list(other.axes))
    for name, axis in one.axes.items():
        again = other.axes[name]
        for what in ("kind", "start", "voltage_range", "displacement_range", "quality"):
            assert getattr(axis, what) == getattr(again, what)
        assert to_document(axis.hysteresis) == to_document(again.hysteresis)
