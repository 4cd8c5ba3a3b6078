"""The node identify as a process of its own, over DDS: a bag in, a latched model out."""

import json
import math
import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")

from nodes.ros_helpers import (  # noqa: E402
    LATCHED,
    PATIENCE_S,
    Graph,
    NodeProcess,
    on_graph,
    stage_model,
    started,
    values_of,
    voltage_path,
)  # fmt: skip
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from slpi_ros import cli  # noqa: E402
from slpi_ros.errors import RecordError, UsageError  # noqa: E402
from slpi_ros.identification.fit import identify  # noqa: E402
from slpi_ros.io.bag_reader import read_bag  # noqa: E402
from slpi_ros.io.bag_writer import write_bag  # noqa: E402
from slpi_ros.io.record import Record  # noqa: E402
from slpi_ros.io.schemas import validate  # noqa: E402
from slpi_ros.model.document import format_model, load_model, parse_model, save_model  # noqa: E402
from slpi_ros.model.sensor import Sensor  # noqa: E402
from slpi_ros.nodes.identify import DECLARATIONS, Identify, IdentifySettings  # noqa: E402
from slpi_ros.nodes.jobs import (  # noqa: E402
    DiagnosisRequest,
    FitOutcome,
    FitRequest,
    StageIdentity,
    WorkerProcess,
    fit,
    run_diagnosis,
)

pytestmark = pytest.mark.slow

NAME = "/identify: identify"
# Quick to fit, and needs no better.
QUICK = {"kind": "pi", "diagnostic_period": 0.2}
# Reports in which a bag would have been found.
LOOKS = 6


def write_calibration(
    path: Path,
    seed: int = 1,
    samples: int = 600,
    hum: float = 0.0,
    axes: Sequence[str] = ("x",),
    hardware_id: str = "stage 7",
    top: float = 100.0,
    digit: float = 0.0,
) -> str:
    """Write a bag of 200 samples per second up to `top` V, with a hum (m) of 30 Hz and a resolution `digit` (m)."""
    v = voltage_path(samples, seed, top)
    y = stage_model().axis("x").simulate(np.arange(samples), v) + np.random.default_rng(seed).normal(0.0, 5e-9, samples)
    y += hum * np.sin(2 * np.pi * 30.0 * np.arange(samples) / 200.0)
    y = np.round(y / digit) * digit if digit else y
    stamps = 1_700_000_000_000_000_000 + np.arange(samples, dtype=np.int64) * 5_000_000
    write_bag(path, Record(stamps, dict.fromkeys(axes, v), dict.fromkeys(axes, y), hardware_id=hardware_id))
    return str(path)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> str:
    return write_calibration(tmp_path_factory.mktemp("bags") / "calibration")


@pytest.fixture(scope="module")
def humming_bag(tmp_path_factory) -> str:
    """Return a bag long enough to be diagnosed."""
    return write_calibration(tmp_path_factory.mktemp("bags") / "humming", samples=1500, hum=100e-9)


@dataclass
class Client:
    graph: Graph
    node: NodeProcess
    models: list[Any]

    def status(self, wanted, what: str):
        return self.graph.wait_for_status(NAME, wanted, what)

    def look_on(self) -> None:
        """Wait for more reports than the node looks at its folder between."""
        before = len(self.graph.statuses(NAME))
        self.graph.spin_until(lambda: len(self.graph.statuses(NAME)) > before + LOOKS, "more reports")

    def identified(self, count: int = 1) -> str:
        """Return the document that is published as the `count`-th."""
        self.graph.spin_until(lambda: len(self.models) >= count, f"model {count}")
        return self.models[count - 1].data

    def failed(self, text: str) -> None:
        status = self.status(lambda status: status.level == b"\2" and text in status.message, text)
        assert "\n" not in status.message

    def diagnose(self) -> Trigger.Response:
        return self.graph.call(Trigger, "/identify/diagnose", Trigger.Request())

    def diagnosis(self, state: str) -> dict[str, str]:
        """Return the values of the first report that says so of the diagnosis."""
        return values_of(self.status(lambda status: values_of(status)["diagnosis.state"] == state, state))

    def set(self, **values: object) -> str:
        """Set parameters; return why they were refused, or nothing."""
        return self.graph.set_parameters("/identify", **values)


