"""``slpi call`` and ``slpi param`` with nodes that run."""

import json
import re
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy")

from forked import completed  # noqa: E402
from nodes.compensator_client import compensator  # noqa: E402
from nodes.ros_helpers import stage_model, started  # noqa: E402
from rcl_interfaces.msg import ParameterType  # noqa: E402
from refusals import holds, refusal  # noqa: E402

from slpi_ros.cli.call import MOVES  # noqa: E402
from slpi_ros.errors import UsageError  # noqa: E402
from slpi_ros.model.document import save_model  # noqa: E402
from slpi_ros.nodes import __file__ as nodes  # noqa: E402
from slpi_ros.nodes.graph_calls import value_of  # noqa: E402


def slpi(*arguments: str):
    return completed("slpi_ros.cli:main", arguments)


@pytest.fixture(scope="module")
def x_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "x.json"
    save_model(stage_model(), path)
    return str(path)


@pytest.mark.slow
def test_a_service_is_called_and_first_it_is_said_what_that_moves(x_file):
    given = {"model_file": x_file, "reset_cycles": 2, "slew_limit": 2000.0, "reset_rate": 1000.0}
    with compensator("-r", "__ns:=/lab", namespace="/lab", **given) as client:
        client.connect()
        done = slpi("call", "/lab/compensator", "~/reset_memory")
        assert done.returncode == 0 and not done.stderr
        first, verdict, *_ = done.stdout.splitlines()
        assert holds(first, "reset_memory", "oscillation") and verdict.startswith("done: ")
        client.graph.spin_until(lambda: client.answers and max(client.answers)[0] > 50.0, "the reset")
        # Nothing measures a displacement, so there is no zero.
        refused = slpi("call", "lab/compensator", "set_zero", "--json")
        assert refused.returncode == 1
        said = json.loads(refused.stdout)
        assert not said["success"] and said["message"] and said["moves"] == MOVES["set_zero"]
        wrong = slpi("call", "/lab/compensator", "fly")
        assert wrong.returncode == 2 and holds(wrong.stderr, "/lab/compensator/fly", "reset_memory")


@pytest.mark.slow
def test_a_parameter_is_told_and_set_as_what_it_is(tmp_path):
    with started("stage_simulator", {"axes": ["x", "y"]}), started("identify", {"kind": "pi"}) as node:
        told = slpi("param", "/identify", "kind")
        assert (told.returncode, told.stdout.splitlines()[0]) == (0, "kind: pi")
        done = slpi("param", "/identify", "sensor_delay", "0.002", "--json")
        assert json.loads(done.stdout) == {"node": "/identify", "name": "sensor_delay", "value": 0.002, "before": 0.0}
        # A text stays one, whatever YAML takes it for.
        assert slpi("param", "/identify", "topic", "0123").stdout.startswith("topic: 0123 (was stage_state)")
        for arguments, code, says in (
            (("/identify", "kind", "magic"), 2, "'magic'"),
            (("/identify", "replace", "maybe"), 2, "'maybe'"),
            (("/identify", "sensor_dely"), 2, "sensor_delay"),
            (("/stage_simulator", "seed", "3"), 2, "seed"),
            (("/nobody", "seed"), 1, "/nobody"),
        ):
            refused = slpi("param", *arguments)
            assert refused.returncode == code and holds(refused.stderr, says)
            assert len(refused.stderr.splitlines()) == 1
        assert slpi("param", "/stage_simulator", "axes").stdout.startswith('axes: ["x", "y"]')
        assert node.process.poll() is None


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("5e7", "DOUBLE", 5e7), ("5", "DOUBLE", 5.0), ("010", "INTEGER", 10), ("2.5", "INTEGER", 2.5),
        ("[1, 2.5]", "DOUBLE_ARRAY", [1.0, 2.5]), ("[1, 2.5]", "DOUBLE", [1.0, 2.5]), (".nan", "DOUBLE", None),
        ("True", "BOOL", True), ("no", "STRING", "no"), ("[x, y, 0123]", "STRING_ARRAY", ["x", "y", "0123"]),
    ],
)  # fmt: skip
def test_a_text_becomes_a_value_of_the_type(text, kind, value):
    found = value_of(text, getattr(ParameterType, f"PARAMETER_{kind}"), "it")
    assert found != found if value is None else (found == value and type(found) is type(value))


@pytest.mark.parametrize(("text", "kind"), [("soon", "DOUBLE"), ("[1, soon]", "DOUBLE_ARRAY"), ("yes", "BOOL")])
def test_a_text_that_is_no_value_of_the_type(text, kind):
    assert holds(refusal(UsageError, value_of, text, getattr(ParameterType, f"PARAMETER_{kind}"), "it"), "it")


def test_of_every_service_it_is_known_what_it_moves():
    sources = [path.read_text() for path in Path(nodes).parent.glob("*.py")]
    offered = {name for source in sources for name in re.findall(r'"~/(\w+)"', source)}
    offered |= {"start", "pause", "stop"}
    assert offered == set(MOVES)
