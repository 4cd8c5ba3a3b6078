"""A measured record's desired path at its own pace, through the node and through the command line."""

import time

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from forked import completed  # noqa: E402
from nodes.compensator_client import PERIOD_NS, START_NS, compensator  # noqa: E402

import slpi_ros  # noqa: E402
from slpi_ros.io.tables import import_table, read_table, write_table  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture
def shifted(measured_data, tmp_path):
    """Identify the PICMA record; write its desired path, moved into the identified displacements, as a table."""
    table = measured_data / "picma_1hz_decay_grow.csv"
    model = slpi_ros.identify(import_table(table), start=2.0, stop=25.0)
    slpi_ros.save_model(model, tmp_path / "model.json")
    desired = np.genfromtxt(table, delimiter=",", names=True)["desired_um"] * 1e-6
    low, high = model.axes["x"].displacement_range
    desired += (low + high - desired.min() - desired.max()) / 2
    write_table(tmp_path / "desired.csv", np.arange(desired.size) * PERIOD_NS * 1e-9, {"x": desired}, "m")
    return tmp_path, desired


@pytest.mark.parametrize("samples", [1000, pytest.param(None, marks=pytest.mark.long)])
def test_the_node_answers_at_200_hz_what_the_command_line_gives(shifted, samples):
    folder, desired = shifted
    desired = desired[:samples]
    command = ["compensate", folder / "model.json", folder / "desired.csv", "-o", folder / "voltage.csv"]
    completed("slpi_ros.cli:main", [*map(str, command)]).check_returncode()
    expected = read_table(folder / "voltage.csv", "V")[1]["x"][:samples]
    with compensator(model_file=str(folder / "model.json")) as client:
        client.connect()
        start = time.monotonic()
        for i, y in enumerate(desired.tolist()):
            # No more wait for an answer than the node's queue holds, however slow the machine is.
            client.graph.spin_until(
                lambda due=start + i * 5e-3, least=i - 50: time.monotonic() >= due and client.answered >= least,
                "the next sample",
            )
            client.wish(["x"], [y], START_NS + i * PERIOD_NS)
        client.graph.spin_until(lambda: client.answered >= desired.size, "every answer")
        answers = np.array(client.answers)[:, 0]
    assert answers.size == desired.size
    difference = np.abs(answers - expected)
    print(f"{answers.size} samples, largest difference {difference.max():.3g} V")
    assert difference.max() <= 1e-9
    assert np.mean((expected > expected.min()) & (expected < expected.max())) > 0.8, "the path is within reach"
