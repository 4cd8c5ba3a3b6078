import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, PI_CASE, axis_model, axis_models, cases, fractions, paths

from slpi_ros.errors import RecordError, SlpiError, UnreachableError, UsageError
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.limits import Limits
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel

T = np.arange(5.0)
X = axis_model(FAMILY_CASE)
Y = axis_model(PI_CASE)
ONE, TWO = StageModel({"x": X}), StageModel({"x": X, "y": Y}, "stage 7", "2024-05-06T07:08:09Z")
VOLTS = np.array([10.0, 60.0, 30.0, 45.0, 90.0])
METRES = np.array([3e-6, 8e-6, 5e-6, 6e-6, 11e-6])


@st.composite
def models_and_paths(draw: st.DrawFn) -> tuple[AxisModel, np.ndarray]:
    case = draw(cases())
    turns = draw(st.lists(fractions(0, 1).map(lambda share: case.span[0] + share * case.width), max_size=3))
    return axis_model(case, tuple(turns)), draw(paths(case, *case.span))


@given(models_and_paths())
def test_compensate_undoes_simulate(drawn):
    axis, v = drawn
    model = StageModel({"x": replace(axis, displacement_range=(-1e3, 1e3))})
    t = np.arange(v.size, dtype=float)
    first = np.clip(axis.start.voltage, *axis.voltage_range)
    # The axis comes inside its range before it follows a path.
    y = model.simulate([-1.0, *t], [first, *v])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HeldAtLimitWarning)
        back = model.compensate([-1.0, *t], y)
    width = axis.voltage_range[1] - axis.voltage_range[0]
    np.testing.assert_allclose(back, [first, *v], rtol=0, atol=1e-9 * width)


@given(axis_models())
def test_the_memory_starts_where_the_model_says(axis):
    memory, start = axis.memory(), axis.start
    height = axis.displacement_range[1] - axis.displacement_range[0]
    assert memory.voltage == start.voltage
    assert memory.displacement == pytest.approx(
        start.displacement, abs=1e-12 * height + 1e-15 * abs(start.displacement)
    )
    if not start.history:
        assert memory.snapshot() == Memory(axis.hysteresis, start.voltage, start.displacement).snapshot()


def test_the_history_decides_where_loops_close():
    """Up to 60 V and down to 20 V before: a rise from there runs along the inner loop and closes it at 60 V."""
    plain, before = Start(20.0, 5e-6), Start(20.0, 5e-6, (0.0, 60.0))
    axes = [replace(X, start=start) for start in (plain, before)]
    rise = np.array([30.0, 60.0, 80.0])
    first_rise, inner = (axis.simulate(np.arange(3.0), rise) for axis in axes)
    walked = Memory(X.hysteresis, 0.0, 0.0, primed=True).forward_array(np.array([60.0, 20.0, *rise]))
    np.testing.assert_allclose(inner, walked[2:] - walked[1] + 5e-6, rtol=0, atol=1e-15)
    assert abs(first_rise - inner).max() > 1e-7
    assert axes[1].memory().depth == 3


def test_forms_of_arguments():
    y = ONE.simulate(T, VOLTS)
    assert isinstance(y, np.ndarray)
    assert y.dtype == np.float64
    assert (y == X.simulate(T, VOLTS)).all()
    assert (ONE.simulate(T.tolist(), VOLTS.tolist()) == y).all()
    assert (ONE.simulate(T, VOLTS.astype(np.float32)) == y).all()
    assert (ONE.simulate(T.astype(int), VOLTS.astype(int)) == y).all()
    mapped = ONE.simulate(T, {"x": VOLTS})
    assert list(mapped) == ["x"]
    assert (mapped["x"] == y).all()
    both = TWO.simulate(T, {"y": VOLTS, "x": VOLTS.tolist()})
    assert list(both) == ["y", "x"]
    assert (both["x"] == y).all()
    assert (both["y"] == Y.simulate(T, VOLTS)).all()
    assert list(TWO.simulate(T, {"y": VOLTS})) == ["y"]
    back = TWO.compensate(T, {"x": METRES})
    assert (back["x"] == ONE.compensate(T, METRES)).all()


def test_every_call_starts_anew_and_leaves_its_arguments_alone():
    v, t = VOLTS.copy(), T.copy()
    v.flags.writeable = t.flags.writeable = False
    assert (ONE.simulate(t, v) == ONE.simulate(t, v)).all()
    y = METRES.copy()
    y.flags.writeable = False
    assert (ONE.compensate(t, y) == ONE.compensate(t, y)).all()


def test_every_second_sample_of_an_array():
    assert (ONE.simulate(T, np.repeat(VOLTS, 2)[::2]) == ONE.simulate(T, VOLTS)).all()


def test_no_samples_and_equal_times():
    assert ONE.simulate([], []).shape == (0,)
    assert ONE.compensate([], []).shape == (0,)
    assert (ONE.simulate(np.zeros(5), VOLTS) == ONE.simulate(T, VOLTS)).all()


@given(models_and_paths())
def test_stream_gives_what_compensate_gives(drawn):
    axis, v = drawn
    model = StageModel({"x": axis})
    y = np.clip(axis.simulate(np.arange(v.size), v), *axis.displacement_range)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HeldAtLimitWarning)
        batch = model.compensate(np.arange(v.size), y)
    step = model.stream("x")
    streamed = [step(t, wish) for t, wish in enumerate(y.tolist())]
    np.testing.assert_allclose(streamed, batch, rtol=0, atol=1e-9 * np.ptp(axis.voltage_range))
    low, high = axis.voltage_range
    assert ((low <= batch) & (batch <= high)).all()


