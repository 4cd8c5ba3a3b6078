"""Every form in which rosbags and the mcap package write a recording, read back value for value."""

import errno
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from bag_makers import JOINT_STATE, joint_state, mcap_file, rosbags_bag, serialised, split_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType
from refusals import holds, refusal

from slpi_ros.errors import RecordError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_storage import McapFile
from slpi_ros.io.record import OUT_OF_ORDER

COUNT = 900
STATES = [
    (1000 + row, joint_state(10**9 + 1000 * row, ("x", "long"), (row, row + 0.5), (-row, 2 * row), "stage"))
    for row in range(COUNT)
]
NOISE = [(1000 + row, joint_state(5, ("other",), (0,), (0,))) for row in range(0, COUNT, 7)]
TOPICS = {"/stage_state": STATES, "/other": NOISE}
ROWS = sorted(
    [(topic, logged, JOINT_STATE, serialised(m)) for topic, pairs in TOPICS.items() for logged, m in pairs],
    key=lambda row: row[1],
)

forms = pytest.mark.parametrize(
    ("storage", "compression"),
    [(storage, way) for storage in ("mcap", "sqlite3") for way in ("none", "message", "file")] + [("mcap", "storage")],
)


def assert_whole(record, count=COUNT) -> None:
    row = np.arange(count)
    assert record.hardware_id == "stage"
    assert record.notes == ()
    np.testing.assert_array_equal(record.time_ns, 10**9 + 1000 * row)
    np.testing.assert_array_equal(record.displacement["x"], row)
    np.testing.assert_array_equal(record.displacement["long"], row + 0.5)
    np.testing.assert_array_equal(record.voltage["x"], -row)
    np.testing.assert_array_equal(record.voltage["long"], 2 * row)


@forms
def test_whole_bag_lone_file_and_folder_without_metadata(tmp_path, storage, compression):
    bag = rosbags_bag(tmp_path / "bag", TOPICS, storage, compression)
    assert_whole(read_bag(bag))
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    assert_whole(read_bag(file))
    (bag / "metadata.yaml").unlink()
    assert_whole(read_bag(bag))


@forms
def test_split_bag(tmp_path, storage, compression):
    # More than ten parts: in the order of names the tenth would come second.
    parts = [{"/stage_state": STATES[start : start + 80]} for start in range(0, COUNT, 80)]
    parts[0]["/other"] = NOISE
    bag = split_bag(tmp_path / "bag", parts, storage, compression)
    assert len(list(bag.iterdir())) == 13
    assert_whole(read_bag(bag))
    (bag / "metadata.yaml").unlink()
    assert_whole(read_bag(bag))
    next(bag.glob("bag_3.*")).unlink()
    assert holds(refusal(RecordError, read_bag, bag), f"ros2 bag reindex {bag}", "11 bag files", "0 to 10")


def test_two_bags_in_one_folder_are_not_one(tmp_path):
    for name in ("morning", "evening"):
        bag = rosbags_bag(tmp_path / name, TOPICS)
        shutil.copy(bag / f"{name}.mcap", tmp_path / f"{name}_{0 if name == 'morning' else 1}.mcap")
        shutil.rmtree(bag)
    assert holds(refusal(RecordError, read_bag, tmp_path), f"ros2 bag reindex {tmp_path}", "2 bag files")


def test_damaged_compressed_file(tmp_path):
    bag = rosbags_bag(tmp_path / "bag", TOPICS, "mcap", "file")
    file = bag / "bag.mcap.zstd"
    file.write_bytes(file.read_bytes()[:-100])
    assert holds(refusal(RecordError, read_bag, file), file, "zstd -t")
    assert holds(refusal(RecordError, read_bag, bag), bag)


