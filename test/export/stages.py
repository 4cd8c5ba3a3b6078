"""Random stages for an export: every causal kind, with effects of the stage, in the ranges that they reach."""

import math
from dataclasses import replace

import numpy as np
from effects.cases import BY_NAME
from hypothesis import reject
from hypothesis import strategies as st
from strategies import cases, fractions

from slpi_ros.effects.base import Effect
from slpi_ros.effects.contact import Contact
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.self_heating import SelfHeating
from slpi_ros.effects.slew import Slew
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.errors import UsageError
from slpi_ros.export.stage import ExportedStage
from slpi_ros.hysteresis.kinds import CausalModel
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.multi_slope import MultiSlope
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.model.axis_model import AxisModel, FitQuality, Start
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

QUALITY = FitQuality(8e-9, 3e-8, 8e-9, 8e-9, 1234, 0.75, "bag")
KINDS = ("pi", "slpi", "mpi")
STAGE_EFFECTS = (
    *("delay", "lag", "slew", "saturation", "rate_dependence", "creep", "contact", "resonance", "self_heating"),
    *("surroundings", "gain_drift", "hum", "sensor_periodic"),
)
# One of each, on a stage of 10 um.
EVERY: tuple[Effect, ...] = (
    *(Delay(1e-3), Lag(1e-3), Slew(3e4), Saturation(-5.0, 95.0), RateDependence(0.5, 10.0, 2e-9)),
    *(Creep((0.3, 5.0), (0.02, 0.01)), Contact(6e-6, 0.8), Resonance((Mode(200.0, 0.02, 0.5), Mode(300.0, 0.03, 0.3)))),
    SelfHeating(1e-8, 3.0, 1e-6),
    Surroundings(
        (
            Quantity("/room/temperature", "", 20.0, 3e-8, 1e-3, 0.5, averaging=0.02, lowest=18.0, highest=24.0),
            Quantity("/load", "force.z", 0.0, -2e-8, 0.0, 0.0, averaging=0.05, ahead=0.02, lowest=0.0, highest=5.0),
        ),
        1e-6,
    ),
    GainDrift((1.0,), (0.05,), 1e-6),
)


@st.composite
def multi_slopes(draw: st.DrawFn) -> MultiSlope:
    """Draw an MPI model whose inverse exists everywhere: one operator has threshold 0."""
    amplitude, count = draw(fractions(40, 120)), draw(st.integers(1, 10))
    weights = draw(st.lists(fractions(0.05, 1), min_size=count, max_size=count))
    thresholds = np.linspace(0.0, 0.4 * amplitude, count)
    return MultiSlope(draw(fractions(-20, 20)), amplitude, thresholds, 1e-7 * np.array(weights) / sum(weights))


def axis_of(
    kind: str, shape: CausalModel, start: Start, span: tuple[float, float], effects: tuple[Effect, ...] = ()
) -> AxisModel:
    """Return the model of an axis over `span` (V), with the displacements that it reaches there."""
    axis = AxisModel(kind, shape, start, span, (-1e3, 1e3), QUALITY)
    memory = axis.memory()
    high, low = memory.forward(span[1]), memory.forward(span[0])
    return replace(axis, displacement_range=(low, high), effects=effects)


@st.composite
def axes(draw: st.DrawFn, others: tuple[str, ...] = ()) -> AxisModel:
    kind = draw(st.sampled_from(KINDS))
    if kind == "mpi":
        shape: CausalModel = draw(multi_slopes())
        span = (shape.origin, shape.origin + shape.amplitude)
        rest = span[0] + draw(fractions(0, 1)) * shape.amplitude
    else:
        case = draw(cases((kind,)))
        shape, span = case.shape, case.span
        rest = min(max(case.rest[0], span[0]), span[1])
    width = span[1] - span[0]
    turns = draw(st.lists(fractions(-0.1, 1.1).map(lambda share: span[0] + share * width), max_size=5))
    # A multi-slope model without previous motion is valid above its rest only.
    from_rest = kind != "mpi" and draw(st.booleans())
    history = tuple(turns) if turns or kind != "mpi" else (rest,)
    names = draw(st.lists(st.sampled_from(STAGE_EFFECTS), unique=True, max_size=4))
    effects = tuple(draw(BY_NAME[name]) for name in names)
    if others:
        effects += (CrossCoupling({other: draw(fractions(-0.3, 0.3)) for other in others}),)
    return axis_of(kind, shape, Start(rest, 0.0, history, from_rest), span, effects)


@st.composite
def stages(draw: st.DrawFn) -> StageModel:
    """Draw models whose voltage can move within their range; of others there is nothing to export."""
    names = draw(st.sampled_from((("x",), ("x", "y"))))
    model = StageModel({name: draw(axes(tuple(other for other in names if other != name))) for name in names})
    try:
        ExportedStage.of(model, Limits(-math.inf, math.inf))
    except UsageError:
        reject()
    return model


def family(n: int = 21) -> LoopFamily:
    """Return a loop family over 0 to 100 V and 10 um, with wide loops."""
    grid = np.linspace(0.0, 100.0, n)
    alpha, beta = np.meshgrid(grid, grid, indexing="ij")
    width = np.clip(alpha - beta, 0.0, None)
    return LoopFamily(
        grid,
        np.where(alpha >= beta, 8e-8 * width + 1.5e-10 * width**2 + 1e-12 * width**2 * (alpha - 50) / 5, 0.0),
        1e-7 * grid,
        8e-8,
    )


def plays() -> PrandtlIshlinskii:
    return PrandtlIshlinskii(np.array([0.0, 2.0, 5.0, 10.0, 20.0]), np.array([6e-8, 1e-8, 1e-8, 1e-8, 1e-8]))


def slopes() -> MultiSlope:
    return MultiSlope(0.0, 100.0, np.linspace(0.0, 40.0, 11), np.full(11, 1e-8))


def one_axis(kind: str = "slpi", effects: tuple[Effect, ...] = ()) -> StageModel:
    """Return a stage of one axis whose record went over the whole range, to 0 V."""
    shape = {"slpi": family, "pi": plays, "mpi": slopes}[kind]()
    return StageModel({"x": axis_of(kind, shape, Start(0.0, 0.0, (0.0, 100.0, 0.0, 60.0)), (0.0, 100.0), effects)})


def two_axes(effects: tuple[Effect, ...] = EVERY) -> StageModel:
    """Return a stage of two coupled axes of different kinds, with effects."""
    start = Start(0.0, 0.0, (0.0, 100.0, 20.0, 60.0))
    return StageModel({
        "x": axis_of("slpi", family(), start, (0.0, 100.0), (*effects, CrossCoupling({"y": 0.03}))),
        "y": axis_of("pi", plays(), start, (0.0, 100.0), (CrossCoupling({"x": -0.02}),)),
    })  # fmt: skip
