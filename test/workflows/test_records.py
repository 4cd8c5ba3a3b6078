"""Which records a workflow reads and takes."""

from dataclasses import replace

import numpy as np
import pytest
from hostile_bags import plain, steps, with_signals
from refusals import holds, refusal

from slpi_ros.cli import main
from slpi_ros.errors import IdentificationError, ModelError, RecordError, UsageError
from slpi_ros.fleet.bags import compare, examine
from slpi_ros.fleet.sources import Bag
from slpi_ros.identification.fit import identify
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.model.document import format_model, save_model
from slpi_ros.model.sensor import Sensor
from slpi_ros.nodes.jobs import DiagnosisRequest, run_diagnosis
from slpi_ros.workflows.diagnose import DiagnoseRequest, diagnose
from slpi_ros.workflows.identify import IdentifyRequest
from slpi_ros.workflows.identify import identify as identify_records
from slpi_ros.workflows.records import Source, UnusableRecordError, assess_record, with_given_names
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


def test_records_of_a_model_have_the_names_by_which_bags_are_given(model, tmp_path, monkeypatch):
    axis = model.axes["x"]
    sources = "02_calibration, gone, a\0b"
    model = replace(model, axes={"x": replace(axis, quality=replace(axis.quality, source=sources))})
    (tmp_path / "stage" / "02_calibration").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for file, given, name in (
        ("stage/model.json", "stage/02_calibration", "stage/02_calibration"),
        (str(tmp_path / "stage" / "model.json"), "./stage/02_calibration/", "stage/02_calibration"),
        ("model.json", "stage/02_calibration", "02_calibration"),
        (None, "02_calibration", "02_calibration"),
    ):
        named = with_given_names(model, ["other", given], file)
        assert named.axes["x"].quality.sources == [name, "gone", "a\0b"]