def test_no_room_to_unpack(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    bag = rosbags_bag(tmp_path / "bag", TOPICS, "sqlite3", "file")
    monkeypatch.setattr(shutil, "copyfileobj", full)
    for path in (bag, bag / "bag.db3.zstd"):
        assert holds(refusal(RecordError, read_bag, path), path, "TMPDIR")


def test_sqlite_with_messages_in_its_journal(tmp_path):
    bag = rosbags_bag(tmp_path / "bag", TOPICS, "sqlite3")
    (bag / "bag.db3-wal").write_bytes(b"messages")
    assert holds(refusal(RecordError, read_bag, bag), "bag.db3-wal", "wal_checkpoint")


def test_sqlite_copied_without_its_journal(tmp_path):
    # Until its first checkpoint a database that is written with a log ahead is a page without tables.
    with closing(sqlite3.connect(tmp_path / "live.db3")) as base:
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, data BLOB)")
        base.commit()
        shutil.copy(tmp_path / "live.db3", tmp_path / "copy.db3")
    told = str(refusal(RecordError, read_bag, tmp_path / "copy.db3"))
    assert holds(told, tmp_path / "copy.db3", "copy.db3-wal")
    assert ".recover" not in told


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize(
    "indexes", [IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE], ids=["all", "none", "chunk", "msg"]
)
@pytest.mark.parametrize("chunking", [True, False])
def test_mcap_package_with_any_options(tmp_path, compression, indexes, chunking):
    file = mcap_file(
        tmp_path / "file.mcap",
        ROWS,
        compression=compression,
        index_types=indexes,
        use_chunking=chunking,
        chunk_size=20_000,
    )
    assert_whole(read_bag(file))


def test_mcap_without_any_summary(tmp_path):
    options = {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False, "use_summary_offsets": False}
    file = mcap_file(tmp_path / "file.mcap", ROWS, index_types=IndexType.NONE, chunk_size=20_000, **options)
    assert_whole(read_bag(file))


@pytest.mark.parametrize("chunking", [True, False])
def test_mcap_out_of_order(tmp_path, chunking):
    shuffled = [ROWS[row] for row in np.random.default_rng(0).permutation(len(ROWS))]
    file = mcap_file(tmp_path / "file.mcap", shuffled, use_chunking=chunking, chunk_size=5_000)
    read = read_bag(file)
    (note,) = read.notes
    assert note.startswith(OUT_OF_ORDER)
    assert_whole(replace(read, notes=()))


def test_several_publishers_of_one_topic(tmp_path):
    # The mcap package keeps channels of the same topic apart.
    rows = [("/stage_state" if row % 3 else "/stage_state#", *rest) for row, (_, *rest) in enumerate(ROWS)]
    rows = [row for row in rows if b"other" not in row[3]]
    assert_whole(read_bag(mcap_file(tmp_path / "file.mcap", rows, chunk_size=5_000)))


def test_chunk_that_does_not_agree_with_its_checksum(tmp_path):
    file = mcap_file(tmp_path / "file.mcap", ROWS, compression=CompressionType.NONE)
    data = bytearray(file.read_bytes())
    place = data.index(serialised(STATES[300][1])) + 80
    data[place] ^= 1
    file.write_bytes(data)
    assert holds(refusal(RecordError, read_bag, file), file, "checksum")


# CDR begins with a zero; what begins as zstd does would be unpacked.
messages = st.binary(max_size=5).map(lambda data: b"\0" + data) | st.just(b"")


@settings(max_examples=60)
@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 9), messages), max_size=40), st.data())
def test_every_message_of_a_topic_byte_by_byte(tmp_path_factory, rows, data):
    folder = tmp_path_factory.mktemp("mcap")
    file = mcap_file(
        folder / "file.mcap",
        [(f"/{topic}", logged, JOINT_STATE, message) for topic, logged, message in rows],
        chunk_size=data.draw(st.sampled_from([1, 60, 1000])),
        use_chunking=data.draw(st.booleans()),
        index_types=data.draw(st.sampled_from([IndexType.ALL, IndexType.CHUNK])),
    )
    with file.open("rb") as stream:
        bag = McapFile(stream)
        wanted = {each.number for each in bag.connections if each.topic == "/a"}
        read = [pair for b in bag.blocks(wanted) for pair in zip(b.logged.tolist(), b.each(), strict=True)]
    assert read == [(logged, message) for topic, logged, message in rows if topic == "a"]


@settings(max_examples=40)
@given(st.data())
def test_damaged_mcap_never_escapes(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    options = {"compression": data.draw(st.sampled_from(CompressionType)), "enable_crcs": data.draw(st.booleans())}
    file = mcap_file(folder / "file.mcap", ROWS[:60], chunk_size=2_000, **options)
    content = bytearray(file.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=5)):
        content[place] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    try:
        read = read_bag(file)
    except RecordError as error:
        assert holds(str(error), file) and "\n" not in str(error)
    else:
        # What is read has the form of a record: damage that no checksum guards may change its numbers.
        count = read.time_ns.size
        assert 0 < count <= 60 and set(read.axes) == set(read.voltage) == set(read.displacement) != set()
        assert all(
            column.shape == (count,) for columns in (read.voltage, read.displacement) for column in columns.values()
        )
