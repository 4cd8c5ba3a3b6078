"""``--with`` from end to end: identify, verify, refit, diagnose, fleet and the job of the identify node on bags."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bag_makers import STORE, header, joint_state, rosbags_bag
from diagnosis.test_surroundings import DECOY, TOPIC, record
from refusals import holds

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.nodes.jobs import FitRequest, fit

pytestmark = pytest.mark.slow

GAIN = 2e-7
DEGREES = "sensor_msgs/msg/Temperature"


def written(path, one):
    """Write a record with what its sensors say as temperatures, in a bag that rosbags writes."""
    origin = int(one.time_ns[0])
    signals = zip(one.time_ns.tolist(), one.voltage["x"].tolist(), one.displacement["x"].tolist(), strict=True)
    topics = {"/stage_state": [(at, joint_state(at, ("x",), (y,), (v,), "stage")) for at, v, y in signals]}
    for topic, (t, values) in one.surroundings.items():
        stamps = origin + np.round(t * 1e9).astype(np.int64)
        topics[topic] = [
            (at, STORE.types[DEGREES](header=header(at), temperature=value, variance=0.0))
            for at, value in zip(stamps.tolist(), values.tolist(), strict=True)
        ]
    return str(rosbags_bag(path, topics))


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """Bags of two days of a stage whose zero follows the temperature."""
    folder = tmp_path_factory.mktemp("bags")
    return [written(folder / f"day{day}", record(offset=GAIN, since=500.0 * day)) for day in range(2)]


def said(capsys, *words):
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return code, out, err


def gain_of(model):
    (effect,) = slpi_ros.load_model(model).axes["x"].effects
    (one,) = effect.quantities
    assert one.topic == TOPIC
    return one.offset_gain


@pytest.fixture(scope="module")
def followed(bags, tmp_path_factory):
    """A model of the first day that follows the temperature."""
    model = tmp_path_factory.mktemp("model") / "model.json"
    assert main(["identify", bags[0], "--with", TOPIC, "-o", str(model)]) == 0
    return model


def test_identified_and_judged_on_another_day(bags, followed, tmp_path, capsys):
    assert gain_of(followed) == pytest.approx(GAIN, rel=0.1)
    plain, errors = tmp_path / "plain.json", {}
    assert said(capsys, "identify", bags[0], "-o", plain)[0] == 0
    for model in (followed, plain):
        folder = tmp_path / f"judged-{model.stem}"
        words = "--tolerance", "0.05", "--without-offset", "-o", folder
        code, *_ = said(capsys, "verify", bags[1], "--model", model, *words)
        assert code == (0 if model is followed else 1)
        errors[model] = json.loads((folder / "verification.json").read_text())["axes"]["x"]["rest_rms_m"]
    assert 8 * errors[followed] < errors[plain]


def test_a_refit_keeps_what_the_stage_follows(bags, followed, tmp_path, capsys):
    again = tmp_path / "again.json"
    assert said(capsys, "refit", followed, bags[1], "-o", again)[0] == 0
    assert gain_of(again) == pytest.approx(GAIN, rel=0.1)


def test_the_identify_node_and_the_fleet_follow_it_too(bags, followed, tmp_path, capsys):
    by_node = tmp_path / "node.json"
    outcome = fit(FitRequest((bags[0],), "/stage_state", "slpi", None, None, "", surroundings=(TOPIC,)))
    assert not outcome.error
    by_node.write_text(outcome.document)
    assert gain_of(by_node) == pytest.approx(gain_of(followed), rel=1e-9)
    results = tmp_path / "fleet"
    assert said(capsys, "fleet", *bags, "-o", results, "--with", TOPIC)[0] == 0
    (model,) = (results / "models").rglob("*.json")
    assert gain_of(model) == pytest.approx(gain_of(followed), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "why"),
    [("/room/nothing", "/room/nothing"), (f"{TOPIC}:pressure", "pressure")],
)
def test_a_quantity_that_is_not_there_is_refused_in_a_line(name, why, bags, tmp_path, capsys):
    code, _, err = said(capsys, "identify", bags[0], "--with", name, "-o", tmp_path / "model.json")
    assert code in (1, 2) and err.count("\n") == 1
    assert holds(err, why, "--with") or why in err
    assert not (tmp_path / "model.json").exists()
    outcome = fit(FitRequest((bags[0],), "/stage_state", "slpi", None, None, "", surroundings=(name,)))
    assert why in outcome.error


def test_only_the_named_ones_are_looked_at(bags, followed, tmp_path, capsys):
    plain, found = tmp_path / "plain.json", tmp_path / "found"
    assert said(capsys, "identify", bags[0], "-o", plain)[0] == 0
    assert said(capsys, "diagnose", bags[0], "--model", plain, "--with", DECOY, "-o", found)[0] == 0
    (axis,) = json.loads((found / "diagnosis.json").read_text())["axes"].values()
    assert axis["looked_at"] == [DECOY]


@pytest.fixture(scope="module")
def poor(tmp_path_factory):
    """A bag with quantities that cannot be used: of two readings, of half the time, of another time, and constant."""
    one = record(offset=GAIN, since=250.0)
    t, values = one.surroundings[TOPIC]
    half, constant = t.size // 2, np.full(t.size, 21.0)
    courses = {
        "/two": (t[[0, -1]], values[[0, -1]]), "/half": (t[:half], values[:half]), "/out": (t + 5000.0, values),
        "/still": (t, constant), TOPIC: (t, values),
    }  # fmt: skip
    return written(tmp_path_factory.mktemp("poor") / "bag", replace(one, surroundings=courses))


POOR = {"/two": "2 readings", "/half": "its readings go from", "/out": "its readings go from", "/still": "stays at 21"}


@pytest.mark.parametrize("name", POOR)
def test_a_named_quantity_that_cannot_be_used_is_told(name, poor, tmp_path, capsys):
    command = "identify", poor, "-o", tmp_path / "model.json", "--with"
    code, _, err = said(capsys, *command, name)
    assert code == 1 and err.count("\n") == 1 and f"{name} is not used" in err and POOR[name] in err
    code, _, err = said(capsys, *command, name, TOPIC)
    assert code == 0 and f"{name} is not used: " in err and POOR[name] in err
    assert gain_of(tmp_path / "model.json") == pytest.approx(GAIN, rel=0.1)


def test_a_verification_tells_what_the_model_does_not_follow(poor, followed, tmp_path, capsys):
    for command in (("verify", poor, "--model", followed), ("refit", followed, poor, "-o", tmp_path / "new.json")):
        code, _, err = said(capsys, *command, "--with", "/two")
        assert code == 1 and err.count("\n") == 1 and holds(err, "/two is not used", TOPIC)
        code, _, err = said(capsys, *command, "--with", "/two", TOPIC)
        assert code == 0 and "/two is not used: the model does not follow it" in err
        assert said(capsys, *command)[2] == ""
