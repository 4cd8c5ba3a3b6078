from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slpi_ros.compensator.feedback import PidGains
from slpi_ros.papers import mpi_study as published
from slpi_ros.papers.compound import RATE, WARM_UP, Outcome, follow, path, present, run_study, tune
from slpi_ros.papers.mpi_study import FAMILY, SMPI
from slpi_ros.simulation.character import Character
from slpi_ros.simulation.stage import p11_stage

GAIN = 0.7e-6


class Line:
    """A stage that follows its voltage at once; after the warm-up its displacement is off."""

    def __init__(self, offset=0.0, disturbance=0.0):
        self.offset, self.disturbance, self.times = offset, disturbance, []

    def rest(self):
        self.times = []

    def run(self, t, v):
        self.times += t.tolist()
        return self.offset + GAIN * v, self.offset + GAIN * v

    def step(self, t, v):
        self.times.append(t)
        return self.offset + self.disturbance + GAIN * v

    def measure(self, y):
        return y


@pytest.fixture(scope="module")
def studies():
    return {"x": run_study(p11_stage().axes["x"], "x", path_cycles=1)}


def test_table_6_is_that_of_the_text():
    # The columns run into each other.
    assert "".join(str(peak) for peak, _ in published.TABLE_6) == "60801008080"
    assert "".join(str(frequency) for _, frequency in published.TABLE_6) == "11123"


def test_the_path_turns_at_the_peaks_and_at_zero():
    y = path([(60e-6, 1.0), (80e-6, 3.0)], 2)
    turns = 1 + np.flatnonzero(np.diff(np.sign(np.diff(y))))
    np.testing.assert_allclose(y[turns], [60e-6, 0, 60e-6, 0, 80e-6, 0, 80e-6], atol=1e-20)
    np.testing.assert_allclose(np.diff(turns) / RATE, [0.5, 0.5, 0.5, 1 / 6, 1 / 6, 1 / 6], atol=1 / RATE)
    assert y[0] == y[-1] == 0


@given(
    frequency=st.floats(50, 2000),
    damping=st.floats(0.005, 0.3),
    gain=st.floats(1e-8, 1e-5),
    delay=st.floats(0, 2e-3),
)
def test_the_loop_gain_stays_below_one_around_the_mode_whatever_the_delay(frequency, damping, gain, delay):
    gains = tune(Character(resonance=frequency, damping=damping), gain)
    s = 2j * np.pi * np.linspace(0.7, 5, 2000) * frequency
    omega = 2 * np.pi * frequency
    stage = gain * omega**2 / (s**2 + 2 * damping * omega * s + omega**2) * np.exp(-s * delay)
    loop = np.abs((gains.proportional + gains.integral / s) * stage)
    assert loop.max() < 0.5
    at_mode = np.argmin(np.abs(s.imag - omega))
    assert loop[at_mode] == pytest.approx(np.hypot(1 / 3, 1 / 10), rel=0.02)


def test_a_perfect_feedforward_meets_every_sample():
    desired = path([(40e-6, 2.0)], 2)
    stage = Line(offset=3e-6)
    outcome = follow(stage, desired, desired / GAIN, None, 100.0)
    np.testing.assert_allclose(outcome.measured, desired, atol=1e-18)
    np.testing.assert_allclose(outcome.displacement, desired, atol=1e-18)
    np.testing.assert_allclose(np.diff(stage.times), 1 / RATE)


def test_feedback_takes_away_what_feedforward_cannot_know():
    desired = path([(40e-6, 1.0)], 1)
    gains = PidGains(0.0, 50.0 / GAIN)
    alone = follow(Line(disturbance=1e-6), desired, desired / GAIN, None, 100.0)
    with_pid = follow(Line(disturbance=1e-6), desired, desired / GAIN, gains, 100.0)
    np.testing.assert_allclose(alone.measured[1:] - desired[1:], 1e-6, rtol=1e-9)
    assert alone.scatter < 0.05e-6 < 0.95e-6 < alone.offset
    assert np.abs(with_pid.measured - desired)[round(0.3 * RATE) :].max() < 1e-9


def test_a_rest_comes_before_the_zero():
    desired = path([(40e-6, 2.0)], 1)
    stage = Line()
    follow(stage, desired, desired / GAIN, None, 100.0, rest=1.5)
    assert stage.times[-desired.size] == pytest.approx(WARM_UP + 1.5 + 1 / RATE)


def test_figures_of_an_outcome():
    desired = path([(10e-6, 1.0), (20e-6, 1.0)], 2)
    outcome = Outcome(desired, 1.1 * desired + 1e-6, desired)
    np.testing.assert_allclose(outcome.peaks, [12e-6, 12e-6, 23e-6, 23e-6])
    assert outcome.by_truth.maximum == 0
    assert outcome.by_sensor.maximum == pytest.approx(3e-6)
    assert outcome.offset == pytest.approx(1e-6 + 0.1 * desired.mean())
    assert outcome.within(2e-6) == pytest.approx(0.75, abs=0.01)


def test_targets_are_met(studies):
    compound = studies["x"].compound
    peaks = np.array([peak for peak, _ in published.TABLE_6])
    for label in (SMPI, FAMILY):
        outcome = compound[label, True]
        assert outcome.by_sensor.mean * 1e6 <= published.COMPOUND_MEAN
        assert outcome.by_truth.mean * 1e6 <= published.COMPOUND_MEAN
        assert np.all(np.abs(outcome.peaks * 1e6 - peaks) <= published.COMPOUND_BAND)
        assert outcome.by_sensor.mean < 0.2 * compound["", True].by_sensor.mean
        assert outcome.by_sensor.mean < 0.2 * compound[label, False].by_sensor.mean
    assert compound[FAMILY, True].by_sensor.mean < compound[SMPI, True].by_sensor.mean


def test_the_family_scatters_less_as_feedforward(studies):
    for outcomes in (studies["x"].feedforward, {k: o for (k, fed), o in studies["x"].compound.items() if not fed}):
        assert outcomes[FAMILY].scatter < 0.7 * outcomes[SMPI].scatter


def test_every_exhibit_is_complete(studies):
    shown = present(studies)
    assert [exhibit.title.split(":")[0] for exhibit in shown] == ["Fig. 11", "Fig. 12", "Fig. 13 and 14, Table 6"]
    for exhibit in shown:
        assert exhibit.paper and exhibit.ours and exhibit.remark and exhibit.pictures
        for table in exhibit.tables:
            assert table.rows and all(len(row) == len(table.header) for row in table.rows)
        assert "nan" not in f"{exhibit.ours}{exhibit.remark}{exhibit.tables}"


def test_exhibits_show_what_was_computed(studies):
    shown = present(studies)[-1]
    outcome = studies["x"].compound[SMPI, True]
    assert f"{outcome.by_sensor.mean * 1e6:.4f} µm on the worse axis, not above the paper's" in shown.ours
    assert "all segments are met" in shown.ours and "NOT" not in shown.ours
    column = [row[3] for row in shown.tables[0].rows]
    assert column == [f"{peak * 1e6:.2f}" for peak in outcome.peaks]


def test_a_missed_target_is_said(studies):
    study, way = studies["x"], (SMPI, True)
    poor = replace(study.compound[way], measured=study.compound[way].measured + 1e-6)
    shown = present({"x": replace(study, compound={**study.compound, way: poor})})[-1]
    assert "ABOVE" in shown.ours
    assert "NOT all segments" in shown.ours
