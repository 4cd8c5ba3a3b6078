"""A run on a cluster within this process: rows, references, changes, exchange, continuation."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from distributed import KilledWorker
from pandas.testing import assert_frame_equal

import slpi_ros
from slpi_ros.cli import main
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.fleet import bags, cluster, run
from slpi_ros.fleet.pages import DOCUMENT, PAGE, report_fleet
from slpi_ros.fleet.results import TABLE, Results
from slpi_ros.fleet.sources import Bag, find_bags
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.schemas import validate

DAY_NS = 86_400 * 10**9


def by_name(table):
    return {Path(row.bag).stem: row for row in table.itertuples()}


def test_each_bag_is_a_row(done, fleet):
    rows = by_name(done[2])
    assert len(done[2]) == 11 == len(rows)
    assert {name: row.verdict for name, row in rows.items()} == {
        "broken": bags.REFUSED,
        "a-0": bags.IDENTIFIED, "a-10": bags.PASSED, "a-20": bags.CHANGED, "a-30": bags.CHANGED, "a-40": bags.FOREIGN,
        "b-0": bags.IDENTIFIED, "b-10": bags.PASSED, "b-20": bags.PASSED, "b-30": bags.PASSED, "b-40": bags.FOREIGN,
    }  # fmt: skip
    assert "empty" in rows["broken"].error and rows["broken"].axis == ""
    assert (rows["a-40"].like_stage, rows["b-40"].like_stage) == ("b", "a")
    assert rows["a-20"].gain_change == pytest.approx(0.02, abs=4 * rows["a-20"].gain_uncertainty)
    assert rows["a-20"].gain_m_per_v == pytest.approx(1.02 * rows["a-0"].gain_m_per_v, rel=3e-3)
    assert rows["a-20"].refitted_rms_m < rows["a-20"].limit_rms_m < rows["a-20"].held_out_rms_m
    assert rows["a-0"].date == pd.Timestamp(20_000 * DAY_NS, tz="UTC")


def test_models_of_each_stage(done):
    folder, _, table = done
    rows = by_name(table)
    for name in ("a-0", "a-20"):
        assert slpi_ros.load_model(folder / rows[name].model).hardware_id == "a"
    assert rows["a-10"].model == rows["a-0"].model != rows["a-20"].model
    assert (folder / rows["a-20"].page).is_file()


def test_changes_and_exchange(done):
    document = json.loads((done[0] / DOCUMENT).read_text())
    validate(document, "fleet", DOCUMENT)
    a, b = document["stages"]
    (step,) = [one for one in a["changes"] if one["quantity"] == "gain"]
    assert step["kind"] == "step" and step["size"] == pytest.approx(0.02, abs=4e-3)
    assert (step["date_ns"], step["before_ns"]) == (20_020 * DAY_NS, 20_010 * DAY_NS)
    assert not [one for one in b["changes"] if one["quantity"] == "gain"]
    for one, other in ((a, "b"), (b, "a")):
        (exchange,) = one["exchanges"]
        assert exchange == {
            "like_stage": other, "date_ns": 20_040 * DAY_NS, "before_ns": 20_030 * DAY_NS, "mutual": True
        }  # fmt: skip
        assert one["health"] == "exchanged"


def test_pages(done):
    index = (done[0] / PAGE).read_text()
    assert 'href="stages/a.html"' in index and "broken.mcap" in index
    assert (done[0] / "stages" / "a.html").is_file()


def test_a_second_run_has_nothing_to_do(done, fleet, client, monkeypatch):
    monkeypatch.setattr(bags, "examine", None)
    again = run([fleet], done[0], client=client, diagnose=False)
    assert_frame_equal(again, done[2])


@pytest.mark.parametrize("kept", [pytest.param(5, marks=pytest.mark.long), -2])
def test_a_run_that_was_stopped_at_any_line_continues(done, fleet, client, tmp_path, kept):
    folder = tmp_path / "copy"
    shutil.copytree(done[0], folder)
    lines = (done[0] / "journal.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "journal.jsonl").write_bytes(b"".join(lines[:kept]))
    again = run([fleet], folder, client=client, diagnose=False)
    assert_frame_equal(again.drop(columns="seconds"), done[2].drop(columns="seconds"))


def test_new_and_changed_bags_are_added(stages, client, tmp_path):
    stages.write(tmp_path / "bags", "a", 0)
    first = run([tmp_path / "bags"], tmp_path / "out", client=client)
    stages.write(tmp_path / "bags", "a", 5, 1.03)
    second = run([tmp_path / "bags"], tmp_path / "out", client=client)
    assert list(second.verdict) == [bags.IDENTIFIED, bags.CHANGED] and second.seconds[0] == first.seconds[0]


def test_given_models_a_date_and_a_list(done, stages, client, tmp_path):
    rows = by_name(done[2])
    models = tmp_path / "models"
    models.mkdir()
    shutil.copy(done[0] / rows["a-0"].model, models / "a.json")
    early, late = (stages.write(tmp_path, "a", day, name="") for day in (1, 7))
    table = tmp_path / "list.csv"
    table.write_text(f"bag,stage\n{early.name},a\n{late.name},a\nmissing,a\n".replace("unnamed-1,", f"{early},"))
    found = run([table], client=client, models=models, since=str(np.datetime64(20_003, "D")))
    assert {Path(row.bag).name: row.verdict for row in found.itertuples()} == {
        late.name: bags.PASSED, "missing": bags.REFUSED
    }  # fmt: skip


@pytest.mark.slow
def test_the_cause_of_an_error_that_is_no_change_is_named(stages, client, tmp_path):
    stages.write(tmp_path / "bags", "a", 0)
    record = stages.record("a", 5)
    hum = 60e-9 * np.sin(2 * np.pi * 13.7 * stages.drive.t)
    write_bag(tmp_path / "bags" / "a-5", replace(record, displacement={"x": record.displacement["x"] + hum}))
    rows = by_name(run([tmp_path / "bags"], client=client))
    assert rows["a-0"].diagnosis == "" and len(rows["a-0"].causes) == 0
    assert rows["a-5"].diagnosis == "named" and rows["a-5"].verdict != bags.CHANGED
    (cause,) = rows["a-5"].causes
    assert cause["name"] == "hum" and cause["p_value"] < 0.01 and cause["share_of_residual"] > 0.9
    assert json.loads(cause["parameters"])["lines"][0]["frequency"] == pytest.approx(13.7, abs=0.02)


def test_a_bag_of_an_unknown_stage_stands_alone(stages, client, tmp_path):
    for day in (0, 1):
        stages.write(tmp_path, "a", day, name="")
    assert list(run([tmp_path], client=client, diagnose=False).verdict) == [bags.IDENTIFIED] * 2


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_bags_of_a_folder_whose_name_is_not_utf8(stages, client, tmp_path, storage):
    folder = tmp_path / os.fsdecode(b"Me\xdfreihe")
    for day, gain in ((0, 1.0), (5, 1.03)):
        write_bag(folder / f"a-{day}", stages.record("a", day, gain), storage=storage)
    (folder / "broken.mcap").write_bytes(b"")
    lines, usable = report_fleet([str(folder)], str(tmp_path / "out"), client=client, diagnose=False)
    rows = by_name(pd.read_parquet(tmp_path / "out" / TABLE))
    assert {name: row.verdict for name, row in rows.items()} == {
        "a-0": bags.IDENTIFIED, "a-5": bags.CHANGED, "broken": bags.REFUSED
    }  # fmt: skip
    assert usable and len(lines) == 4 and all("Me\\udcdfreihe" in row.bag for row in rows.values())
    assert (tmp_path / "out" / PAGE).is_file()
    assert len(run([folder], tmp_path / "out", client=client, diagnose=False)) == 3


def test_what_cannot_be_run(fleet, client, tmp_path):
    with pytest.raises(UsageError):
        run([fleet], client=client, workers=2)
    with pytest.raises(UsageError, match="yesterday"):
        run([fleet], client=client, since="yesterday")
    (tmp_path / "empty").mkdir()
    with pytest.raises(SlpiError):
        run([tmp_path / "empty"], client=client)
    with Results(tmp_path / "out", {}), pytest.raises(SlpiError):
        run([fleet], tmp_path / "out", client=client)


def test_watch_takes_bags_as_they_are_completed(stages, client, tmp_path, monkeypatch):
    looks = []

    def find(sources):
        looks.append(len(looks))
        if looks[-1] == 1:
            stages.write(tmp_path / "bags", "a", 5)
            (tmp_path / "bags" / "growing.mcap").write_bytes(b"not yet complete")
        if looks[-1] == 2:
            raise KeyboardInterrupt
        return find_bags(sources)

    stages.write(tmp_path / "bags", "a", 0)
    monkeypatch.setattr(cluster, "find_bags", find)
    with pytest.raises(KeyboardInterrupt):
        run([tmp_path / "bags"], tmp_path / "out", client=client, watch=True, diagnose=False)
    assert list(pd.read_parquet(tmp_path / "out" / TABLE).verdict) == [bags.IDENTIFIED, bags.PASSED]


@pytest.mark.parametrize("axes", [(), ("x",)])
def test_a_bag_that_ends_its_workers_is_a_row(axes):
    class Future:
        status = "error"

        def exception(self):
            return KilledWorker("task", None, 3)

    one = bags.Examined(Bag("/huge.mcap", "a"), "a", axes=axes)
    task = cluster.Task(one, bags.compare if axes else bags.examine, (), lambda _: ())
    work = cluster._Cluster(None, None)
    for attempt in range(cluster.ATTEMPTS - 1):
        assert list(work._settle([replace(task, attempts=attempt)], Future())) == []
        assert work._waiting.pop().attempts == attempt + 1
    ((_, result),) = work._settle([replace(task, attempts=cluster.ATTEMPTS - 1)], Future())
    (row,) = result.rows if axes else result.rows()
    assert row.verdict == bags.REFUSED and row.axis == "".join(axes) and "/huge.mcap" in row.error


class Done:
    """The future of a group of tasks, finished after some seconds."""

    status = "finished"

    def __init__(self, count, seconds):
        self._result = list(range(count)), seconds

    def result(self):
        return self._result


def tasks_of(count, size=1000, **given):
    sizes = [size] * count if isinstance(size, int) else size
    examined = [bags.Examined(Bag(f"/{k}.mcap", "a", size), "a") for k, size in enumerate(sizes)]
    return [cluster.Task(one, bags.examine, (), lambda _: (), **given) for one in examined]


def groups(work, tasks):
    source = iter(tasks)
    return [len(group) for group in iter(lambda: work._next(source), [])]


def test_quick_tasks_are_sent_together_and_their_results_stay_with_them():
    work, tasks = cluster._Cluster(None, None), tasks_of(5)
    # As long as nobody knows how long one takes, each is sent by itself.
    assert groups(work, tasks) == [1] * 5
    assert list(work._settle(tasks, Done(5, 5 * cluster.GROUP_SECONDS / 4))) == list(zip(tasks, range(5), strict=True))
    assert groups(work, tasks_of(9)) == [4, 4, 1]
    # A large bag is not, nor is a slow function, nor one that is to be alone.
    large = cluster.GROUP_BYTES
    assert groups(work, tasks_of(5, [10, large, 10, 10, 2 * large])) == [1, 1, 2, 1]
    assert groups(work, [*tasks_of(2), *tasks_of(1, alone=True), *tasks_of(2)]) == [2, 1, 2]
    other = [replace(task, function=bags.compare) for task in tasks_of(2)]
    assert groups(work, [*tasks_of(2), *other]) == [2, 1, 1]
    for _ in range(10):
        list(work._settle(tasks[:1], Done(1, 100.0)))
    assert groups(work, tasks_of(3)) == [1, 1, 1]


@pytest.mark.parametrize("error", [KilledWorker("task", None, 3), MemoryError()])
def test_of_a_group_that_fails_each_task_is_tried_by_itself(error):
    class Future:
        status = "error"

        def exception(self):
            return error

    work, tasks = cluster._Cluster(None, None), tasks_of(3)
    assert list(work._settle(tasks, Future())) == []
    assert list(work._waiting) == [replace(task, alone=True) for task in tasks]
    assert groups(work, []) == [1, 1, 1]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (("nothing",), 1),
        ((".", "--workers", "0"), 2),
        ((".", "--workers", "2", "--scheduler", "tcp://host:1"), 2),
        ((".", "--since", "soon"), 2),
        ((".", "--models", "nothing"), 2),
        ((".",), 1),
    ],
)
def test_the_command_refuses_in_one_line(options, code, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    try:
        ended = main(["fleet", *options, "-o", "out"])
    except SystemExit as end:
        ended = end.code
    said = capsys.readouterr()
    assert ended == code and not said.out and said.err.count("\n") == 1 and said.err.startswith("slpi fleet: ")
    assert not list(tmp_path.iterdir())
