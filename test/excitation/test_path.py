"""The drive that covers a path."""

from dataclasses import replace

import numpy as np
import pytest
from calibration.stages import stage_of
from hypothesis import assume, given
from hypothesis import strategies as st

from slpi_ros.arrays.rates import fastest
from slpi_ros.excitation.drives import Drive, excite
from slpi_ros.excitation.path import with_path
from slpi_ros.hysteresis.reversals import reversals
from slpi_ros.identification.fit import identify
from slpi_ros.io.record import Record
from slpi_ros.model.stage_model import StageModel
from slpi_ros.simulation.character import Character

RATE = 100.0


@st.composite
def voltage_paths(draw: st.DrawFn) -> np.ndarray:
    """Draw a path through some levels, V, each reached in some samples."""
    levels = draw(st.lists(st.floats(0.0, 100.0), min_size=2, max_size=12))
    steps = draw(st.lists(st.integers(1, 40), min_size=len(levels) - 1, max_size=len(levels) - 1))
    return np.interp(np.arange(sum(steps) + 1), np.cumsum([0, *steps]), levels)


def covered(v: np.ndarray, drive: np.ndarray) -> bool:
    """Return whether the drive holds the path sample by sample."""
    windows = np.lib.stride_tricks.sliding_window_view(drive, v.size)
    return bool((np.abs(windows - v).max(axis=1) < 1e-9).any())


@given(voltage_paths(), st.sampled_from([0.0, 0.5]), st.integers(0, 5))
def test_range_rates_and_turns_of_a_path_are_in_its_drive(v, rest, seed):
    base = excite(voltage_min=0.0, voltage_max=100.0, start=100.0 * rest, duration=10.0, rate=RATE, seed=seed)
    drive = with_path(base, {"x": v})
    whole = drive.voltage["x"]
    own = whole[base.t.size :]
    assert covered(v, own)
    assert own.min() <= v.min() and own.max() >= v.max()
    assert whole[0] == whole[-1] == 100.0 * rest and np.allclose(np.diff(drive.t), 1 / RATE)
    assume(np.ptp(v) > 1.0)
    # The way of the path is a part of the drive, and so are its turns, at the rate of the path and at a slower one.
    assert np.max(np.abs(np.diff(own))) >= np.max(np.abs(np.diff(v)))
    turns = v[reversals(v, 0.5)]
    found = own[reversals(own, 0.5)]
    assert all(np.abs(found - turn).min() < 0.5 for turn in turns[1:-1])


@given(voltage_paths(), st.floats(20.0, 500.0))
def test_the_limits_hold_for_the_path_too(v, slew):
    base = excite(voltage_min=20.0, voltage_max=80.0, slew_limit=slew, duration=60.0, rate=RATE)
    voltage = with_path(base, {"x": v}).voltage["x"]
    assert voltage.min() >= 20.0 and voltage.max() <= 80.0
    assert np.abs(np.diff(voltage)).max() * (RATE / slew) <= 1.0 + 1e-9


def test_the_rate_of_a_fast_path_is_in_its_drive():
    t = np.arange(500) / RATE
    v = 50.0 + 20.0 * np.sin(2 * np.pi * 12.0 * t)
    base = excite(voltage_min=0.0, voltage_max=100.0, duration=20.0, rate=RATE)
    drive = with_path(base, {"x": v})
    beyond = np.abs(np.diff(drive.voltage["x"])) * RATE > 0.9 * fastest(t, v)
    assert np.count_nonzero(beyond) >= 200 and np.abs(np.diff(base.voltage["x"])).max() * RATE < fastest(t, v)


def test_axes_move_one_after_the_other():
    base = excite(("x", "y"), voltage_min=0.0, voltage_max=100.0, duration=40.0, rate=RATE)
    v = 50.0 + 10.0 * np.sin(np.arange(300) / 10.0)
    drive = with_path(base, {"x": v, "y": v + 1.0})
    x, y = (np.abs(np.diff(drive.voltage[axis])) > 0.0 for axis in ("x", "y"))
    assert not (x & y).any() and covered(v, drive.voltage["x"]) and covered(v + 1.0, drive.voltage["y"])
    alone = with_path(base, {"y": v})
    assert (alone.voltage["x"][base.t.size :] == base.voltage["x"][-1]).all() and alone.axes == ("x", "y")
    assert drive.specs["x"].duration == pytest.approx(drive.t[-1])


def test_a_model_of_such_a_record_follows_the_path_better():
    def recorded(drive: Drive) -> Record:
        """Record a stage whose loops widen with the rate, the same one each time."""
        stage = stage_of(Character(rate_dependence=2.0))
        t, v = (1000.0 + drive.t).tolist(), drive.voltage["x"]
        y = np.array([stage.measure(stage.step(at, [each]))[0] for at, each in zip(t, v.tolist(), strict=True)])
        return Record(np.rint(drive.t * 1e9).astype(np.int64), {"x": v}, {"x": y})

    rate = 200.0
    limits = {"voltage_min": 0.0, "voltage_max": 100.0, "rate": rate}
    base = excite(duration=30.0, seed=1, **limits)
    first = identify(recorded(base))
    t = np.arange(0.0, 6.0, 1 / rate)
    y = 10e-6 + 1.5e-6 * np.sin(2 * np.pi * 8.0 * t) * np.minimum(t, 1.0)
    better = identify(recorded(with_path(base, {"x": first.compensate(t, y)})))

    def error(model: StageModel) -> float:
        """Return the rms error (m) along the path, after a sweep and a way to its begin."""
        sweep = excite(duration=4.0, drive="sweep", **limits).voltage["x"]
        step = model.stream("x", start_memory="wiped")
        for v in sweep.tolist():
            step.drive(v, 1 / rate)
        way = np.concatenate([np.linspace(step.uncoupled_displacement, y[0], 200), y])
        v = np.concatenate([sweep, [step(k / rate, each) for k, each in enumerate(way.tolist())]])
        path = recorded(replace(base, t=np.arange(v.size) / rate, voltage={"x": v})).displacement["x"][-y.size :]
        return float(np.sqrt(np.mean((path - y) ** 2)))

    assert error(better) < 0.6 * error(first)
