"""What every node program says of itself, without starting ROS."""

import json
import re
from importlib import import_module
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy")

from slpi_ros.nodes import parameters, start  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = re.findall(r'"(\w+) = slpi_ros\.nodes\.', (ROOT / "setup.py").read_text())
TOPICS = json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]


@pytest.mark.parametrize("option", ["--help", "-h"])
@pytest.mark.parametrize("name", PROGRAMS)
def test_help_tells_topics_and_parameters_and_starts_nothing(name, option, monkeypatch, capsys):
    module = import_module(f"slpi_ros.nodes.{name}")
    monkeypatch.setattr("sys.argv", [name, option])
    monkeypatch.setattr(rclpy, "init", None)
    assert getattr(start, name)() == 0
    said = capsys.readouterr()
    assert not said.err and said.out.startswith(f"usage: ros2 run slpi_ros {name} ")
    # Only what is in two columns: topics and parameters.
    heads = re.findall(r"^  (\S+) \((\w+)", said.out, re.MULTILINE)
    topics = [(each["name"], way) for each in TOPICS for way, role in (("in", "subscribers"), ("out", "publishers"))
              if name in each[role]]  # fmt: skip
    assert heads == [*topics, *((each.name, "default") for each in module.DECLARATIONS)]
    # It speaks the protocol of its device, and no topic.
    assert topics or name == "device_simulator"
    assert all(line.isprintable() and len(line) <= 120 for line in said.out.splitlines())
    assert "``" not in said.out and "DECLARATIONS" not in said.out


@pytest.mark.parametrize("name", PROGRAMS)
def test_every_parameter_has_a_description(name):
    for each in import_module(f"slpi_ros.nodes.{name}").DECLARATIONS:
        assert each.description.endswith(".") and each.descriptor().description == each.description


def test_parameters_are_declared_in_the_tables_only():
    files = {path for path in (ROOT / "slpi_ros").rglob("*.py") if "declare_parameter(" in path.read_text()}
    assert files == {Path(parameters.__file__).resolve()}