@contextmanager
def identifying(**parameters: object) -> Iterator[Client]:
    with on_graph() as graph, started("identify", {**QUICK, **parameters}) as node:
        graph.tested = node
        models = graph.record(String, "/stage_model", LATCHED)
        graph.watch_diagnostics()
        yield Client(graph, node, models)


def without_time(document: str) -> dict[str, Any]:
    return {**json.loads(document), "created": ""}


def test_a_bag_becomes_the_model_that_the_library_identifies(bag, tmp_path):
    output = tmp_path / "model.json"
    with identifying(bags=[bag], output=str(output), start=0, stop=2.5) as client:
        document = client.identified()
        status = client.status(lambda status: "identified" in status.message, "its quality")
        # Whoever comes late hears it too.
        with on_graph() as late:
            heard = late.record(String, "/stage_model", LATCHED)
            late.spin_until(lambda: heard, "the latched model")
            assert heard[0].data == document
        assert client.node.stop() == 0
    model = identify(read_bag(bag), "pi", start=0.0, stop=2.5)
    found = parse_model(document, "test")
    assert found.hardware_id == status.hardware_id == "stage 7"
    path = voltage_path(300, 9)
    assert found.simulate(np.arange(300), path) == pytest.approx(model.simulate(np.arange(300), path), abs=1e-12)
    assert without_time(output.read_text()) == without_time(document)
    values = values_of(status)
    assert status.level == b"\0" and " nm" in status.message and "µm" in status.message
    assert float(values["x.rms_nm"]) == pytest.approx(model.axes["x"].quality.rms * 1e9, rel=1e-2)
    assert values["x.samples"] == str(model.axes["x"].quality.samples)


def test_without_a_bag_it_waits_until_it_is_given_one(bag):
    with identifying() as client:
        status = client.status(lambda status: True, "a report")
        assert status.level == b"\1" and "no bag" in status.message
        assert client.set(bags=[bag]) == ""
        client.identified()
        assert client.set(start=0.5) == ""
        client.identified(2)
        client.status(lambda status: status.level == b"\0", "health")


def test_a_failing_bag_is_reported_and_the_last_good_model_stays(bag, tmp_path):
    truncated = tmp_path / "truncated.mcap"
    (source,) = Path(bag).glob("*.mcap")
    truncated.write_bytes(source.read_bytes()[:2000])
    still = tmp_path / "still"
    stamps = np.arange(500, dtype=np.int64) * 5_000_000 + 1
    write_bag(still, Record(stamps, {"x": np.full(500, 3.0)}, {"x": np.zeros(500)}))
    with identifying(bags=[str(tmp_path / "none")]) as client:
        client.failed("none: no such bag")
        for path in (str(truncated), str(still)):
            assert client.set(bags=[path]) == ""
            client.failed(Path(path).name)
        assert client.set(bags=[bag], topic="other") == ""
        client.failed("other")
        assert client.set(topic="stage_state", output=str(tmp_path / "no" / "folder.json")) == ""
        client.failed("cannot be written")
        # That a file cannot be written does not keep the model from those who listen.
        document = client.identified()
        assert client.set(bags=["/nowhere"]) == ""
        client.failed("/nowhere")
        with on_graph() as late:
            heard = late.record(String, "/stage_model", LATCHED)
            late.spin_until(lambda: heard, "the last good model")
            assert heard[0].data == document
        assert "Traceback" not in client.node.stderr


def test_wrong_parameters_change_nothing(bag):
    with identifying() as client:
        client.status(lambda status: True, "a report")
        for refused, why in (
            ({"kind": "magic"}, "kind"),
            ({"watch_directory": "/nowhere/at/all"}, "no such folder"),
            ({"start": 5, "stop": 2.0}, "start before you stop"),
            ({"topic": ""}, "topic"),
            ({"diagnostic_period": 3.0}, "read-only"),
            ({"nonsense": 3.0}, "undeclared"),
        ):
            assert why in client.set(**refused)
        assert client.set(bags=[bag], start=-1, stop=float("nan")) == ""
        client.identified()


def source_of(document: str) -> str:
    return str(json.loads(document)["axes"]["x"]["quality"]["source"])


def test_several_bags_in_one_fit(bag, tmp_path):
    other = write_calibration(tmp_path / "other", seed=2)
    with identifying(bags=[bag, other]) as client:
        document = client.identified()
        assert source_of(document) == f"{bag}, {other}"
        assert json.loads(document)["axes"]["x"]["quality"]["samples"] == 1200


