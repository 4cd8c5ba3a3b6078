"""The layouts for PlotJuggler and Foxglove: every topic, field and value in them exists."""

import json
import re
import xml.etree.ElementTree as ElementTree
from importlib import import_module

import pytest

pytest.importorskip("rclpy")

import yaml  # noqa: E402
from documentation.pages import ROOT  # noqa: E402

CONFIG = ROOT / "config"
TOPICS = {each["name"]: each for each in json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]}
STAGE = yaml.safe_load((CONFIG / "xy.yaml").read_text())["/**"]["ros__parameters"]
VALUES = set(re.findall(r"`([\w.]+)`", (ROOT / "msg_schemas" / "README.md").read_text()))
# Names in a message for an axis, beside the axis itself.
TRACKING = {"/tracking_error": ["mean", "rms", "maximum"]}
STATUS = "/compensator: compensator"


def assert_field(topic, field):
    """Assert that the first type of a topic has a field."""
    name = topic if topic in TOPICS else topic.removeprefix("/")
    package, folder, kind = TOPICS[name]["types"][0].split("/")
    assert field in getattr(import_module(f"{package}.{folder}"), kind).get_fields_and_field_types(), (topic, field)


def assert_value(key):
    """Assert that the compensator reports a value on /diagnostics."""
    axis, _, rest = key.partition(".")
    assert (f"AXIS.{rest}" if axis in STAGE["axes"] else key) in VALUES, key


def plotjuggler_series():
    root = ElementTree.parse(CONFIG / "plotjuggler.xml").getroot()
    computed = {each.get("name") for each in root.iter("snippet")}
    for curve in root.iter("curve"):
        both = [curve.get("curve_x"), curve.get("curve_y")]
        yield from both if all(both) else {curve.get("name")} - computed
    for snippet in root.iter("snippet"):
        yield snippet.find("linked_source").text
        yield from (each.text for each in snippet.find("additional_sources"))
    drawn = {curve.get("name") for curve in root.iter("curve")}
    assert computed <= drawn


def test_plotjuggler():
    found = list(plotjuggler_series())
    for series in found:
        if series.startswith("/diagnostics/"):
            start = f"/diagnostics/{STAGE['hardware_id']}/{STATUS}/"
            assert series.startswith(start)
            assert_value(series.removeprefix(start))
        elif joint := re.fullmatch(r"(/\w+)/([\w.]+)/(position|effort)", series):
            axis, _, value = joint[2].partition(".")
            assert axis in STAGE["axes"]
            assert value in (TRACKING[joint[1]] if value else ("",))
            assert_field(joint[1], joint[3])
        else:
            topic, field, index = re.fullmatch(r"(/\w+)/(\w+)\[(\d+)\]", series).groups()
            assert_field(topic, field)
            assert int(index) < len(STAGE["axes"])
    assert len(found) > 20


def panels_of(layout):
    return {layout} if isinstance(layout, str) else panels_of(layout["first"]) | panels_of(layout["second"])


def test_foxglove():
    document = json.loads((CONFIG / "foxglove.json").read_text())
    assert panels_of(document["layout"]) == set(document["configById"])
    plots = [each for name, each in document["configById"].items() if name.startswith("Plot!")]
    paths = [path["value"] for each in plots for path in [*each["paths"], *filter(None, [each.get("xAxisPath")])]]
    of_status = re.compile(r'/diagnostics\.status\[:\]\{name=="(.+?)"\}\.values\[:\]\{key=="([\w.]+)"\}\.value')
    for path in paths:
        if found := of_status.fullmatch(path):
            assert found[1] == STATUS
            assert_value(found[2])
        else:
            topic, field, index = re.fullmatch(r"(/\w+)\.(\w+)\[(\d+)\]", path).groups()
            assert_field(topic, field)
            assert int(index) < len(STAGE["axes"]) * (1 + len(TRACKING.get(topic, ())))
    assert len(paths) > 15
    summary = document["configById"]["DiagnosticSummary!all"]
    assert summary["topicToRender"] in TOPICS
