"""Which records a workflow reads and takes."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_makers import joint_state, rosbags_bag, split_bag
from hostile_bags import plain, steps, with_signals
from refusals import holds, refusal

from slpi_ros.cli import main
from slpi_ros.diagnosis import diagnose as diagnoses
from slpi_ros.diagnosis.result import Diagnosis
from slpi_ros.errors import IdentificationError, ModelError, RecordError, UsageError
from slpi_ros.fleet.bags import compare, examine
from slpi_ros.fleet.sources import Bag
from slpi_ros.identification.fit import identify
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.model.axis_model import FittedRecord
from slpi_ros.model.document import format_model, load_model, save_model
from slpi_ros.model.sensor import Sensor
from slpi_ros.nodes.jobs import DiagnosisRequest, FitRequest, fit, run_diagnosis
from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose
from slpi_ros.workflows.identify import IdentifyRequest
from slpi_ros.workflows.identify import identify as identify_records
from slpi_ros.workflows.records import Source, UnusableRecordError, assess_record, fitted_record, with_given_names
from slpi_ros.workflows.refit import RefitRequest, refit
from slpi_ros.workflows.verify import VerifyRequest, verify

DAY_NS = 86_400 * 10**9


@pytest.fixture(scope="module")
def record():
    return plain(np.random.default_rng(1))


@pytest.fixture(scope="module")
def coarse(record):
    """Return a record whose sensor has steps of 12 % of its range."""
    return replace(with_signals(record, y=steps(record.displacement["x"], 0.12)), source="coarse")


@pytest.fixture(scope="module")
def model(record):
    return identify(record, "pi")


def test_every_workflow_refuses_the_same_record(coarse, model):
    source = Source(records=[coarse])
    reasons = {
        refusal(UnusableRecordError, identify_records, IdentifyRequest(source)),
        refusal(UnusableRecordError, diagnose, DiagnoseRequest(source, model)),
        refusal(UnusableRecordError, verify, VerifyRequest(source, model)),
        refusal(UnusableRecordError, refit, RefitRequest(source, model)),
    }
    assert len(reasons) == 1 and issubclass(UnusableRecordError, IdentificationError)
    assert holds(reasons.pop(), "coarse", "'x'")


def test_every_command_node_and_the_fleet_refuse_it(coarse, model, tmp_path, capsys):
    bag, file, folder = str(tmp_path / "bag"), str(tmp_path / "model.json"), str(tmp_path / "out")
    write_bag(bag, coarse)
    save_model(model, file)
    said = set()
    for command in (
        ["diagnose", bag, "--model", file, "-o", folder],
        ["verify", bag, "--model", file],
        ["refit", file, bag, "-o", str(tmp_path / "new.json")],
    ):
        assert main(command) == 1
        said.add(capsys.readouterr().err.strip().split(": ", 1)[1])
    said.add(run_diagnosis(DiagnosisRequest((bag,), "stage_state", format_model(model), folder)).error)
    judged = compare(examine(Bag(bag), Source()), Source(), str(tmp_path), "model.json", "new.json")
    said |= {row.error for row in judged.rows}
    assert len(said) == 1 and not (tmp_path / "new.json").exists()


def test_the_error_holds_what_was_found_up_to_the_reason(coarse):
    with pytest.raises(UnusableRecordError) as caught:
        identify_records(IdentifyRequest(Source(records=[coarse])))
    assert [finding.level for finding in caught.value.findings["x"]].count("stop") == 1
    assert not UnusableRecordError("one line").findings


def test_axes_are_assessed_by_themselves(record, coarse):
    both = replace(
        record,
        voltage=dict.fromkeys("yx", record.voltage["x"]),
        displacement={"y": coarse.displacement["x"], "x": record.displacement["x"]},
    )
    assessed = assess_record(both, Source())
    assert list(assessed.refused) == ["y"] and list(assessed.findings) == ["y", "x"]
    assert identify_records(IdentifyRequest(Source(records=[both], axes=["x"]), "pi")).model.axes.keys() == {"x"}


def test_the_end_that_a_late_sensor_has_not_told_is_no_gap(record):
    sensor = Sensor(delay=0.5)
    late = with_signals(record, y=sensor.apply(record.t, record.displacement["x"]))
    lines = [finding.text for finding in assess_record(late, Source(), {"x": sensor}).findings["x"]]
    assert not [line for line in lines if "missing" in line]


def test_records_correct_a_model_in_the_order_of_time(record, model):
    monday = replace(record, source="monday")
    tuesday = replace(record, time_ns=record.time_ns + DAY_NS, source="tuesday")
    done = refit(RefitRequest(Source(records=[tuesday, monday]), model))
    assert [step.record.source for step in done.steps] == ["monday", "tuesday"]
    assert done.model.axes["x"].quality.source.endswith("monday, tuesday")


def test_an_axis_that_cannot_be_read_hinders_no_other(record, model, tmp_path):
    nothing = np.full(len(record), np.nan)
    voltage = {"x": record.voltage["x"], "y": nothing}
    write_bag(tmp_path / "bag", replace(record, voltage=voltage, displacement={**record.displacement, "y": nothing}))
    bags = [str(tmp_path / "bag")]
    assert Source(bags, axes=["x"]).read(coupled=True)[0].axes == ("x",)
    assert holds(refusal(RecordError, Source(bags).read, coupled=True), "'y'")
    assert verify(VerifyRequest(Source(bags, axes=["x"]), model)).verification.axes.keys() == {"x"}


def test_what_does_not_match_is_found_in_the_data(record, model):
    other = replace(record, hardware_id="another stage")
    named = replace(model, hardware_id="stage")
    for work, request in ((diagnose, DiagnoseRequest), (verify, VerifyRequest)):
        assert holds(refusal(ModelError, work, request(Source(records=[other]), named)), "another stage")
    with pytest.raises(UsageError):
        Source(["bag", "bag"]).read()


def test_several_bags_of_one_stage(tmp_path, record):
    bags = [str(tmp_path / name) for name in ("one", "two")]
    for bag in bags:
        write_bag(bag, replace(record, hardware_id="stage"))
    assert [read.source for read in Source(bags).read()] == bags
    refusal(UsageError, Source([]).read)
    again = str(tmp_path / "two" / ".." / "one")
    assert holds(refusal(UsageError, Source([*bags, again]).read), again)
    other = str(tmp_path / "other")
    write_bag(other, replace(record, hardware_id="another"))
    assert holds(refusal(RecordError, Source([*bags, other]).read), other, "'another'", bags[0], "'stage'")


@pytest.mark.parametrize(
    ("model", "first", "second"), [("a", "a", "b"), ("a", "b", "b"), ("b", "a", "a"), ("", "a", "b")]
)
def test_a_stage_that_is_accepted_is_taken_for_the_other_one(record, tmp_path, model, first, second):
    names = {"one": first, "two": second}
    for place, name in names.items():
        write_bag(tmp_path / place, replace(record, hardware_id=name))
    bags = [str(tmp_path / place) for place in names]
    this = model or "a"
    read = Source(bags, accept_stage="b").read(stage=model)
    assert [each.hardware_id for each in read] == [this, this]
    other = Source(bags, accept_stage="c")
    if first != second:
        with pytest.raises(RecordError):
            other.read(stage=model)
    else:
        assert [each.hardware_id for each in other.read(stage=model)] == [first, second]


@pytest.mark.parametrize("order", ["one after the other", "in turn"])
def test_every_way_refuses_messages_of_two_stages(record, order, tmp_path, capsys):
    file, both, at = str(tmp_path / "model.json"), str(tmp_path / "both"), record.time_ns.tolist()
    frames = ["A", "B"] * len(at) if order == "in turn" else ["A"] * (len(at) // 2) + ["B"] * len(at)
    v, y = record.voltage["x"].tolist(), record.displacement["x"].tolist()
    states = [(at[k], joint_state(at[k], ("x",), (y[k],), (v[k],), frames[k])) for k in range(len(at))]
    rosbags_bag(Path(both), {"/stage_state": states})
    save_model(replace(identify(record, "pi"), hardware_id="A"), file)
    commands = {
        "identify": [both, "-o", str(tmp_path / "new.json"), "--kind", "pi"],
        "verify": [both, "--model", file],
        "diagnose": [both, "--model", file, "-o", str(tmp_path / "diagnosis")],
        "refit": [file, both, "-o", str(tmp_path / "new.json")],
        "learn": [both, "--model", file, "--period", "1", "-o", str(tmp_path / "next.csv")],
    }
    said = []
    for command, options in commands.items():
        assert main([command, *options]) == 1
        said.append(capsys.readouterr().err.strip().removeprefix(f"slpi {command}: "))
    said.append(fit(FitRequest((both,), "stage_state", "pi", None, None, "")).error)
    said.append(
        run_diagnosis(
            DiagnosisRequest((both,), "stage_state", format_model(load_model(file)), str(tmp_path / "node"))
        ).error
    )
    said += examine(Bag(both), Source()).refused.values()
    assert main(["doctor", both, "--no-ros", "--json"]) == 1
    said.append(json.loads(capsys.readouterr().out)["checks"][0]["text"])
    assert len(said) == 9 and len(set(said)) == 1 and holds(said[0], "'A'", "'B'")
    # Both are names of the same stage.
    assert main(["identify", *commands["identify"], "--accept-stage", "B"]) == 0
    assert load_model(tmp_path / "new.json").hardware_id == "A"
    assert "'B'" in capsys.readouterr().err


def test_records_of_an_older_model_are_those_at_the_place_of_their_bags(record, model, tmp_path, monkeypatch):
    axis = model.axes["x"]
    sources = "02_calibration, gone, a\0b"
    model = replace(model, axes={"x": replace(axis, quality=replace(axis.quality, source=sources))})
    bag = tmp_path / "stage" / "02_calibration"
    write_bag(bag, record)
    write_bag(tmp_path / "other", record)
    assert fitted_record(record, "x").sha256 == fitted_record(with_signals(record, v=-record.voltage["x"]), "x").sha256
    monkeypatch.chdir(tmp_path)
    for file, given, name in (
        ("stage/model.json", "stage/02_calibration", "stage/02_calibration"),
        (str(tmp_path / "stage" / "model.json"), "./stage/02_calibration/", "stage/02_calibration"),
        ("stage/model.json", str(next(bag.glob("*.mcap"))), str(next(bag.glob("*.mcap")))),
        ("model.json", "stage/02_calibration", "02_calibration"),
        (None, "02_calibration", "02_calibration"),
    ):
        source = Source(["other", given])
        read = [replace(record, source=str(Path(bag))) for bag in source.bags]
        named = with_given_names(model, read, source, file)
        assert named.axes["x"].quality.sources == [name, "gone", "a\0b"]


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """Folder with the bag ``data/cal``, its model, and another bag of the stage."""
    folder = tmp_path_factory.mktemp("stage")
    for name, seed in (("data/cal", 1), ("data/check", 2)):
        (folder / name).parent.mkdir(exist_ok=True)
        write_bag(folder / name, plain(np.random.default_rng(seed)))
    assert main(["identify", str(folder / "data/cal"), "--kind", "pi", "-o", str(folder / "model.json")]) == 0
    return folder


def verdict_of(bags, model, folder, *words):
    """Return the verdict of a verification, and whether each record is independent, as the certificate says them."""
    words = [*bags, "--model", model, "--tolerance", "0.05", "--certificate", "-o", folder, *words]
    code = main(["verify", *map(str, words)])
    found, certificate = (json.loads((folder / name).read_text()) for name in ("verification.json", "certificate.json"))
    independent = [record["independent"] for record in certificate["records"]]
    assert found["verdict"] == certificate["verdict"] and (code == 0) == (found["verdict"] == "passed")
    assert independent == [one["independent"] for one in found["axes"]["x"]["records"]]
    return found["verdict"], independent


SPELLINGS = {
    "as it was": lambda folder: folder / "data" / "cal",
    "with a slash": lambda folder: f"{folder / 'data' / 'cal'}/",
    "through another folder": lambda folder: f"{folder}/data/check/../cal",
    "the file alone": lambda folder: next((folder / "data" / "cal").glob("*.mcap")),
    "a link": lambda folder: made(folder / "link", lambda to: to.symlink_to(folder / "data" / "cal")),
    "a link to the file": lambda folder: made(
        folder / "link.mcap", lambda to: to.symlink_to(next((folder / "data" / "cal").glob("*.mcap")))
    ),
    "a copy": lambda folder: made(folder / "copy", lambda to: shutil.copytree(folder / "data" / "cal", to)),
    "in another format": lambda folder: made(
        folder / "again", lambda to: write_bag(to, read_bag(folder / "data" / "cal"), storage="sqlite3")
    ),
    "a copy that begins at another time": lambda folder: made(
        folder / "later",
        lambda to: write_bag(to, replace(one := read_bag(folder / "data" / "cal"), time_ns=one.time_ns + DAY_NS)),
    ),
}


def made(place, make):
    make(place)
    return place


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_a_record_of_the_fit_proves_nothing_however_it_is_given(identified, spelling, tmp_path):
    folder = tmp_path / "stage"
    shutil.copytree(identified, folder)
    bag, other = SPELLINGS[spelling](folder), folder / "data" / "check"
    assert verdict_of([bag], folder / "model.json", tmp_path / "out") == ("unproved", [False])
    assert verdict_of([bag, other], folder / "model.json", tmp_path / "out") == ("passed", [False, True])
    assert verdict_of([other], folder / "model.json", tmp_path / "out") == ("passed", [True])


@pytest.mark.parametrize("older", [False, True])
def test_a_record_of_the_fit_is_known_in_another_folder(identified, older, tmp_path, monkeypatch):
    folder = tmp_path / "stage"
    shutil.copytree(identified, folder)
    monkeypatch.chdir(folder)
    assert main(["identify", "data/cal", "--kind", "pi", "-o", "new.json"]) == 0
    model = json.loads(Path("new.json").read_text())
    if older:
        del model["axes"]["x"]["quality"]["records"]
        Path("new.json").write_text(json.dumps(model))
    assert verdict_of(["data/cal"], "new.json", tmp_path / "out")[0] == "unproved"
    (file,) = Path("data/cal").glob("*.mcap")
    assert verdict_of([file], "new.json", tmp_path / "out")[0] == "unproved"
    if older:
        return
    monkeypatch.chdir("data")
    assert verdict_of(["cal"], "../new.json", tmp_path / "out")[0] == "unproved"


def test_another_bag_at_the_same_place_is_another_record(identified, tmp_path):
    folder = tmp_path / "stage"
    shutil.copytree(identified, folder)
    (folder / "data" / "cal").rename(tmp_path / "away")
    (folder / "data" / "check").rename(folder / "data" / "cal")
    assert main(["identify", str(tmp_path / "away"), "--kind", "pi", "-o", str(folder / "model.json")]) == 0
    text = (folder / "model.json").read_text().replace(str(tmp_path / "away"), str(folder / "data" / "cal"))
    (folder / "model.json").write_text(text)
    assert verdict_of([folder / "data" / "cal"], folder / "model.json", tmp_path / "out") == ("passed", [True])
    assert verdict_of([tmp_path / "away"], folder / "model.json", tmp_path / "out") == ("unproved", [False])


@pytest.mark.parametrize("older", [False, True])
def test_a_comma_in_the_name_of_a_bag(record, older, tmp_path):
    bag, file = tmp_path / "monday, at noon", tmp_path / "model.json"
    write_bag(bag, record)
    assert main(["identify", str(bag), "--kind", "pi", "-o", str(file)]) == 0
    if older:
        model = json.loads(file.read_text())
        del model["axes"]["x"]["quality"]["records"]
        file.write_text(json.dumps(model))
    assert verdict_of([bag], file, tmp_path / "out") == ("unproved", [False])


def test_a_part_of_a_split_bag_is_of_the_record(record, tmp_path):
    at, half = record.time_ns.tolist(), 400
    v, y = record.voltage["x"].tolist(), record.displacement["x"].tolist()
    states = [(at[k], joint_state(at[k], ("x",), (y[k],), (v[k],))) for k in range(len(at))]
    whole = split_bag(tmp_path / "cal", [{"/stage_state": states[:half]}, {"/stage_state": states[half:]}])
    first, file = whole / "cal_0.mcap", tmp_path / "model.json"
    for fitted, given in ((whole, first), (first, whole), (first, first)):
        assert main(["identify", str(fitted), "--kind", "pi", "-o", str(file)]) == 0
        assert verdict_of([given], file, tmp_path / "out") == ("unproved", [False])
        moved = tmp_path / "moved"
        shutil.copytree(whole, moved / "cal")
        assert verdict_of([moved / given.relative_to(tmp_path)], file, tmp_path / "out") == ("unproved", [False])
        shutil.rmtree(moved)


def test_a_table_that_is_imported_twice_is_one_record(record, tmp_path):
    rows = zip(record.t.tolist(), record.voltage["x"].tolist(), record.displacement["x"].tolist(), strict=True)
    (tmp_path / "data.csv").write_text("time_s,x_V,x_m\n" + "".join(f"{t!r},{v!r},{y!r}\n" for t, v, y in rows))
    for name, more in (("one", []), ("two", ["--sample-period", "0.01", "--storage", "sqlite3"])):
        assert main(["import", str(tmp_path / "data.csv"), "-o", str(tmp_path / name), *more]) == 0
    file = tmp_path / "model.json"
    assert main(["identify", str(tmp_path / "one"), "--kind", "pi", "-o", str(file)]) == 0
    assert verdict_of([tmp_path / "two"], file, tmp_path / "out") == ("unproved", [False])


def test_a_corrected_and_an_extended_model_know_their_records(identified, tmp_path):
    cal, check, file = identified / "data" / "cal", identified / "data" / "check", tmp_path / "new.json"
    assert main(["refit", str(identified / "model.json"), str(check), "-o", str(file)]) == 0
    copies = [shutil.copytree(bag, tmp_path / f"copy of {bag.name}") for bag in (cal, check)]
    assert verdict_of(copies, file, tmp_path / "out") == ("unproved", [False, False])
    (axis,) = load_model(file).axes.values()
    assert [record.source for record in axis.quality.records] == axis.quality.sources == [str(cal), str(check)]
    # One of the two records is that of the model, by another name.
    source = Source([str(copies[0]), str(check)])
    model = with_given_names(load_model(identified / "model.json"), source.read(), source, None)
    assert model.axes["x"].quality.sources == [str(copies[0])]


def test_an_extended_model_knows_its_records(identified, monkeypatch):
    model, cal = load_model(identified / "model.json"), identified / "data" / "cal"
    seen = []

    def extending(records, model, **_):
        seen.append(model.axes["x"].quality.sources)
        quality = replace(model.axes["x"].quality, source=", ".join(each.source for each in records))
        return Diagnosis({}, replace(model, axes={"x": replace(model.axes["x"], quality=quality)}))

    monkeypatch.setattr(diagnoses, "diagnose", extending)
    link, check = identified / "also cal", identified / "data" / "check"
    link.symlink_to(cal)
    source = Source([str(link), str(check)])
    done = diagnose(DiagnoseRequest(source, model)).diagnosis.extended.axes["x"].quality
    assert seen == [[str(link)]] and done.sources == [str(link), str(check)]
    assert len({record.sha256 for record in done.records}) == 2
    # The calibrator diagnoses what moves of its records, by their names.
    part = replace(read_bag(cal).part(slice(5, None)), source=str(cal))
    done = diagnose(DiagnoseRequest(Source(records=[part]), model)).diagnosis.extended.axes["x"].quality
    assert done.sources == [str(cal)] and len(done.records) == 2
    assert model.axes["x"].quality.records[0] in done.records
    # What a diagnosis leaves as it is, is of the same records.
    monkeypatch.setattr(diagnoses, "diagnose", lambda records, model, **_: Diagnosis({}, model))
    assert diagnose(DiagnoseRequest(Source([str(check)]), model)).diagnosis.extended == model


def test_a_model_document_keeps_its_records(model, tmp_path):
    axis = model.axes["x"]
    records = FittedRecord("data/cal"), FittedRecord("a, b", 64 * "0")
    kept = replace(model, axes={"x": replace(axis, quality=replace(axis.quality, records=records))})
    save_model(kept, tmp_path / "model.json")
    assert load_model(tmp_path / "model.json").axes["x"].quality == kept.axes["x"].quality
    assert kept.axes["x"].quality.sources == ["data/cal", "a, b"]
    assert axis.quality.records is None and axis.quality.fitted == (FittedRecord(axis.quality.source),)
