"""Measured records: held-out, free-run errors."""

import numpy as np
import pytest
from identification.records import rms

import slpi_ros
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.tables import import_table


def through_a_bag(table, folder):
    """Import a table as a user does: into a bag, and read that."""
    write_bag(folder / table.stem, import_table(table))
    return slpi_ros.read_bag(folder / table.stem)


@pytest.mark.parametrize(("kind", "bound"), [("slpi", 0.065e-6), ("pi", 0.45e-6)])
def test_afm_second_half_from_the_first(measured_data, tmp_path, kind, bound):
    record = through_a_bag(measured_data / "afm_double_sine_x.csv", tmp_path)
    half = record.t[len(record) // 2]
    error = slpi_ros.identify(record, kind, stop=half).simulate(record.t, record.voltage["x"])
    error = (error - record.displacement["x"])[record.t >= half]
    assert rms(error[np.isfinite(error)]) <= bound


@pytest.mark.parametrize(("kind", "bound"), [("slpi", 0.24e-6), ("pi", 0.45e-6)])
def test_picma_growing_from_decaying(measured_data, tmp_path, kind, bound):
    record = through_a_bag(measured_data / "picma_1hz_decay_grow.csv", tmp_path)
    error = slpi_ros.identify(record, kind, start=2.0, stop=25.0).simulate(record.t, record.voltage["x"])
    error = error - record.displacement["x"]
    assert rms(error[(record.t >= 25) & (record.t < 37)]) <= bound


@pytest.mark.parametrize(
    "name", ["picma_1hz_major", "piezo_150v_1hz", pytest.param("afm_triangle_sine", marks=pytest.mark.long)]
)
def test_the_other_records_can_be_identified(measured_data, tmp_path, name):
    record = through_a_bag(measured_data / f"{name}.csv", tmp_path)
    for axis, model in slpi_ros.identify(record).axes.items():
        stroke = np.ptp(record.displacement[axis][np.isfinite(record.displacement[axis])])
        assert model.quality.held_out_rms < 0.02 * stroke
