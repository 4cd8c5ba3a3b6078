"""Records for the tests of identification, from the simulated stage and from formulas."""

from dataclasses import replace

import numpy as np

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters


def record_of(t, v, y, axis="x"):
    return Record(np.round(np.asarray(t) * 1e9).astype(np.int64), {axis: np.asarray(v)}, {axis: np.asarray(y)}, "test")


def stage(seed, noise=8e-9):
    return SimulatedAxis(replace(AxisParameters.random(seed), noise_rms=noise), seed)


def calibration(seed, duration=20.0, noise=8e-9):
    """Return a record of a calibration drive from rest, and its true displacement."""
    t, v = calibration_drive(0.0, 100.0, duration=duration, rate=200.0, seed=seed)
    true, measured = stage(seed, noise).run(t, v)
    return record_of(t, v, measured), true


def rms(error):
    return float(np.sqrt(np.mean(np.asarray(error) ** 2)))
