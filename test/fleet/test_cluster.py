"""Clusters of separate processes by address: equal results, whatever is killed."""

import os
import random
import signal
import socket
import subprocess
import sys
import time
from unittest.mock import Mock

import pandas as pd
import pytest
from fleet.dask_processes import CHECKOUT, DaskProcesses
from pandas.testing import assert_frame_equal

from slpi_ros.errors import SlpiError
from slpi_ros.fleet import cluster, run
from slpi_ros.fleet.results import JOURNAL, TABLE

# Kills of workers, schedulers and clients in one run, at random places of it.
KILLS = tuple(map(int, os.environ.get("SLPI_FLEET_KILLS", "2,1,1").split(",")))


@pytest.fixture
def undisturbed(done):
    return done[2]


def start(fleet, output, address, *options):
    command = [sys.executable, "-m", "slpi_ros.cli", "fleet", str(fleet), "-o", str(output), "--no-diagnose"]
    return subprocess.Popen(
        [*command, "--scheduler", address, *options],
        env=os.environ | {"PYTHONPATH": CHECKOUT}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def lines(output):
    journal = output / JOURNAL
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def assert_same(output, undisturbed):
    """Assert equality to the last digit; only the computing time differs."""
    found = pd.read_parquet(output / TABLE)
    assert_frame_equal(found.drop(columns="seconds"), undisturbed.drop(columns="seconds"), check_exact=True)


@pytest.mark.slow
@pytest.mark.long
def test_nothing_is_lost_whatever_is_killed(fleet, undisturbed, tmp_path):
    output, chance = tmp_path / "out", random.Random(os.environ.get("SLPI_FLEET_SEED", "1"))
    victims = [name for name, count in zip(("worker", "scheduler", "client"), KILLS, strict=True) for _ in range(count)]
    chance.shuffle(victims)
    total = 2 * len(undisturbed)
    # One kill after each of these numbers of journal lines; several may fall together.
    moments = sorted(chance.randrange(1, total) for _ in victims)
    with DaskProcesses(tmp_path) as processes:
        running = start(fleet, output, processes.address)
        for victim, moment in zip(victims, moments, strict=True):
            while lines(output) < moment and running.poll() is None:
                time.sleep(0.02)
            time.sleep(chance.uniform(0.0, 1.0))
            if victim == "client":
                running.kill()
            else:
                processes.kill(0 if victim == "scheduler" else chance.randrange(1, 3))
            if running.poll() is not None or victim == "client":
                running.communicate()
                running = start(fleet, output, processes.address)
        said = running.communicate()
        if running.returncode:
            # A scheduler that is away for longer ends the run in one line; the next one continues it.
            assert running.returncode == 1 and "finished rows are kept" in said[1], said
            running = start(fleet, output, processes.address)
            said = running.communicate()
    assert running.returncode == 0, said
    assert_same(output, undisturbed)


@pytest.mark.slow
def test_an_interrupted_run_ends_in_order(fleet, undisturbed, tmp_path):
    with DaskProcesses(tmp_path, workers=1) as processes:
        running = start(fleet, tmp_path / "out", processes.address)
        while lines(tmp_path / "out") < 5:
            assert running.poll() is None
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        said = running.communicate()
        assert running.returncode == 130 and "Traceback" not in said[1], said
        assert (tmp_path / "out" / TABLE).exists()
        assert start(fleet, tmp_path / "out", processes.address).wait() == 0
    assert_same(tmp_path / "out", undisturbed)


def test_no_scheduler(fleet, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "RECONNECT", 0.5)
    with pytest.raises(SlpiError):
        run([fleet], tmp_path / "out", scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize(
    ("address", "code"),
    [("nope", 2), ("", 2), ("tcp://host:port", 2), ("gopher://host:70", 2), ("tcp://unheard.of:8786", 1)],
)
def test_what_is_no_address_is_told_in_one_line_before_anything_is_written(fleet, tmp_path, address, code, monkeypatch):
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    monkeypatch.setattr(socket, "getaddrinfo", Mock(side_effect=unknown))
    # No client is made for it: one that fails ends in a traceback after ten seconds.
    monkeypatch.setattr("distributed.Client", None)
    out = tmp_path / "out"
    with pytest.raises(SlpiError) as refused:
        run([fleet], out, scheduler=address)
    assert refused.value.exit_code == code and address in str(refused.value) and not out.exists()
