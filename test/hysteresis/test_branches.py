"""Which branch each sample lies on, against a stack kept sample by sample from the laws."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import cases_and_paths, repeated

from slpi_ros.hysteresis.branches import AT_REST, LONG_FALL, trace

FloatArray = NDArray[np.float64]


class Branch(NamedTuple):
    direction: int
    origin: int
    # voltage at which the branch runs into the one that is two below it
    closes: float


def branches(v: FloatArray, *, symmetric_rest: bool, primed: bool) -> list[tuple[int, int] | None]:
    """For each sample the direction and the origin of its branch; None while at rest."""
    rest = v[0]
    stack = [Branch(-1, LONG_FALL, -np.inf)] if primed else []
    answers: list[tuple[int, int] | None] = [None]
    for i in range(1, v.size):
        if v[i] == v[i - 1]:
            answers.append(answers[-1])
            continue
        s = 1 if v[i] > v[i - 1] else -1
        if not stack:
            stack.append(Branch(s, AT_REST, s * np.inf))
        elif stack[-1].direction != s:
            if len(stack) > 1:
                # Where the branch below turned.
                closes = v[stack[-1].origin] if stack[-1].origin >= 0 else rest
            elif primed:
                closes = np.inf
            elif symmetric_rest:
                closes = 2 * rest - v[i - 1]
            else:
                closes = rest if s > 0 else -np.inf
            stack.append(Branch(s, i - 1, closes))
        while s * (v[i] - stack[-1].closes) >= 0:
            del stack[-2:]
            if not stack:
                stack.append(Branch(s, AT_REST, s * np.inf))
        answers.append((s, stack[-1].origin))
    return answers


STARTS = [(True, False), (True, True), (False, False), (False, True)]


@pytest.mark.parametrize(("symmetric_rest", "primed"), STARTS)
@repeated
@given(drawn=cases_and_paths(), at_rest=st.integers(1, 3))
def test_every_moved_sample_lies_on_one_branch_and_the_right_one(symmetric_rest, primed, drawn, at_rest):
    case, path = drawn
    v = np.concatenate([[case.rest[0]] * at_rest, path])
    origin, direction = trace(v, symmetric_rest=symmetric_rest, primed=primed)
    moved = np.maximum.accumulate(v != v[0])
    assert (origin[~moved] == (LONG_FALL if primed else AT_REST)).all()
    assert (direction[~moved] == (-1 if primed else 0)).all()
    answers = [pair if on else None for pair, on in zip(zip(direction, origin, strict=True), moved, strict=True)]
    expected = branches(v, symmetric_rest=symmetric_rest, primed=primed)
    turned = [None if answer is None else (answer[0], turn(v, answer[1])) for answer in answers]
    assert turned == [None if answer is None else (answer[0], turn(v, answer[1])) for answer in expected]


def turn(v: FloatArray, origin: int) -> tuple[float, str]:
    """Rest may be named by `AT_REST` or by a sample at rest; samples that rest together are one turning point."""
    if origin == LONG_FALL:
        return np.inf, "fall"
    while origin > 0 and v[origin] == v[origin - 1]:
        origin -= 1
    return (float(v[0]), "rest") if origin <= 0 else (float(v[origin]), f"sample {origin}")


def test_branches_by_name():
    v = np.array([0.0, 0.0, 2.0, 5.0, 3.0, 4.0, 4.0, 6.0, -7.0, 1.0])
    origin, direction = trace(v, symmetric_rest=True)
    assert direction.tolist() == [0, 0, 1, 1, -1, 1, 1, 1, -1, 1]
    assert origin.tolist() == [AT_REST] * 4 + [3, 4, 4, AT_REST, AT_REST, 8]
    assert trace(v, symmetric_rest=False)[0].tolist() == [AT_REST] * 4 + [3, 4, 4, AT_REST, 7, 8]
    origin, direction = trace(v, symmetric_rest=False, primed=True)
    assert direction.tolist() == [-1, -1, 1, 1, -1, 1, 1, 1, -1, 1]
    assert origin.tolist() == [LONG_FALL] * 2 + [1, 1, 3, 4, 4, 1, LONG_FALL, 8]


@pytest.mark.parametrize("v", [[], [3.0], [3.0, 3.0, 3.0]])
def test_what_never_moves_is_at_rest(v):
    origin, direction = trace(np.array(v), symmetric_rest=True)
    assert origin.tolist() == [AT_REST] * len(v)
    assert direction.tolist() == [0] * len(v)
