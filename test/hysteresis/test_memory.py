"""The memory as an object: batches, snapshots, and what it refuses."""

import json
import sys
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import FAMILY_CASE, Case, cases, cases_and_paths, paths, stream_forward, stream_inverse

from slpi_ros.errors import UsageError
from slpi_ros.hysteresis.prandtl_ishlinskii import play
from slpi_ros.hysteresis.turning_points import Memory, MemoryState

NOT_FINITE = (float("nan"), float("inf"), -float("inf"))
ABSURD = (1e6, -1e6, 1e300, -1e300)


@given(cases_and_paths())
def test_batch_equals_stream_forward(drawn):
    case, v = drawn
    memory, twin = case.memory(), case.memory()
    np.testing.assert_allclose(
        memory.forward_array(v), stream_forward(twin, v), rtol=0, atol=rounding(case) * case.slopes[1]
    )
    assert_same_turns(memory, twin, case)


@given(cases_and_paths())
def test_batch_equals_stream_inverse(drawn):
    case, path = drawn
    y = case.displacements(path)
    memory, twin = case.memory(), case.memory()
    tolerance = rounding(case) * case.slopes[1] / case.slopes[0]
    np.testing.assert_allclose(memory.inverse_array(y), stream_inverse(twin, y), rtol=0, atol=tolerance)
    assert_same_turns(memory, twin, case)


@given(cases_and_paths(), st.integers(1, 90))
def test_batches_of_any_size_go_on_where_the_last_one_ended(drawn, size):
    case, v = drawn
    memory = case.memory()
    parts = [memory.forward_array(part) for part in np.split(v, range(size, v.size, size))]
    np.testing.assert_allclose(
        np.concatenate(parts), case.memory().forward_array(v), rtol=0, atol=rounding(case) * case.slopes[1]
    )


def rounding(case: Case) -> float:
    """Volts: 1e-12 of the range or of all voltages at play; the long fall of a primed memory is rounded to 1.5e-11."""
    return 1e-12 * max(case.width, *map(abs, case.span), abs(case.rest[0]), 50.0 * case.primed)


def assert_same_turns(memory, twin, case):
    one, other = memory.snapshot(), twin.snapshot()
    assert (one.direction, len(one.turn_voltages)) == (other.direction, len(other.turn_voltages))
    np.testing.assert_allclose(one.turn_voltages, other.turn_voltages, rtol=1e-12, atol=1e-9 * case.width)


def test_empty_batches_move_nothing():
    memory = Memory(play(2.0))
    memory.forward(3.0)
    before = memory.snapshot()
    assert memory.forward_array(np.array([])).shape == (0,)
    assert memory.inverse_array(np.array([])).shape == (0,)
    assert memory.snapshot() == before


@given(cases_and_paths(), st.integers(0, 100), st.booleans())
def test_a_restored_memory_goes_on_identically(drawn, cut, inverse):
    case, path = drawn
    drive = stream_inverse if inverse else stream_forward
    path = case.displacements(path) if inverse else path
    memory = case.memory()
    drive(memory, path[: cut % path.size])
    kept = memory.snapshot()
    text = json.dumps(asdict(kept), allow_nan=False)
    rest = drive(memory, path[cut % path.size :])
    assert kept == MemoryState(**{key: tuple(x) if isinstance(x, list) else x for key, x in json.loads(text).items()})
    for state in (kept, MemoryState(**json.loads(text))):
        fresh = case.memory()
        fresh.restore(state)
        assert (fresh.voltage, fresh.displacement, fresh.direction, fresh.depth) == (
            kept.voltage, kept.displacement, kept.direction, len(kept.turn_voltages),
        )  # fmt: skip
        assert (drive(fresh, path[cut % path.size :]) == rest).all()
        assert fresh.snapshot() == memory.snapshot()


@given(cases_and_paths())
def test_a_snapshot_is_not_moved_by_what_comes_after_it(drawn):
    case, v = drawn
    memory = case.memory()
    kept = memory.snapshot()
    stream_forward(memory, v)
    later = memory.snapshot()
    memory.restore(kept)
    assert memory.snapshot() == kept == case.memory().snapshot()
    stream_forward(memory, v)
    assert memory.snapshot() == later


