"""The SMPI model: the multi-slope model of the largest cycles of a record, and the line of all cycles' peaks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import IdentificationError
from slpi_ros.hysteresis.mpi import MultiSlope
from slpi_ros.hysteresis.multi_slope import BACK, AmplitudeScaled, cycles
from slpi_ros.identification.fitted import Fitted
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, Problem, held_out_errors
from slpi_ros.identification.multi_slope import SAME_AMPLITUDE, MultiSlopeBasis, peak_line
from slpi_ros.identification.samples import FEWEST, Samples, only_one
from slpi_ros.model.stage_model import Start

FloatArray = NDArray[np.float64]


def fit_amplitude_scaled(records: Sequence[Samples]) -> Fitted:
    """Fit the SMPI model to one record.

    Raises
    ------
    UsageError
        If there are several records.
    IdentificationError
        If too few samples belong to cycles of the largest amplitude.
    """
    samples = only_one(records, "smpi")
    largest = in_largest_cycles(samples.v)
    count = int(np.count_nonzero(samples.fitted & largest))
    if count < FEWEST:
        raise IdentificationError(
            f"{count} samples in cycles up to the highest voltage; at least {FEWEST} are needed: "
            "drive from the lowest voltage to the highest and back"
        )

    def predict(kept: NDArray[np.bool_]) -> FloatArray:
        model, offset = _fit(samples, kept, largest)
        return model.along(float(samples.v[0]), offset).forward_array(samples.v)

    model, offset = _fit(samples, samples.fitted, largest)
    y = model.along(float(samples.v[0]), offset).forward_array(samples.v)
    problem = Problem.pose([samples.only(largest)], MultiSlopeBasis.over(*_ends(samples)))
    return Fitted(
        hysteresis=model,
        start=Start(float(samples.v[0]), offset),
        y=samples.y[samples.fitted],
        voltage_range=samples.voltage_range,
        errors=(y - samples.y)[samples.fitted],
        held_out=held_out_errors(samples, samples.fitted, predict),
        covered=problem.basis.covered(problem.design.local[problem.weights > 0]),
    )


def in_largest_cycles(v: FloatArray) -> NDArray[np.bool_]:
    """Return which samples belong to a cycle that reaches the highest voltage of a record, shape (N,)."""
    low, high = float(v.min()), float(v.max())
    chosen = np.zeros(v.size, dtype=bool)
    for first, last in cycles(v, low + BACK * (high - low)):
        chosen[first : last + 1] |= v[first : last + 1].max() >= high - SAME_AMPLITUDE * (high - low)
    return chosen


def _ends(samples: Samples) -> tuple[float, float]:
    return float(samples.v.min()), float(samples.v.max())


def _fit(samples: Samples, kept: NDArray[np.bool_], largest: NDArray[np.bool_]) -> tuple[AmplitudeScaled, float]:
    """Return the model fitted to the samples `kept`, and the displacement at the start (m)."""
    part = replace(samples, fitted=kept & largest)
    problem = Problem.pose([part], MultiSlopeBasis.over(*_ends(samples)))
    x = problem.solve(FIRST_SMOOTHNESS) * problem.scale
    base = problem.basis.shape(x, problem.gain)
    assert isinstance(base, MultiSlope)
    # Of all fitted samples: a few peaks say nothing of the samples between them.
    model = AmplitudeScaled(base, *peak_line(samples.v, np.where(samples.fitted, samples.y, np.nan)))
    # Displacement at the start: at the low end, where all cycles begin, the model must be right.
    relative = model.along(float(samples.v[0]), 0.0).forward_array(samples.v)
    low, high = _ends(samples)
    at_low_end = kept & (samples.v <= low + BACK * (high - low))
    return model, float(np.median((samples.y - relative)[at_low_end if at_low_end.any() else kept]))
