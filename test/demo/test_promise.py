"""The promise of the calibrator in the demo: the best row, and a reason where promise and run differ."""

import re

import numpy as np
import pytest
from scripts import importable

RATE = 100.0
T = np.arange(1000) / RATE
Y = 5e-6 + 3e-6 * np.sin(2.0 * np.pi * T / 3.0)


@pytest.fixture(scope="module")
def demo():
    """Return the modules under test, imported as scripts import them."""
    with importable("demo"):
        import plots
        import promise

        yield {"plots": plots, "promise": promise}


@pytest.fixture
def run(demo):
    noise = 10e-9 * np.random.default_rng(1).standard_normal(T.size)
    return lambda name, error: demo["plots"].Run(name, T, Y, Y + noise + error)


def test_the_best_row_is_that_with_the_smallest_error(demo, run):
    runs = [run("uncompensated", 1e-6), run("SLPI", 0.0), run("SLPI with causes", 20e-9)]
    assert demo["promise"].best_of(runs) == 1
    assert demo["promise"].best_of(runs[::2]) == 1


def test_a_reason_is_told_only_where_promise_and_run_differ(demo, run):
    kept, other = demo["promise"].kept, run("uncompensated", 1e-6)
    assert "zero" not in kept(8e-9, 8e-9, [other, run("SLPI with causes", 0.0)])
    slope = np.gradient(Y, T)
    for error, cause, size in [
        (50e-9, "zero", 50.0), (8e-9 * T, "zero", 8.0),
        (-5e-3 * slope, "time", 5.0), (0.02 * (Y - Y.mean()), "sensitivity", 2.0),
    ]:  # fmt: skip
        found = re.search(r"it is the (\w+)(.*):", kept(8e-9, 8e-9, [other, run("causes", error)]))
        sizes = [float(each) for each in re.findall(r"[\d.-]+", found[2])]
        assert found[1] == cause and size in [pytest.approx(each, rel=0.1) for each in sizes]
    # What none of them explains is said, and a computer that was too busy from some time on.
    bump = np.where((T > 6.0) & (T < 7.0), 250e-9, 0.0)
    assert "None of" in kept(8e-9, 8e-9, [other, run("causes", bump)])
    busy = demo["plots"].Run("causes", T, Y, run("causes", bump).displacement, late=(6.0, 6.1))
    assert re.search(
        r"it is the busy computer.* 2 setpoints .*6\.0 s.*: without it ([\d.]+)", kept(8e-9, 8e-9, [other, busy])
    )
    for rest, moved in ((79e-9, False), (9e-9, True)):
        told = kept(80e-9, rest, [other, run("causes", 0.0)])
        assert "less than promised" in told and ("zero" in told and "9.0 nm" in told) == moved
    # The model with causes is as promised, but another one is better.
    assert "with SLPI" in kept(8e-9, 8e-9, [other, run("SLPI", -0.2e-9), run("SLPI with causes", 1e-9)])
