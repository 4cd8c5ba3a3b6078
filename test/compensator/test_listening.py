"""What holds the first voltage of a compensator back: others that command the stage."""

import random

import pytest

from slpi_ros.compensator.block import PATIENCE_NS
from slpi_ros.compensator.listening import LOOK_NS, LOOK_WITHOUT_NS, QUIET_NS, RANDOM_NS, Listening

MS = 1_000_000
BEGIN = 10**12


def listening(*others):
    """Return the rule of a node that has left the stage as it is."""
    rule = Listening(lambda: list(others))
    rule.begin(BEGIN)
    rule.thorough = False
    return rule


def free_after(rule, until_ns=8_000 * MS, step_ns=10 * MS):
    """Return the time (ns) from the begin on at which nothing holds the first voltage back."""
    return next((at for at in range(0, until_ns, step_ns) if rule.check(BEGIN + at) is None), None)


def test_alone_it_waits_for_the_graph_only():
    assert free_after(listening()) == LOOK_WITHOUT_NS
    rule = listening()
    rule.state(BEGIN + 100 * MS)
    rule.state(BEGIN + 300 * MS)
    assert free_after(rule) == 100 * MS + LOOK_NS


@pytest.mark.parametrize("seed", range(5))
def test_beside_a_silent_one_it_listens_as_long_as_that_would_take_to_be_heard(seed):
    random.seed(seed)
    rule = listening("/other")
    rule.state(BEGIN)
    assert QUIET_NS <= free_after(rule) <= QUIET_NS + RANDOM_NS + 10 * MS


def test_it_listens_from_when_the_graph_knows_of_another_one():
    others = []
    rule = Listening(lambda: list(others))
    rule.begin(BEGIN)
    rule.state(BEGIN)
    assert rule.check(BEGIN + LOOK_WITHOUT_NS - MS) is not None
    assert rule.check(BEGIN + LOOK_WITHOUT_NS) is None
    others.append("/other")
    assert rule.check(BEGIN + 9_000 * MS) is not None
    assert rule.check(BEGIN + 9_000 * MS + QUIET_NS - MS) is not None
    assert rule.check(BEGIN + 9_000 * MS + QUIET_NS + RANDOM_NS) is None


def test_it_names_who_commands_and_goes_on_when_that_has_ended():
    rule = listening("/other")
    rule.state(BEGIN)
    for at in range(0, 5_000, 800):
        rule.hear(BEGIN + at * MS)
        found = rule.check(BEGIN + (at + 10) * MS)
        assert found is not None and "/other" in found.reason
    last = 4_800 * MS
    assert rule.check(BEGIN + last + QUIET_NS - MS) is not None
    assert rule.check(BEGIN + last + QUIET_NS) is None
    # Until its own first voltage it goes on listening.
    rule.hear(BEGIN + 7_000 * MS)
    assert rule.check(BEGIN + 7_001 * MS) is not None


def test_a_voltage_of_somebody_whom_the_graph_does_not_know_counts():
    rule = listening()
    rule.state(BEGIN)
    rule.hear(BEGIN + 400 * MS)
    assert rule.check(BEGIN + LOOK_NS + 100 * MS) is not None


def test_a_block_that_is_played_holds_it_back():
    rule = listening()
    rule.state(BEGIN)
    rule.play(True, BEGIN + 19_000 * MS)
    assert rule.check(BEGIN + 20_000 * MS) is not None
    rule.play(False, BEGIN + 20_000 * MS)
    assert rule.check(BEGIN + 20_000 * MS) is None


def test_a_driver_that_has_died_plays_no_block():
    rule = listening()
    rule.state(BEGIN)
    rule.play(True, BEGIN + 19_000 * MS)
    assert rule.check(BEGIN + 19_000 * MS + PATIENCE_NS - MS) is not None
    assert rule.check(BEGIN + 19_000 * MS + PATIENCE_NS) is None


def test_two_that_begin_together_do_not_decide_alike():
    assert len({free_after(each) for each in _many()}) > 5


def _many():
    for _ in range(30):
        rule = listening("/other")
        rule.state(BEGIN)
        yield rule
