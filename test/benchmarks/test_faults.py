"""The fault bench, in short: other faults in every run, none of them wrong."""

import os
import random
import time

import pytest

from benchmarks.faults import files, long_life, mutated, table


def seed() -> int:
    """Return a new seed, under CI always the same."""
    return 1 if os.environ.get("CI") else int(time.time())


def test_mutated_files():
    rows = files(300, seed())
    assert table(rows) == 0
    assert all(counts["tried"] == 30 for _, counts in rows)
    # Some are still good: faults that every reader sees at once would test little.
    assert 0 < sum(counts["refused"] for _, counts in rows) < sum(counts["tried"] for _, counts in rows)


def test_faults_are_drawn_from_the_seed_alone():
    assert mutated(b"x" * 100, random.Random("1 a 1")) == mutated(b"x" * 100, random.Random("1 a 1")) != b"x" * 100


def test_a_long_life_in_short():
    assert long_life(0.05, 50.0, seed())["wrong"] == 0


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.long
def test_two_lives():
    pytest.importorskip("rclpy")
    from benchmarks.faults import lives

    rows = lives(2, seed())
    assert table(rows) == 0
