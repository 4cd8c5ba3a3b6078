"""The documentation site: it builds without a warning, and what it says exists."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import import_module
from typing import get_args
from urllib.parse import unquote

import pytest

pytest.importorskip("rclpy")

from documentation.pages import DOCS, PAGES, README, ROOT, commands_of  # noqa: E402

from slpi_ros import cli  # noqa: E402
from slpi_ros.effects.base import Side  # noqa: E402
from slpi_ros.effects.registry import EFFECTS  # noqa: E402

PATHS = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
SHOWN = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}


class Page(HTMLParser):
    """The anchors, links and resources of a built page."""

    def __init__(self, path):
        super().__init__()
        self.anchors, self.links, self.resources = set(), [], []
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag in SHOWN and given.get(SHOWN[tag]):
            self.resources.append(given[SHOWN[tag]])


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_its_links_lead_somewhere(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-E", "-W", "--keep-going", "-q", "-d", tmp_path / "state", DOCS]
    built = tmp_path / "html"
    ended = subprocess.run([*command, built], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert ended.returncode == 0, ended.stdout
    pages = {path: Page(path) for path in built.rglob("*.html")}
    assert len(pages) >= len(PAGES)
    lost, fetched = [], []
    for path, page in pages.items():
        fetched += [(path.name, one) for one in page.resources if re.match(r"(\w+:)?//", one)]
        for link in page.links:
            if re.match(r"\w+:", link):
                continue
            name, _, anchor = unquote(link).partition("#")
            there = (path.parent / name).resolve() if name else path
            if not there.exists() or anchor and there in pages and anchor not in pages[there].anchors:
                lost.append((path.name, link))
    assert not lost
    assert not fetched


def test_links_out_of_the_site_lead_to_files_of_the_repository():
    for page in PAGES:
        for name in re.findall(r"\]\((\.\./[\w./-]+)(?:#[\w-]+)?\)", page.read_text()):
            assert (page.parent / name).exists(), (page, name)


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_is_one_that_the_programs_take(page):
    for words in commands_of(page, "bash", "console"):
        if words[0] == "slpi" and words[1:] != ["--help"]:
            cli.parser().parse_args(words[1:])
        if words[:3] == ["ros2", "run", "slpi_ros"]:
            check_node(words[3], words[4:])
        if words[:3] == ["ros2", "launch", "slpi_ros"]:
            launch = (ROOT / "launch" / words[3]).read_text()
            declared = set(re.findall(r'DeclareLaunchArgument\(\s*"(\w+)"', launch))
            assert {word.partition(":=")[0] for word in words[4:]} <= declared


def check_node(name, words):
    """Assert that a node has the parameters that a command sets."""
    declared = {each.name for each in import_module(f"slpi_ros.nodes.{name}").DECLARATIONS} | {"hardware_id"}
    assert words[:1] in ([], ["--ros-args"])
    for option, value in zip(words[1::2], words[2::2], strict=True):
        assert option in ("-p", "-r", "--params-file")
        if option == "-p":
            parameter = value.partition(":=")[0]
            assert parameter in declared or parameter.startswith("qos_overrides./"), (name, parameter)


def test_the_nodes_page_has_every_node_and_service():
    text = (DOCS / "reference" / "nodes.md").read_text()
    programs = re.findall(r'"(\w+) = slpi_ros\.nodes\.', (ROOT / "setup.py").read_text())
    assert programs
    for name in programs:
        assert f"\n## {name}\n" in text
        section = text.split(f"\n## {name}\n")[1].split("\n## ")[0]
        source = (ROOT / "slpi_ros" / "nodes" / f"{name}.py").read_text()
        for service in set(re.findall(r'"(~/\w+)"', source)):
            assert f"`{service}`" in section, (name, service)


def test_the_page_of_parameters_has_those_of_every_node():
    command = [sys.executable, "-c", "import generated; print(generated.parameters())"]
    said = subprocess.run(
        command, cwd=DOCS, stdout=subprocess.PIPE, text=True, check=True, env=os.environ | PATHS
    ).stdout
    programs = re.findall(r'"(\w+) = slpi_ros\.nodes\.', (ROOT / "setup.py").read_text())
    assert len(programs) >= 8 and re.findall(r"^## (\w+)$", said, re.MULTILINE) == sorted(programs)


def test_the_page_of_motions_has_the_table_of_the_code():
    assert "\n<!-- generated: motions -->\n" in (DOCS / "reference" / "motions.md").read_text()
    command = [sys.executable, "-c", "import generated; print(generated.motions())"]
    said = subprocess.run(
        command, cwd=DOCS, stdout=subprocess.PIPE, text=True, check=True, env=os.environ | PATHS
    ).stdout
    rows = {row.split("|")[1].strip(): row.split("|")[3].strip() for row in said.splitlines()[2:]}
    assert rows["`block`"] == "`idle`, `fault`" and rows["`fault`"] == "`idle`" and rows["`hold`"] == "any"


def test_the_diagnosis_page_has_the_table_of_all_effects():
    page = (DOCS / "explanation" / "diagnosis.md").read_text()
    listed = re.search(r"\n<!-- generated: effects -->\n(\*In these files: .+\*)\n", page)
    assert listed
    assert re.findall(r"`(\w+)`", listed[1]) == sorted(
        EFFECTS, key=lambda name: get_args(Side).index(EFFECTS[name].side)
    )


def test_the_values_of_diagnostics_on_the_pages_exist():
    said = (ROOT / "msg_schemas" / "README.md").read_text()
    for page in PAGES:
        for name in re.findall(r"`(AXIS\.\w+)`", page.read_text()):
            assert f"`{name}`" in said, (page.name, name)


def test_the_example_of_ros2_control_agrees_with_the_compensator():
    import yaml

    from slpi_ros.nodes.compensator_parameters import DECLARATIONS

    given = yaml.safe_load((DOCS / "examples" / "controllers.yaml").read_text())
    ours = given["compensator"]["ros__parameters"]
    assert ours.keys() <= {each.name for each in DECLARATIONS}
    controller = given["voltage_controller"]["ros__parameters"]
    assert controller["joints"] == ours["axes"]
    assert given["controller_manager"]["ros__parameters"].keys() >= {"voltage_controller", "joint_state_broadcaster"}
    launch = (DOCS / "examples" / "ros2_control.launch.py").read_text()
    topics = {each["name"] for each in json.loads((ROOT / "msg_schemas" / "topics.json").read_text())["topics"]}
    assert set(re.findall(r'\("(\w+)", "/', launch)) <= topics
    compile(launch, "ros2_control.launch.py", "exec")


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_beside_each_ros2_line_that_calls_or_sets_is_one_without_it(page):
    text = page.read_text()
    for node, service in re.findall(r"ros2 service call (/[\w/]+)/(\w+)", text):
        assert f"slpi call {node} {service}" in text
    for node, name in re.findall(r"ros2 param set (/\w+) (\w+)", text):
        assert f"slpi param {node} {name}" in text


def test_nothing_moves_in_a_tutorial_before_its_limits_are_given():
    for page in (DOCS / "tutorials").glob("*.md"):
        for words in commands_of(page, "bash", "console"):
            assert "/voltage_command" not in words, "a raw voltage keeps no limit"