def test_bags_completed_in_the_watched_folder_are_identified(tmp_path):
    old, new = tmp_path / "watched" / "old", tmp_path / "watched" / "new"
    write_calibration(old, seed=1)
    output = tmp_path / "model.json"
    with identifying(watch_directory=str(old.parent), output=str(output)) as client:
        # The newest bag that is there already.
        assert source_of(client.identified()) == str(old)
        # One still being written: everything but what its writer adds last.
        write_calibration(tmp_path / "elsewhere", seed=3)
        new.mkdir()
        (recorded,) = (tmp_path / "elsewhere").glob("*.mcap")
        (new / recorded.name).write_bytes(recorded.read_bytes())
        client.look_on()
        assert len(client.models) == 1
        # A broken one is reported and skipped.
        broken = old.parent / "broken"
        broken.mkdir()
        (broken / "metadata.yaml").write_text("nonsense")
        client.failed("broken")
        (new / "metadata.yaml").write_bytes((tmp_path / "elsewhere" / "metadata.yaml").read_bytes())
        document = client.identified(2)
        assert source_of(document) == str(new)
        assert without_time(output.read_text()) == without_time(document)
        answer = client.graph.call(Trigger, "/identify/identify", Trigger.Request())
        assert answer.success and str(new) in answer.message
        client.identified(3)


def test_a_bag_whose_recording_was_killed_is_told_once_and_stays_watched(tmp_path):
    whole, killed, junk = tmp_path / "elsewhere", tmp_path / "watched" / "killed", tmp_path / "watched" / "junk.mcap"
    write_calibration(whole)
    (recorded,) = whole.glob("*.mcap")
    killed.mkdir(parents=True)
    (killed / recorded.name).write_bytes(recorded.read_bytes())
    junk.write_bytes(b"junk")
    long_ago = time.time() - 3600.0
    for path in (killed / recorded.name, killed, junk):
        os.utime(path, (long_ago, long_ago))
    with identifying(watch_directory=str(killed.parent)) as client:
        told = client.status(lambda status: "abandoned" in status.message, "a word on what was abandoned")
        assert told.level == b"\1" and str(killed) in told.message and str(junk) in told.message
        assert "ros2 bag reindex" in told.message and "delete" in told.message and "\n" not in told.message
        assert values_of(told)["abandoned_bags"] == "2"
        client.look_on()
        assert client.node.stderr.count("abandoned") == 2
        junk.unlink()
        (killed / "metadata.yaml").write_bytes((whole / "metadata.yaml").read_bytes())
        assert source_of(client.identified()) == str(killed)
        healthy = client.status(lambda status: status.level == b"\0", "health")
        assert values_of(healthy)["abandoned_bags"] == "0"


def test_bags_that_no_message_can_name_and_pipes_are_skipped(tmp_path):
    """Reported, counted, and the next bag is identified, also after a restart in the same folder."""
    watched = tmp_path / "watched"
    watched.mkdir()
    for life in range(2):
        with identifying(watch_directory=str(watched)) as client:
            write_calibration(tmp_path / "bag")
            (tmp_path / "bag").rename(os.fsdecode(os.path.join(os.fsencode(watched), b"caf\xe9 %d" % life)))
            client.failed("caf\\udce9")
            folder = Path(write_calibration(tmp_path / "pipe"))
            (data,) = folder.glob("*.mcap")
            data.unlink()
            os.mkfifo(data)
            folder.rename(watched / f"pipe{life}\x1b[2J")
            client.failed("no regular file")
            bag = Path(write_calibration(tmp_path / "good")).rename(watched / f"good{life}")
            told = client.status(lambda status, bag=bag: values_of(status).get("x.source") == str(bag), "its model")
            assert int(values_of(told)["failed"]) >= 2
            assert "Traceback" not in client.node.stderr and "\x1b[2J" not in client.node.stderr
            assert client.node.stop() == 0


