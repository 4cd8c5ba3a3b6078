"""``slpi learn`` where bags, model and what was learned before are of different axes or stages: one line, no change."""

from dataclasses import replace

import numpy as np
import pytest
from identification.records import calibration

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record
from slpi_ros.io.tables import read_table, write_table

RATE, SIZE, PASSES = 500.0, 200, 4
T = np.arange(SIZE) / RATE
Y = 10e-6 - 3e-6 * np.cos(2 * np.pi * np.arange(SIZE) / SIZE)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    file = tmp_path_factory.mktemp("model") / "model.json"
    one = slpi_ros.identify(calibration(seed=1)[0], "pi")
    axes = {"x": one.axes["x"], "y": one.axes["x"]}
    slpi_ros.save_model(replace(one, axes=axes, hardware_id="one"), file)
    return file


def bag_of(folder, axes, stage="one", day=0):
    """Write a bag of some passes of one path, without a pause."""
    rng = np.random.default_rng(day)
    t = np.arange(PASSES * SIZE) / RATE
    y = {axis: np.tile(Y, PASSES) + 20e-9 + rng.normal(0.0, 3e-9, t.size) for axis in axes}
    time_ns = 10**18 + day * 10**12 + np.round(1e9 * t).astype(np.int64)
    write_bag(folder, Record(time_ns, {axis: np.full(t.size, 50.0) for axis in axes}, y, hardware_id=stage))
    return str(folder)


def words(model, tmp_path, axes=None):
    """Return the options; `axes`: those whose desired path is given."""
    found = ["--model", str(model), "--period", str(SIZE / RATE)]
    found += ["--learned", str(tmp_path / "learned.json"), "-o", str(tmp_path / "next.csv")]
    if axes:
        write_table(tmp_path / "desired.csv", T, dict.fromkeys(axes, Y), "m")
        found += ["--desired", str(tmp_path / "desired.csv")]
    return found


@pytest.mark.parametrize(
    ("learned", "bag", "chosen", "what"),
    [
        ("xy", "x", (), "'y' is not in all of the bags and the model"),
        ("xy", "xy", ("x",), "'y' is not chosen"),
        ("x", "xy", ("x", "y"), "not of 'y', which is chosen"),
    ],
)
def test_axes_that_were_not_learned_or_are_not_there_are_told(learned, bag, chosen, what, model, tmp_path, capsys):
    first, second = bag_of(tmp_path / "first", "xy"), bag_of(tmp_path / "second", bag, day=1)
    assert main(["learn", first, *words(model, tmp_path, learned)]) == 0
    before = (tmp_path / "learned.json").read_bytes()
    capsys.readouterr()
    axes = ["--axis", *chosen] if chosen else []
    assert main(["learn", second, *words(model, tmp_path), *axes]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and what in said and "learned.json" in said
    assert (tmp_path / "learned.json").read_bytes() == before


def test_without_a_choice_the_learned_axes_go_on(model, tmp_path):
    for day, given in enumerate(("x", "")):
        bag = bag_of(tmp_path / f"bag{day}", "xy", day=day)
        assert main(["learn", bag, *words(model, tmp_path, given)]) == 0
    assert read_table(tmp_path / "next.csv", "m")[1].keys() == {"x"}


def test_a_chosen_axis_that_a_bag_lacks_is_told(model, tmp_path, capsys):
    bag = bag_of(tmp_path / "bag", "x")
    assert main(["learn", bag, *words(model, tmp_path, "xy"), "--axis", "x", "y"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no axis 'y'" in said


def test_a_bag_of_another_stage_is_refused_unless_it_is_accepted(model, tmp_path, capsys):
    bag = bag_of(tmp_path / "bag", "x", stage="two")
    assert main(["learn", bag, *words(model, tmp_path, "x")]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "'one'" in said and "'two'" in said
    assert not (tmp_path / "next.csv").exists()
    assert main(["learn", bag, *words(model, tmp_path, "x"), "--accept-stage", "two"]) == 0
