"""Bags of which messages are doubled, missing, late, wrongly stamped or of another kind: read, and told."""
# ruff: noqa: E501

import re
import shutil
import struct

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from refusals import holds, refusal
from rosbags.typesys import Stores, get_typestore

from slpi_ros.errors import RecordError
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.io.messages import JOINT_STATE, encode_joint_states
from slpi_ros.io.record import Record
from slpi_ros.workflows.records import Source, assess_record

N, START, PERIOD = 600, 1_764_000_000 * 10**9, 2_000_000
RNG = np.random.default_rng(2)
V = np.interp(np.arange(N), [0, 150, 300, 450, N], [0.0, 100.0, 20.0, 80.0, 0.0])
Y = 2e-7 * V + RNG.normal(0.0, 8e-9, N)
STAMPS = START + PERIOD * np.arange(N)


def messages(stamps, y=Y, v=V):
    return list(encode_joint_states(np.asarray(stamps, np.int64), y[:, None], v[:, None], ("x",)))


def mcap(path, rows, channels=None, profile="ros2"):
    """Write rows (channel, time of recording, bytes); channels are topic, type and encoding by name."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile, "test")
        known = {}
        for name, (topic, msgtype, encoding) in (channels or {"a": ("/stage_state", JOINT_STATE, "cdr")}).items():
            schema = writer.register_schema(msgtype, "ros2msg", b"")
            known[name] = writer.register_channel(topic, encoding, schema)
        for number, (name, logged, data) in enumerate(rows):
            writer.add_message(known[name], int(logged), data, int(logged), number)
        writer.finish()
    return path


def rows(stamps=STAMPS, logged=None, **values):
    return [
        ("a", at, data)
        for at, data in zip(stamps if logged is None else logged, messages(stamps, **values), strict=True)
    ]


def whole(record, notes=0):
    np.testing.assert_array_equal(record.time_ns, STAMPS)
    np.testing.assert_array_equal(record.displacement["x"], Y)
    np.testing.assert_array_equal(record.voltage["x"], V)
    assert len(record.notes) == notes, record.notes


def test_big_endian(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    turned = [
        bytes(store.serialize_cdr(store.deserialize_cdr(data, JOINT_STATE), JOINT_STATE, little_endian=False))
        for data in messages(STAMPS)
    ]
    record = read_bag(mcap(tmp_path / "bag.mcap", [("a", at, data) for at, data in zip(STAMPS, turned, strict=True)]))
    whole(record)
    assert record.displacement["x"].dtype.isnative
    assess_record(record, Source(records=[record]))


@pytest.mark.parametrize("apart", [0, 40_000, 15 * PERIOD])
def test_messages_that_were_recorded_twice(tmp_path, apart):
    twice = sorted([*rows(), *[("b", at + apart, data) for _, at, data in rows()]], key=lambda row: row[1])
    channels = dict.fromkeys("ab", ("/stage_state", JOINT_STATE, "cdr"))
    record = read_bag(mcap(tmp_path / "bag.mcap", twice, channels))
    whole(record, notes=len(record.notes))
    assert any(holds(note, N, 2 * N) and "twice" in note for note in record.notes)
    # Two recordings that overlap, one behind the other.
    record = read_bag(mcap(tmp_path / "bag.mcap", [*rows()[:400], *rows()[300:]]))
    whole(record, notes=len(record.notes))
    assert any(holds(note, 100, N + 100) for note in record.notes)


@pytest.mark.parametrize("back", [20_000_000, 800_000_000, 3600 * 10**9])
def test_a_clock_that_was_set_back(tmp_path, back):
    stamps = STAMPS - back * (np.arange(N) >= 450)
    record = read_bag(mcap(tmp_path / "bag.mcap", rows(stamps, stamps + 300_000)))
    np.testing.assert_array_equal(record.displacement["x"], Y)
    np.testing.assert_array_equal(record.time_ns, stamps)
    assert any("set back" in note and "--stop" in note and holds(note, 451, f"{back / 1e9:g}") for note in record.notes)
    (error,) = assess_record(record, Source(records=[record])).refused.values()
    assert "--stop" in str(error)


@pytest.mark.parametrize("late", [[300], [300, 301, 302], list(range(300, 320))])
def test_messages_that_came_late_are_sorted(tmp_path, late):
    kept = np.setdiff1d(np.arange(N), late)
    order = np.insert(kept, np.searchsorted(kept, late[-1] + 30), late)
    whole(read_bag(mcap(tmp_path / "bag.mcap", [rows()[k] for k in order])), notes=1)


def test_two_halves_in_the_wrong_order_are_sorted(tmp_path):
    whole(read_bag(mcap(tmp_path / "bag.mcap", [rows()[k] for k in np.roll(np.arange(N), N // 2)])), notes=1)


@pytest.mark.parametrize(
    ("wrong", "gone"),
    [
        (dict.fromkeys(range(7, N, 100), 0), list(range(7, N, 100))),
        ({200: START + 10**12}, [200]),
        ({200: START - 10**12}, [200]),
        ({200: int(STAMPS[201]), 201: int(STAMPS[200])}, [200, 201]),
        ({200: int(STAMPS[196]) - 1}, [200]),
    ],
)
def test_single_wrong_stamps_are_left_out(tmp_path, wrong, gone):
    stamps = STAMPS.copy()
    stamps[list(wrong)] = list(wrong.values())
    record = read_bag(mcap(tmp_path / "bag.mcap", rows(stamps, STAMPS + 300_000)))
    kept = np.setdiff1d(np.arange(N), gone)
    np.testing.assert_array_equal(record.time_ns, STAMPS[kept])
    np.testing.assert_array_equal(record.displacement["x"], Y[kept])
    assert any(holds(note, len(gone), N) for note in record.notes)


def test_a_clock_that_begins_at_0_is_one(tmp_path):
    record = read_bag(mcap(tmp_path / "bag.mcap", rows(STAMPS - START)))
    np.testing.assert_array_equal(record.time_ns, STAMPS - START)
    assert not record.notes


def test_profiles_and_encodings_beside_the_stage(tmp_path):
    channels = {
        "a": ("/stage_state", JOINT_STATE, "cdr"),
        "j": ("/log", "foxglove.Log", "json"),
        "p": ("/pose", "foxglove.Pose", "protobuf"),
    }
    mixed = [*rows()[:300], ("j", STAMPS[300], b"{}"), ("p", STAMPS[300], b"\n\x01x"), *rows()[300:]]
    for profile in ("", "ros2", "other"):
        whole(read_bag(mcap(tmp_path / "bag.mcap", mixed, channels, profile)))
    only = {"a": ("/stage_state", JOINT_STATE, "json")}
    message = refusal(RecordError, read_bag, mcap(tmp_path / "bag.mcap", [("a", 1, b"{}")], only, ""))
    assert holds(message, "json") and "recover" not in message


@pytest.mark.parametrize("kind", ["sensor_msgs/JointState", "sensor_msgs::msg::dds_::JointState_"])
def test_other_names_of_the_type(tmp_path, kind):
    whole(read_bag(mcap(tmp_path / "bag.mcap", rows(), {"a": ("/stage_state", kind, "cdr")})))


@pytest.mark.parametrize("place", [0, 300, N])
def test_another_type_on_the_same_topic(tmp_path, place):
    text = b"\0\1\0\0" + struct.pack("<I", 6) + b"hello\0"
    other = [*rows()[:place], ("s", STAMPS[min(place, N - 1)], text), *rows()[place:]]
    channels = {"s": ("/stage_state", "std_msgs/msg/String", "cdr"), "a": ("/stage_state", JOINT_STATE, "cdr")}
    record = read_bag(mcap(tmp_path / "bag.mcap", other, channels))
    whole(record, notes=1)
    assert holds(record.notes[0], 1, "std_msgs/msg/String")


def split(folder, parts=3, name="rec_{}.mcap", storage="mcap", listed=None, count=N):
    folder.mkdir()
    for k in range(parts):
        mcap(folder / name.format(k), rows()[k * N // parts : (k + 1) * N // parts])
    if listed is not None:
        files = "".join(f"    - {name.format(k)}\n" for k in listed)
        (folder / "metadata.yaml").write_text(
            f"rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: {storage}\n  relative_file_paths:\n{files}"
            f"  message_count: {count}\n  topics_with_message_count:\n    - topic_metadata:\n        name: /stage_state\n"
            f"        type: {JOINT_STATE}\n      message_count: {count}\n"
        )
    return folder


def test_parts_and_what_metadata_say_of_them(tmp_path):
    whole(read_bag(split(tmp_path / "a", storage='""', listed=range(3))))
    whole(read_bag(split(tmp_path / "b", listed=range(2), count=2 * N // 3)), notes=1)
    lost = split(tmp_path / "c", listed=range(3))
    (lost / "rec_1.mcap").unlink()
    assert any(holds(note, "rec_1.mcap") for note in read_bag(lost).notes)
    assert any(holds(note, N, N + 50) for note in read_bag(split(tmp_path / "d", listed=range(3), count=N + 50)).notes)
    # As Lyrical names them, with and without metadata.
    for listed in (None, range(3)):
        lyrical = "{}_rec_2026_05_23-10_30_00.mcap"
        whole(read_bag(split(tmp_path / f"e{listed is None}", name=lyrical, listed=listed)))
    renamed = split(tmp_path / "f", parts=1, listed=[0])
    shutil.move(renamed / "rec_0.mcap", renamed / "monday.mcap")
    whole(read_bag(renamed))


def test_some_parts_are_packed(tmp_path):
    from slpi_ros.io.bag_storage import zstd

    folder = split(tmp_path / "bag")
    for name in ("rec_0.mcap", "rec_1.mcap"):
        (folder / f"{name}.zstd").write_bytes(zstd().compress((folder / name).read_bytes()))
        (folder / name).unlink()
    whole(read_bag(folder))


def test_a_pointer_of_git_lfs_and_an_empty_file(tmp_path):
    for name in ("bag.mcap", "bag.db3"):
        path = tmp_path / name
        path.write_text(f"version https://{'git-lfs'}.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
        message = refusal(RecordError, read_bag, path)
        assert "git lfs pull" in message and "recover" not in message
        path.write_bytes(b"")
        assert "recover" not in refusal(RecordError, read_bag, path)


def test_two_publishers_of_one_topic_are_named(tmp_path):
    other = [
        ("a", at + 700_000, data) for at, data in zip(STAMPS, messages(STAMPS + 700_000, v=np.zeros(N)), strict=True)
    ]
    both = sorted([*rows(), *other], key=lambda row: row[1])
    record = read_bag(mcap(tmp_path / "bag.mcap", both))
    (error,) = assess_record(record, Source(records=[record])).refused.values()
    assert re.search("two publishers", str(error))


def test_sqlite_files_too(tmp_path):
    stamps = STAMPS.copy()
    stamps[450:] -= 20_000_000
    record = Record(stamps, {"x": V}, {"x": Y}, "made")
    write_bag(tmp_path / "bag", record, storage="sqlite3")
    read = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(read.time_ns, stamps)
    assert any("set back" in note for note in read.notes)


def test_an_axis_that_is_named_twice(tmp_path):
    both = list(encode_joint_states(STAMPS, np.column_stack([Y, Y + 1e-6]), np.column_stack([V, V]), ("x", "x")))
    path = mcap(tmp_path / "bag.mcap", [("a", at, data) for at, data in zip(STAMPS, both, strict=True)])
    message = refusal(RecordError, read_bag, path)
    assert holds(message, path, "x, x") and "recover" not in message
