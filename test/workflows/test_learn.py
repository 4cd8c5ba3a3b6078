"""``slpi learn``: the next pass from the bags of the passes, trajectories or periods, in one go or bag by bag."""

import json

import numpy as np
import pytest
from bag_makers import JOINT_STATE, STORE, header, joint_state, rosbags_bag
from identification.records import calibration

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.io.tables import read_table, write_table

pytestmark = pytest.mark.slow

RATE, PASSES, SIZE = 500.0, 4, 200
START_NS = 10**18
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    file = tmp_path_factory.mktemp("model") / "model.json"
    slpi_ros.save_model(slpi_ros.identify(calibration(seed=1)[0], "pi"), file)
    return file


def desired():
    t = np.arange(SIZE) / RATE
    return t, 10e-6 - 3e-6 * np.cos(2 * np.pi * np.arange(SIZE) / SIZE)


def answered(asked, seed=0):
    """Return the readings (m) of a stage that is late by two samples and 3 % short."""
    late = np.concatenate([np.full(2, asked[0]), asked[:-2]])
    return 10e-6 + 0.97 * (late - 10e-6) + np.random.default_rng(seed).normal(0.0, 3e-9, asked.size)


def message(start_ns, path):
    point, duration = (
        STORE.types[name] for name in ("trajectory_msgs/msg/JointTrajectoryPoint", "builtin_interfaces/msg/Duration")
    )
    none, points = np.empty(0), []
    for k, y in enumerate(path):
        ns = round(k * 1e9 / RATE)
        since = duration(sec=ns // 10**9, nanosec=ns % 10**9)
        points.append(
            point(positions=np.array([y]), velocities=none, accelerations=none, effort=none, time_from_start=since)
        )
    return STORE.types[TRAJECTORY](header(start_ns), joint_names=["x"], points=points)


def bag_of(folder, path, *, trajectories=True, seed=0, readings=None, others=()):
    """Write a bag of some passes of one path, or of so many readings, each as a trajectory or not told at all.

    `others`: further trajectories, each with the number of the reading at which it comes.
    """
    # The trajectory ends where the next one begins.
    path = np.append(path, path[0])
    whole = np.concatenate([*[path[:-1]] * PASSES, path[-1:]])[:readings]
    read = answered(whole, seed)
    stamps = START_NS + np.round(np.arange(whole.size) * 1e9 / RATE).astype(np.int64)
    states = [
        (int(ns), joint_state(int(ns), ("x",), (y,), (50.0,))) for ns, y in zip(stamps.tolist(), read, strict=True)
    ]
    assert states[0][1].__msgtype__ == JOINT_STATE
    topics = {"/stage_state": states}
    if trajectories:
        starts = [int(stamps[k * SIZE]) for k in range(PASSES)]
        topics["/desired_trajectory"] = [(ns, message(ns, path)) for ns in starts]
        topics["/desired_trajectory"] += [(int(stamps[at]), message(int(stamps[at]), other)) for at, other in others]
    return rosbags_bag(folder, topics)


def error_of(path):
    """Return the true error (m) of a path that is followed for long."""
    _, y = desired()
    true = 10e-6 + 0.97 * (np.roll(path, 2) - 10e-6)
    return float(np.std(true - y))


def test_bag_by_bag_the_path_gets_better(model, tmp_path):
    t, y = desired()
    path, learned, nxt = y, tmp_path / "learned.json", tmp_path / "next.csv"
    errors = [error_of(path)]
    for round_ in range(4):
        bag = bag_of(tmp_path / f"bag{round_}", path, seed=round_)
        report = tmp_path / "report"
        assert main([
            "learn", str(bag), "--model", str(model), "--learned", str(learned), "--report", str(report), "-o", str(nxt)
        ]) == 0  # fmt: skip
        at, columns = read_table(nxt, "m")
        assert np.allclose(at, t, atol=1e-6)
        path = columns["x"]
        errors.append(error_of(path))
    assert errors[-1] < 0.1 * errors[0]
    assert (report / "report.html").stat().st_size > 10_000
    document = json.loads(learned.read_text())
    assert len(document["axes"]["x"]["passes"]) == 4 * PASSES


def test_passes_by_their_period_where_nothing_was_recorded_but_the_stage(model, tmp_path, capsys):
    t, y = desired()
    bag = bag_of(tmp_path / "bag", y, trajectories=False)
    table = tmp_path / "desired.csv"
    write_table(table, t, {"x": y}, "m")
    words = ["learn", str(bag), "--model", str(model), "-o", str(tmp_path / "next.csv")]
    assert main(words) == 2
    assert main([*words, "--period", str(SIZE / RATE)]) == 2
    capsys.readouterr()
    assert main([*words, "--period", str(SIZE / RATE), "--desired", str(table), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["axes"]["x"]["passes"]) == PASSES
    assert main([*words, "--period", "100", "--desired", str(table)]) == 1
    assert main([*words, "--period", "-1", "--desired", str(table)]) == 2


@pytest.mark.parametrize(("readings", "code"), [(SIZE, 0), (SIZE - 1, 1)])
def test_a_bag_of_exactly_one_pass_holds_one(readings, code, model, tmp_path):
    t, y = desired()
    bag = bag_of(tmp_path / "bag", y, trajectories=False, readings=readings)
    write_table(tmp_path / "desired.csv", t, {"x": y}, "m")
    words = ["learn", str(bag), "--model", str(model), "--desired", str(tmp_path / "desired.csv")]
    assert main([*words, "-o", str(tmp_path / "next.csv")]) == code


def test_what_is_no_document_of_this_path_is_refused(model, tmp_path):
    t, y = desired()
    bag, learned = bag_of(tmp_path / "bag", y), tmp_path / "learned.json"
    words = ["learn", str(bag), "--model", str(model), "-o", str(tmp_path / "next.csv"), "--learned", str(learned)]
    learned.write_text('{"schema": "slpi_ros/learned/1"}')
    assert main(words) == 1
    learned.write_text("my notes")
    assert main(words) == 2
    assert learned.read_text() == "my notes"


def test_passes_of_another_path_are_left_out(model, tmp_path, capsys):
    t, y = desired()
    other = 10e-6 + 1e-6 * np.sin(4 * np.pi * np.arange(SIZE) / SIZE)
    table, nxt = tmp_path / "desired.csv", tmp_path / "next.csv"
    write_table(table, t, {"x": y}, "m")
    words = ["learn", "--model", str(model), "--desired", str(table), "--learn-limit", "0.1", "-o", str(nxt)]
    bags = [bag_of(tmp_path / name, way) for name, way in (("own", y), ("other", other))]
    assert main([*words, str(bags[1])]) == 1
    assert not nxt.exists()
    capsys.readouterr()
    assert main([*words, *map(str, bags), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["axes"]["x"]["passes"]) == PASSES
    assert np.abs(read_table(nxt, "m")[1]["x"] - y).max() <= 0.1e-6 + 1e-12


@pytest.mark.parametrize(
    ("at", "other", "whole"),
    [
        (SIZE // 2, [], PASSES - 1),  # cancelled
        (3 * SIZE // 2, [9e-6, 9e-6], PASSES - 1),  # replaced
        (2 * SIZE - 1, [], PASSES - 1),
        (PASSES * SIZE, [], PASSES),
    ],
)
def test_a_pass_that_is_cancelled_or_replaced_does_not_count(at, other, whole, model, tmp_path, capsys):
    t, y = desired()
    write_table(tmp_path / "desired.csv", t, {"x": y}, "m")
    bag = bag_of(tmp_path / "bag", y, others=[(at, other)])
    words = ["learn", str(bag), "--model", str(model), "-o", str(tmp_path / "next.csv"), "--json"]
    for more in ([], ["--desired", str(tmp_path / "desired.csv")]):
        assert main([*words, *more]) == 0
        told = capsys.readouterr()
        assert len(json.loads(told.out)["axes"]["x"]["passes"]) == whole
        assert ("cancelled or replaced" in told.err) == (whole < PASSES)


def test_a_period_that_is_none_of_the_path_is_refused(model, tmp_path):
    t, y = desired()
    bag, table = bag_of(tmp_path / "bag", y), tmp_path / "desired.csv"
    write_table(table, t, {"x": y}, "m")
    words = ["learn", str(bag), "--model", str(model), "-o", str(tmp_path / "next.csv")]
    for period in ("1e-9", "0.01"):
        assert main([*words, "--period", period]) == 2
    assert main([*words, "--desired", str(table), "--period", str(0.5 * SIZE / RATE)]) == 2
    # A path that ends with its first sample once more.
    write_table(table, np.arange(SIZE + 1) / RATE, {"x": np.append(y, y[0])}, "m")
    assert main([*words, "--desired", str(table), "--period", str(SIZE / RATE)]) == 0


def test_a_bag_that_is_no_pass_leaves_what_was_learned_alone(model, tmp_path):
    t, y = desired()
    table, learned, nxt = tmp_path / "desired.csv", tmp_path / "learned.json", tmp_path / "next.csv"
    write_table(table, t, {"x": y}, "m")
    words = ["--model", str(model), "--learned", str(learned), "-o", str(nxt), "--period", str(SIZE / RATE)]
    own = bag_of(tmp_path / "own", y, trajectories=False)
    assert main(["learn", str(own), *words, "--desired", str(table)]) == 0
    before = learned.read_bytes()
    other = bag_of(tmp_path / "other", 20e-6 - y, trajectories=False)
    assert main(["learn", str(other), *words]) == 1
    assert learned.read_bytes() == before


@pytest.mark.parametrize("learned", ["same.json", "./same.json", "folder/../same.json"])
def test_what_was_learned_is_not_written_over_by_the_next_pass(model, learned, tmp_path, monkeypatch):
    bag = bag_of(tmp_path / "bag", desired()[1])
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    assert main(["learn", str(bag), "--model", str(model), "--learned", learned, "-o", "same.json"]) == 2
    assert not (tmp_path / "same.json").exists()