@pytest.mark.parametrize(
    ("other", "why"),
    [
        pytest.param({"hardware_id": "stage 8"}, "stage 'stage 8'", id="another stage"),
        pytest.param({"axes": ("y",)}, "no axis 'x'", id="another axis", marks=pytest.mark.long),
    ],
)
def test_a_bag_of_another_stage_replaces_no_model(tmp_path, other, why):
    watched, output = tmp_path / "watched", tmp_path / "model.json"
    write_calibration(watched / "first")
    with identifying(watch_directory=str(watched), output=str(output)) as client:
        first = client.identified()
        # Which stage it is may be left open, but not forgotten.
        nameless = write_calibration(watched / "nameless", seed=2, hardware_id="", axes=("x", "y"))
        assert source_of(client.identified(2)) == nameless
        assert set(json.loads(client.models[1].data)["axes"]) == {"x", "y"}
        write_calibration(watched / "again", seed=3, axes=("x", "y"))
        again = client.identified(3)
        strange = write_calibration(watched / "strange", seed=4, **{"axes": ("x", "y"), **other})
        client.failed(strange)
        status = client.status(lambda status: why in status.message, why)
        assert "a node and a folder of its own" in status.message
        assert output.read_text() == again != first
        answer = client.graph.call(Trigger, "/identify/identify", Trigger.Request())
        assert answer.success and strange in answer.message
        client.failed(strange)
        assert len(client.models) == 3
        # Who names it means it.
        assert client.set(bags=[strange]) == ""
        assert strange in client.identified(4)


@pytest.mark.parametrize("where", ["file", pytest.param("topic", marks=pytest.mark.long)])
def test_a_bag_of_another_stage_replaces_no_model_after_a_restart(bag, tmp_path, where):
    """It came while the node was down, and is the newest one."""
    watched, output = tmp_path / "watched", tmp_path / "model.json"
    model = identify(read_bag(bag), "pi")
    strange = write_calibration(watched / "strange", seed=2, hardware_id="stage 8")
    given = {"watch_directory": str(watched)}
    if where == "file":
        save_model(model, output)
        given["output"] = str(output)
    before = format_model(model)
    with on_graph() as other:
        publisher = other.node.create_publisher(String, "stage_model", LATCHED)
        if where == "topic":
            publisher.publish(String(data=before))
        with identifying(**given) as client:

            def own() -> list[str]:
                return [message.data for message in client.models if message.data != before]

            client.failed(strange)
            assert not own()
            if where == "file":
                assert without_time(output.read_text()) == without_time(before)
            # What leaves open which stage it is of does not make it forgotten.
            write_calibration(watched / "nameless", seed=3, hardware_id="")
            client.graph.spin_until(own, "a model")
            again = write_calibration(watched / "strange again", seed=4, hardware_id="stage 8")
            client.failed(again)
            assert len(own()) == 1


@pytest.mark.parametrize("where", ["topic", "file"])
def test_watched_bags_are_of_the_stage_of_the_model_in_use(bag, tmp_path, where):
    model, output = identify(read_bag(bag), "pi"), tmp_path / "model.json"
    document = format_model(model)
    strange = write_calibration(tmp_path / "strange", seed=2, hardware_id="stage 8")
    nameless = write_calibration(tmp_path / "nameless", seed=2, hardware_id="")
    if where == "file":
        save_model(model, output)
    given = {"output": str(output), "in_use": document if where == "topic" else ""}

    def fitted(path: str, **more: Any) -> FitOutcome:
        return fit(FitRequest((path,), "stage_state", "pi", None, None, **given | more))

    for unconditional in (False, True):
        refused = fitted(strange, as_in_use=True, unconditional=unconditional)
        assert not refused.document and strange in refused.error and "'stage 8'" in refused.error
    taken = fitted(nameless, as_in_use=True)
    assert taken.document and taken.stage == StageIdentity("stage 7", ("x",))
    # Who names a bag means it, and where the stage is known it counts.
    assert fitted(strange).document
    assert fitted(strange, as_in_use=True, stage=StageIdentity("stage 8", ("x",))).document


