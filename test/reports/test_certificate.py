"""The certificate of a verification: document, page, and what the command line says."""

import hashlib
import json
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from model.test_uncertainty import BARE, QUALITY
from reports.pages import parsed

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.errors import length
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.schemas import validate
from slpi_ros.model.axis_model import Start
from slpi_ros.model.stage_model import StageModel
from slpi_ros.model.uncertainty import COMPONENTS
from slpi_ros.reports import certificate as certificates
from slpi_ros.reports.uncertainty import PLACES, TIMES
from slpi_ros.reports.verification import FILES, describe_verification
from slpi_ros.workflows.verify import VerifyOutcome

NOISE = 8e-9
GIVEN = "start_s", "stop_s", "start_memory"
BEGINS = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a model, an older one without what its uncertainty needs, and a bag with its bag files."""
    folder = tmp_path_factory.mktemp("certificate")
    axis = replace(BARE, start=Start(0.0, 0.0, (100.0, 0.0)), end=None)
    made = datetime.fromtimestamp(BEGINS.timestamp() - 60.0, UTC).isoformat()
    slpi_ros.save_model(StageModel({"x": axis}, "stage 7", made), folder / "model.json")
    old = replace(axis, quality=replace(QUALITY, regions=None))
    slpi_ros.save_model(StageModel({"x": old}, "stage 7", made), folder / "old.json")
    t = np.arange(3000) / 200.0
    v = 50.0 - 50.0 * np.cos(2.0 * np.pi * t / 3.0) * np.exp(-t / 20.0)
    v -= v.min()
    y = axis.simulate(t, v) + NOISE * np.random.default_rng(1).standard_normal(t.size)
    stamps = round(BEGINS.timestamp()) * 10**9 + np.round(t * 1e9).astype(np.int64)
    write_bag(folder / "today", slpi_ros.Record(stamps, {"x": v}, {"x": y}, hardware_id="stage 7"))
    return folder


@pytest.fixture
def verify(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)

    def run(*arguments):
        try:
            code = main(["verify", "today", *map(str, arguments)])
        except SystemExit as end:
            code = end.code
        return (code, *capsys.readouterr())

    return run


def test_a_certificate_holds_what_a_laboratory_files(folder, verify):
    code, _, complaint = verify("--model", "model.json", "--tolerance", "0.05", "--certificate", "-o", "out")
    assert (code, complaint) == (0, "")
    document = json.loads((folder / "out" / "certificate.json").read_text())
    validate(document, "certificate", "test")
    assert (document["hardware_id"], document["verdict"], document["tolerance_m"]) == ("stage 7", "passed", 50e-9)
    own = hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
    assert document["model"]["sha256"] == own
    (record,) = document["records"]
    files = {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in (folder / "today").iterdir()}
    assert record["files"] == files and len(files) >= 2
    assert datetime.fromisoformat(record["begins"]) == BEGINS
    assert record["duration_s"] == pytest.approx(14.995) and record["independent"]
    axis = document["axes"]["x"]
    (error,) = axis["errors"]
    assert error["rms_m"] == pytest.approx(NOISE, rel=0.1) and error["start"] == "known"
    assert error["rms_m"] ** 2 == pytest.approx(error["rest_rms_m"] ** 2 + error["constant_m"] ** 2, rel=0.01)
    # The budget is one of a model with a larger error than this noise.
    assert error["within_expanded"] > 0.95
    budget = axis["uncertainty"]["budget"]
    assert len(budget) == len(TIMES) * len(PLACES)
    for one in budget:
        squares = sum(one[f"{name}_m"] ** 2 for name in COMPONENTS)
        assert one["combined_m"] ** 2 == pytest.approx(squares) and one["expanded_m"] == 2.0 * one["combined_m"]
    assert set(document["versions"]) == {"python", "slpi_ros", "numpy", "scipy"}
    page = parsed(folder / "out" / "certificate.html")
    text = (folder / "out" / "certificate.html").read_text()
    assert page.texts["verdict-x"].startswith("passed") and own in text and all(each in text for each in files.values())
    assert not [each for each in (*page.tags("link"), *page.tags("script"), *page.tags("img")) if "src" in each]
    assert {each.name for each in (folder / "out").iterdir()} == {
        "certificate.html", "certificate.json", "report.html", "verification.json",
    }  # fmt: skip


def test_a_record_of_the_model_proves_nothing(folder, verify):
    model = slpi_ros.load_model(folder / "model.json")
    own = replace(model.axes["x"], quality=replace(QUALITY, source="today"))
    slpi_ros.save_model(replace(model, axes={"x": own}), folder / "own.json")
    code, said, _ = verify("--model", "own.json", "--certificate", "-o", "own")
    assert code == 1 and "unproved" in said.splitlines()[0] and said.splitlines()[-1].startswith("next: slpi verify")
    document, judged = (json.loads((folder / "own" / name).read_text()) for name in ("certificate.json", FILES[0]))
    assert not document["records"][0]["independent"]
    for axis in (document["axes"]["x"], judged["axes"]["x"]):
        assert {document["verdict"], axis["verdict"], *(one["verdict"] for one in axis.get("errors", []))} == {
            "unproved"
        }
    (one,) = judged["axes"]["x"]["records"]
    assert (one["verdict"], one["passed"], one["independent"]) == ("unproved", False, False)
    assert "proves nothing on today" in (folder / "own" / "certificate.html").read_text()


@pytest.mark.parametrize(
    ("options", "named", "code"),
    [((), "without its offset", 0), (("--tolerance", "0.05"), "absolute error", 1)],
)
def test_the_headline_names_the_error_that_is_judged(options, named, code, folder, verify):
    record = slpi_ros.read_bag(folder / "today")
    moved = replace(record, displacement={"x": record.displacement["x"] + 2e-6})
    write_bag(folder / f"moved{code}", moved)
    assert main(["verify", f"moved{code}", "--model", "model.json", *options, "--certificate", "-o", "moved"]) == code
    (one,) = json.loads((folder / "moved" / "certificate.json").read_text())["axes"]["x"]["errors"]
    head = parsed(folder / "moved" / "certificate.html").texts["verdict-stage"]
    judged = length(one[one["limit_of"]])
    assert named in head.split(" rms")[0] and f"{judged} rms" in head and f"limit {length(one['limit_m'])}" in head
    assert ("no tolerance for it was given" in head) == (code == 0) and length(one["rms_m"]) in head


@pytest.mark.parametrize(
    ("options", "given", "told"),
    [
        (("--start", "12"), (12.0, None, None), "from 12 s to the end"),
        (("--stop", "9.5", "--start-memory", "start"), (None, 9.5, "start"), "from the beginning to 9.5 s"),
        ((), (None, None, None), "the whole record"),
    ],
)
def test_a_part_and_an_initial_state_that_were_given_are_told(options, given, told, folder, verify):
    code, said, _ = verify("--model", "model.json", "--tolerance", "0.05", "--certificate", "-o", "part", *options)
    assert code == 0
    documents = [json.loads((folder / "part" / name).read_text()) for name in ("certificate.json", FILES[0])]
    for document, name in zip(documents, ("certificate", "verification"), strict=True):
        assert (document["start_s"], document["stop_s"], document["start_memory"]) == given
        validate(document, name, "test")
        # Those of an earlier version do not say it.
        validate({key: one for key, one in document.items() if key not in GIVEN}, name, "test")
    (remarks,) = (one["remarks"] for one in documents[0]["axes"]["x"]["errors"])
    pages = [(folder / "part" / name).read_text() for name in ("certificate.html", FILES[1])]
    assert told in pages[0]
    if given[:2] != (None, None):
        assert f"samples {told} judged" in said
        assert any(told in remark for remark in remarks) and all(told in page for page in pages)
    assert ("the initial state is known" in remarks) == (given[2] is None)
    assert any(remark.startswith("the initial state is given") and "start" in remark for remark in remarks) == (
        given[2] is not None
    )


@pytest.mark.parametrize("recorded", [True, False])
def test_the_budget_takes_quantities_as_they_were_recorded(recorded, folder):
    model = slpi_ros.load_model(folder / "model.json")
    one = Quantity("/room", offset_gain=1e-7, reference=21.0, lowest=19.0, highest=23.0)
    effect = Surroundings((one,), uncertainty={"quantities.0.offset_gain": 1e-9})
    model = replace(model, axes={"x": replace(model.axes["x"], effects=(effect,))})
    times = np.arange(16.0)
    beside = {"/room" if recorded else "/hall": (times, 21.0 + 2.0 * times / 15.0)}
    record = replace(slpi_ros.read_bag(folder / "today"), surroundings=beside)
    found = slpi_ros.verify(record, model)
    done = VerifyOutcome(found, [record], [])
    document = certificates.certificate(done, [str(folder / "today")], model, str(folder / "model.json"))
    certificates.write_files(folder / "follows", document)
    text = (folder / "follows" / "certificate.html").read_text()
    budget, (kept,) = document["axes"]["x"]["uncertainty"], document["records"]
    unknown = 1e-7 * 4.0 / 12.0**0.5
    assert budget["unknown_quantities_m"] == pytest.approx(unknown)
    assert budget["quantities"] == [{"name": "/room", "value": 22.0 if recorded else None}]
    own = 1e-9 if recorded else unknown
    assert [each["surroundings_m"] for each in budget["budget"]] == pytest.approx([own] * len(budget["budget"]))
    assert kept["not_recorded"] == ([] if recorded else ["/room"])
    assert ("/room, which the model follows, was not recorded" in text) != recorded
    told = describe_verification(found)[0]
    assert ("does not hold /room" in told and "/hall" in told) != recorded


def test_a_model_of_an_earlier_version_has_a_certificate_without_a_budget(folder, verify):
    assert verify("--model", "old.json", "--tolerance", "0.05", "--certificate", "-o", "old")[0] == 0
    axis = json.loads((folder / "old" / "certificate.json").read_text())["axes"]["x"]
    assert axis["uncertainty"] is None and axis["errors"][0]["within_expanded"] is None
    assert "diagnose again" in axis["uncertainty_unknown"]
    assert "diagnose again" in (folder / "old" / "certificate.html").read_text()


def test_it_needs_a_folder(verify):
    code, _, complaint = verify("--model", "model.json", "--certificate")
    assert code == 2 and "--certificate" in complaint and "-o" in complaint


def test_show_tells_the_uncertainty_over_time_and_range(folder, capsys):
    assert main(["show", "-v", str(folder / "model.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    (head,) = [k for k, line in enumerate(lines) if "displacement, µm" in line]
    assert lines[head].split()[-6:] == ["1", "s", "1", "min", "1", "h"]
    table = np.array([line.split(":")[1].split() for line in lines[head + 1 : head + 1 + len(PLACES)]], dtype=float)
    assert table[:, 0] == pytest.approx([0.0, 2.5, 5.0, 7.5, 10.0])
    # Drift alone makes the hour: 3 nm for the root of a second, k = 2.
    assert (np.diff(table[:, 1:]) > 0.0).all() and table[:, 3] == pytest.approx(2 * 3 * 60.3, rel=0.02)
    for name in (*COMPONENTS, "combined", "expanded"):
        assert any(line.startswith(f"axis x: {name} ") for line in lines), name
    assert main(["show", str(folder / "model.json")]) == 0
    assert "after 1 h" in capsys.readouterr().out
    assert main(["show", "-v", str(folder / "old.json")]) == 0
    assert "uncertainty: not known" in capsys.readouterr().out
