"""The command line, the identify node and the fleet decide the same about the same bag, for the same reason."""

import pytest
from hostile_bags import SPOILS, by_node, disagreement, quick_fits, write_hostile


@pytest.fixture(autouse=True)
def quick():
    with quick_fits():
        yield


@pytest.mark.parametrize("name", SPOILS)
def test_every_way_decides_the_same(name, tmp_path):
    assert not disagreement(write_hostile(tmp_path, name, 0), tmp_path)


@pytest.mark.parametrize("name", ["unchanged", "coarse", "one_way"])
def test_also_with_a_late_sensor(name, tmp_path):
    assert not disagreement(write_hostile(tmp_path, name, 1), tmp_path, delay=0.03)


def test_there_are_bags_of_both_kinds(tmp_path):
    decisions = [by_node(write_hostile(tmp_path, name, 2), tmp_path, 0.0) for name in ("unchanged", "unmoved")]
    assert [bool(decision.refused) for decision in decisions] == [False, True]
