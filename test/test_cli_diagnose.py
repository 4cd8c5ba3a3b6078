"""`slpi diagnose` as a user meets it: bags in, a verdict, three files and a page out."""

import io
import json
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from reports.browser import Browser

import slpi_ros
from benchmarks.hidden import hide
from slpi_ros.cli import main
from slpi_ros.diagnosis.result import AMBIGUOUS, AxisDiagnosis, Diagnosis, NamedEffect, RecordOutcome, Traces
from slpi_ros.effects.lag import Lag
from slpi_ros.errors import length
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.record import Record

pytestmark = pytest.mark.slow

SCHEMA = Path(__file__).resolve().parents[1] / "msg_schemas" / "diagnosis.schema.json"
FILES = {"diagnosis.json", "extended_model.json", "report.html"}
SAMPLES, NOISE = 3000, 10e-9


@pytest.fixture(scope="module")
def hidden():
    """Return a stage whose sensor has begun to hum."""
    return hide(2, ["hum"], size=10.0, axes=1, samples=SAMPLES)


@pytest.fixture(scope="module")
def clean(hidden):
    """Return what the same drive gave before."""
    noise = NOISE * np.random.default_rng(1).standard_normal(len(hidden.record))
    return replace(hidden.record, displacement={"x": hidden.clean["x"] + noise}, hardware_id="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, hidden, clean):
    """Return a folder with the bags ``hum`` and ``clean``, and the model of the clean one."""
    folder = tmp_path_factory.mktemp("diagnose")
    write_bag(folder / "hum", hidden.record)
    write_bag(folder / "clean", clean)
    slpi_ros.save_model(slpi_ros.identify(clean), folder / "model.json")
    return folder


@pytest.fixture(scope="module")
def diagnosed(folder):
    """Return what a real process says of the bag with the hum; its files are in ``out``."""
    command = [sys.executable, "-m", "slpi_ros.cli", "diagnose", folder / "hum"]
    options = ["--model", folder / "model.json", "-o", folder / "out"]
    return subprocess.run([*map(str, command + options)], capture_output=True, text=True, timeout=300)


@pytest.fixture
def slpi(capsys, monkeypatch):
    """Return a function that runs the command line here: exit code, what it said, what it complained about."""
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)

    def run(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        return (code, *capsys.readouterr())

    return run


@pytest.fixture
def diagnose(slpi, folder, tmp_path):
    """Return a function that diagnoses a record by the model of the clean bag, into ``tmp_path / out``."""

    def run(record, *options):
        write_bag(tmp_path / "bag", record)
        return slpi("diagnose", tmp_path / "bag", "--model", folder / "model.json", "-o", tmp_path / "out", *options)

    return run


def document_in(folder):
    document = json.loads((folder / "diagnosis.json").read_text())
    jsonschema.validate(document, json.loads(SCHEMA.read_text()))
    assert {path.name for path in folder.iterdir()} == FILES
    return document


def test_a_hidden_hum_is_named_and_mended(folder, hidden, diagnosed):
    assert (diagnosed.returncode, diagnosed.stderr) == (0, "")
    found = document_in(folder / "out")["axes"]["x"]
    (truth,) = hidden.truth
    assert found["verdict"] == "named" and [effect["name"] for effect in found["effects"]] == ["hum"]
    parameters = found["effects"][0]["parameters"]
    assert parameters["lines"][0]["frequency"] == pytest.approx(truth.parameters["frequency"], rel=1e-2)
    assert parameters["lines"][0]["amplitude"] == pytest.approx(truth.parameters["amplitude"], rel=0.1)
    told = diagnosed.stdout.splitlines()
    assert told[0].startswith("ERROR SOURCES: axis x: hum ")
    assert told[1] == "axis x: verdict: named" and told[2] == f"axis x: {found['summary']}"
    assert told[3] == f"axis x: hum: {found['effects'][0]['evidence']}"
    assert told[-2].startswith(str(folder / "out" / "report.html"))
    assert told[-1].startswith("next: slpi verify ") and told[-1].endswith("extended_model.json")
    extended = slpi_ros.load_model(folder / "out" / "extended_model.json")
    record = hidden.record
    models = (extended.axes["x"], given(folder).axes["x"])
    after, before = (
        np.std(model.simulate(record.t, record.voltage["x"], of_record=True) - hidden.reading["x"]) for model in models
    )
    assert after < 0.1 * before
    # The hum belongs to this record: no sensor will say it again.
    left = np.std(extended.simulate(record.t, record.voltage["x"]) - hidden.reading["x"])
    assert left == pytest.approx(before, rel=0.05)


def given(folder):
    return slpi_ros.load_model(folder / "model.json")


def test_a_person_reads_the_verdict_and_takes_the_cause_away(folder, diagnosed, tmp_path):
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(folder / "out" / "report.html")
        assert browser.run("document.getElementById('verdict-x').dataset.verdict") == "named"
        shown = browser.run("document.getElementById('verdict-x').innerText")
        assert diagnosed.stdout.splitlines()[2].removeprefix("axis x: ") in shown
        lines = "document.querySelectorAll('#x-time .scatterlayer .trace .js-line').length"
        before = browser.run(lines)
        browser.click_legend("x-time", "hum")
        browser.until(f"{lines} === {before - 1}")
        browser.click_legend("x-time", "hum")
        browser.until(f"{lines} === {before}")
        assert not browser.complaints()
    finally:
        browser.close()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_nothing_is_found_where_nothing_is_and_a_terminal_shows_progress(slpi, folder, tmp_path, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr("slpi_ros.identification.progress.PATIENCE", 0.0)
    code, said, _ = slpi("diagnose", folder / "clean", "--model", folder / "model.json", "-o", tmp_path / "a" / "b")
    assert code == 0 and said.startswith("GOOD: ")
    found = document_in(tmp_path / "a" / "b")["axes"]["x"]
    assert found["verdict"] == "nothing_found" and found["effects"] == [] and found["next_experiment"] is None
    shown = terminal.getvalue()
    assert "axis x: " in shown and shown.endswith("\r\x1b[K") and "\n" not in shown


def test_a_record_without_any_noise(diagnose, hidden, tmp_path):
    code, said, complaints = diagnose(replace(hidden.record, displacement={"x": hidden.clean["x"]}))
    assert (code, complaints) == (0, "") and said
    found = document_in(tmp_path / "out")["axes"]["x"]
    # What the model of the hysteresis leaves may be more than no noise, but no cause is invented for it.
    assert found["verdict"] in ("unexplained", "nothing_found") and found["effects"] == []
    assert found["after_rms_m"] < 1e-4 * np.ptp(hidden.clean["x"])


def test_missing_readings_and_a_dead_axis_beside(diagnose, hidden, tmp_path):
    record = hidden.record
    reading = record.displacement["x"].copy()
    reading[500:900] = np.nan
    nothing = np.full(len(record), np.nan)
    gaps = replace(record, voltage={"x": record.voltage["x"], "y": nothing}, displacement={"x": reading, "y": nothing})
    code, _, complaints = diagnose(gaps, "--axis", "x")
    assert (code, complaints) == (0, "")
    assert document_in(tmp_path / "out")["axes"]["x"]["effects"][0]["name"] == "hum"


def changed(record, v=None, y=None, **changes):
    signals = {"voltage": v, "displacement": y}
    given = {name: {"x": signal} for name, signal in signals.items() if signal is not None}
    return replace(record, **given, **changes)


def part(record, count):
    return Record(record.time_ns[:count], {"x": record.voltage["x"][:count]}, {"x": record.displacement["x"][:count]})


def hardly_any_samples(record):
    return part(record, 40), "40"


def too_short(record):
    return part(record, 600), "1000"


def constant_voltage(record):
    return changed(record, v=np.full(len(record), 5.0)), "5 V"


def one_way(record):
    return changed(record, v=np.linspace(0.0, 90.0, len(record)), y=np.linspace(0.0, 9e-6, len(record))), "never turns"


def one_loop(record):
    way = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(len(record)) / len(record))
    return changed(record, v=90.0 * way, y=9e-6 * way), "1 times"


def another_stage_by_name(record):
    return replace(record, hardware_id="another"), "'another'"


def another_stage(record):
    return changed(record, y=1.5 * record.displacement["x"]), "µm rms"


def no_reading(record):
    return changed(record, y=np.full(len(record), np.nan)), "position[]"


def another_axis(record):
    only = replace(record, voltage={"z": record.voltage["x"]}, displacement={"z": record.displacement["x"]})
    return only, "axes z"


def backwards(record):
    return replace(record, time_ns=record.time_ns[::-1].copy()), "message 2"


RECORDS = (
    hardly_any_samples, too_short, constant_voltage, one_way, one_loop, another_stage_by_name, another_stage,
    no_reading, another_axis, backwards,
)  # fmt: skip


@pytest.mark.parametrize("case", RECORDS, ids=lambda case: case.__name__)
def test_a_record_that_does_not_allow_it_is_told_in_one_line(diagnose, folder, clean, tmp_path, case):
    stage = slpi_ros.load_model(folder / "model.json")
    slpi_ros.save_model(replace(stage, hardware_id="one"), tmp_path / "named.json")
    record, words = case(clean)
    options = ("--model", tmp_path / "named.json") if record.hardware_id else ()
    code, said, complaints = diagnose(record, *options)
    assert code == 1 and said == "" and words in complaints
    assert complaints.startswith("slpi diagnose: ") and complaints.count("\n") == 1
    assert not (tmp_path / "out").exists()


def missing_axis_of_bag(folder, tmp_path):
    return ["--axis", "x", "z"], 1, "'z'"


def missing_model(folder, tmp_path):
    return ["--model", tmp_path / "none.json"], 1, "none.json"


def no_model_at_all(folder, tmp_path):
    return ["--model", folder / "hum" / "metadata.yaml"], 1, "metadata.yaml"


def wrong_topic(folder, tmp_path):
    return ["--topic", "other"], 1, "stage_state"


def output_is_a_file(folder, tmp_path):
    return ["-o", folder / "model.json"], 1, str(folder / "model.json")


def output_below_a_file(folder, tmp_path):
    return ["-o", folder / "model.json" / "out"], 1, str(folder / "model.json" / "out")


def a_folder_in_the_way(folder, tmp_path):
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    return [], 1, str(tmp_path / "out" / "report.html")


def half_of_the_topics(folder, tmp_path):
    return ["--voltage-topic", "u"], 2, "--displacement-topic"


def unknown_option(folder, tmp_path):
    return ["--colour", "red"], 2, "--colour"


ARGUMENTS = (
    missing_axis_of_bag, missing_model, no_model_at_all, wrong_topic, output_is_a_file, output_below_a_file,
    a_folder_in_the_way, half_of_the_topics, unknown_option,
)  # fmt: skip


@pytest.mark.parametrize("case", ARGUMENTS, ids=lambda case: case.__name__)
def test_a_wrong_argument_is_told_in_one_line(slpi, folder, tmp_path, monkeypatch, case):
    # All of it must be known before the long work.
    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", None)
    options, wanted, words = case(folder, tmp_path)
    usual = ["--model", folder / "model.json", "-o", tmp_path / "out"]
    code, said, complaints = slpi("diagnose", folder / "hum", *usual, *options)
    assert code == wanted and said == "" and words in complaints
    assert complaints.startswith("slpi") and complaints.count("\n") == 1


@pytest.mark.parametrize("left_out", ["--model", "-o"])
def test_model_and_output_must_be_named(slpi, folder, tmp_path, left_out):
    named = {"--model": folder / "model.json", "-o": tmp_path / "out"}
    options = [word for pair in named.items() if pair[0] != left_out for word in pair]
    code, _, complaints = slpi("diagnose", folder / "hum", *options)
    assert code == 2 and left_out in complaints and complaints.count("\n") == 1


def told(folder, after_rms=2e-9):
    """Return a diagnosis made by hand, of which everything is known."""
    t = np.arange(100) * 1e-3
    lag = NamedEffect(Lag(0.015), 75.0, 0.9, 0.002, ("delay",), "it lags", "it comes 15 ms late.")
    axis = AxisDiagnosis(
        verdict=AMBIGUOUS,
        summary="lag or delay.",
        noise_rms=1e-9,
        repeatability_rms=1e-9,
        repeatability_source="repeats",
        given_rms=9e-9,
        before_rms=8e-9,
        after_rms=after_rms,
        effects=(lag,),
        next_experiment="Go faster.",
        traces=Traces(t, t, t, t, t),
        records=(RecordOutcome("some bag", 1e-9, 9e-9, 2e-9, None),),
    )
    return Diagnosis({"x": axis}, replace(given(folder), hardware_id="extended"), "some bag")


def test_what_cannot_be_told_apart_comes_with_the_next_experiment(slpi, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", lambda *_, **__: told(folder))
    code, said, _ = slpi("diagnose", folder / "hum", "--model", folder / "model.json", "-o", tmp_path / "out")
    lines = ["ambiguous", "lag or delay.", "lag: it lags; it comes 15 ms late.", "Go faster."]
    first, *told_lines, _, _ = said.splitlines()
    assert code == 0 and first.startswith("ERROR SOURCES: axis x: lag or delay")
    assert all(line.startswith("axis x: ") for line in told_lines)
    assert all(line.endswith(end) for line, end in zip(told_lines, lines, strict=True))
    effect = document_in(tmp_path / "out")["axes"]["x"]["effects"][0]
    assert effect["alternatives"] == ["delay"] and effect["parameters"] == {"time_constant": 0.015}


def test_a_figure_that_is_not_finite_leaves_no_file(slpi, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", lambda *_, **__: told(folder, np.nan))
    code, _, complaints = slpi("diagnose", folder / "hum", "--model", folder / "model.json", "-o", tmp_path / "out")
    assert code == 1 and complaints.count("\n") == 1 and not (tmp_path / "out").exists()


def test_the_model_given_may_be_the_one_to_be_extended(slpi, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", lambda *_, **__: told(folder))
    (tmp_path / "extended_model.json").write_text((folder / "model.json").read_text())
    code, _, _ = slpi("diagnose", folder / "hum", "--model", tmp_path / "extended_model.json", "-o", tmp_path)
    assert code == 0 and slpi_ros.load_model(tmp_path / "extended_model.json").hardware_id == "extended"


def test_the_page_of_an_identification_tells_errors_left_out_and_findings_of_the_part_fitted(slpi, folder, tmp_path):
    where = ("-o", tmp_path / "m.json", "--report", tmp_path / "page")
    code, said, _ = slpi("identify", folder / "clean", "--kind", "pi", "--stop", "4", "-v", *where)
    page = (tmp_path / "page" / "report.html").read_text()
    found = next(line for line in said.splitlines() if " samples in " in line).removeprefix("axis x: ok   ")
    assert code == 0 and found in page
    held_out = slpi_ros.load_model(tmp_path / "m.json").axes["x"].quality.held_out_rms
    assert length(held_out) in said and length(held_out) in page


def test_a_report_that_cannot_be_written_is_told_before_the_fit(slpi, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("slpi_ros.identification.fit.identify", None)
    where = ("-o", tmp_path / "m.json", "--report", folder / "model.json")
    code, said, complaints = slpi("identify", folder / "clean", *where)
    assert code == 1 and said == "" and complaints.count("\n") == 1 and str(folder / "model.json") in complaints


def test_a_stage_that_has_changed_is_told_from_a_clean_one(diagnose, clean, tmp_path):
    moved = {"x": 1.03 * clean.displacement["x"]}
    code, said, complaints = diagnose(replace(clean, displacement=moved))
    assert (code, complaints) == (0, "")
    found = document_in(tmp_path / "out")["axes"]["x"]
    assert found["effects"] == [] and found["given_rms_m"] > 3.0 * found["before_rms_m"]
    assert "+3 %" in found["summary"] and found["summary"] in said and said.startswith("ERROR SOURCES: axis x: ")
    assert "slpi refit" in found["next_experiment"]


def test_what_is_not_asked_for_is_not_drawn(clean, folder):
    model = slpi_ros.load_model(folder / "model.json")
    y = clean.displacement["x"].copy()
    y[2000:2100] = np.nan
    diagnosis = slpi_ros.diagnose(replace(clean, displacement={"x": y}), model, start=float(clean.t[500]))
    traces = diagnosis.axes["x"].traces
    assert traces.t.size == SAMPLES - 600 and traces.t[0] == pytest.approx(clean.t[500])
    assert np.isin(traces.measured, y).all()
    assert np.max(np.abs(traces.measured - traces.before)) < 20 * NOISE


def test_digits_without_noise_are_explained_by_nothing(clean):
    record = replace(clean, displacement={"x": np.round(2e-7 * clean.voltage["x"], 11)})
    found = slpi_ros.diagnose(record, slpi_ros.identify(record)).axes["x"]
    assert found.verdict == "nothing_found"
    assert 0.5e-12 < found.repeatability_rms < 10e-12


def test_records_of_two_stages_are_refused(slpi, folder, tmp_path, hidden, clean):
    write_bag(tmp_path / "mine", replace(hidden.record, hardware_id="mine"))
    write_bag(tmp_path / "other", replace(clean, hardware_id="other"))
    model = ("--model", folder / "model.json", "-o", tmp_path / "out")
    for other in (folder / "clean", tmp_path / "other"):
        for bags in ((tmp_path / "mine", other), (other, tmp_path / "mine")):
            code, said, complaint = slpi("diagnose", *bags, *model)
            assert code == 1 and not said and complaint.count("\n") == 1
            assert "'mine'" in complaint and str(tmp_path / "mine") in complaint and str(other) in complaint
    assert not (tmp_path / "out").exists()


def test_a_record_that_is_there_twice_is_refused(slpi, folder, tmp_path):
    shutil.copytree(folder / "hum", tmp_path / "copy")
    # A path that is given twice is wrong usage, as for `slpi identify`; a copy is found in the data.
    for again, expected in ((folder / "hum", 2), (tmp_path / "copy", 1)):
        code, _, complaint = slpi(
            "diagnose", folder / "hum", again, "--model", folder / "model.json", "-o", tmp_path / "out"
        )
        assert code == expected and complaint.count("\n") == 1 and str(again) in complaint
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_into_a_bag_or_over_the_model(slpi, folder, tmp_path):
    shutil.copytree(folder / "hum", tmp_path / "bag")
    shutil.copy(folder / "model.json", tmp_path / "extended_model.json")
    data, model = tmp_path / "bag" / "bag.mcap", tmp_path / "extended_model.json"
    before = {path: path.read_bytes() for path in (*(tmp_path / "bag").iterdir(), model)}
    for command in (
        ("identify", tmp_path / "bag", "-o", data),
        ("refit", model, tmp_path / "bag", "-o", tmp_path / "bag" / "metadata.yaml"),
        ("diagnose", tmp_path / "bag", "--model", model, "-o", tmp_path / "bag"),
        ("verify", tmp_path / "bag", "--model", model, "-o", tmp_path / "bag" / "below"),
    ):
        code, said, complaint = slpi(*command)
        assert code == 2 and not said and complaint.count("\n") == 1
    assert before == {path: path.read_bytes() for path in (*(tmp_path / "bag").iterdir(), model)}