def test_a_small_record_does_not_replace_a_model_of_the_whole_range(tmp_path):
    """Unless somebody asks for it; the line says what is less, by how much, and what is wanted."""
    watched, output = tmp_path / "watched", tmp_path / "model.json"
    whole = write_calibration(watched / "whole")
    with identifying(watch_directory=str(watched), output=str(output)) as client:
        first = client.identified()
        small = write_calibration(watched / "small", seed=2, samples=60, top=5.0)

        def kept(text: str, bag: str) -> None:
            status = client.status(lambda status: text in status.message and bag in status.message, text)
            assert status.level == b"\1" and "stays" in status.message and "\n" not in status.message
            assert values_of(status)["x.source"] == whole and output.read_text() == first and len(client.models) == 1

        kept("80%", small)
        assert client.node.stderr.count("80%") == 1
        # Neither does one that is named, nor one with a sensor that is far too coarse.
        assert client.set(bags=[small], watch_directory="") == ""
        kept("80%", small)
        coarse = write_calibration(tmp_path / "coarse", seed=3, digit=1.2e-6)
        assert client.set(bags=[coarse]) == ""
        client.failed("too coarse")
        assert len(client.models) == 1
        assert client.set(bags=[small]) == ""
        kept("80%", small)
        assert client.graph.call(Trigger, "/identify/identify", Trigger.Request()).success
        assert source_of(client.identified(2)) == small and source_of(output.read_text()) == small
        # A better one needs no word.
        assert client.set(bags=[whole]) == ""
        assert source_of(client.identified(3)) == whole
        assert client.set(bags=[small], replace=True) == ""
        assert source_of(client.identified(4)) == small
        assert "Traceback" not in client.node.stderr


@pytest.mark.parametrize("where", ["topic", pytest.param("file", marks=pytest.mark.long)])
def test_the_model_in_use_may_be_of_somebody_else(bag, tmp_path, where):
    """The last one on the topic, or that in the file after a restart."""
    small, output = write_calibration(tmp_path / "small", seed=2, samples=60, top=5.0), tmp_path / "model.json"
    model = identify(read_bag(bag), "pi")
    parameters = {"bags": [small]}
    if where == "file":
        save_model(model, output)
        parameters["output"] = str(output)
    with on_graph() as other:
        publisher = other.node.create_publisher(String, "stage_model", LATCHED)
        if where == "topic":
            publisher.publish(String(data=format_model(model)))
        with identifying(**parameters) as client:
            status = client.status(lambda status: "stays" in status.message, "a word on it")
            assert small in status.message and "80%" in status.message and status.level == b"\1"
            assert not client.node.stderr.count("[ERROR]")
            answer = client.graph.call(Trigger, "/identify/identify", Trigger.Request())
            assert answer.success
            client.graph.spin_until(lambda: any(source_of(each.data) == small for each in client.models), "the model")


def test_no_file_of_somebody_else_becomes_the_model(bag, tmp_path):
    (tmp_path / "notes.csv").write_text("mine")
    with identifying(bags=[bag], output=str(tmp_path / "notes.csv")) as client:
        client.identified()
        client.failed("notes.csv")
        assert (tmp_path / "notes.csv").read_text() == "mine"
        assert client.set(output="a" * 300) == ""
        client.failed("name too long")
        assert client.set(output="nowhere/model.json") == ""
        client.failed("nowhere")


def test_a_record_that_the_command_line_refuses_is_refused(bag, tmp_path):
    coarse = write_calibration(tmp_path / "coarse", digit=1.2e-6)
    outcome = fit(FitRequest((coarse,), "stage_state", "pi", None, None, ""))
    assert not outcome.document and coarse in outcome.error and "too coarse" in outcome.error
    document = format_model(identify(read_bag(bag), "pi"))
    diagnosed = run_diagnosis(DiagnosisRequest((coarse,), "stage_state", document, str(tmp_path / "out")))
    assert "too coarse" in diagnosed.error
    assert cli.main(["identify", coarse, "-o", str(tmp_path / "m.json")]) == 1


def test_the_stage_of_another_folder_is_another_one(tmp_path):
    mine = write_calibration(tmp_path / "mine" / "bag")
    yours = write_calibration(tmp_path / "yours" / "bag", axes=("y",), hardware_id="stage 8")
    with identifying(watch_directory=str(tmp_path / "mine")) as client:
        assert source_of(client.identified()) == mine
        assert client.set(watch_directory=str(tmp_path / "yours")) == ""
        assert yours in client.identified(2)


def test_trigger_without_anything_to_do():
    with identifying() as client:
        answer = client.graph.call(Trigger, "/identify/identify", Trigger.Request())
        assert not answer.success and "no bag" in answer.message


