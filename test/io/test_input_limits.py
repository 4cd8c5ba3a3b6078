"""Input that never ends, or is larger than any record: refused in one line, with little memory."""

import json
import os
import resource
import sqlite3
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from bag_makers import JOINT_STATE, joint_state, mcap_file, rosbags_bag, serialised
from mcap.writer import CompressionType, IndexType
from scipy.io import savemat
from strategies import two_axes

from slpi_ros.cli import main
from slpi_ros.errors import ModelError
from slpi_ros.io.bag_storage import zstd
from slpi_ros.io.input_limits import LONGEST_NAME, MODEL_BYTES, MOST_AXES
from slpi_ros.io.schemas import load_schema
from slpi_ros.model.document import format_model, load_model, save_model

# What one refusal may add to the largest memory of this process, bytes; each of these cases asked for more.
MEMORY = 2**30
ZEROS = bytes(2**26)
STATES = [(10**9 + k * 10**7, joint_state(10**9 + k * 10**7, ["x"], [1e-6 * k], [float(k)])) for k in range(50)]
ROWS = [("/stage_state", logged, JOINT_STATE, serialised(message)) for logged, message in STATES]


def fifo(path: Path) -> Path:
    os.mkfifo(path)
    return path


def endless(path: Path) -> Path:
    path.symlink_to("/dev/zero")
    return path


def bag(path: Path, storage="mcap", compression="none") -> tuple[Path, Path]:
    """Return the folder of a bag, and its only data file."""
    rosbags_bag(path, {"/stage_state": STATES}, storage, compression)
    (file,) = (file for file in path.iterdir() if file.name != "metadata.yaml")
    return path, file


def replaced(file: Path, make) -> None:
    file.unlink()
    make(file)


def bomb(path: Path) -> Path:
    """Write 64 GiB of zeros as zstd: many frames of a repeated block."""
    path.write_bytes(zstd().compress(ZEROS) * 1000)
    return path


