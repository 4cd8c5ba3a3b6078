"""Spoiled records lead to nearly the same model: a small part of ``benchmarks/robustness.py``."""

import numpy as np
import pytest
from scripts import importable

SEED, SECONDS, RATE = 1, 30.0, 200.0


@pytest.fixture(scope="module")
def robustness():
    with importable("benchmarks"):
        import robustness

        yield robustness


@pytest.fixture(scope="module")
def recording(robustness):
    return robustness.recorded(SEED, SECONDS, RATE)


def mean_error(robustness, recording, spoiled):
    high = recording.true.max()
    span = high - recording.true[-1]
    error = robustness.unseen_errors(spoiled, SEED, RATE, high - 0.98 * span, high - 0.02 * span)
    return float(error.mean())


@pytest.fixture(scope="module")
def clean(robustness, recording):
    return mean_error(robustness, recording, recording)


@pytest.mark.parametrize("case", ["outliers", "coarse", "unknown_memory", "mid_loop", "voltage_noise"])
def test_a_spoiled_record_does_little_harm(robustness, recording, clean, case):
    spoiled = getattr(robustness, case)(recording, np.random.default_rng(0), SEED)
    # Of one seed alone the clean error is a matter of luck, too.
    assert mean_error(robustness, recording, spoiled) < 2 * clean + 1e-5
    assert clean < 3e-4
