"""Whole paths and single samples have the same inverse, whatever the model, its start, the path and the stamps.

``SLPI_EXAMPLES=1000`` looks longer; ``--hypothesis-seed`` looks elsewhere.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from effects.cases import BY_NAME, numbers, rate_laws
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import axis_model, cases, paths

from slpi_ros.effects.base import EffectContext
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.resonance import Resonance
from slpi_ros.errors import UsageError
from slpi_ros.model.axis_model import START_MEMORIES, AxisModel
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import StageModel

FloatArray = NDArray[np.float64]
pytest.importorskip("numba")
# A delay is compensated by preview; what belongs to sensor or record is in no inverse.
INVERTED = ("lag", "slew", "saturation", "rate_dependence", "creep", "contact", "resonance")
INVERTED = (*INVERTED, "self_heating", "gain_drift")


@dataclass(frozen=True)
class Drawn:
    """A model of one axis or of two, a path for each, their stamps, limits and the memory at the start."""

    model: StageModel
    t: FloatArray
    y: dict[str, FloatArray]
    limits: Limits | None
    start_memory: str


@st.composite
def axes(draw: st.DrawFn) -> tuple[AxisModel, FloatArray]:
    """Draw an axis, and a path in its range that seldom begins where the axis is."""
    case = draw(cases())
    turns = draw(st.lists(numbers(0, 1).map(lambda share: case.span[0] + share * case.width), max_size=3))
    axis = axis_model(case, tuple(turns))
    axis = replace(axis, end=draw(st.none() | st.just(axis.after(draw(paths(case, *case.span))))))
    # In units of this stage.
    unit = float(np.ptp(axis.displacement_range)) / 10e-6
    effects = []
    for name in sorted(draw(st.sets(st.sampled_from(INVERTED)))):
        effect = draw(rate_laws() if name == "rate_dependence" else BY_NAME[name])
        if name == "saturation" and not (effect.lower < axis.voltage_range[1] and effect.upper > axis.voltage_range[0]):
            continue
        if name == "creep" and draw(st.booleans()):
            effect = replace(effect, initial=unit * 1e-6)
        if name == "contact":
            effect = replace(effect, position=unit * effect.position)
        if name in ("self_heating", "gain_drift"):
            effect = replace(effect, origin=unit * effect.origin)
        if name == "rate_dependence":
            effect = replace(effect, reversible_gain=unit * effect.reversible_gain)
        effects.append(effect)
    if draw(st.booleans()):
        effects.append(draw(BY_NAME["delay"]))
    low, high = axis.displacement_range
    size = draw(st.integers(1, 60))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    stretch = draw(st.sampled_from((0.02, 0.3, 1.0)))
    y = low + (high - low) * np.clip(0.5 + stretch * np.cumsum(rng.normal(size=size)) / 3, -0.1, 1.1)
    # Steps, rests and slow motion.
    y = np.where(
        rng.random(size) < draw(st.sampled_from((0.0, 0.3, 0.9))), np.round(y / (high - low), 1) * (high - low), y
    )
    if draw(st.booleans()):
        y[0] = axis.rest(None, "end")
    return replace(axis, effects=tuple(effects)), y


@st.composite
def models_and_paths(draw: st.DrawFn) -> Drawn:
    first, y = draw(axes())
    model, wanted = {"x": first}, {"x": y}
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    if draw(st.booleans()):
        second, z = draw(axes())
        gains = draw(st.tuples(numbers(-0.4, 0.4), numbers(-0.4, 0.4)))
        scale = float(np.ptp(first.displacement_range) / np.ptp(second.displacement_range))
        for name, axis, other, gain in (
            ("x", first, "y", gains[0] * min(scale, 1.0)),
            ("y", second, "x", gains[1] * min(1 / scale, 1.0)),
        ):
            model[name] = replace(axis, effects=(*axis.effects, CrossCoupling({other: gain})))
        if draw(st.booleans()):
            wanted["y"] = np.resize(z, y.size)
    step = 10.0 ** draw(numbers(-4.0, -0.5))
    dt = step * (rng.random(y.size) >= draw(st.sampled_from((0.0, 0.2))))
    if draw(st.booleans()):
        dt *= 10.0 ** rng.uniform(-1.0, 1.0, y.size)
    t = draw(st.sampled_from((0.0, 1.7e9, -3.3))) + np.cumsum(dt)
    low, high = first.voltage_range
    limits = draw(st.none() | st.tuples(numbers(0, 0.4), numbers(0.6, 1)))
    if limits:
        limits = Limits(low + limits[0] * (high - low), low + limits[1] * (high - low))
        if len(model) == 2:
            limits = None
    return Drawn(StageModel(model), t, wanted, limits, draw(st.sampled_from(START_MEMORIES)))


def streamed(drawn: Drawn) -> dict[str, tuple[FloatArray, NDArray[np.bool_]]]:
    """Return voltages and whether they are held, sample by sample."""
    model, stage = drawn.model, drawn.model.streams(drawn.start_memory)
    if drawn.limits:
        stage.streams = {name: axis.stream(drawn.limits, drawn.start_memory) for name, axis in model.axes.items()}
    rows = []
    for k, now in enumerate(drawn.t.tolist()):
        v = stage.step(now, {name: float(y[k]) for name, y in drawn.y.items()})
        rows.append({name: (v[name], stage.streams[name].held) for name in v})
    return {name: tuple(map(np.array, zip(*(row[name] for row in rows), strict=True))) for name in drawn.y}


@pytest.mark.parametrize("compiled", [True, False])
@given(models_and_paths())
def test_a_path_is_compensated_as_its_samples_are(compiled, drawn):
    try:
        expected = streamed(drawn)
    except UsageError:
        # The inverse of a resonance asks for a displacement that no voltage gives.
        expected = None
    with pytest.MonkeyPatch.context() as patch:
        # On a whole path modes are inverted better than sample by sample.
        patch.setattr(Resonance, "looks_ahead", False)
        for module in ("slpi_ros.model.streaming", "slpi_ros.hysteresis.turning_points"):
            patch.setattr(f"{module}.worth_compiling", lambda samples: compiled)
        if expected is None:
            with pytest.raises(UsageError, match="sample"):
                drawn.model.command(drawn.t, drawn.y, drawn.limits, drawn.start_memory)
            return
        answers = drawn.model.command(drawn.t, drawn.y, drawn.limits, drawn.start_memory)
    for name, (v, held) in answers.items():
        previewed = expected[name][0]
        for effect in drawn.model.axes[name].effects:
            if effect.shift:
                previewed = effect.invert(previewed, EffectContext.since_start(drawn.t))
        # Compiled, the same sums are rounded otherwise, and a flat branch multiplies what they differ by.
        np.testing.assert_allclose(v, previewed, rtol=1e-12, atol=1e-12, err_msg=name)
        np.testing.assert_array_equal(held, expected[name][1])
