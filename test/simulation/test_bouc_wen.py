import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from benchmarks.hidden.physics import BoucWen
from slpi_ros.errors import UsageError

voltages = st.floats(-20, 120)


def integrated(stage, path):
    """Integrate dh = a d dv - b h |dv| - c |h| dv numerically along straight moves from rest."""
    h, last, found = 0.0, 0.0, []
    for v in path:
        way = np.sign(v - last)

        def slope(_, h, way=way):
            return way * stage.share * stage.gain - stage.softening * h - way * stage.asymmetry * np.abs(h)

        if v != last:
            solution = solve_ivp(slope, (0, abs(v - last)), [h], rtol=1e-10, atol=1e-18, max_step=2.0)
            h = solution.y[0, -1]
        last = v
        found.append(stage.gain * v - h)
    return stage.offset + np.array(found)


@given(st.lists(voltages, min_size=1, max_size=6), st.floats(-0.6, 0.6))
@settings(max_examples=40, deadline=None)
def test_it_solves_its_equation(path, share):
    stage = BoucWen(asymmetry=0.025 * share, offset=1e-7)
    np.testing.assert_allclose(stage.run(np.array(path)), integrated(stage, path), atol=1e-13)


@given(st.lists(voltages, min_size=1, max_size=6))
def test_it_does_not_depend_on_the_rate(path):
    corners = np.array([0.0, *path])
    fine = np.interp(np.linspace(0, len(path), 50 * len(path) + 1), np.arange(corners.size), corners)
    np.testing.assert_allclose(BoucWen().run(fine)[::50], BoucWen().run(corners), atol=1e-18)


def test_small_loops_do_not_close_and_large_ones_settle():
    """After an excursion a stage of relays is back on its branch; this one is not."""
    stage = BoucWen(softening=0.05, asymmetry=0.02)
    wiped = [100.0, 0.0] * 4
    away_and_back = stage.run(np.array([*wiped, 60.0, 40.0, 60.0, 100.0]))
    at_once = stage.run(np.array([*wiped, 60.0, 100.0]))
    assert abs(away_and_back[-2] - away_and_back[-4]) > 50e-9
    assert away_and_back[-4] == pytest.approx(at_once[-2], abs=1e-12)
    again = stage.run(np.array([*wiped, 100.0, 0.0]))
    assert again[-1] == pytest.approx(again[-3], abs=1e-9)


@pytest.mark.parametrize("wrong", [{"gain": 0.0}, {"share": 1.0}, {"share": 0.0}, {"softening": 0.01}])
def test_what_is_no_stage(wrong):
    with pytest.raises(UsageError):
        BoucWen(**wrong)