def packed_arrays(path: Path) -> Path:
    """Write a MATLAB file of three vectors with 2 GiB of zeros each, packed to two megabytes each."""
    savemat(path, {"time_s": np.arange(2.0)}, do_compression=True)
    content, size = path.read_bytes()[:128], 2**31
    for name in (b"time_s", b"voltage_V", b"displacement_um"):
        padded = name + bytes(-len(name) % 8)
        shape = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIII", 5, 8, size // 8, 1)
        array = shape + struct.pack("<II", 1, len(name)) + padded + struct.pack("<II", 9, size)
        compressor = zlib.compressobj()
        packed = compressor.compress(struct.pack("<II", 14, len(array) + size) + array)
        packed += compressor.compress(ZEROS) + compressor.flush(zlib.Z_FULL_FLUSH)
        # After a full flush the same zeros are the same bytes again.
        packed += (compressor.compress(ZEROS) + compressor.flush(zlib.Z_FULL_FLUSH)) * (size // len(ZEROS) - 1)
        content += struct.pack("<II", 15, len(packed)) + packed
    path.write_bytes(content)
    return path


def text(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def bag_without(path: Path, name: str, make) -> Path:
    folder, data = bag(path)
    replaced(folder / "metadata.yaml" if name else data, make)
    return folder


def view(path: Path) -> Path:
    """Write a bag whose definitions are an endless query."""
    folder, file = bag(path, "sqlite3")
    with sqlite3.connect(file) as base:
        base.execute("DROP TABLE schema")
        base.execute(
            "CREATE VIEW schema(schema_version) AS WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) "
            "SELECT max(k) FROM n"
        )
    return file


def aliases(path: Path) -> Path:
    folder, _ = bag(path)
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    laughs += "".join(f"a{k}: &a{k} [{', '.join(10 * [f'*a{k - 1}'])}]\n" for k in range(1, 12))
    metadata = folder / "metadata.yaml"
    known = metadata.read_text().replace("compression_format: ''", "compression_format: *a11")
    metadata.write_text(laughs + known.replace("compression_mode: ''", "compression_mode: message"))
    assert "*a11" in metadata.read_text()
    return folder


def no_summary(path: Path) -> Path:
    """Write chunks that pack well, without the summary that would let a reader skip them."""
    rows = [("/spare", 10**9, JOINT_STATE, ZEROS[: 2**24])] * 40
    dropped = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
    options = {"index_types": IndexType.NONE, "chunk_size": 2**26, **dict.fromkeys(dropped, False)}
    return mcap_file(path, rows, compression=CompressionType.ZSTD, **options)


def many_names(path: Path) -> Path:
    names = [f"axis{k}" for k in range(100_000)]
    values = [0.0] * len(names)
    rows = [("/stage_state", t, JOINT_STATE, serialised(joint_state(t, names, values, values))) for t in (1, 2)]
    return mcap_file(path, rows)


def other_names(path: Path) -> Path:
    states = (joint_state(t + 1, [f"a{50 * t + k}" for k in range(50)], [0.0] * 50, [0.0] * 50) for t in range(3000))
    rows = [("/stage_state", t, JOINT_STATE, serialised(message)) for t, message in enumerate(states)]
    return mcap_file(path, rows)


def long_name(path: Path) -> Path:
    name = "x" * 5000
    rows = [(t, joint_state(t, [name], [1e-9 * t], [1.0 * t])) for t in range(1, 50)]
    return mcap_file(path, [("/stage_state", t, JOINT_STATE, serialised(message)) for t, message in rows])


def wide(path: Path, columns: int, name: str = "spare{}") -> Path:
    names = [name.format(k) for k in range(columns)]
    return text(path, ",".join(["time_s", *names]), *(",".join(["1"] * (columns + 1)) for _ in range(2)))


TABLES = {
    "a pipe": lambda folder: fifo(folder / "t.csv"),
    "a pipe as MAT": lambda folder: fifo(folder / "t.mat"),
    "a device": lambda folder: endless(folder / "t.csv"),
    "a device as MAT": lambda folder: endless(folder / "t.mat"),
    "a million columns": lambda folder: wide(folder / "t.csv", 1_000_000),
    "100,000 axes": lambda folder: wide(folder / "t.csv", 20_000, "a{}_V"),
    "200 axes": lambda folder: wide(folder / "t.csv", 200, "displacement{}_um"),
    "6 GiB in a MAT file": lambda folder: packed_arrays(folder / "t.mat"),
}
BAGS = {
    "a pipe": lambda folder: fifo(folder / "b.mcap"),
    "a pipe without suffix": lambda folder: fifo(folder / "b"),
    "a device": lambda folder: endless(folder / "b.db3"),
    "a pipe for metadata": lambda folder: bag_without(folder / "b", "metadata", fifo),
    "a device for metadata": lambda folder: bag_without(folder / "b", "metadata", endless),
    "a pipe for data": lambda folder: bag_without(folder / "b", "", fifo),
    "a device for data": lambda folder: bag_without(folder / "b", "", endless),
    "64 GiB packed": lambda folder: bomb(folder / "b.mcap.zstd"),
    "64 GiB packed in a folder": lambda folder: bomb(bag(folder / "b", compression="file")[1]).parent,
    "chunks that unpack to 640 MB": lambda folder: no_summary(folder / "b.mcap"),
    "an endless view": lambda folder: view(folder / "b"),
    "aliases of aliases": lambda folder: aliases(folder / "b"),
    "100,000 names": lambda folder: many_names(folder / "b.mcap"),
    "other names in each message": lambda folder: other_names(folder / "b.mcap"),
    "a name of 5000 characters": lambda folder: long_name(folder / "b.mcap"),
}


def million_axes(path: Path) -> Path:
    axis = json.loads(format_model(two_axes()))["axes"]["x"]
    document = json.loads(format_model(two_axes())) | {"axes": {f"a{k}": {} for k in range(400_000)} | {"x": axis}}
    path.write_text(json.dumps(document))
    return path


MODELS = {
    "a pipe": lambda folder: fifo(folder / "m.json"),
    "a device": lambda folder: endless(folder / "m.json"),
    "a million axes": lambda folder: million_axes(folder / "m.json"),
    "17 MiB": lambda folder: text(folder / "m.json", " " * (MODEL_BYTES + 1)),
}


def refused(capsys, *arguments: object) -> str:
    """Return the one line with which a command refuses its input; the memory of this process hardly grows."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert main([str(each) for each in arguments]) == 1
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    said = capsys.readouterr()
    assert not said.out and said.err.count("\n") == 1 and len(said.err) < 1000, said
    assert grown < MEMORY
    return said.err


@pytest.mark.parametrize("case", TABLES)
def test_tables(case, tmp_path, capsys):
    table = TABLES[case](tmp_path)
    assert str(table) in refused(capsys, "import", table, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", [case for case in TABLES if "MAT" not in case])
def test_tables_of_commands(case, tmp_path, capsys):
    table = TABLES[case](tmp_path)
    save_model(two_axes(), tmp_path / "model.json")
    refused(capsys, "simulate", tmp_path / "model.json", table, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", BAGS)
def test_bags(case, tmp_path, capsys):
    source = BAGS[case](tmp_path)
    assert str(source) in refused(capsys, "identify", source, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("case", MODELS)
def test_models(case, tmp_path, capsys):
    model = MODELS[case](tmp_path)
    assert str(model) in refused(capsys, "show", model)


def test_the_schemas_have_the_same_limits():
    for name in ("model", "saved_memory"):
        axes = load_schema(name)["properties"]["axes"]
        assert (axes["maxProperties"], axes["propertyNames"]["maxLength"]) == (MOST_AXES, LONGEST_NAME)


def test_an_invalid_document_is_told_soon(tmp_path):
    """However many of its numbers are wrong."""
    document = json.loads(format_model(two_axes()))
    document["axes"]["x"]["effects"] = [{"name": "creep", "parameters": {"gains": ["x"] * 300_000}}]
    path = tmp_path / "m.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ModelError, match="axes"):
        load_model(path)
