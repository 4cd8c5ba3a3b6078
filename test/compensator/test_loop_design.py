"""The design of the loop: what it promises, against python-control and the loop over time, and what it refuses."""

from dataclasses import replace
from math import pi

import control
import numpy as np
import pytest
from strategies import PI_CASE, axis_model

from slpi_ros.compensator.feedback import PidGains
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_design import DETUNING, MESSAGES, Design, design
from slpi_ros.compensator.loop_filter import Notch
from slpi_ros.compensator.loop_margin import LEAST_MARGIN, DiscreteLoop, Plant, refusal
from slpi_ros.effects.base import Effect
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.resonance import Resonance
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.model.axis_model import AxisModel

BARE = replace(axis_model(PI_CASE), effects=())
RATE = 2000.0


def modelled(*effects: Effect) -> AxisModel:
    return replace(BARE, effects=effects)


def rung(*modes: tuple[float, float, float], delay: float = 1e-3, scale: float = 1.0) -> AxisModel:
    return modelled(Delay(delay), Resonance(tuple(Mode(f * scale, d, g) for f, d, g in modes)))


STAGES = {
    "a light mode": rung((120.0, 0.02, 1.0)),
    "a damped mode": rung((80.0, 0.4, 1.0), delay=5e-4),
    "two modes": rung((150.0, 0.01, 0.7), (310.0, 0.04, 0.3), delay=5e-4),
    "a lag and no mode": modelled(Delay(2e-3), Lag(4e-3)),
    "nothing": BARE,
}


@pytest.fixture(scope="module")
def designs() -> dict[str, Design]:
    return {name: design(model, RATE) for name, model in STAGES.items()}


def oracle(model: AxisModel, found: Design) -> tuple[float, float]:
    """Return modulus margin and bandwidth (Hz) by python-control."""
    plant, period, gains = found.plant, found.period, found.gains
    assert plant.dynamics.b.size == Plant.of(model).dynamics.b.size and plant.slope <= Plant.of(model).slope
    a, b, c, d = plant.dynamics
    omega = np.unique(np.concatenate([
        np.geomspace(0.1, pi / period * 0.9999, 20_000),
        *(w * np.linspace(0.95, 1.05, 2001) for w in np.abs(np.linalg.eigvals(a))),
    ]))  # fmt: skip
    omega = omega[omega < pi / period]
    z = np.exp(1j * omega * period)
    # A delay of a whole number of periods, after a zero-order hold.
    whole = round(plant.delay / period)
    assert whole * period == pytest.approx(plant.delay)
    stage = control.ss(a, b[:, None], c[None, :], [[d]]) if b.size else control.ss([], [], [], [[1.0]])
    held = control.sample_system(stage, period, method="zoh")(z) if b.size else np.ones(z.shape)
    back = plant.slope * held * z ** (-whole - 1.0)
    back = back * (gains.proportional + gains.integral * period * z / (z - 1.0))
    for notch in gains.notches:
        w = 2.0 * pi * notch.frequency
        book = control.tf([1.0, 2.0 * notch.damping * w, w * w], [1.0, 2.0 * notch.width * w, w * w])
        back = back * control.sample_system(book, period, method="bilinear", prewarp_frequency=w)(z)
    if gains.measurement_filter:
        kept = np.exp(-period / gains.measurement_filter)
        back = back * (1.0 - kept) * z / (z - kept)
    sensitivity = np.abs(1.0 / (1.0 + back))
    _, _, modulus, *_ = control.stability_margins(control.FRD(back, omega, smooth=True))
    return float(min(modulus, 1.0 / sensitivity.max())), float(omega[np.argmax(sensitivity >= 0.5**0.5)] / (2.0 * pi))


@pytest.mark.parametrize("name", STAGES)
def test_margin_and_bandwidth_are_those_of_python_control(designs, name):
    found = designs[name]
    modulus, bandwidth = oracle(STAGES[name], found)
    # The promised margin is that of the worst corner, the bandwidth that of the model.
    assert 0.495 <= found.margin <= modulus + 0.005
    assert found.bandwidth == pytest.approx(bandwidth, rel=0.01)


@pytest.mark.parametrize("name", ["a light mode", "two modes"])
def test_detuned_modes_keep_the_margin(designs, name):
    gains, delay = designs[name].gains, STAGES[name].effects[0].seconds
    modes = STAGES[name].effects[1].modes
    largest = min(BARE.mean_slope, Plant.of(BARE).slope)
    assert designs[name].plant.slope < largest
    for scale in np.linspace(1.0 - DETUNING, 1.0 + DETUNING, 21):
        for later in (0.0, MESSAGES):
            steep = Plant.of(
                rung(*((m.frequency, m.damping, m.gain) for m in modes), delay=delay + later, scale=float(scale))
            )
            for plant, least in ((steep, LEAST_MARGIN), (replace(steep, slope=largest), 0.5)):
                margins = DiscreteLoop(plant, gains, 1.0 / RATE).margins
                assert margins.stable and margins.modulus >= 0.96 * least, (scale, later)
    assert refusal(STAGES[name], gains, 1.0 / RATE) == ""


