"""The bench of nodes beside each other, in short."""

import os
import random
import time

import pytest

from benchmarks import company


@pytest.mark.parametrize("kind", company.KINDS, ids=lambda kind: kind.__name__)
def test_a_plan_judges_whoever_must_speak(kind):
    for seed in range(20):
        plan = kind(random.Random(seed))
        assert plan == kind(random.Random(seed))
        assert any(step.must for step in plan.steps)
        assert all(name in plan.judged for step in plan.steps for name in step.must)


@pytest.mark.ros
@pytest.mark.long
@pytest.mark.parametrize("kind", ["at_once", "second", "commander", "foreign"])
def test_a_life(kind):
    pytest.importorskip("rclpy")
    seed = 1 if os.environ.get("CI") else int(time.time())
    assert company.table([company.live(0, seed, kind)]) == 0
