"""The policy of who may speak, the table of topics, and what is installed: they agree."""

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

CHECKOUT = Path(__file__).resolve().parents[1]
TOPICS = json.loads((CHECKOUT / "msg_schemas" / "topics.json").read_text())["topics"]
POLICY = ElementTree.parse(CHECKOUT / "config" / "security_policy.xml").getroot()
# What every node of ROS 2 has, and the lifecycle.
OF_ROS = {"/rosout", "/parameter_events", "/clock", "~/transition_event"}
# Stand-ins for nodes of the user.
OTHERS = {"planner", "stage_driver", "operator"}


def allowed(what: str, names: str, verb: str) -> dict[str, set[str]]:
    """Return what each enclave may publish, subscribe, request or reply."""
    found = {}
    for profile in POLICY.iter("profile"):
        lists = [each for each in profile.findall(names) if each.get(verb) == "ALLOW"]
        found[profile.get("node")] = {entry.text for each in lists for entry in each.findall(what)}
    return found


def test_the_topics_of_each_node_are_those_of_the_table():
    for verb, side in (("publish", "publishers"), ("subscribe", "subscribers")):
        policy = allowed("topic", "topics", verb)
        for node in policy.keys() - OTHERS:
            table = {topic["name"] for topic in TOPICS if node in topic[side]}
            assert policy[node] - OF_ROS == table, (node, verb)
        assert {node for topic in TOPICS for node in topic[side]} <= policy.keys()


def test_nobody_else_decides_over_hardware():
    publishers = allowed("topic", "topics", "publish")
    for topic in ("voltage_command", "stage_model"):
        (nodes,) = ({*each["publishers"]} for each in TOPICS if each["name"] == topic)
        assert {node for node, names in publishers.items() if topic in names} == nodes
    callers = {node for node, names in allowed("service", "services", "request").items() if names}
    assert callers == {"operator"}


def test_nothing_is_allowed_by_pattern():
    assert not [element for element in POLICY.iter() if "*" in (element.text or "") or "*" in str(element.attrib)]
    enclaves = [enclave.get("path") for enclave in POLICY.iter("enclave")]
    assert len(set(enclaves)) == len(enclaves) == len(list(POLICY.iter("profile")))


def test_every_pinned_package_has_a_licence():
    lock = (CHECKOUT / "requirements" / "lock.txt").read_text()
    pins = re.findall(r"^([\w.-]+)==\S+", lock, re.MULTILINE)
    # Every pin has the hashes of its files.
    assert len(re.findall(r"^[\w.-]+==\S+ \\\n    --hash=sha256:[0-9a-f]{64}", lock, re.MULTILINE)) == len(pins)
    rows = list(csv.DictReader((CHECKOUT / "requirements" / "licences.csv").open()))
    assert [row["package"] for row in rows] == pins
    assert all(row["licence"] for row in rows)
