"""Loop separation, against the engine's own stack of turning points."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.hysteresis.loop_family import LoopFamily
from slpi_ros.hysteresis.reversals import without_small_reversals
from slpi_ros.hysteresis.slpi_published import SUSPECTED, TRUE_VERTEX, Separation, separate
from slpi_ros.hysteresis.turning_points import Memory

FloatArray = NDArray[np.float64]

# Without hysteresis, but with a memory.
STRAIGHT = LoopFamily(np.array([-1.0, 1.0]), np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([0.0, 2.0]), 1.0)

# Whole volts make equal turning points, repeated samples and loops that close exactly likely.
paths = st.one_of(
    st.lists(st.integers(-6, 12), min_size=1, max_size=60),
    st.lists(st.floats(-10, 100), min_size=1, max_size=60),
).map(lambda values: np.array(values, dtype=np.float64))


def ramps(*turns: float, step: float = 4.0) -> FloatArray:
    """Straight ramps between turning points."""
    parts = [np.linspace(a, b, round(abs(b - a) / step) + 1)[1:] for a, b in pairwise(turns)]
    return np.concatenate([[turns[0]], *parts])


def engine_loops(v: FloatArray) -> tuple[dict[int, int], list[int], int | None]:
    """Follow the engine: vertex and closing sample of each loop it forgets, the turns left, and a fall from rest."""
    memory = Memory(STRAIGHT, float(v[0]), float(v[0]))
    turns: list[int] = []
    closed: dict[int, int] = {}
    fell_from = None
    for k in range(1, v.size):
        direction = memory.direction
        memory.forward(float(v[k]))
        if v[k] == v[k - 1]:
            continue
        risen = v[k] > v[k - 1]
        if not direction and not risen:
            fell_from = k - 1
        if direction and (direction > 0) != risen:
            turns.append(k - 1)
        while len(turns) > memory.depth:
            turn = turns.pop()
            if turns and memory.depth <= len(turns) - 1:
                closed[turns.pop()] = k
            else:
                # The only turn was that of a fall from rest: the loop closes at rest.
                assert fell_from is not None, turn
                closed[fell_from], fell_from = k, None
    return closed, turns, fell_from


def levels_of(separation: Separation) -> NDArray[np.int64]:
    level = np.full(separation.voltage.size, -1)
    for loop in separation.loops:
        level[loop.samples] = loop.level
    return level


@settings(max_examples=400)
@given(paths)
def test_equals_the_engines_closed_loops(v: FloatArray) -> None:
    separation = separate(v)
    closed, turns, fell_from = engine_loops(v)

    found = {loop.vertex: loop for loop in separation.loops if loop.closed}
    assert found.keys() == closed.keys()
    for vertex, end in closed.items():
        assert separation.vertex[vertex] == TRUE_VERTEX
        assert vertex < found[vertex].samples.min() <= found[vertex].samples.max() < end

    # The engine's turns that are left: the outer loop's own one first, then a vertex and a turn for each open loop.
    opened = [loop.vertex for loop in separation.loops[1:] if not loop.closed]
    assert opened == turns[1::2]
    assert all(separation.vertex[turn] == SUSPECTED for turn in turns if turn)
    assert (separation.loops[0].direction < 0) == (fell_from is not None)

    # Every sample in exactly one loop, as deep as there are loops around it.
    owned = np.concatenate([loop.samples for loop in separation.loops])
    assert sorted(owned) == list(range(v.size))
    spans = [*closed.items(), *((vertex, v.size) for vertex in opened)]
    depth = [sum(start < k < end for start, end in spans) for k in range(v.size)]
    assert levels_of(separation).tolist() == depth


def judged(v: FloatArray) -> list[list[int]]:
    """Judge sample by sample, as the paper says it: ``tr``, ``lv`` and ``sp`` of each."""
    table = [[1, 0, 2]]
    suspects: list[int] = []
    phase = 1
    for k in range(1, v.size):
        if phase * (v[k] - v[k - 1]) < 0:
            phase = -phase
            suspects.append(k - 1)
            table[k - 1] = [phase, len(suspects), SUSPECTED]
        while len(suspects) > 1 and v[k] != v[k - 1] and phase * (v[k] - v[suspects[-2]]) >= 0:
            table[suspects[-2]][2] = TRUE_VERTEX
            suspects = suspects[:-2]
        table.append([phase, len(suspects), 0])
    table[0][2] = TRUE_VERTEX
    return table


@given(paths)
def test_table_is_what_the_papers_judging_gives(v: FloatArray) -> None:
    table = separate(v, 2 * v).table()
    assert table[:, :3].tolist() == [[k, x, 2 * x] for k, x in enumerate(v.tolist())]
    assert table[:, 3:].tolist() == judged(v)


@given(paths)
def test_a_single_loop_turns_once(v: FloatArray) -> None:
    for loop in separate(v).loops[1:]:
        own = v[loop.path]
        assert np.all(loop.direction * (own - own[0]) >= 0)
        moves = np.sign(np.diff(own))
        assert np.count_nonzero(np.diff(moves[moves != 0])) <= 1
        if loop.closed:
            assert own[0] == own[-1]
        assert set(loop.joined) <= set(loop.samples.tolist())


CASES = {
    "one loop within another": (ramps(0, 80, 12, 68, 20, 68, 80, 100, 0), [(0, 0, 1), (1, 80, -1), (2, 68, -1)]),
    "vertex on the back branch": (ramps(0, 100, 40, 72, 40, 0), [(0, 0, 1), (1, 40, 1)]),
    "several on one branch": (
        ramps(0, 40, 20, 60, 40, 80, 60, 100, 0),
        [(0, 0, 1), (1, 40, -1), (1, 60, -1), (1, 80, -1)],
    ),
    "overlapped inner and outer": (ramps(0, 60, 0, 100, 0), [(0, 0, 1), (1, 60, -1)]),
    "the same loop twice": (ramps(0, 60, 20, 60, 20, 60, 100), [(0, 0, 1), (1, 60, -1), (1, 60, -1)]),
    "open at the end": (ramps(0, 100, 20, 60, 32, 48), [(0, 0, 1), (1, 20, 1), (2, 32, 1)]),
    "falls at first": (ramps(0, -20, 0, 40, 0), [(0, 0, 1), (1, 0, -1)]),
}


@pytest.mark.parametrize(("v", "expected"), CASES.values(), ids=CASES)
def test_loops_of_known_paths(v: FloatArray, expected: list[tuple[int, float, int]]) -> None:
    loops = separate(v).loops
    assert [(loop.level, v[loop.vertex], loop.direction) for loop in loops] == expected


def test_inner_loops_are_sewn_at_their_vertices() -> None:
    v = ramps(0, 80, 12, 68, 20, 68, 80, 100, 0)
    outer, first, second = separate(v).loops
    assert v[outer.joined].tolist() == [80.0] and v[first.joined].tolist() == [68.0] and not second.joined.size
    # Sewn together, the outer loop is the plain 0 -> 100 -> 0, with the vertex and the closing sample at 80 V.
    plain = ramps(0, 100, 0)
    assert v[outer.path].tolist() == sorted([*plain[:26], 80.0]) + plain[26:].tolist()


def test_paper_counts_levels_of_the_back_phase_one_higher() -> None:
    v = ramps(0, 100, 40, 72, 40, 0)
    separation = separate(v)
    vertex = int(np.flatnonzero(separation.vertex == TRUE_VERTEX)[1])
    assert v[vertex] == 40.0 and separation.level[vertex] == 2


@given(paths, st.floats(0.01, 3.0), st.integers(0, 2**32 - 1))
def test_noise_within_the_dead_band_makes_no_loop(v: FloatArray, dead_band: float, seed: int) -> None:
    coarse = 4.0 * dead_band * np.round(v)
    noise = np.random.default_rng(seed).uniform(-dead_band, dead_band, v.size) / 2.01
    clean, noisy = separate(coarse), separate(coarse + noise, dead_band=dead_band)
    reversals = [np.sign(np.diff(s.voltage)) for s in (clean, noisy)]
    turns = [np.count_nonzero(np.diff(r[r != 0])) for r in reversals]
    assert turns[0] == turns[1]
    assert np.max(np.abs(noisy.voltage - coarse)) <= dead_band


@given(paths, st.floats(0.0, 20.0))
def test_dead_band_keeps_large_turns_and_is_idempotent(v: FloatArray, dead_band: float) -> None:
    flat = without_small_reversals(v, dead_band)
    assert np.max(np.abs(flat - v)) <= dead_band
    assert np.array_equal(without_small_reversals(flat, dead_band), flat)
    moves = [abs(b - a) for a, b in pairwise(turning_values(flat))]
    assert all(move > dead_band for move in moves)


def turning_values(v: FloatArray) -> list[float]:
    v = v[np.insert(np.diff(v) != 0, 0, True)]
    inner = np.flatnonzero(np.diff(np.sign(np.diff(v)))) + 1
    return [float(v[0]), *v[inner].tolist(), float(v[-1])] if v.size > 1 else [float(v[0])]


def test_refuses_what_is_no_record() -> None:
    with pytest.raises(RecordError):
        separate(np.array([]))
    with pytest.raises(RecordError):
        separate(np.zeros(3), np.zeros(2))
    with pytest.raises(UsageError, match=r"\b1\b.*\bnan\b"):
        separate(np.array([0.0, np.nan]))