def test_a_diagnosis_of_the_model_in_use(humming_bag, tmp_path):
    with identifying(bags=[humming_bag], kind="slpi", output=str(tmp_path / "stage.json")) as client:
        client.identified()
        assert client.diagnosis("none")["diagnosis.folder"] == ""
        answer = client.diagnose()
        folder = tmp_path / "stage_diagnosis"
        assert answer.success and "x: named: Found: hum" in answer.message and "\n" not in answer.message
        assert str(folder / "report.html") in answer.message and str(folder / "extended_model.json") in answer.message
        # Reports went on meanwhile.
        assert client.diagnosis("diagnosing")["diagnosis.bag"] == humming_bag
        done = client.diagnosis("done")
        assert done["x.verdict"] == "named" and done["diagnosis.folder"] == str(folder)
        document = json.loads((folder / "diagnosis.json").read_text())
        validate(document, "diagnosis", "test")
        assert [effect["name"] for effect in document["axes"]["x"]["effects"]] == ["hum"]
        assert load_model(folder / "extended_model.json").axes["x"].effects
        assert (folder / "report.html").read_text().startswith("<!doctype html>")
        # What is running stays as it is.
        assert len(client.models) == 1 and not parse_model(client.models[0].data, "test").axes["x"].effects
        assert "Traceback" not in client.node.stderr


def test_a_diagnosis_reads_all_bags_of_the_fit(bag, humming_bag, tmp_path, monkeypatch):
    seen = []

    def diagnosed(records, model, **_):
        seen.extend(record.source for record in records)
        raise RecordError("enough")

    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", diagnosed)
    document = format_model(identify(read_bag(bag), "pi"))
    outcome = run_diagnosis(DiagnosisRequest((bag, humming_bag), "stage_state", document, str(tmp_path)))
    assert outcome.error == "enough" and seen == [bag, humming_bag]


def test_a_diagnosis_judges_the_part_that_was_fitted(tmp_path, monkeypatch):
    """As of a bag that is usable up to where its clock was set back."""
    back = Path(write_calibration(tmp_path / "whole", samples=2000))
    record = read_bag(back)
    stamps = record.time_ns.copy()
    stamps[1500:] -= 5_000_000_000
    write_bag(tmp_path / "back", replace(record, time_ns=stamps))
    seen = []

    def diagnosed(records, model, *, axes, start, stop):
        seen.append((start, stop))
        raise RecordError("enough")

    monkeypatch.setattr("slpi_ros.diagnosis.diagnose.diagnose", diagnosed)
    request = FitRequest((str(tmp_path / "back"),), "stage_state", "pi", 0.5, 7.0, "")
    published = SimpleNamespace(
        _diagnosis=SimpleNamespace(use=seen.append),
        _in_use=SimpleNamespace(publish=lambda document: None),
        get_logger=lambda: SimpleNamespace(info=lambda text: None),
    )
    Identify._publish(published, request, fit(request))
    outcome = run_diagnosis(replace(seen.pop(), folder=str(tmp_path / "out")))
    assert outcome.error == "enough" and seen == [(0.5, 7.0)]


def test_a_diagnosis_that_cannot_be_is_told(bag, tmp_path):
    (tmp_path / "file").touch()
    with identifying() as client:
        answer = client.diagnose()
        assert not answer.success and "no bag has been identified" in answer.message
        assert client.set(bags=[bag]) == ""
        client.identified()
        answer = client.diagnose()
        assert not answer.success and "600 usable samples" in answer.message and "\n" not in answer.message
        failed = client.status(lambda status: "600 usable samples" in status.message, "a warning")
        assert failed.level == b"\1" and values_of(failed)["diagnosis.state"] == "failed"
        # Without an output the files would have gone to a temporary folder.
        Path(values_of(failed)["diagnosis.folder"]).rmdir()
        assert client.set(diagnosis_directory=str(tmp_path / "file")) == ""
        answer = client.diagnose()
        assert not answer.success and "no folder to write into" in answer.message
        # Where the next one goes is no reason to identify anew; another start is, and then the failure is history.
        assert len(client.models) == 1
        assert client.set(diagnosis_directory=str(tmp_path), start=0.5) == ""
        client.identified(2)
        assert client.status(lambda status: values_of(status)["diagnosis.state"] == "none", "health").level == b"\0"
        assert "Traceback" not in client.node.stderr


@pytest.mark.parametrize(
    ("parameters", "named"),
    [({"kind": "magic"}, "kind"), ({"watch_directory": "/nowhere"}, "no such folder"), ({"start": "x"}, "start")],
)
def test_wrong_parameters_end_it_in_one_line(parameters, named):
    with started("identify", parameters) as node:
        assert node.wait() == 2
        assert node.stderr.count("\n") == 1 and named in node.stderr


