"""Who reports the state of a stage: whose stage it is, and whether there is one publisher."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.compensator.reporters import STANDS_NS, SoleReporter, WhoseStage

MS = 1_000_000


@pytest.mark.parametrize(
    ("expected", "model", "reported", "accepted", "differs"),
    [
        ("", "a", "b", "", True),
        ("", "a", "a", "", False),
        ("", "a", "", "", False),
        ("", "", "b", "", False),
        ("", "a", "base_link", "", False),
        ("c", "", "b", "", True),
        ("c", "a", "", "", True),
        ("c", "c", "b", "", True),
        ("", "a", "b", "b", False),
        ("", "a", "b", "a", False),
        ("c", "a", "b", "b", True),
        ("", "a", "b", "z", True),
    ],
)
def test_names_that_differ_are_told(expected, model, reported, accepted, differs):
    rule = WhoseStage(expected, accepted)
    rule.model = model
    rule.hear(reported, 1)
    found = rule.check(2)
    assert bool(found) is differs
    if found:
        known = {name for name in (expected, model, reported) if name and name != accepted}
        assert sum(f"'{name}'" in found.reason for name in known) == 2


@pytest.mark.parametrize(
    ("model", "reported", "named"),
    [("", "a", "'a'"), ("a", "", "'a'"), ("a", "base_link", "'a'"), ("", "", ""), ("a", "a", ""), ("", "map", "")],
)
def test_a_name_that_one_of_them_lacks_is_told(model, reported, named):
    rule = WhoseStage()
    rule.model = model
    assert not rule.doubt  # nothing has reported yet
    rule.hear(reported, 1)
    assert bool(rule.doubt) is bool(named) and named in rule.doubt
    assert rule.check(2) is None


def test_another_stage_stands_for_a_while_though_the_own_one_reports_too():
    rule = WhoseStage()
    rule.model = "a"
    rule.hear("b", 10 * MS)
    rule.hear("a", 20 * MS)
    assert rule.check(30 * MS)
    assert rule.check(10 * MS + STANDS_NS) is None


def _heard(numbers, frames=None):
    rule = SoleReporter("x")
    for place, number in enumerate(numbers):
        rule.hear(number, frames[place] if frames else "", place * MS)
    return rule.check(len(numbers) * MS)


@given(st.integers(1, 10**9), st.lists(st.integers(1, 5), min_size=1, max_size=60), st.integers(0, 3))
def test_one_publisher_is_alone_whatever_is_lost_and_however_often_it_is_started_again(first, steps, restarts):
    numbers = []
    for life in range(restarts + 1):
        start = first if life == 0 else 1
        numbers += list(start + np.cumsum(steps[: len(steps) // (life + 1) + 1]))
    assert _heard([int(number) for number in numbers]) is None


@given(st.integers(1, 2000), st.integers(1, 2000), st.integers(1, 7), st.integers(1, 7), st.randoms())
def test_two_that_are_alive_are_found(first, second, run, other_run, random):
    # Each in runs, of which messages may be lost.
    numbers, ends = [], [first, second]
    for _ in range(6):
        for place, length in enumerate((run, other_run)):
            for _ in range(length):
                ends[place] += 1 if random.random() < 0.9 else 2
                numbers.append(ends[place])
    assert _heard(numbers) is not None


def test_without_numbers_names_that_take_turns_are_two():
    assert _heard([None] * 8, ["a", "b"] * 4).axis == "x"
    assert _heard([None] * 8, ["a"] * 4 + ["b"] * 4) is None


def test_it_ends_when_one_of_them_has_ended():
    rule = SoleReporter("x")
    for place in range(20):
        rule.hear(place // 2 + 100 * (place % 2) + 1, "", place * MS)
    assert rule.check(21 * MS)
    for place in range(20):
        rule.hear(place + 11, "", (20 + 200 * place) * MS)
    assert rule.check(20 * 200 * MS) is None