@given(cases().flatmap(lambda case: st.tuples(st.just(case), paths(case), paths(case))), st.sampled_from(NOT_FINITE))
def test_samples_that_are_not_finite_leave_the_memory_untouched(drawn, sample):
    case, before, after = drawn
    for method in ("forward", "inverse"):
        _refused(case, before, after, method, sample)
        for batch in ([sample], [case.rest[0] + 1.0, sample], [*range(50), sample, *range(50)]):
            _refused(case, before, after, f"{method}_array", np.array(batch))


@given(cases().flatmap(lambda case: st.tuples(st.just(case), paths(case), paths(case))), st.sampled_from(ABSURD))
def test_absurd_samples_leave_the_memory_untouched(drawn, sample):
    """A voltage of a million volts, and a displacement that would need one."""
    case, before, after = drawn
    _refused(case, before, after, "forward", sample)
    _refused(case, before, after, "inverse", sample * case.slopes[1])


@given(cases().flatmap(lambda case: st.tuples(st.just(case), paths(case), paths(case))), st.sampled_from(ABSURD))
def test_absurd_batches_leave_the_memory_untouched(drawn, sample):
    """Be it a lone sample or one on a long smooth run."""
    case, before, after = drawn
    start = case.rest[0]
    for v in (
        [sample],
        [start + 1.0, start - 1.0, sample],
        [*np.linspace(start, start + 9.0, 50), *np.linspace(0, sample, 50)],
    ):
        _refused(case, before, after, "forward_array", np.array(v))
        _refused(case, before, after, "inverse_array", case.rest[1] + (np.array(v) - start) * case.slopes[1])


def _refused(case, before, after, method, sample):
    memory = case.memory()
    stream_forward(memory, before)
    kept = memory.snapshot()
    with pytest.raises(UsageError) as refusal:
        getattr(memory, method)(sample)
    assert "\n" not in str(refusal.value)
    assert memory.snapshot() == kept
    twin = case.memory()
    stream_forward(twin, before)
    assert (stream_forward(memory, after) == stream_forward(twin, after)).all()


@given(cases_and_paths())
def test_the_memory_never_goes_where_a_voltage_is_refused(drawn):
    """A displacement either is refused, or its voltage can be given to the memory as well."""
    case, path = drawn
    for share in (0.3, 1.0, 2.0):
        for sign in (1, -1):
            memory = case.memory()
            stream_forward(memory, path)
            try:
                v = memory.inverse(case.rest[1] + sign * share * 1e5 * case.slopes[1])
            except UsageError:
                continue
            twin = case.memory()
            stream_forward(twin, path)
            assert abs(twin.forward(v) - memory.displacement) < 1e-6 * case.height


@pytest.mark.parametrize("method", ["forward", "inverse"])
def test_sliding_costs_as_little_down_as_up(method):
    """Counted in calls: the quick path must be open in both directions, on the first branch and on later ones."""
    memory = Memory(FAMILY_CASE.shape, primed=True)
    for turn in (0.0, 90.0, 10.0, 80.0, 20.0):
        memory.forward(turn)
    counts = []
    for rise in (True, False, True, False):
        ends = (25.0, 75.0) if rise else (70.0, 30.0)
        memory.forward(ends[0])
        low, high = memory.displacement, Memory.forward(memory, ends[1])
        memory.forward(ends[0])
        path = np.linspace(*(ends if method == "forward" else (low, high)), 40)[1:-1].tolist()
        step = getattr(memory, method)
        step(path[0])
        counts.append(_calls(lambda step=step, path=path: [step(x) for x in path[1:]]))
    assert len(set(counts)) == 1


def _calls(work) -> int:
    events = []
    sys.setprofile(lambda frame, event, argument: events.append(event))
    try:
        work()
    finally:
        sys.setprofile(None)
    return events.count("call")
