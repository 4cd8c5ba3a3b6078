"""The command ``slpi export``: its files, its limits, and what it refuses."""

import json
import subprocess

import numpy as np
import pytest
from export.built import compiler
from export.stages import EVERY, one_axis, two_axes

from slpi_ros import save_model
from slpi_ros.cli import main
from slpi_ros.effects.contact import Contact

FILES = {"slpi_inverse.h", "slpi_inverse.c", "slpi_test.c"}


@pytest.fixture
def model(tmp_path):
    save_model(two_axes(), tmp_path / "model.json")
    return str(tmp_path / "model.json")


def test_its_files_build_and_pass(model, tmp_path, capsys):
    out = tmp_path / "c"
    limits = ["--voltage-min", "5", "--voltage-max", "80", "--slew-limit", "2000", "--axis", "x", "--json"]
    assert main(["export", model, "-o", str(out), *limits]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {path.name for path in out.iterdir()} == FILES == set(said["files"])
    assert said["axes"]["x"]["voltage_range_V"] == [5.0, 80.0] and list(said["axes"]) == ["x"]
    assert ".slew = R(2000.0)" in (out / "slpi_inverse.c").read_text()
    command = [compiler(), "-std=c11", "-O1", "slpi_inverse.c", "slpi_test.c", "-lm", "-o", "slpi_test"]
    assert not subprocess.run(command, cwd=out).returncode
    assert not subprocess.run([out / "slpi_test"], stdout=subprocess.DEVNULL).returncode
    # What it wrote itself it replaces.
    assert main(["export", model, "-o", str(out)]) == 0


def test_the_vectors_show_the_limits(model, tmp_path):
    from slpi_ros.export.stage import ExportedStage
    from slpi_ros.export.vectors import vectors
    from slpi_ros.model.limits import Limits

    found = vectors(ExportedStage.of(two_axes(), Limits(5.0, 80.0, 500.0)), 300)
    assert found.volts.min() >= 5.0 and found.volts.max() <= 80.0
    # The time of a step that is refused because of its displacement is added to the next.
    taken, t = found.codes == 0, np.cumsum(np.where(found.codes == 1, 0.0, found.dt))
    moved = np.abs(np.diff(found.volts[taken], axis=0)).max(axis=1)
    assert (moved <= 500.0 * np.minimum(np.diff(t[taken]), 0.1) + 1e-9).all()


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--axis", "z"], 2),
        (["--slew-limit", "-1"], 2),
        (["--slew-limit", "nan"], 2),
        (["--voltage-min", "200"], 2),
        (["--voltage-min", "50", "--voltage-max", "20"], 2),
        (["--voltage-min", "20", "--voltage-max", "20"], 2),
        (["--voltage-max", "0"], 2),
        (["--target", "fortran"], 2),
    ],
)
def test_what_it_refuses_takes_one_line(model, tmp_path, capsys, options, code):
    try:
        found = main(["export", model, "-o", str(tmp_path / "c"), *options])
    except SystemExit as exit_:
        found = exit_.code
    assert found == code
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "c").exists()


def test_a_model_that_reaches_nothing_is_refused(tmp_path, capsys):
    save_model(one_axis("slpi", (Contact(0.0, 1e-9),)), tmp_path / "model.json")
    assert main(["export", str(tmp_path / "model.json"), "-o", str(tmp_path / "c")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1 and not (tmp_path / "c").exists()


def test_foreign_files_are_not_replaced(model, tmp_path, capsys):
    out = tmp_path / "c"
    out.mkdir()
    (out / "slpi_inverse.c").write_text("int mine;\n")
    assert main(["export", model, "-o", str(out)]) == 2
    assert (out / "slpi_inverse.c").read_text() == "int mine;\n"
    assert [path.name for path in out.iterdir()] == ["slpi_inverse.c"]
    assert main(["export", model, "-o", str(out), "--overwrite"]) == 0
    assert "replaced" in capsys.readouterr().err


def test_a_file_in_the_way_of_the_folder_is_an_error_of_one_line(model, tmp_path, capsys):
    (tmp_path / "c").write_text("")
    assert main(["export", model, "-o", str(tmp_path / "c")]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.long
def test_units_are_written(tmp_path, capsys):
    save_model(one_axis("pi", EVERY[:2]), tmp_path / "model.json")
    out = tmp_path / "units"
    assert main(["export", str(tmp_path / "model.json"), "-o", str(out), "--target", "fmu"]) == 0
    assert len(list(out.glob("*.fmu"))) == 4
    assert main(["export", str(tmp_path / "model.json"), "-o", str(out), "--target", "fmu"]) == 0
    capsys.readouterr()