@pytest.mark.parametrize("name", STAGES)
def test_further_below_the_bandwidth_errors_are_as_small_as_with_an_integrator(designs, name):
    found = designs[name]
    loop = DiscreteLoop(found.plant, found.gains, found.period)
    for level in (0.5, 0.1):
        there = 2.0 * pi * found.bandwidth / (level**-2 - 1.0) ** 0.5 * np.linspace(0.3, 0.9, 10)
        assert np.all(np.abs(1.0 / (1.0 + loop.response(there))) < level)


def test_a_lag_that_is_a_delay_and_modes_that_are_none_leave_the_loop_stable():
    """As a diagnosis has found them; below the highest mode both stages are alike, above it this one moves more."""
    modes = Mode(78.8, 0.3, 0.945), Mode(48.6, 0.457, 0.0095), Mode(35.0, 0.5, 0.0455)
    told = modelled(Lag(8.5e-4), Resonance(modes))
    found = design(told, 1682.0)
    for scale in (0.9, 1.0, 1.1):
        stage = Plant.of(rung((78.4, 0.3146, 1.0), delay=8.1e-4, scale=scale))
        margins = DiscreteLoop(stage, found.gains, found.period).margins
        assert margins.enough, (scale, margins)
    assert found.bandwidth > 15.0


@pytest.mark.parametrize("twice", [1.0, pytest.param(2.0, marks=pytest.mark.long)])
def test_a_measured_response_with_more_slope_than_that_of_the_model_counts_with_it(twice):
    model, omega = STAGES["a light mode"], 2.0 * pi * np.linspace(2.0, 300.0, 100)
    slope = design(model, RATE).plant.slope
    measured = twice * Plant.of(model).response(omega) * slope / Plant.of(model).slope
    found = design(model, RATE, measured=(omega, measured / Plant.of(model).response(omega)))
    # As large motions have more slope than small ones, so much more is kept in reserve.
    stage = replace(Plant.of(model), slope=twice * min(BARE.mean_slope, Plant.of(BARE).slope))
    assert DiscreteLoop(stage, found.gains, found.period).margins.modulus > 0.49


def test_dynamics_that_were_measured_only_have_a_bandwidth_however_low():
    stage, omega = rung((195.0, 0.24, 1.0), delay=1.7e-3), 2.0 * pi * np.linspace(1.7, 280.0, 60)
    found = design(BARE, 4281.0, measured=(omega, Plant.of(stage).response(omega) / Plant.of(BARE).response(omega)))
    slope = min(BARE.mean_slope, Plant.of(BARE).slope)
    margins = DiscreteLoop(replace(Plant.of(stage), slope=slope), found.gains, found.period).margins
    assert margins.modulus > 0.49
    assert found.bandwidth == pytest.approx(oracle(BARE, found)[1], rel=0.01) and found.bandwidth > 0.5


@pytest.mark.parametrize("name", STAGES)
def test_a_step_settles_as_told_and_without_an_error_that_stays(designs, name):
    found = designs[name]
    t, error = found.step()
    settled = found.settling(0.01)
    assert 0.0 < settled < 5.0 / found.bandwidth
    assert error[0] == 1.0 and np.all(np.abs(error[t >= settled]) <= 0.01)
    assert abs(error[-1]) < 1e-3 and found.settling(1.5 * np.abs(error).max()) == 0.0


def test_a_notch_allows_many_times_the_bandwidth_of_an_integral_gain_with_a_margin_of_its_own():
    """Issue of the design: 120 Hz, damping 0.02; two fifths of the damping in rad/s is the rule without a notch."""
    found = design(rung((120.0, 0.02, 1.0)), 5000.0)
    rule = PidGains(0.0, 2.0 * 0.02 * 2.0 * pi * 120.0 / 5.0 / found.plant.slope)
    _, before = oracle(rung((120.0, 0.02, 1.0)), replace(found, gains=rule))
    assert found.bandwidth > 12.0 * before


def test_what_limits_is_told(designs):
    assert designs["a light mode"].limit == "mode" and designs["a light mode"].limits["mode"] > 20.0
    assert design(rung((800.0, 0.3, 1.0), delay=5e-3), 10_000.0).limit == "delay"
    assert design(rung((120.0, 0.5, 1.0), delay=1e-4), 500.0).limit == "rate"
    assert list(designs["nothing"].limits) == ["rate"]


