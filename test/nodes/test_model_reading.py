"""Reading model documents: large ones in a process of their own, the newest first."""

import json
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.compensator_client import START_NS, compensator  # noqa: E402
from nodes.ros_helpers import LATCHED, axis_model, stage_model  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from slpi_ros.compensator.persistence import model_id  # noqa: E402
from slpi_ros.errors import ModelError  # noqa: E402
from slpi_ros.hysteresis.loop_family import LoopFamily  # noqa: E402
from slpi_ros.io.input_limits import TOPIC_MODEL_CHARACTERS  # noqa: E402
from slpi_ros.model.document import format_model, parse_model  # noqa: E402
from slpi_ros.model.stage_model import StageModel  # noqa: E402
from slpi_ros.nodes import jobs as model_reading  # noqa: E402
from slpi_ros.nodes.jobs import SMALL, Reading  # noqa: E402


def fine_model(vertices: int, axes: tuple[str, ...] = ("x",)) -> StageModel:
    """Return a stage whose loops are known at many vertices."""
    grid = np.linspace(0.0, 100.0, vertices)
    width = (grid[:, None] - grid[None, :]) / 100.0
    surface = np.where(width > 0.0, 8e-6 * width + 2e-6 * width**2, 0.0)
    family = LoopFamily(grid, surface, 1.03 * surface[:, 0], 1e-7)
    top = float(family.rise[-1])
    model = replace(axis_model(), hysteresis=family, displacement_range=(0.0, top))
    return StageModel(dict.fromkeys(axes, model), "stage under test", "2026-01-02T03:04:05+00:00")


FINE = format_model(fine_model(161))
HOSTILE = "{" + ",".join(f'"k{i}":{{"a":[1,2,3]}}' for i in range(60_000)) + "}"


@pytest.fixture
def nothing_checked_here(monkeypatch):
    def refuse(*_):
        raise AssertionError("checked in this process")

    monkeypatch.setattr(model_reading, "parse_model", refuse)


def test_a_stage_with_the_finest_models_has_a_document_that_is_not_too_large():
    assert len(FINE) > SMALL and len(format_model(fine_model(161, ("x", "y", "z")))) < TOPIC_MODEL_CHARACTERS
    assert len(format_model(fine_model(41, ("x", "y")))) < SMALL


def test_a_large_document_is_the_model_that_a_small_one_would_be(nothing_checked_here):
    model, fingerprint = Reading(FINE, "here").read()
    assert fingerprint == model_id(model) == model_id(parse_model(FINE, "here"))


# Names, as pytest puts the name of a test into the environment, which takes no megabytes: no process could be started.
@pytest.mark.parametrize(
    "text",
    [HOSTILE, FINE[:-1], FINE.replace("1e-07", "1e-7000", 1) + "]", "[" * (SMALL + 1)],
    ids=["hostile", "cut", "too much", "deep"],
)
def test_a_large_wrong_document_is_refused_elsewhere(nothing_checked_here, text):
    with pytest.raises(ModelError, match="^here: [^\n]+$"):
        Reading(text, "here").read()


def test_a_small_document_needs_no_process(monkeypatch):
    monkeypatch.setattr(model_reading, "WorkerProcess", None)
    model, fingerprint = Reading(format_model(stage_model()), "here").read()
    assert fingerprint == model_id(model)
    with pytest.raises(ModelError, match="^here: [^\n]+$"):
        Reading("{}", "here").read()


def test_a_document_larger_than_any_stage_has_is_refused_at_once():
    with pytest.raises(ModelError, match=f"here: {TOPIC_MODEL_CHARACTERS + 1} .*{TOPIC_MODEL_CHARACTERS}"):
        Reading("x" * (TOPIC_MODEL_CHARACTERS + 1), "here")


def test_a_reading_that_is_cancelled_comes_to_nothing(nothing_checked_here):
    reading, results = Reading(HOSTILE, "here"), []
    thread = threading.Thread(target=lambda: results.append(reading.read()))
    thread.start()
    reading.cancel()
    thread.join()
    assert results == [None]
    assert reading.read() is None


FIRST_WORKER = """
import time
from slpi_ros.nodes.jobs import CheckOutcome, WorkerProcess
worker = WorkerProcess(time.sleep, 60.0, CheckOutcome, "sleep")
print(open(f"/proc/{worker.process.pid}/status").read())
worker.end()
"""


def test_the_first_worker_too_leaves_ctrl_c_to_its_node():
    """Python's own helper process, begun with the first one, lets SIGINT through."""
    said = subprocess.run([sys.executable, "-c", FIRST_WORKER], capture_output=True, text=True, check=True).stdout
    (blocked,) = (line.split()[1] for line in said.splitlines() if line.startswith("SigBlk:"))
    assert int(blocked, 16) & 1 << (signal.SIGINT - 1)


def test_the_newest_document_wins_and_commands_go_on():
    path = 1e-6 * (3.0 + np.sin(np.arange(600) * 0.05))[:, None]
    good = stage_model()
    with compensator() as client:
        client.connect()
        models = client.graph.publisher(String, "/stage_model", LATCHED)
        models.publish(String(data=FINE))
        client.report("the large model", **{"model.id": model_id(fine_model(161))[:12]})
        models.publish(String(data=HOSTILE))
        answers = client.follow(["x"], path)
        # The hostile one may have been refused by now, or is left in favour of this.
        models.publish(String(data=HOSTILE))
        models.publish(String(data=json.dumps(json.loads(format_model(good)))))
        client.report("the newest", **{"model.id": model_id(good)[:12], "last_model_error": ""})
        answers = np.concatenate([answers, client.follow(["x"], path[::-1], START_NS + 10**10)])
        assert len(answers) == 1200 and "Traceback" not in client.node.stderr
