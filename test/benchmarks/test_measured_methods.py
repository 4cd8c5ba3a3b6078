"""Every method of the measured records reproduces a system of its own class, and the scores count what they should."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import slpi_ros
from benchmarks.measured import bench, scores, twins
from benchmarks.measured.manifest import Span, Task, read_manifest
from benchmarks.measured.methods import METHODS, Invertible, Series, chosen_history, operators, possible_histories
from benchmarks.measured.methods.base import Prepared, Scale, delayed, invert_by_iteration, remembered
from benchmarks.measured.methods.gru import GruMethod, forward, gradient
from benchmarks.measured.methods.linear import Creep, Plays, Preisach, RatePlays
from benchmarks.measured.methods.nonlinear import BoucWen, EnvelopePlays
from slpi_ros.errors import IdentificationError
from slpi_ros.identification.free_run import ways_to

NAMES = [method.name for method in METHODS]
RADII = np.arange(30) / 30
# Largest error, % of range, where it is not 0.15: unseen turning points, and a training that is cut short.
LARGEST = {"GRU": 3.0, "Preisach": 0.5, "SLPI": 0.5, "SLPI, causes": 0.5}
# Sampling period (s), number of samples, and the sample from which on is judged.
PERIOD, COUNT, JUDGED = 0.01, 3000, 1800


@cache
def drive():
    """Return times (s), voltages (V) and the same as -1..1: triangles of falling amplitude, slow and fast, twice."""
    turns, seconds = [0.0], []
    for amplitude in (5.0, 4.0, 3.0, 2.0, 5.0, 4.5, 3.5, 2.5, 5.0, 3.8, 2.8, 1.5, 5.0):
        turns += [5.0 + amplitude, 5.0 - amplitude]
        seconds += [1.5 if len(seconds) % 4 else 0.6, 1.0 if len(seconds) % 3 else 0.5]
    times = np.concatenate([[0.0], np.cumsum(seconds)])
    t = PERIOD * np.arange(COUNT)
    v = np.interp(t, times * t[-1] / times[-1], turns)
    return t, v, v / 5.0 - 1.0


def columns(features, u=None):
    t, _, own = drive()
    return features.columns(Prepared(t, own, 0), own if u is None else u, np.arange(COUNT))


def system(name):
    """Return displacements of the class of a method, (N,)."""
    t, _, u = drive()
    falling = np.exp(-np.arange(30) / 8.0)
    pi = columns(Plays()) @ falling
    match name:
        case "line":
            return 2.0 * u + 1.0
        case "PI":
            return pi
        case "PI, lag":
            return columns(Plays(), delayed(Prepared(t, u, 0), 0.0, 0.03)) @ falling
        case "modified PI":
            return pi + 0.3 * np.maximum(pi - 1.0, 0.0)
        case "generalised PI":
            shape = columns(EnvelopePlays((1.0, 0.2, 0.5, 1.0, -0.1, 0.5)))
            return shape @ np.append(0.5, np.exp(-np.arange(25) / 5.0))
        case "rate-dep. PI":
            return columns(RatePlays(0.02)) @ falling
        case "PI, creep":
            return columns(Creep()) @ np.concatenate([falling[:25], np.full(9, 0.05)])
        case "Bouc-Wen":
            return columns(BoucWen((0.7, 0.3, 0.2))) @ np.array([2.0, 0.3, 0.1, -1.0])
        case "NARX":
            powers = np.array([[1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0]])
            return operators.polynomial_run(u, powers, np.array([0.9, 0.1, 0.5]), 0.0)
        case "GRU":
            return np.tanh(u)
    return columns(Preisach(6, 12)) @ np.linspace(0.5, 2.0, 22)


# They take from ten seconds to a minute.
SLOW = ("Preisach", "modified PI", "SLPI, causes")
CASES = [pytest.param(name, marks=pytest.mark.long) if name in SLOW else name for name in NAMES]


@pytest.mark.parametrize("name", CASES)
def test_own_class(name):
    t, v, _ = drive()
    y = 10.0 * system(name) + 3.0
    # Digits of a sensor: without any noise at all a diagnosis has nothing to compare with.
    y += 1e-4 * np.ptp(y) * np.random.default_rng(0).standard_normal(y.size)
    method = GruMethod(steps=300, seeds=(0,)) if name == "GRU" else METHODS[NAMES.index(name)]
    fitted = np.arange(COUNT) < JUDGED
    record = Series("record", t, v, np.where(fitted, y, np.nan), fitted)
    model = method.fit([record])
    histories = possible_histories([record], v[0])
    runs = [model.simulate("record", t, v, history) for history in histories]
    errors = [100.0 * np.std((run - y)[JUDGED:]) / np.ptp(y) for run in runs]
    assert min(errors) < LARGEST.get(name, 0.15)
    # Networks and polynomials of past outputs have no inverse.
    assert isinstance(model, Invertible) == (name not in ("NARX", "GRU"))
    if isinstance(model, Invertible):
        clean = 10.0 * system(name) + 3.0
        found = [model.invert("record", t, clean, history) for history in histories]
        assert min(np.std((own - v)[JUDGED:]) for own in found) < (0.02 if name in LARGEST else 0.01) * np.ptp(v)


def test_an_inverse_that_does_not_converge_is_none():
    class Falling:
        def simulate(self, name, t, v, history):
            return -v

    t, v, _ = drive()
    scale = Scale(5.0, 5.0, 0.0, 10.0)
    with pytest.raises(ValueError, match="converge"):
        invert_by_iteration(Falling(), scale, "record", t, v, ())


def test_the_history_is_chosen_on_what_is_not_judged():
    t, v, _ = drive()
    fitted = np.arange(COUNT) < JUDGED
    record = Series("a", t, v, v, fitted)
    chooses, judged = scores.split(replace(record, fitted=~fitted), [record])
    assert np.array_equal(chooses, fitted)
    assert np.array_equal(judged, ~fitted)
    # A hold of half of the record says nothing of the history.
    held = replace(record, name="b", v=np.where(np.arange(COUNT) < JUDGED // 2, v[JUDGED // 2], v))
    chooses, judged = scores.split(held, [record])
    way = [np.sum(np.abs(np.diff(held.v[:JUDGED][part[:JUDGED]]))) for part in (chooses, judged)]
    assert chooses[: JUDGED // 2].all()
    assert way[0] / sum(way) == pytest.approx(0.1, abs=0.01)
    assert np.array_equal(chooses | judged, fitted)
    assert not (chooses & judged).any()


def test_without_a_diagnosis_slpi_stays_as_it_is(monkeypatch):
    def refuse(*_, **__):
        raise IdentificationError("too little data")

    t, v, _ = drive()
    monkeypatch.setattr(slpi_ros, "diagnose", refuse)
    model = METHODS[NAMES.index("SLPI, causes")].fit(
        [Series("record", t[:600], v[:600], system("SLPI")[:600], np.ones(600, dtype=bool))]
    )
    assert "too little data" in model.said
    assert np.isfinite(model.simulate("other", t, v, (10.0, 0.0))).all()


def test_histories_change_what_follows():
    t, v, _ = drive()
    model = METHODS[NAMES.index("PI")].fit([Series("record", t, v, 10.0 * system("PI"), np.ones(COUNT, dtype=bool))])
    short = slice(200, 260)
    low, high = (model.simulate("new", t[short], v[short], history) for history in ((10.0, 0.0), (0.0, 10.0)))
    assert np.ptp(low - high) > 0.01


def test_gradient_of_the_network():
    rng = np.random.default_rng(1)
    x, target, weight = rng.standard_normal((12, 3)), rng.standard_normal(12), np.ones(12)
    size = 4
    w, r, out = rng.standard_normal((3, size, 3)), rng.standard_normal((3, size, size)), rng.standard_normal(size + 1)
    h = rng.standard_normal(size)
    found = [np.zeros_like(w), np.zeros_like(r), np.zeros_like(out)]
    gradient(x, target, weight, w, r, out, h, *found)

    def loss():
        return 0.5 * float(np.sum((forward(x, w, r, out, h)[0] - target) ** 2))

    for parameter, slope in zip((w, r, out), found, strict=True):
        for at in np.ndindex(parameter.shape):
            kept = parameter[at]
            parameter[at] = kept + 1e-6
            above = loss()
            parameter[at] = kept - 1e-6
            below = loss()
            parameter[at] = kept
            assert slope[at] == pytest.approx((above - below) / 2e-6, rel=1e-4, abs=1e-6)


def test_relays_close_their_loops():
    t, v, u = drive()
    y = columns(Preisach(6, 12)) @ np.ones(22)
    tops = np.flatnonzero(u > 0.999)
    assert np.ptp(y[tops]) < 0.01 * np.ptp(y)


def test_an_interval_holds_the_error():
    error = np.random.default_rng(0).standard_normal(5000)
    low, high = scores.interval(scores.mean_squares(error))
    assert low < 1.0 < high
    assert high - low < 0.1
    # The ratio to an error on the same samples is better known than either.
    low, high = scores.interval(scores.mean_squares(1.1 * error), scores.mean_squares(error))
    assert low == pytest.approx(1.1) == high


def test_marks():
    row = {
        "a": {"rms": 2.0, "blocks": [0.5, *[4.2] * (scores.BLOCKS - 1)]},
        "b": {"rms": 1.6, "blocks": [30.0, *[1.1] * (scores.BLOCKS - 1)]},
        "c": {"rms": 3.0, "blocks": [9.0] * scores.BLOCKS},
        "d": {"refused": "too short"},
    }
    assert bench.marks(row) == {"a": "=", "b": "*", "c": ""}


def test_what_is_judged_is_not_given(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time_s,voltage_V,displacement_um\n" + "".join(f"{0.1 * k:.1f},{k % 7},{k % 5}\n" for k in range(40))
    )
    task = Task("task", "x", (Span("a", 0.0, 2.0),), (Span("a", 2.0),))
    (one,) = scores.fitted_series(scores.Tables(tmp_path), task)
    assert np.isnan(one.y[one.t >= 2.0]).all()
    assert np.isfinite(one.y[one.t < 2.0]).all()


def test_a_record_at_an_end_comes_from_the_other_one():
    t, v, _ = drive()
    records = [Series("a", t, v, v, np.ones(COUNT, dtype=bool))]
    low, high = float(v.min()), float(v.max())

    def chosen(at, best, ratio, *, rested=False):
        errors = [1.0 if history == best else ratio for history in possible_histories(records, at)]
        return chosen_history(records, at, errors, rested=rested)

    middle = (low + high) / 2.0
    assert chosen(low, (), 1.05) == (high, low)
    assert chosen(high, (), 1.05) == (low, high)
    assert chosen(low, (), 1.05, rested=True) == ()
    assert chosen(low, (), 1.2) == ()
    assert chosen(middle, (), 1.05) == ()
    # The ways to a state are those of the package.
    assert possible_histories(records, middle)[:-2] == ways_to(low, high, middle)


def test_what_is_remembered():
    v = np.array([0.0, 5.0, -5.0, 3.0, 1.0, 2.0, -1.0, 2.5, 0.0, 1.0])
    assert remembered(v) == (5.0, -5.0, 3.0, -1.0, 2.5, 0.0, 1.0)
    assert remembered(-v) == tuple(-x for x in remembered(v))


@pytest.mark.parametrize("name", CASES[:-1])
def test_no_method_loses_to_a_line_on_its_own_data(measured_data, name):
    task = next(task for task in read_manifest().tasks if task.name == "afm_double_sine")
    tables = scores.Tables(measured_data)
    line, own = (
        next(iter(scores.score(tables, task, method).values()))
        for method in (METHODS[0], GruMethod(steps=300, seeds=(0,)) if name == "GRU" else METHODS[NAMES.index(name)])
    )
    assert own.fitted <= line.fitted * 1.001


@pytest.mark.parametrize("name", ["PI, lag", "generalised PI", "Bouc-Wen", "NARX"])
def test_a_method_and_its_twin(measured_data, name):
    task = next(task for task in read_manifest().tasks if task.name == "afm_double_sine")
    (found,) = twins.twin(measured_data, task, METHODS[NAMES.index(name)])
    assert found[2] == pytest.approx(found[3], rel=twins.AGREES)


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["line", "PI", "modified PI", "rate-dep. PI", "PI, creep", "Preisach", "GRU", "SLPI", "SLPI, causes"]
)
def test_another_method_and_its_twin(measured_data, name):
    test_a_method_and_its_twin(measured_data, name)
