"""The manifest of the public measured records, and the way from a repository to a table and a bag."""

import hashlib
import json
import subprocess
from dataclasses import replace

import pytest

import slpi_ros
from benchmarks.measured import fetch
from benchmarks.measured.manifest import ManifestError, Source, Span, Task, read_manifest
from benchmarks.measured.sources import EXTRACTIONS


def git(folder, *arguments):
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    done = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def published(tmp_path):
    """Return a folder with the repository someone/rig, and a manifest of its record."""
    place = tmp_path / "mirror" / "someone" / "rig"
    place.mkdir(parents=True)
    git(place, "init", "--quiet")
    rows = [f",{0.01 * k:.2f},{0.1 * k:.1f},{float(k):.1f}" for k in range(50)]
    (place / "data.csv").write_text("\n".join(rows) + "\n")
    git(place, "add", "data.csv")
    git(place, "commit", "--quiet", "-m", "data")
    table = "time_s,voltage_V,displacement_um\n" + "".join(
        f"{0.01 * k:.2f},{float(k):.1f},{0.1 * k:.1f}\n" for k in range(50)
    )
    record = {
        "source": "rig",
        "files": ["data.csv"],
        "extraction": "piezo_150v",
        "columns": {"time_s": "s", "voltage_V": "V", "displacement_um": "um"},
        "rate_hz": 100,
        "sha256": hashlib.sha256(table.encode()).hexdigest(),
        "known": "a straight line",
    }
    source = {
        "repository": "someone/rig",
        "commit": git(place, "rev-parse", "HEAD"),
        "licence": "none stated",
        "device": "a stage",
    }
    manifest = tmp_path / "manifest.json"
    manifest.write_text(json.dumps({"sources": {"rig": source}, "records": {"line": record}, "tasks": []}))
    return tmp_path / "mirror", manifest


def check(output):
    record = slpi_ros.read_bag(output / "bags" / "line")
    assert len(record) == 50
    assert record.displacement["x"][10] == pytest.approx(1e-6)


def test_from_a_mirror(published, tmp_path):
    mirror, manifest = published
    assert fetch.main(["-o", str(tmp_path / "out"), "--mirror", str(mirror), "--manifest", str(manifest)]) == 0
    check(tmp_path / "out")


def test_as_from_the_network(published, tmp_path, monkeypatch):
    mirror, manifest = published
    git(mirror / "someone" / "rig", "config", "uploadpack.allowFilter", "true")
    for key, value in {
        "GIT_CONFIG_COUNT": "1",
        "GIT_CONFIG_KEY_0": f"url.file://{mirror}/someone/rig.insteadOf",
        "GIT_CONFIG_VALUE_0": "https://github.com/someone/rig.git",
    }.items():
        monkeypatch.setenv(key, value)
    assert fetch.main(["-o", str(tmp_path / "out"), "--manifest", str(manifest)]) == 0
    check(tmp_path / "out")


def test_without_a_network_one_line(published, tmp_path, monkeypatch, capsys):
    _, manifest = published
    document = json.loads(manifest.read_text())
    document["records"]["another"] = document["records"]["line"]
    manifest.write_text(json.dumps(document))
    monkeypatch.setenv("GIT_CONFIG_COUNT", "1")
    monkeypatch.setenv("GIT_CONFIG_KEY_0", f"url.file://{tmp_path}/nothing/.insteadOf")
    monkeypatch.setenv("GIT_CONFIG_VALUE_0", "https://github.com/")
    assert fetch.main(["-o", str(tmp_path / "out"), "--manifest", str(manifest)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "https://github.com/someone/rig.git" in line
    assert not (tmp_path / "out" / "line.csv").exists()


def test_a_folder_that_cannot_be_made_takes_one_line(published, tmp_path, capsys):
    mirror, manifest = published
    (tmp_path / "out").write_text("a file")
    with pytest.raises(SystemExit) as ended:
        fetch.main(["-o", str(tmp_path / "out"), "--mirror", str(mirror), "--manifest", str(manifest)])
    assert ended.value.code == 2
    assert "File exists" in capsys.readouterr().err.splitlines()[-1]


def test_another_file_is_refused(published, tmp_path, capsys):
    mirror, manifest = published
    document = json.loads(manifest.read_text())
    document["records"]["line"]["sha256"] = 64 * "0"
    manifest.write_text(json.dumps(document))
    assert fetch.main(["-o", str(tmp_path / "out"), "--mirror", str(mirror), "--manifest", str(manifest)]) == 1
    assert "sha256" in capsys.readouterr().err


def test_the_manifest():
    manifest = read_manifest()
    assert {record.source for record in manifest.records.values()} == set(manifest.sources)
    assert {record.extraction for record in manifest.records.values()} <= set(EXTRACTIONS)
    used = {span.record for task in manifest.tasks for span in (*task.fitted, *task.judged)}
    assert used == set(manifest.records)


def test_the_tables_are_those_of_the_manifest(measured_data):
    for name, record in read_manifest().records.items():
        table = (measured_data / f"{name}.csv").read_bytes()
        assert hashlib.sha256(table).hexdigest() == record.sha256, name
        assert table.split(b"\n")[0].decode() == ",".join(record.columns)


@pytest.mark.parametrize(
    "change",
    [
        {"commit": "8d1d16b"},
        {"repository": "https://github.com/a/b"},
        {"licence": ""},
    ],
)
def test_sources_that_cannot_be_right(change):
    good = Source("a/b", 40 * "0", "MIT", "a stage")
    with pytest.raises(ManifestError):
        replace(good, **change)


@pytest.mark.parametrize(
    "change",
    [
        {"files": ("../secret",)},
        {"files": ()},
        {"columns": {"time_s": "s", "displacement_um": "um"}},
        {"rate_hz": 0.0},
        {"sha256": "abc"},
    ],
)
def test_records_that_cannot_be_right(change):
    good = read_manifest().records["picma_1hz_major"]
    with pytest.raises(ManifestError):
        replace(good, **change)


def test_what_is_fitted_is_not_judged():
    with pytest.raises(ManifestError):
        Task("picma", "x", (Span("a", 0.0, 5.0),), (Span("a", 4.0, 9.0),))
    Task("picma", "x", (Span("a", 0.0, 4.0),), (Span("a", 4.0, 9.0),))
