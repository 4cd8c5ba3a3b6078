"""README: its links lead somewhere, its commands are run, and what is not run is listed here with the reason."""

import re
import shutil

import pytest

pytest.importorskip("rclpy")

from documentation.pages import README, Reader, commands_of  # noqa: E402

# Run here, in this order, and in test/nodes/test_readme_steps.py.
SELF_CALIBRATED = ["stage_simulator", "calibrator", "slpi show", "slpi verify", "slpi diagnose", "slpi refit"]
BY_HAND = ["stage_simulator", "recorder", "exciter", "slpi identify", "compensator", "ros2 topic pub"]
NOT_RUN = {
    "make demo": "minutes of a whole demo",
    "make test": "runs this test",
    "make build": "has been run before any test of a node",
    "source install/setup.bash": "has been run before any test of a node",
    "export PATH": "the tests have a PATH of their own",
    "slpi import measured.csv": "a table of the reader's: test_tutorials.py runs the commands on one",
    "slpi import later.csv": "the same",
    "slpi identify my_bag": "the same",
    "slpi diagnose my_bag": "the same",
    "slpi verify another_bag": "the same",
    "slpi compensate diagnosis/extended_model.json": "the same",
    "ros2 run slpi_ros exciter": "run below by hand, with another seed",
    "ros2 bag record /stage_state -o": "rosbag2 has no wheels: the recorder does the same",
}
# The stage moves faster than in life, and the clock of the other nodes is its own.
FASTER = {"stage_simulator": "-p speed:=2.0 -p rate:=100.0", "calibrator": "-p use_sim_time:=true -p rate:=100.0"}


def command(words):
    """Return the only command of the page for these words."""
    all_of_them = [line for line in blocks("bash") if line.removeprefix("ros2 run slpi_ros ").startswith(words)]
    assert len(all_of_them) == 1, (words, all_of_them)
    return all_of_them[0]


def blocks(language):
    found = re.findall(rf"^```{language}\n(.*?)^```$", README.read_text(), re.DOTALL | re.MULTILINE)
    return [line.partition(" #")[0].strip() for block in found for line in block.splitlines()]


def test_every_command_is_run_or_has_a_reason_why_not():
    assert {command(words) for words in SELF_CALIBRATED + BY_HAND} == set(blocks("bash"))
    not_run = [next((known for known in NOT_RUN if line.startswith(known)), line) for line in blocks("console")]
    assert sorted(not_run) == sorted(NOT_RUN)
    assert not re.search(r"^```(?!bash$|console$|$)", README.read_text(), re.MULTILINE)
    assert len(commands_of(README, "bash", "console")) == len(blocks("bash")) + len(blocks("console"))


def test_it_is_read_in_five_minutes():
    assert len(README.read_text().splitlines()) <= 180


def test_links_lead_to_files_and_headings():
    for name, anchor in re.findall(r"\]\((?!\w+:)([\w./-]+)(?:#([\w-]+))?\)", README.read_text()):
        page = README.parent / name
        assert page.exists(), name
        headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE) if anchor else []
        assert not anchor or anchor in [re.sub(r"[^\w -]", "", one).lower().replace(" ", "-") for one in headings]


@pytest.mark.slow
@pytest.mark.long
def test_a_stage_calibrates_itself_and_is_verified_diagnosed_and_refitted(tmp_path, installed):
    installed("calibrator")
    reader = Reader(tmp_path)
    try:
        for words in SELF_CALIBRATED:
            if words == "slpi verify":
                # The record of a verification stands for that of the next week.
                last = max(path for path in (tmp_path / "my_stage").iterdir() if "verif" in path.name)
                shutil.copytree(last, tmp_path / "today")
            reader.type(f"{command(words)} {FASTER.get(words, '')}", patience=1800.0)
        reader.check_alive()
    finally:
        reader.close()
    for name in ("my_stage/report.html", "verification/report.html", "diagnosis/extended_model.json"):
        assert (tmp_path / name).exists(), name
