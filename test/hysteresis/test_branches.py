"""Which branch each sample lies on, against a stack kept sample by sample from the laws."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import cases_and_paths, repeated

from slpi_ros.hysteresis.branches import AT_REST, LONG_FALL, Piece, trace

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
    answers: list[tuple[int, int] | None] = [None] * v.size
    before = 0
    for piece in trace(v, symmetric_rest=symmetric_rest, primed=primed):
        assert before <= piece.start < piece.stop
        before = piece.stop
        for i in range(piece.start, piece.stop):
            answers[i] = piece.direction, piece.origin
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


def test_pieces_by_name():
    v = np.array([0.0, 0.0, 2.0, 5.0, 3.0, 4.0, 4.0, 6.0, -7.0, 1.0])
    assert trace(v, symmetric_rest=True) == [
        Piece(2, 4, 1, AT_REST),
        Piece(4, 5, -1, 3),
        Piece(5, 7, 1, 4),
        Piece(7, 8, 1, AT_REST),
        Piece(8, 9, -1, AT_REST),
        Piece(9, 10, 1, 8),
    ]
    assert trace(v, symmetric_rest=False)[-2:] == [Piece(8, 9, -1, 7), Piece(9, 10, 1, 8)]
    assert trace(v, symmetric_rest=False, primed=True)[0] == Piece(2, 4, 1, 1)
    assert trace(v, symmetric_rest=False, primed=True)[-2:] == [Piece(8, 9, -1, LONG_FALL), Piece(9, 10, 1, 8)]


@pytest.mark.parametrize("last", [4.0, 6.0])
def test_samples_still_at_rest_lie_on_no_piece(last):
    assert trace(np.array([5.0, 5.0, 5.0, last]), symmetric_rest=False)[0][:2] == (3, 4)


@pytest.mark.parametrize("v", [[], [3.0], [3.0, 3.0, 3.0]])
def test_what_never_moves_has_no_pieces(v):
    assert trace(np.array(v), symmetric_rest=True) == []
