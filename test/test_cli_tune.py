"""``slpi tune``: gains that the compensator takes, a page that shows the loop, and refusals in one line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from reports.pages import parsed, trace
from strategies import PI_CASE, axis_model

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.compensator.gains_file import TunedGains
from slpi_ros.compensator.loop_margin import DiscreteLoop, Plant
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.resonance import Resonance
from slpi_ros.model.stage_model import StageModel

X = replace(axis_model(PI_CASE), effects=(Delay(1e-3), Resonance((Mode(120.0, 0.02, 1.0),))))
Y = replace(X, effects=(Delay(2e-3),))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("tuned")
    slpi_ros.save_model(StageModel({"x": X, "y": Y}), made / "xy.json")
    arguments = ("tune", made / "xy.json", "-o", made / "gains.yaml", "--rate", "1500", "--report", made / "report")
    assert main([str(each) for each in arguments]) == 0
    return made


def test_the_compensator_takes_the_file_and_finds_the_loop_stable(folder):
    pytest.importorskip("rclpy")
    from slpi_ros.nodes.compensator_parameters import DECLARATIONS, CompensatorSettings

    text = (folder / "gains.yaml").read_text()
    assert text.startswith("# Gains of a compensator, by slpi tune")
    told = yaml.safe_load(text)["/**"]["ros__parameters"]
    defaults = {entry.name: entry.default for entry in DECLARATIONS}
    settings = CompensatorSettings.of(defaults | {"axes": ["x", "y"]} | told)
    assert settings.period == 1.0 / 1500.0
    read = TunedGains.read(str(folder / "gains.yaml"))
    assert {"x": settings.loops[0].gains, "y": settings.loops[1].gains} == read.axes
    assert len(read.axes["x"].notches) == 1 and read.axes["y"].notches == () and read.rate == 1500.0


def test_the_page_shows_stage_sensitivity_and_step(folder):
    page = parsed(folder / "report" / "report.html")
    assert set(page.charts) == {f"{name}-{axis}" for name in ("bode", "sensitivity", "step") for axis in ("x", "y")}
    frequency, response = trace(page.charts["bode-x"], "model")
    assert frequency[response.argmax()] == pytest.approx(120.0, rel=0.02)
    assert response.max() / response[0] == pytest.approx(25.0, rel=0.05)
    frequency, sensitivity = trace(page.charts["sensitivity-x"], "with these gains")
    bandwidth = float(page.texts["verdict-x"].split(" Hz")[0])
    assert frequency[(sensitivity >= 0.5**0.5).argmax()] == pytest.approx(bandwidth, rel=0.03)
    assert sensitivity.max() <= 2.02
    assert trace(page.charts["step-x"], "error")[1][0] == 100.0


def test_a_model_of_hysteresis_alone_is_told_to_be_no_reason_to_trust_the_loop(tmp_path, capsys):
    slpi_ros.save_model(StageModel({"x": replace(X, effects=()), "y": Y}), tmp_path / "xy.json")
    assert main(["tune", str(tmp_path / "xy.json"), "-o", str(tmp_path / "g.yaml")]) == 0
    warned = [line for line in capsys.readouterr().out.splitlines() if "--for-response" in line]
    assert len(warned) == 1 and warned[0].startswith("axis x")


def test_one_axis_and_json(folder, capsys):
    arguments = ("tune", folder / "xy.json", "-o", folder / "y.yaml", "--axis", "y", "--json", "--margin", "0.6")
    assert main([str(each) for each in arguments]) == 0
    found = json.loads(capsys.readouterr().out)["axes"]
    assert set(found) == {"y"} and found["y"]["modulus_margin"] == pytest.approx(0.6, abs=0.01)
    assert found["y"]["bandwidth_Hz"] > 0.0 and next(iter(found["y"]["limits_Hz"])) in ("delay", "rate")
    # The other axis gets no feedback.
    read = TunedGains.read(str(folder / "y.yaml")).axes
    assert read["x"].integral == 0.0 < read["y"].integral == found["y"]["ki"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--rate", "200"), "120 Hz"), (("--rate", "-5"), "-5"), (("--margin", "1.5"), "1.5"), (("--axis", "q"), "q"),
        (("--rate", "fast"), "fast"),
    ],
)  # fmt: skip
def test_what_cannot_be_tuned_is_told_in_one_line(folder, tmp_path, capsys, arguments, named):
    output = tmp_path / "gains.yaml"
    try:
        code = main(["tune", str(folder / "xy.json"), "-o", str(output), *arguments])
    except SystemExit as end:
        code = end.code
    lines = capsys.readouterr().err.splitlines()
    assert code == 2 and named in lines[-1] and not output.exists()
    assert len(lines) == 1 or "fast" in arguments


def test_a_file_by_somebody_else_and_the_model_stay(folder, tmp_path, capsys):
    other = tmp_path / "gains.yaml"
    other.write_text("/**:\n  ros__parameters:\n    ki: 1.0\n")
    for output in (other, folder / "xy.json"):
        before = output.read_bytes()
        assert main(["tune", str(folder / "xy.json"), "-o", str(output)]) == 2
        assert str(output) in capsys.readouterr().err and output.read_bytes() == before


@pytest.mark.parametrize("stage", ["other", ""])
def test_a_record_of_another_stage_or_without_the_drive(stage, tmp_path, capsys):
    from slpi_ros.io.bag_writer import write_bag
    from slpi_ros.io.record import Record

    slpi_ros.save_model(StageModel({"x": X}, "own"), tmp_path / "m.json")
    one = np.zeros(1)
    write_bag(tmp_path / "bag", Record(np.ones(1, dtype=np.int64), {"x": one}, {"x": one}, hardware_id=stage))
    command = ["tune", str(tmp_path / "m.json"), str(tmp_path / "bag"), "-o", str(tmp_path / "g.yaml")]
    assert main(command) == 1 and not (tmp_path / "g.yaml").exists()
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and ("several stages: 'own' (the model), 'other'" in said) == bool(stage)
    assert ("--for-response" in said) != bool(stage)
    assert main([*command, "--accept-stage", "other"]) == 1
    assert "several stages" not in capsys.readouterr().err


@pytest.mark.long
def test_a_measured_response_is_shown_beside_the_model_and_used(folder, tmp_path, capsys):
    """From the drive to the page: a stage whose mode is elsewhere than the model says."""
    from slpi_ros.io.bag_writer import write_bag
    from slpi_ros.io.record import Record
    from slpi_ros.io.tables import read_table
    from slpi_ros.simulation.axis import SimulatedAxis
    from slpi_ros.simulation.character import Character
    from slpi_ros.simulation.parameters import AxisParameters

    drive = tmp_path / "drive.csv"
    limits = ("--voltage-min", "0", "--voltage-max", "100", "--rate", "1000", "--duration", "20")
    assert main(["excite", "-o", str(drive), "--for-response", *limits]) == 0
    assert main(["excite", "-o", str(drive), "--for-response", "--for", "creep", *limits]) == 2
    t, voltage = read_table(str(drive), "V")
    stage = SimulatedAxis(AxisParameters.random(4), 1, Character(delay=1e-3, resonance=100.0, damping=0.02))
    _, y = stage.run(t, voltage["x"])
    write_bag(tmp_path / "bag", Record((t * 1e9).astype(int), {"x": voltage["x"]}, {"x": y}, "bag"))
    arguments = [
        folder / "xy.json",
        tmp_path / "bag",
        "-o",
        tmp_path / "g.yaml",
        "--axis",
        "x",
        "--report",
        tmp_path / "r",
    ]
    capsys.readouterr()
    assert main([str(each) for each in ("tune", *arguments, "--rate", "1500")]) == 0
    said = capsys.readouterr().out
    band = said.split("agree from ")[1].split(" Hz")[0].split(" to ")
    assert float(band[0]) < 2.0 and 20.0 < float(band[1]) < 110.0
    page = parsed(tmp_path / "r" / "report.html")
    frequency, response = trace(page.charts["bode-x"], "measured")
    assert frequency[response.argmax()] == pytest.approx(100.0, rel=0.05)
    # The mode that was measured is one of those the loop bears.
    true = Plant.of(replace(X, effects=(Delay(1e-3), Resonance((Mode(100.0, 0.02, 1.0),)))))
    before, after = (
        DiscreteLoop(true, TunedGains.read(str(path)).axes["x"], 1.0 / 1500.0).margins.modulus
        for path in (folder / "gains.yaml", tmp_path / "g.yaml")
    )
    assert after > before + 0.02
    # A record of something else is refused, and so is one bag too many.
    write_bag(tmp_path / "other", Record((t * 1e9).astype(int), {"x": 50.0 + 0.0 * t}, {"x": y}, "other"))
    assert main(["tune", str(folder / "xy.json"), str(tmp_path / "other"), "-o", str(tmp_path / "g.yaml")]) == 1
    assert "--for-response" in capsys.readouterr().err