def children(pid: int) -> list[int]:
    """Return the processes that identify for process `pid`."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(child) for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.long)])
def test_an_endless_identification_blocks_nothing_and_leaves_nothing(bag, number):
    with identifying() as client:
        client.status(lambda status: True, "a report")
        assert client.set(bags=[bag], kind="slpi") == ""
        (worker,) = client.graph.spin_until(lambda: children(client.node.process.pid), "the worker")
        os.kill(worker, signal.SIGSTOP)
        client.status(lambda status: "identifying" in status.message, "a report while it works")
        assert client.set(kind="magic") != ""
        # Another bag replaces what is under way.
        assert client.set(bags=[bag], kind="pi") == ""
        client.identified()
        assert client.set(kind="slpi") == ""
        (worker,) = client.graph.spin_until(lambda: children(client.node.process.pid), "the second worker")
        os.kill(worker, signal.SIGSTOP)
        assert client.node.stop(number) == 0
        assert not Path(f"/proc/{worker}").exists()
        assert "Traceback" not in client.node.stderr


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")
def test_an_endless_diagnosis_blocks_nothing_and_leaves_nothing(bag, humming_bag, tmp_path):
    with identifying(bags=[bag, humming_bag], diagnosis_directory=str(tmp_path)) as client:
        client.identified()
        asked = client.graph.node.create_client(Trigger, "/identify/diagnose")
        client.graph.spin_until(asked.service_is_ready, "the service")
        answers = [asked.call_async(Trigger.Request())]
        (worker,) = client.graph.spin_until(lambda: children(client.node.process.pid), "the worker")
        os.kill(worker, signal.SIGSTOP)
        assert client.diagnosis("diagnosing")["diagnosis.bag"] == f"{bag}, {humming_bag}"
        # Who asks meanwhile waits for the same one; bags are identified as ever.
        answers.append(asked.call_async(Trigger.Request()))
        assert client.graph.call(Trigger, "/identify/identify", Trigger.Request()).success
        client.identified(2)
        assert children(client.node.process.pid) == [worker]
        os.kill(worker, signal.SIGKILL)
        client.graph.spin_until(lambda: all(answer.done() for answer in answers), "two answers")
        for answer in answers:
            assert not answer.result().success and "exit code -9" in answer.result().message
        asked.call_async(Trigger.Request())
        (worker,) = client.graph.spin_until(lambda: children(client.node.process.pid), "another worker")
        os.kill(worker, signal.SIGSTOP)
        assert client.node.stop() == 0
        assert not Path(f"/proc/{worker}").exists()
        assert "Traceback" not in client.node.stderr


def test_a_worker_that_dies_is_an_error_not_a_hang(bag):
    request = FitRequest((bag,), "stage_state", "pi", None, None, "")
    job = WorkerProcess(fit, request, FitOutcome, "the identification")
    job.process.kill()
    deadline = time.monotonic() + PATIENCE_S
    while (outcome := job.outcome()) is None:
        assert time.monotonic() < deadline
    assert not outcome.document and "exit code -9" in outcome.error


def test_what_is_known_of_the_sensor_is_in_the_model(bag):
    given = {"sensor_delay": 0.01, "sensor_lag": 0.002}
    values = {one.name: one.default for one in DECLARATIONS} | {"bags": [bag], "kind": "pi"} | given
    request = IdentifySettings.of(values).request
    assert (request.sensor_delay, request.sensor_lag) == (0.01, 0.002)
    outcome = fit(request)
    assert parse_model(outcome.document, "new").axes["x"].sensor == Sensor(0.01, 0.002)
    for name in given:
        for value in (-0.001, 1.5, math.nan):
            with pytest.raises(UsageError, match=name):
                IdentifySettings.of(values | {name: value})


def test_the_compensator_takes_the_model_over(bag, tmp_path):
    output = tmp_path / "model.json"
    with identifying(bags=[bag], output=str(output)) as client, started("compensator") as node:
        client.graph.tested = node
        client.graph.wait_for_status(
            "/compensator: compensator", lambda status: values_of(status)["model.kind"] == "pi", "the model"
        )
        model = load_model(output)
        status = client.graph.statuses("/compensator: compensator")[-1]
        assert values_of(status)["model.created"] == model.created
