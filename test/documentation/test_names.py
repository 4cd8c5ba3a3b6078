"""Every option, parameter, topic and service that the pages name exists in the code."""

import argparse
import json
import re
from functools import cache
from importlib import import_module

import pytest

pytest.importorskip("rclpy")

from documentation.pages import PAGES, README, ROOT  # noqa: E402

from slpi_ros import cli  # noqa: E402

TEXTS = [README, ROOT / "CHANGELOG.rst", ROOT / "msg_schemas" / "README.md", *PAGES]
# Names of other packages, and those that stand for any.
OTHERS = {"commands", "foxglove_bridge", "output_interval", "simulate_fmu", "COMMAND", "NAME"}
# Values that are put together from their parts.
COMPOSED = re.compile(r"(latency|deadline_error)_(p50|p99|max)_us")


def spans(path):
    """Return the code within the lines of a page."""
    text = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)
    return [one[0] or one[1] for one in re.findall(r"``([^`\n]+)``|`([^`\n]+)`", text)]


@cache
def options():
    """Return the options of each command of ``slpi``."""
    (commands,) = (each for each in cli.parser()._actions if isinstance(each, argparse._SubParsersAction))
    return {name: set(parser._option_string_actions) for name, parser in commands.choices.items()}


@cache
def source():
    """Return every word of the code, its schemas and its configuration."""
    folders = ("slpi_ros", "msg_schemas", "launch", "config", "docs/examples", "benchmarks", "demo", "tools")
    endings = (".py", ".json", ".yaml", ".j2", ".sh", ".c", ".h")
    files = [path for each in folders for path in (ROOT / each).rglob("*") if path.suffix in endings]
    files += [ROOT / name for name in ("Makefile", "setup.py", "package.xml")]
    return set(re.findall(r"\w+", "\n".join(path.read_text(errors="replace") for path in files)))


@cache
def parameters():
    """Return the parameters of all nodes, and those that ROS gives every node."""
    nodes = re.findall(r'"(\w+) = slpi_ros\.nodes\.', (ROOT / "setup.py").read_text())
    declared = [each for node in nodes for each in import_module(f"slpi_ros.nodes.{node}").DECLARATIONS]
    return {each.name.split(".")[0] for each in declared} | {"use_sim_time", "qos_overrides", "hardware_id"}


@cache
def arguments():
    """Return the arguments of the launch files."""
    texts = [path.read_text() for path in (ROOT / "launch").glob("*.py")]
    return {name for text in texts for name in re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', text)}


@cache
def services():
    """Return the names of all services and topics."""
    nodes = "\n".join(path.read_text() for path in (ROOT / "slpi_ros" / "nodes").glob("*.py"))
    topics = json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]
    called = re.findall(r'"~/(\w+)"|\("(\w+)", self\._on_', nodes)
    return {one or other for one, other in called} | {each["name"].strip("/") for each in topics}


@cache
def targets():
    """Return the targets of the Makefile that have a rule."""
    rules = re.findall(r"^([a-z][\w -]*):(?!=|.*export)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    return {name for rule in rules for name in rule.split()}


def unknown(span):
    """Return the names in a piece of code that do not exist."""
    command = re.match(r"slpi (\w+)", span)
    if command and command[1] not in options():
        yield command[1]
    if command or span.startswith("--"):
        every = set().union(*options().values())
        for option in re.findall(r"(?<!\S)--[a-z][\w-]*", span):
            if option not in options().get(command[1] if command else "", every):
                yield from () if not command and option[2:].replace("-", "_") in source() else [option]
    if target := re.match(r"make ([a-z][\w-]*)", span):
        yield from () if target[1] in targets() else [target[1]]
    elif ":=" in span:
        for kind, name in re.findall(r"(-[pr] )?([\w.]+):=", span):
            known = services() if kind == "-r " else parameters() | arguments()
            yield from () if name.split(".")[0] in known else [name]
    elif name := re.fullmatch(r"~/(\w+)", span):
        yield from () if name[1] in services() else [name[1]]
    elif re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)+", span) and not COMPOSED.fullmatch(span):
        yield from () if span in source() else [span]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_names_exists(page):
    assert not {(span, name) for span in spans(page) for name in unknown(span) if name not in OTHERS}


def test_what_the_makefile_promises_has_a_rule():
    (phony,) = re.findall(r"^\.PHONY: (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {*phony.split()} - {"FORCE"} == targets()


@pytest.mark.parametrize(
    "span",
    [
        "slpi fit",
        "slpi verify BAG --tolerances 1",
        "--no-such-option",
        "slew_limits:=1",
        "-r x:=y",
        "~/stopp",
        "no_such_name",
        "make bench-nothing",
    ],
)
def test_a_name_that_does_not_exist_is_seen(span):
    assert list(unknown(span))
