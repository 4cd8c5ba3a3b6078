"""Bags of two small simulated stages, and a Dask cluster within the test process."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from distributed import Client, LocalCluster

from slpi_ros.excitation.drives import excite
from slpi_ros.fleet.pages import report_fleet
from slpi_ros.fleet.results import TABLE
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.simulation.axis import SimulatedAxis
from slpi_ros.simulation.parameters import AxisParameters

DAY_NS = 86_400 * 10**9
NOISE = 8e-9


def stage_path(drive, seed):
    """Return the displacement of a simulated stage without noise, shape (N,), metres."""
    parameters = replace(AxisParameters.random(seed), noise_rms=0.0, quantisation=0.0, levels=120)
    return SimulatedAxis(parameters).run(drive.t, drive.voltage["x"])[0]


class Stages:
    """Writer of bags of simulated stages."""

    def __init__(self):
        self.drive = excite(("x",), voltage_min=0.0, voltage_max=100.0, duration=15.0, rate=100.0)
        self.paths = {"a": stage_path(self.drive, 1), "b": stage_path(self.drive, 2)}
        self._rng = np.random.default_rng(0)

    def record(self, stage, day, gain=1.0, name=None):
        """Return a record of a stage, with the hardware id `name` if that differs."""
        y = gain * self.paths[stage] + self._rng.normal(0.0, NOISE, self.drive.t.size)
        time_ns = np.rint(self.drive.t * 1e9).astype(np.int64) + (20_000 + day) * DAY_NS
        return Record(time_ns, {"x": self.drive.voltage["x"]}, {"x": y}, hardware_id=stage if name is None else name)

    def write(self, folder, stage, day, gain=1.0, name=None) -> Path:
        path = folder / f"{stage if name is None else name or 'unnamed'}-{day}"
        write_bag(path, self.record(stage, day, gain, name))
        return path


@pytest.fixture(scope="session")
def stages():
    return Stages()


@pytest.fixture(scope="session")
def fleet(stages, tmp_path_factory):
    """Return a folder: a gains 2 % from day 20 on, b is unchanged, both are exchanged from day 40 on; one is broken."""
    folder = tmp_path_factory.mktemp("fleet")
    for day, gain in ((0, 1.0), (10, 1.0), (20, 1.02), (30, 1.02)):
        stages.write(folder, "a", day, gain)
        stages.write(folder, "b", day)
    stages.write(folder, "b", 40, name="a")
    stages.write(folder, "a", 40, 1.02, name="b")
    (folder / "deeper").mkdir()
    (folder / "deeper" / "broken.mcap").write_bytes(b"")
    return folder


@pytest.fixture(scope="session")
def client():
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "dashboard_address": ":0"}
    with LocalCluster(**options) as cluster, Client(cluster, set_as_default=False) as own:
        yield own


@pytest.fixture(scope="session")
def done(fleet, client, tmp_path_factory):
    """Return folder, lines and table of a run."""
    folder = tmp_path_factory.mktemp("done")
    lines, usable = report_fleet([str(fleet)], str(folder), client=client, diagnose=False)
    assert usable
    return folder, lines, pd.read_parquet(folder / TABLE)
