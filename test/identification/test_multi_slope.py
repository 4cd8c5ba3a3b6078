"""Identification of MPI and SMPI: the basis is the engine's, weights and peaks are found again, ``X_p = a f^b``."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identification.records import record_of

from slpi_ros.errors import IdentificationError
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, MultiSlope, thresholds_for
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.design_matrix import Design, Walk
from slpi_ros.identification.fit import identify
from slpi_ros.identification.published_kinds import (
    MultiSlopeBasis,
    PeakFrequency,
    cycle_peaks,
    fit_peak_frequency,
    peak_line,
)
from slpi_ros.identification.quadratic_program import QuadraticProgram

WEIGHTS = 1e-7 * np.array([5, 0, 1, 2, 0, 0, 1, 0.5, 0, 0, 0, 0.2, 0])
MODEL = MultiSlope(-5.0, 120.0, thresholds_for(120.0), WEIGHTS)
# MPI paper, Table 1: amplitude (V), a (um), b.
TABLE_1 = [(20, 12.306, -0.017), (40, 27.235, -0.018), (60, 43.448, -0.017), (80, 59.669, -0.014),
           (100, 75.08, -0.013), (120, 89.189, -0.012)]  # fmt: skip
FREQUENCIES = np.array([0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0])


def drive(amplitudes, low=-5.0, samples=150):
    """Triangles from the low end up and back, one for each amplitude."""
    corners = [low]
    for amplitude in amplitudes:
        corners += [low + amplitude, low]
    ways = np.arange(len(corners))
    return np.interp(np.linspace(0, ways[-1], samples * ways[-1] + 1), ways, corners)


@pytest.mark.parametrize("primed", [False, True])
@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), corners=st.integers(2, 30), between=st.integers(1, 40))
def test_prediction_is_what_the_engine_simulates(primed, seed, corners, between):
    rng = np.random.default_rng(seed)
    basis = MultiSlopeBasis(-3.0, 12.0, np.array([0.0, 0.7, 1.1, 4.0, 12.0]))
    x = np.append(rng.uniform(0.1, 1.0, basis.size), rng.normal())
    v = np.interp(np.linspace(0, corners - 1, corners * between), np.arange(corners), rng.uniform(-5, 15, corners))
    walk = Walk.along(v, symmetric_rest=basis.symmetric_rest, primed=primed)
    predicted = Design.of(walk, basis.branch_part(walk)).predict(x)
    memory = Memory(basis.shape(x, 1.0), float(v[0]), float(x[-1]), primed=primed)
    np.testing.assert_allclose(predicted, memory.forward_array(v), atol=1e-8)


def fit(basis, v, y, gain):
    walk = Walk.along(v, symmetric_rest=basis.symmetric_rest, primed=False)
    design = Design.of(walk, basis.branch_part(walk))
    matrix, vector = design.normal_equations(y, np.ones(v.size))
    matrix[np.diag_indices_from(matrix)] += 1e-9 * v.size
    constraints, bound = basis.monotone(gain)
    return basis.shape(QuadraticProgram(matrix, constraints, bound).solve(vector).x, gain), design


def test_weights_are_found_again():
    v = drive([120.0, 70.0, 30.0, 100.0, 120.0])
    y = Memory(MODEL, -5.0).forward_array(v) * 1e6
    basis = MultiSlopeBasis.over(-5.0, 115.0)
    found, design = fit(basis, v, y, gain=0.5)
    # The last operator never moves within the range.
    np.testing.assert_allclose(found.weights[:-1], 1e6 * WEIGHTS[:-1], atol=1e-5)
    assert (found.origin, found.amplitude) == (-5.0, 120.0)
    assert found.thresholds.tolist() == MODEL.thresholds.tolist()
    assert basis.covered(design.local) == pytest.approx(12 / 13)


def test_weights_are_never_negative_and_the_first_is_positive():
    """A stage whose gain sinks with the voltage would have negative weights, one that waits no first one."""
    v = drive([120.0])
    waiting = MultiSlope(-5.0, 120.0, thresholds_for(120.0)[1:], 1e6 * WEIGHTS[1:])
    for y in (30.0 * np.sqrt((v + 5.0) / 120.0), Memory(waiting, -5.0).forward_array(v)):
        found, _ = fit(MultiSlopeBasis.over(-5.0, 115.0), v, y, gain=0.25)
        assert found.weights.min() >= 0.0
        assert found.weights[0] >= 0.02 * 0.25 * (1 - 1e-4)


def test_peaks_of_cycles_make_the_line_of_the_amplitude_scaled_model():
    stroke = MODEL.stroke(115.0, -5.0)
    amplitudes, peaks = np.array([20.0, 60.0, 120.0]), stroke * np.array([0.1, 0.4, 1.0])
    model = AmplitudeScaled(MODEL, amplitudes, peaks)
    v = drive([60.0, 20.0, 60.1, 120.0, 59.9, 20.0])
    found_v, found_y = peak_line(v, model.along(-5.0, 3e-6).forward_array(v))
    assert found_v == pytest.approx(amplitudes)
    assert found_y == pytest.approx(peaks, rel=1e-3)


def test_each_cycle_has_its_amplitude_and_its_peak_above_its_start():
    v = np.array([0, 50, 100, 50, 0.5, 20, 40, 20, 0, 0, 80, 0.0])
    y = 1e-7 * np.array([7, 60, 120, 80, 9, 30, 52, 40, 8, 8, 98, 8.0])
    amplitudes, peaks = cycle_peaks(v, y)
    assert amplitudes.tolist() == [100, 40, 80]
    assert peaks == pytest.approx(1e-7 * np.array([113, 43, 90]))


def test_a_start_in_mid_range_missing_samples_and_rests_are_no_cycles():
    v = np.array([60.0, 90, 50, 0, 0.4, 0, 0.2, 0, 50, 100, 50, 0, 0])
    y = 1e-7 * v
    y[[1, 8]] = np.nan
    amplitudes, peaks = cycle_peaks(v, y)
    assert amplitudes.tolist() == [100] and peaks == pytest.approx([1e-5])


def test_a_cycle_whose_peak_or_start_is_not_known_is_left_out():
    v = np.array([0.0, 0.3, 40, 59.8, 60, 40, 0, 50, 100, 50, 0, 80, 0])
    y = 1e-7 * v
    y[[0, 4, 8]] = np.nan
    amplitudes, peaks = cycle_peaks(v, y)
    assert amplitudes.tolist() == [59.8, 80] and peaks == pytest.approx([5.95e-6, 8e-6])
    y[10] = np.nan
    assert cycle_peaks(v, y)[0].tolist() == [59.8]


def test_nearly_equal_amplitudes_are_averaged_and_do_not_chain():
    tops = [100.0, 99.0, 50.0, 98.5, 97.4, 96.0]
    v = np.concatenate([[0.0, top] for top in tops] + [[0.0]])
    voltages, displacements = peak_line(v, 2e-7 * v)
    assert voltages == pytest.approx([50.0, (96.0 + 97.4) / 2, (98.5 + 99 + 100) / 3])
    assert displacements == pytest.approx(2e-7 * voltages)


@pytest.mark.parametrize(
    ("v", "y", "message"),
    [
        ([], [], "no cycle"),
        ([10.0, 50.0], [np.nan, np.nan], "no cycle"),
        ([50.0, 20.0, 0.0], [3.0, 2.0, 0.0], "no cycle"),
        ([0.0, 50.0, 0.0, 100.0, 0.0], [0.0, 2e-6, 0.0, 1e-6, 0.0], "peak displacement 1e-06 m .* 100 V"),
        ([0.0, 50.0, 0.0], [0.0, -1e-6, -2e-6], "peak displacement 0 m .* 50 V"),
    ],
)
def test_records_without_a_line_of_peaks(v, y, message):
    with pytest.raises(IdentificationError, match=message):
        peak_line(np.array(v), np.array(y))


@pytest.mark.parametrize(("amplitude", "a", "b"), TABLE_1)
def test_the_papers_peaks_over_frequency(amplitude, a, b):
    found = fit_peak_frequency(FREQUENCIES, 1e-6 * a * FREQUENCIES**b)
    assert found.a == pytest.approx(1e-6 * a, rel=1e-10)
    assert found.b == pytest.approx(b, rel=1e-8)
    assert found(1.0) == pytest.approx(1e-6 * a, rel=1e-10)
    assert found(FREQUENCIES) == pytest.approx(1e-6 * a * FREQUENCIES**b, rel=1e-10)


def test_peaks_are_fitted_with_the_least_squared_error_in_metres():
    """Not in logarithms: with errors, no other a and b are better."""
    rng = np.random.default_rng(4)
    peak = 80e-6 * FREQUENCIES**-0.3 * rng.uniform(0.8, 1.2, FREQUENCIES.size)

    def error(candidate):
        return np.sum((candidate(FREQUENCIES) - peak) ** 2)

    found = fit_peak_frequency(FREQUENCIES, peak)
    for da, db in rng.normal(0, 1e-4, (50, 2)):
        assert error(found) < error(PeakFrequency(found.a * (1 + da), found.b + db))
    slope, level = np.polyfit(np.log(FREQUENCIES), np.log(peak), 1)
    assert error(found) < 0.99 * error(PeakFrequency(np.exp(level), slope))


@pytest.mark.parametrize(
    ("frequency", "peak"),
    [
        ([], []),
        ([1.0], [1e-6]),
        ([2.0, 2.0], [1e-6, 1.1e-6]),
        ([1.0, 2.0], [1e-6]),
        ([0.0, 1.0], [1e-6, 1e-6]),
        ([-1.0, 1.0], [1e-6, 1e-6]),
        ([1.0, 2.0], [1e-6, 0.0]),
        ([1.0, 2.0], [1e-6, np.nan]),
        ([1.0, np.inf], [1e-6, 1e-6]),
    ],
)
def test_peaks_that_cannot_be_fitted_are_told(frequency, peak):
    with pytest.raises(IdentificationError, match=r"^X_p = a f\^b: [^\n]+$"):
        fit_peak_frequency(frequency, peak)


def test_equal_cycles_do_not_upset_the_cross_validation():
    """Eight cycles of one length: blocks of them may hold every peak."""
    v = drive((150, 150, 140, 120, 100, 80, 60, 40, 20), low=0.0, samples=100)
    y = MultiSlope(0.0, 150.0, thresholds_for(150.0), WEIGHTS[:11])
    record = record_of(0.01 * np.arange(v.size), v, Memory(y, 0.0, 1e-6).forward_array(v))
    axis = identify(record, "smpi", start=2.0).axes["x"]
    assert axis.quality.held_out_rms < 0.02 * np.ptp(record.displacement["x"])