@given(models_and_paths())
def test_what_the_model_gives_within_its_range_is_never_held(drawn):
    """Not even by rounding, where the path touches the limits."""
    axis, v = drawn
    v = np.concatenate([[np.clip(axis.start.voltage, *axis.voltage_range)], v, axis.voltage_range, v[::-1]])
    y = axis.simulate(np.arange(v.size), v)
    axis = replace(axis, displacement_range=(y.min(), y.max()))
    assert not axis.compensate(np.arange(y.size), y)[1].any()
    stream = axis.stream()
    for t, wish in enumerate(y.tolist()):
        stream.step(t, wish)
        assert not stream.held


def test_limits_narrow_the_identified_voltages():
    assert X.stream().limits == Limits(0.0, 100.0)
    assert X.stream(Limits(-50.0, 60.0, 5.0)).limits == Limits(0.0, 60.0, 5.0)
    v, held = X.compensate(T, METRES, Limits(20.0, 50.0))
    assert v.min() == 20.0
    assert v.max() == 50.0
    assert held.tolist() == ((v == 20.0) | (v == 50.0)).tolist()
    with pytest.raises(UsageError):
        X.stream(Limits(150.0, 200.0))


def test_out_of_reach_waits_at_the_limit_with_a_warning():
    y = np.array([4e-6, 15e-6, 15.5e-6, 6e-6, 5e-6])
    with pytest.warns(HeldAtLimitWarning, match=r"^2 of 5 .*sample 1\b") as caught:
        v = ONE.compensate(T, y)
    assert v[1] == v[2] == 100.0
    reached = ONE.simulate(T, v)
    np.testing.assert_allclose(reached[[0, 3, 4]], y[[0, 3, 4]], rtol=0, atol=1e-15)
    assert len(caught) == 1


@pytest.mark.parametrize("wishes", [[15e-6], {"x": [15e-6]}], ids=["array", "mapping"])
def test_the_warning_points_at_the_caller(wishes):
    with pytest.warns(HeldAtLimitWarning) as caught:
        ONE.compensate([0.0], wishes)
    assert caught[0].filename == __file__


def test_what_is_met_is_no_reason_to_warn():
    """Here rest lies at the lowest voltage, so paths begin there."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        v = ONE.compensate(T, [2e-6, 2e-6, 3e-6, 4e-6, 5e-6])
    assert v[:2].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("signal", "error", "words"),
    [
        ({"z": VOLTS}, UsageError, "'z'.*x, y"),
        (VOLTS, UsageError, "mapping"),
        ({"x": VOLTS[:4]}, UsageError, r"axis 'x'.*\(4,\).*\(5,\)"),
        ({"x": VOLTS[:, None]}, UsageError, "axis 'x'"),
        ({"x": 3.0}, UsageError, "axis 'x'"),
        ({"x": [3e-6, 4e-6, np.nan, 3e-6, 4e-6]}, UsageError, "axis 'x'.*sample 2"),
        ({"y": [1e-6, 2e-6, 3e-6, 4e-6, -np.inf]}, UsageError, "axis 'y'.*sample 4"),
        ({"x": ["a", "b", "c", "d", "e"]}, SlpiError, "axis 'x'"),
        ({"x": [[1.0], [2.0, 3.0], [], [], []]}, SlpiError, "axis 'x'"),
        ({"x": [None] * 5}, SlpiError, "axis 'x'"),
        ({"x": [10**400] * 5}, SlpiError, "axis 'x'"),
    ],
)
@pytest.mark.parametrize("method", ["simulate", "compensate"])
def test_signals_that_do_not_fit(method, signal, error, words):
    with pytest.raises(error, match=f"^[^\n]*{words}[^\n]*$"):
        getattr(TWO, method)(T, signal)


@pytest.mark.parametrize(
    ("t", "words"),
    [
        ([0.0, 1.0, 0.5, 2.0, 3.0], "sample 2"),
        ([0.0, 1.0, np.nan, 2.0, 3.0], "finite"),
        ([0.0, 1.0, 2.0, 3.0, np.inf], "finite"),
        (0.0, "time"),
        (T[:, None], "time"),
        (["a"] * 5, "time"),
        (None, "time"),
    ],
)
@pytest.mark.parametrize("method", ["simulate", "compensate"])
def test_times_that_make_no_sense(method, t, words):
    with pytest.raises(SlpiError, match=f"^[^\n]*{words}[^\n]*$"):
        getattr(ONE, method)(t, np.full(5, 3e-6))


def test_time_is_the_records_fault():
    with pytest.raises(RecordError):
        ONE.simulate([1.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize("y", [-1e-6, 17e-6, 8.0, -1e300])
def test_far_out_of_range_is_refused(y):
    axis = replace(X, displacement_range=(2e-6, 14e-6))
    with pytest.raises(UnreachableError, match=r"^axis 'x'[^\n]*sample 3[^\n]* µm [^\n]*$"):
        StageModel({"x": axis}).compensate(T, [3e-6, 3e-6, 3e-6, y, 3e-6])


def test_an_absurd_voltage_is_refused():
    with pytest.raises(UsageError, match="axis 'x'"):
        ONE.simulate(T, [0.0, 1.0, 2.0, 3.0, 1e9])
    with pytest.raises(UsageError, match="axis 'x'"):
        ONE.simulate(np.arange(100.0), np.linspace(0.0, 1e9, 100))


def test_axes_by_name():
    assert TWO.axis("y") is Y
    with pytest.raises(UsageError, match="'yaw'.*x, y"):
        TWO.stream("yaw")
