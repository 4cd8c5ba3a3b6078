"""The compensator as a process of its own, over DDS: what it answers, what it rejects, what it says."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import PERIOD_NS, START_NS, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, stage_model, voltage_path  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray, String  # noqa: E402

from slpi_ros.compensator.validation import CAUSES  # noqa: E402
from slpi_ros.model.document import format_model, save_model  # noqa: E402
from slpi_ros.model.stage_model import HeldAtLimitWarning, StageModel  # noqa: E402

pytestmark = pytest.mark.filterwarnings(f"ignore::{HeldAtLimitWarning.__module__}.{HeldAtLimitWarning.__name__}")


@pytest.fixture
def xy_file(tmp_path: Path) -> str:
    path = tmp_path / "xy.json"
    save_model(stage_model(("x", "y")), path)
    return str(path)


@pytest.fixture
def x_file(tmp_path: Path) -> str:
    path = tmp_path / "x.json"
    save_model(stage_model(), path)
    return str(path)


def desired_path(model, samples, axes=("x",)):
    return np.column_stack(
        [
            model.axis(axis).simulate(np.arange(samples) * 5e-3, voltage_path(samples, seed))
            for seed, axis in enumerate(axes)
        ]
    )


def library(model, path, axes=("x",)):
    answer = model.compensate(np.arange(len(path)) * 5e-3, dict(zip(axes, path.T, strict=True)))
    return np.column_stack([answer[axis] for axis in axes])


@pytest.mark.parametrize("executor", ["events", "default"])
def test_every_sample_is_answered_in_order_as_the_library_answers(xy_file, executor):
    model = stage_model(("x", "y"))
    path = desired_path(model, 2000, ("x", "y"))
    with compensator(axes=["x", "y"], model_file=xy_file, executor=executor) as client:
        client.connect()
        answers = client.follow(["y", "x"], path[:, ::-1])
        status, values = client.report(accepted=2000)
    assert answers == pytest.approx(library(model, path, ("x", "y")), abs=1e-9)
    assert (values["received"], values["rejected"]) == ("2000", "0")
    assert status.hardware_id == values["model.hardware_id"] == "stage under test"
    assert values["model.created"] == "2026-01-02T03:04:05+00:00"
    assert (values["model.kind"], values["memory"]) == ("slpi, slpi", "assumed")


def test_a_path_that_is_faster_than_the_record_is_told_once(tmp_path):
    axis = stage_model().axes["x"]
    stroke = np.ptp(axis.displacement_range) * 1e6
    axis = replace(axis, quality=replace(axis.quality, fastest=50.0))
    save_model(StageModel({"x": axis}), tmp_path / "x.json")
    # At the rate of the record, then at six times that.
    way = np.concatenate([np.arange(100) * 2.5e-3 * stroke, np.arange(30) * 15e-3 * stroke])[:, None] * 1e-6
    with compensator(model_file=str(tmp_path / "x.json")) as client:
        client.connect()
        client.follow(["x"], way[:100])
        _, values = client.report(accepted=100)
        assert values["x.beyond_record"] == ""
        client.follow(["x"], way[100:], START_NS + 10**9)
        _, values = client.report(accepted=130)
        reports = len(client.reports)
        client.graph.spin_until(lambda: len(client.reports) > reports + 3, "later reports")
        told = values["x.beyond_record"]
        assert f"{3 * stroke:.3g} µm/s" in told and f"{0.5 * stroke:.3g} µm/s" in told
        said = [told in status.message for status in client.graph.statuses("/compensator: compensator")]
        assert any(said) and not any(said[-2:])
        client.node.stop()
        assert client.node.stderr.count(told) == 1


NAN, INF = math.nan, math.inf
BAD = {
    "empty": [([], [])],
    "length": [(["x", "y"], [1e-6]), (["x"], []), (["x"], [1e-6, 2e-6]), ([], [1e-6])],
    "unknown_axis": [(["z"], [1e-6]), (["x", "y", ""], [1e-6] * 3), (["X", "y"], [1e-6] * 2)],
    "duplicate_axis": [(["x", "x"], [1e-6, 1e-6])],
    "not_finite": [(["x", "y"], [1e-6, value]) for value in (NAN, INF, -INF)],
    "out_of_range": [(["y", "x"], [1e-6, value]) for value in (1.0, -5e-6, 1e300)],
}


def test_bad_messages_are_rejected_whole_counted_by_cause_and_forgotten(xy_file):
    model, axes = stage_model(("x", "y")), ["x", "y"]
    path = desired_path(model, 120, axes)
    floods = [(cause, *message) for cause, messages in BAD.items() for message in messages]
    with compensator(axes=axes, model_file=xy_file) as client:
        client.connect()
        status, values = client.report()
        assert status.level == b"\0"
        for i, row in enumerate(path.tolist()):
            stamp = START_NS + i * PERIOD_NS
            client.wish(axes, row, stamp)
            for _, names, displacements in floods[i % len(floods) : i % len(floods) + 2]:
                client.wish(names, displacements, stamp)
            # A whole message is rejected for one axis, and for one nanosecond.
            client.wish(axes, row[::-1], stamp - 1)
            client.graph.spin_until(lambda sent=i: len(client.answers) > sent, f"answer {i}")
        expected = dict.fromkeys(CAUSES, 0) | {"time_backwards": len(path)}
        for i in range(len(path)):
            for cause, _, _ in floods[i % len(floods) : i % len(floods) + 2]:
                expected[cause] += 1
        status, values = client.report(rejected=sum(expected.values()))
        answers = np.array(client.answers)
    assert answers == pytest.approx(library(model, path, axes), abs=1e-9)
    assert {cause: int(values[f"rejected.{cause}"]) for cause in CAUSES} == expected
    assert status.level == b"\1" and "rejected" in status.message


def test_one_bad_message_is_reported_at_once_and_then_forgiven(x_file):
    with compensator(model_file=x_file) as client:
        client.connect()
        client.wish(["nobody"], [1e-6])
        status, values = client.report("the rejection", **{"rejected.unknown_axis": 1})
        assert status.level == b"\1" and "no axis 'nobody'" in status.message
        client.graph.wait_for_status("/compensator: compensator", lambda s: s.level == b"\0", "health again")


def test_voltages_stay_within_limits_and_slew(x_file):
    path = desired_path(stage_model(), 800)
    path[::50] = stage_model().axis("x").displacement_range[1] * 1.15
    with compensator(model_file=x_file, voltage_min=5, voltage_max=[80.5], slew_limit=400) as client:
        client.connect()
        client.follow(["x"], path[:90])
        client.report(accepted=90)
        # What the slew limit holds back follows without further messages.
        client.wish(["x"], [path[0, 0]], START_NS + 100 * PERIOD_NS)
        client.wait_for_rest(80.5)
        client.wish(["x"], [path[0, 0]], START_NS + 101 * PERIOD_NS)
        _, values = client.report(accepted=92)
        v = np.array([[5.0], *client.answers])[:, 0]
    assert v.min() >= 5.0 and v.max() == 80.5
    # In one step two output periods at most.
    assert np.abs(np.diff(v)).max() <= 2.0 * 400 / 1000 + 1e-9
    assert int(values["held_at_limit"]) > 0


def test_a_displacement_below_the_remanence_waits_at_the_limit(x_file):
    top = stage_model().axis("x").displacement_range[1]
    with compensator(model_file=x_file) as client:
        client.connect()
        assert client.ask(["x"], [top]) == pytest.approx([100.0])
        assert client.ask(["x"], [-1e-7]) == [0.0]
        status, values = client.report(held_at_limit=1)
        assert "held at a voltage limit" in status.message and values["rejected"] == "0"
        expected = library(stage_model(), np.array([[top], [-1e-7], [5e-6]]))[-1]
        assert client.ask(["x"], [5e-6]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("share", "remedy"), [(0.9, "narrower than the model"), (1.05, "within the identified range")])
def test_what_to_do_about_a_displacement_out_of_reach_depends_on_the_range(share, remedy, x_file):
    top = stage_model().axis("x").displacement_range[1]
    with compensator(model_file=x_file, voltage_max=50.0) as client:
        client.connect()
        client.ask(["x"], [share * top])
        client.graph.spin_until(lambda: remedy in client.node.stderr, "the remedy")


def test_axes_that_are_not_named_keep_their_voltage(xy_file):
    with compensator(axes=["y", "x"], model_file=xy_file) as client:
        client.connect()
        both = client.ask(["x", "y"], [3e-6, 6e-6])
        assert both[0] > both[1]
        assert client.ask(["x"], [4e-6])[0] == both[0]


@pytest.mark.parametrize("kind", ["Float64", "Float64MultiArray"])
def test_unnamed_displacements_go_by_the_order_of_axes(xy_file, kind):
    one = kind == "Float64"
    model, axes = stage_model(("x", "y")), ["x"] if one else ["y", "x"]
    path = desired_path(model, 40, axes)
    message = Float64 if one else Float64MultiArray
    with compensator(axes=axes, model_file=xy_file, desired_type=kind, desired=message) as client:
        client.connect()
        for row in path.tolist():
            client.publish(message(data=row[0] if one else row))
        client.publish(message(data=math.nan if one else [1e-6]))
        _, values = client.report(received=len(path) + 1)
        client.graph.spin_until(lambda: len(client.answers) >= len(path), "all answers")
        answers = np.array(client.answers)
    assert answers == pytest.approx(library(model, path, axes), abs=1e-9)
    assert values["rejected.not_finite" if one else "rejected.length"] == "1"


LATCH = """
import sys, time, rclpy
from std_msgs.msg import String
from slpi_ros.nodes.common import LATCHED
rclpy.init()
node = rclpy.create_node("model_source")
publisher = node.create_publisher(String, "stage_model", LATCHED)
publisher.publish(String(data=open(sys.argv[1]).read()))
print("latched", flush=True)
time.sleep(600)
"""


def test_a_model_latched_by_another_process_long_before(x_file):
    source = subprocess.Popen([sys.executable, "-c", LATCH, x_file], stdout=subprocess.PIPE, text=True)
    try:
        assert source.stdout and source.stdout.readline() == "latched\n"
        with compensator() as client:
            client.connect()
            client.report("the model", **{"model.kind": "slpi"})
            path = desired_path(stage_model(), 100)
            assert client.follow(["x"], path) == pytest.approx(library(stage_model(), path), abs=1e-9)
    finally:
        source.kill()
        source.communicate()


def test_refused_models_leave_the_old_one_working():
    model = stage_model()
    path = desired_path(model, 200)
    good = format_model(model)
    hostile = [
        "", "garbage", "[1, 2", '{"schema": 3}', "[" * 100_000, "null", good[: len(good) // 2],
        good.replace("slpi_ros/model/3", "slpi_ros/model/999"), good.replace('"x"', '"y"'), good.replace("0.0", "NaN"),
        good.replace("[0.0, 100.0]", "[200.0, 300.0]"), good.replace('"slpi"', '"magic"'),
    ]  # fmt: skip
    with compensator() as client:
        client.connect()
        status, _ = client.report("the start", state="active", received=0)
        assert status.level == b"\1" and "waiting for a model" in status.message
        client.wish(["x"], [1e-6])
        client.report("the rejection", **{"rejected.no_model": 1})
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        models.publish(String(data="garbage"))
        status, _ = client.report(models_refused=1)
        assert status.level == b"\2" and "not a model document" in status.message
        models.publish(String(data=good))
        client.report("the model", **{"model.kind": "slpi", "last_model_error": ""})
        answers = [client.follow(["x"], path[:100])]
        for i, text in enumerate(hostile, start=2):
            models.publish(String(data=text))
            status, values = client.report(models_refused=i)
            assert status.level == b"\1" and "model refused" in status.message and values["last_model_error"]
            assert "\n" not in values["last_model_error"]
        # The same model again is no news: the memory stays.
        models.publish(String(data=good))
        client.report("forgiveness", last_model_error="", models_refused=len(hostile) + 1)
        answers.append(client.follow(["x"], path[100:], START_NS + 100 * PERIOD_NS))
        assert "Traceback" not in client.node.stderr
    assert np.concatenate(answers) == pytest.approx(library(model, path), abs=1e-9)


def test_a_new_model_takes_over_without_a_jump(x_file):
    path = np.repeat(desired_path(stage_model(), 300), 2, axis=0)
    with compensator(model_file=x_file, slew_limit=1000.0) as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        for i, part in enumerate(np.split(path, 6)):
            client.follow(["x"], part, START_NS + i * len(part) * PERIOD_NS)
            model = stage_model(stroke=(10.0 + 0.1 * (i + 1)) * 1e-6)
            models.publish(String(data=format_model(model).replace("2026-01-02T03:04:05", f"model {i}")))
            client.report("the new model", **{"model.created": f"model {i}+00:00"})
        v = np.array(client.answers)[:, 0]
    # In one step two output periods at most.
    assert np.abs(np.diff(v)).max() <= 2.0 * 1000.0 / 1000 + 1e-9


def test_namespaces_and_remapping(x_file):
    names = {"desired_displacement": "/planner/wish", "voltage_command": "/voltage_controller/commands"}
    remap = [part for old, new in names.items() for part in ("-r", f"{old}:={new}")]
    with compensator("-r", "__ns:=/left/arm", *remap, namespace="/left/arm", names=names, model_file=x_file) as client:
        client.connect()
        assert client.ask(["x"], [0.0]) == [0.0]
    with compensator("-r", "__ns:=/left", namespace="/left") as client:
        client.connect()
        client.graph.publisher(String, "/left/stage_model", LATCHED).publish(String(data=format_model(stage_model())))
        client.report("the model", **{"model.kind": "slpi"})
        assert client.ask(["x"], [0.0]) == [0.0]