def test_noise_of_the_stage_is_that_of_the_loop_over_time(designs):
    """A first-order loop: the variance of ``x' = x - k (x + n)`` a period later, against a simulation of many steps."""
    found = designs["nothing"]
    rng = np.random.default_rng(2)
    gains, slope, period = found.gains, found.plant.slope, found.period
    kept = np.exp(-period / gains.measurement_filter) if gains.measurement_filter else 0.0
    x = v = following = filtered = integral = 0.0
    moved = []
    for noise in rng.normal(size=100_000):
        v, following = following, 0.0
        x = slope * v
        filtered += (1.0 - kept) * (-(x + noise) - filtered)
        integral += gains.integral * period * filtered
        following = gains.proportional * filtered + integral
        moved.append(x)
    assert found.noise == pytest.approx(BARE.quality.floor_rms * np.std(moved), rel=0.05)


@pytest.mark.parametrize(
    ("model", "rate", "margin", "error", "named"),
    [
        (rung((600.0, 0.02, 1.0)), 1000.0, 0.5, UsageError, "600 Hz"),
        (rung((100.0, 0.02, 1.0)), 0.0, 0.5, UsageError, "rate of 0 Hz"),
        (rung((100.0, 0.02, 1.0)), float("nan"), 0.5, UsageError, "rate of nan"),
        (rung((100.0, 0.02, 1.0)), 1e5, 0.5, UsageError, "100000 Hz"),
        (rung((100.0, 0.02, 1.0)), 1000.0, 0.99, UsageError, "0.99"),
        (rung((100.0, 0.02, 1.0)), 1000.0, 0.1, UsageError, "0.1"),
    ],
)
def test_what_cannot_be_designed_is_refused_in_one_line(model, rate, margin, error, named):
    with pytest.raises(error) as caught:
        design(model, rate, margin)
    assert named in str(caught.value) and "\n" not in str(caught.value)


def test_a_model_without_a_slope_is_refused(monkeypatch):
    monkeypatch.setattr(Plant, "of", classmethod(lambda cls, model: cls(0.0)))
    with pytest.raises(ModelError) as caught:
        design(BARE, RATE)
    assert "slope" in str(caught.value)


def test_gains_come_back_from_their_file(tmp_path):
    gains = {
        "x": PidGains(1.25e6, 3e8, 0.0, 0.0, 1e-4, (Notch(120.5, 0.02, 1.5), Notch(310.0, 0.1, 0.5))),
        "y": PidGains(0.0, 1e7),
    }
    for tuned in (TunedGains(2500.0, gains), TunedGains(1000.0, {"y": gains["x"]}), TunedGains(1e4, {"x": gains["y"]})):
        path = str(tmp_path / "gains.yaml")
        tuned.write(path, " of a stage")
        assert TunedGains.read(path) == tuned


# Eight lists of nine of the list before: 43 million numbers.
BOMB = "/**:\n  ros__parameters:\n    output_rate: 1000.0\n    a: &a 1.0\n"
for before, name in zip("abcdefgh", "bcdefghi", strict=True):
    BOMB += f"    {name}: &{name} [{', '.join(['*' + before] * 9)}]\n"
BOMB += "    ki: *i\n"


@pytest.mark.parametrize(
    "text",
    [
        "", "- 1", "a: b", "/**:\n  ros__parameters:\n    ki: 1.0\n", "\x00", "{",
        "/**:\n  ros__parameters:\n    output_rate: fast\n", "/**:\n  ros__parameters:\n    output_rate: -1.0\n",
        "/**:\n  ros__parameters:\n    output_rate: 100.0\n    ki: -1.0\n",
        "/**:\n  ros__parameters:\n    output_rate: 100.0\n    notch_frequency.x: [60.0]\n",
        "/**:\n  ros__parameters:\n    output_rate: 999.0\n    notch_frequency.x: [6.0]\n    notch_width.x: [1, 2]\n",
        "/**:\n  ros__parameters:\n    output_rate: 1000.0\n    ki: [1.0, 2.0]\n",
        "/**:\n  ros__parameters:\n    output_rate: 1000.0\n    5: 1.0\n",
        f"/**:\n  ros__parameters:\n    output_rate: 1000.0\n    ki: 1{'0' * 400}\n",
        f"/**:\n  ros__parameters:\n    output_rate: 1000.0\n    ki: {'9' * 6000}\n",
        f"/**:\n  ros__parameters:\n    output_rate: 1000.0\n    ki: {'[' * 1000}{']' * 1000}\n",
        BOMB,
    ],
)  # fmt: skip
def test_a_file_without_gains_is_named_in_one_line(tmp_path, text):
    path = tmp_path / "gains.yaml"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        TunedGains.read(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 1000
    with pytest.raises(UsageError):
        TunedGains.read(str(tmp_path / "none.yaml"))
