"""Bags of both storages: round trips, other readers, and every way in which a bag can be bad."""

import errno
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from refusals import holds, refusal
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from slpi_ros.errors import RecordError, UsageError
from slpi_ros.io.bag_files import partial_path
from slpi_ros.io.bag_reader import read_bag
from slpi_ros.io.bag_writer import BagWriter, write_bag
from slpi_ros.io.messages import JOINT_STATE, encode_joint_states
from slpi_ros.io.record import OUT_OF_ORDER, Record

STORE = get_typestore(Stores.ROS2_JAZZY)
SUFFIX = {"mcap": ".mcap", "sqlite3": ".db3"}
both_storages = pytest.mark.parametrize("storage", ["mcap", "sqlite3"])


def make_record(samples=300, axes=("x", "y"), hardware_id="stage-7"):
    rng = np.random.default_rng(0)
    return Record(
        time_ns=1_700_000_000_000_000_123 + 1_000_000 * np.arange(samples),
        voltage={axis: rng.normal(size=samples) for axis in axes},
        displacement={axis: rng.normal(size=samples) * 1e-6 for axis in axes},
        hardware_id=hardware_id,
    )


def assert_same(one: Record, other: Record) -> None:
    assert one.axes == other.axes
    assert one.hardware_id == other.hardware_id
    np.testing.assert_array_equal(one.time_ns, other.time_ns)
    for axis in one.axes:
        np.testing.assert_array_equal(one.voltage[axis], other.voltage[axis])
        np.testing.assert_array_equal(one.displacement[axis], other.displacement[axis])


def bag_file(folder: Path) -> Path:
    return next(file for file in folder.iterdir() if file.suffix in SUFFIX.values())


def joint_state(stamp_ns=0, names=("x",), position=(1.0,), effort=(2.0,), frame_id=""):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
    arrays = {"position": position, "velocity": (), "effort": effort}
    arrays = {name: np.array(values, float) for name, values in arrays.items()}
    return STORE.types[JOINT_STATE](header=header, name=list(names), **arrays)


def foreign_bag(path, topics, storage="mcap"):
    """Write a bag as others would: topic to messages, or to the name of a type without any message."""
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        for topic, messages in topics.items():
            kind = messages if isinstance(messages, str) else JOINT_STATE
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for row, message in enumerate(() if isinstance(messages, str) else messages):
                writer.write(connection, 5_000 + row, bytes(STORE.serialize_cdr(message, kind)))
    return path


def decoded_by_mcap(file: Path):
    """Return topic, time of the log and message, as the mcap packages read them."""
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, raw.log_time, message) for _, channel, raw, message in reader.iter_decoded_messages()]


@both_storages
def test_round_trip(tmp_path, storage):
    record = make_record()
    write_bag(tmp_path / "deep" / "bag", record, storage=storage)
    read = read_bag(tmp_path / "deep" / "bag")
    assert_same(read, record)
    assert read.source == str(tmp_path / "deep" / "bag")
    assert sorted(os.listdir(tmp_path / "deep")) == ["bag"]
    assert sorted(os.listdir(tmp_path / "deep" / "bag")) == sorted(["metadata.yaml", f"bag{SUFFIX[storage]}"])


@both_storages
def test_many_chunks(tmp_path, storage):
    record = make_record(samples=30_000)
    write_bag(tmp_path / "bag", record, storage=storage)
    assert_same(read_bag(str(tmp_path / "bag")), record)


@both_storages
def test_what_is_wrong_with_a_record_survives(tmp_path, storage):
    record = make_record(samples=6, axes=("x",))
    record.time_ns[3] -= 2_500_000  # time runs backwards
    record.time_ns[5] = record.time_ns[4]
    record.displacement["x"][2] = np.nan
    record.voltage["x"][1] = np.inf
    write_bag(tmp_path / "bag", record, storage=storage)
    assert_same(read_bag(tmp_path / "bag"), record)


@pytest.mark.parametrize(("order", "told"), [("halves", "1 of 100"), ("reversed", "99 of 100"), ("ascending", "")])
def test_that_messages_were_sorted_is_told(order, told, tmp_path):
    record = make_record(samples=100, axes=("x",))
    rows, stamps = np.arange(100), record.time_ns
    if order == "halves":
        rows = np.roll(rows, 50)
    elif order == "reversed":
        rows = rows[::-1]
    columns = (record.displacement["x"][:, None], record.voltage["x"][:, None])
    messages = list(encode_joint_states(stamps, *columns, ("x",), "stage"))
    with BagWriter(tmp_path / "bag") as bag:
        for row in rows.tolist():
            bag.write(int(stamps[row]), messages[row], "/stage_state")
    read = read_bag(tmp_path / "bag")
    np.testing.assert_array_equal(read.time_ns, stamps)
    notes = [note for note in read.notes if note.startswith(OUT_OF_ORDER)]
    assert [told in note for note in notes] == ([True] if told else [])
    assert not any("--stop" in note for note in read.notes)


@both_storages
def test_lone_file_and_folder_without_metadata(tmp_path, storage):
    record = make_record()
    write_bag(tmp_path / "bag", record, storage=storage)
    assert_same(read_bag(bag_file(tmp_path / "bag")), record)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert_same(read_bag(tmp_path / "bag"), record)


def test_other_library_reads_what_we_write(tmp_path):
    record = make_record(samples=20)
    write_bag(tmp_path / "bag", record)
    messages = decoded_by_mcap(tmp_path / "bag" / "bag.mcap")
    assert {topic for topic, _, _ in messages} == {"/stage_state"}
    assert [logged for _, logged, _ in messages] == record.time_ns.tolist()
    for row, (_, _, states) in enumerate(messages):
        assert states.header.stamp.sec * 10**9 + states.header.stamp.nanosec == record.time_ns[row]
        assert (states.header.frame_id, states.name) == ("stage-7", ["x", "y"])
        assert list(states.position) == [record.displacement[axis][row] for axis in "xy"]
        assert list(states.effort) == [record.voltage[axis][row] for axis in "xy"]


def state(stamp, names=("x",), position=(0.0,), effort=(0.0,)):
    """Return one serialised message of a stage."""
    (message,) = encode_joint_states(np.array([stamp]), np.array([position]), np.array([effort]), names, "stage-7")
    return message


@both_storages
def test_writer_sample_by_sample(tmp_path, storage):
    record = make_record(samples=10)
    with BagWriter(tmp_path / "bag", storage=storage, topic="ns/stage_state") as bag:
        for row, stamp in enumerate(record.time_ns.tolist()):
            signals = ([signal[axis][row] for axis in "xy"] for signal in (record.displacement, record.voltage))
            bag.write(stamp, state(stamp, ("x", "y"), *signals))
        assert bag.message_count == 10
    assert_same(read_bag(tmp_path / "bag", "/ns/stage_state"), record)


def test_writer_of_several_topics(tmp_path):
    text = bytes(STORE.serialize_cdr(STORE.types["std_msgs/msg/String"](data="hello"), "std_msgs/msg/String"))
    with BagWriter(tmp_path / "bag", topic=None) as bag:
        bag.add_topic("words", "std_msgs/msg/String")
        bag.add_topic("stage_state")
        bag.write(10, text, "words")
        bag.write(20, bytes(STORE.serialize_cdr(joint_state(7), JOINT_STATE)), "/stage_state")
        assert holds(refusal(UsageError, bag.write, 30, text, "other"), "other", "add_topic")
        assert holds(refusal(UsageError, bag.write, 30, text), "add_topic")
        assert holds(refusal(RecordError, bag.add_topic, "own", "my_msgs/msg/Own"), "own", "my_msgs/msg/Own")
    assert read_bag(tmp_path / "bag").time_ns.tolist() == [7]
    first, second = decoded_by_mcap(tmp_path / "bag" / "bag.mcap")
    assert (first[0], first[1], first[2].data) == ("/words", 10, "hello")
    assert (second[0], second[1], second[2].name) == ("/stage_state", 20, ["x"])


def test_axes_are_chosen_by_name(tmp_path):
    write_bag(tmp_path / "bag", make_record(axes=("x", "y", "z")))
    assert read_bag(tmp_path / "bag", axes=["z", "x"]).axes == ("z", "x")
    assert read_bag(tmp_path / "bag", axes=[]).axes == ("x", "y", "z")
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag", axes=["x", "w"]), "'w'", "x, y, z")


@both_storages
def test_names_that_vary_are_matched(tmp_path, storage):
    messages = [
        joint_state(1, ["x", "y"], [1, 2], [10, 20]),
        joint_state(2, ["y", "x"], [3, 4], [30, 40], frame_id="late"),
        joint_state(3, ["y"], [5], [50]),
        joint_state(4, ["x", "y"], [6], [60]),
    ]
    record = read_bag(foreign_bag(tmp_path / "bag", {"/stage_state": messages}, storage))
    assert record.time_ns.tolist() == [1, 2, 3, 4]
    assert record.hardware_id == "late"
    np.testing.assert_array_equal(record.displacement["x"], [1, 4, np.nan, 6])
    np.testing.assert_array_equal(record.voltage["y"], [20, 30, 50, np.nan])


def test_time_of_the_log_where_nothing_is_stamped(tmp_path):
    record = read_bag(foreign_bag(tmp_path / "none", {"/stage_state": [joint_state()] * 3}))
    assert record.time_ns.tolist() == [5_000, 5_001, 5_002]
    messages = [joint_state(0), joint_state(9)]
    assert read_bag(foreign_bag(tmp_path / "some", {"/stage_state": messages})).time_ns.tolist() == [0, 9]


@pytest.mark.parametrize("asked", ["stage_state", "/stage_state", "lab/stage_state", "/lab/stage_state"])
def test_topic_under_a_namespace(tmp_path, asked):
    topics = {"/lab/stage_state": [joint_state(1)], "/lab/other_stage_state": "std_msgs/msg/Float64"}
    assert len(read_bag(foreign_bag(tmp_path / "bag", topics), asked)) == 1


def test_topic_without_namespace_goes_first(tmp_path):
    bag = foreign_bag(tmp_path / "bag", {"/a/s": [joint_state(1)], "/s": [joint_state(2)], "/b/s": [joint_state(3)]})
    assert read_bag(bag, "s").time_ns.tolist() == [2]
    assert read_bag(bag, "b/s").time_ns.tolist() == [3]


def test_topics_that_cannot_be_read(tmp_path):
    topics = {"/a/s": [joint_state(1)], "/b/s": [joint_state(2)], "/f": "std_msgs/msg/Float64", "/e": JOINT_STATE}
    bag = foreign_bag(tmp_path / "bag", topics)
    ambiguous = refusal(RecordError, read_bag, bag, "s")
    assert holds(ambiguous, "'s'", "/a/s", "/b/s") and not holds(ambiguous, "/f")
    assert holds(refusal(RecordError, read_bag, bag), "'stage_state'", "/a/s (sensor_msgs/msg/JointState)", "/f")
    assert holds(refusal(RecordError, read_bag, bag, "f"), "'/f'", "std_msgs/msg/Float64", JOINT_STATE)
    empty = refusal(RecordError, read_bag, bag, "e")
    assert holds(empty, "'e'") and JOINT_STATE not in empty
    bare = refusal(RecordError, read_bag, foreign_bag(tmp_path / "bare", {}))
    assert holds(bare, tmp_path / "bare", "'stage_state'") and "/msg/" not in bare


def test_messages_without_a_signal(tmp_path):
    bag = foreign_bag(tmp_path / "bag", {"/stage_state": [joint_state(1, ["x", "y"], [1, 2], [3])]})
    assert holds(refusal(RecordError, read_bag, bag), bag, "'y'", "effort[]", "x, y")
    assert read_bag(bag, axes=["x"]).axes == ("x",)
    nameless = foreign_bag(tmp_path / "nameless", {"/stage_state": [joint_state(1, [])]})
    assert holds(refusal(RecordError, read_bag, nameless), nameless, "name[]")


def test_no_bag_at_all(tmp_path):
    (tmp_path / "folder").mkdir()
    remedies = {"t.csv": "slpi import", "old.bag": "rosbags-convert", "notes.txt": "rosbag2"}
    for name in remedies:
        (tmp_path / name).write_text("time_s,x_V\n")
    told = set()
    for name, remedy in (remedies | {"nothing": "rosbag2", "folder": "metadata.yaml"}).items():
        message = refusal(RecordError, read_bag, tmp_path / name)
        assert holds(message, tmp_path / name, remedy)
        told.add(message.replace(name, ""))
    assert len(told) == 5


def test_folder_of_several_files_without_metadata(tmp_path):
    write_bag(tmp_path / "bag", make_record())
    shutil.copy(tmp_path / "bag" / "bag.mcap", tmp_path / "bag" / "bag_1.mcap")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), f"ros2 bag reindex {tmp_path / 'bag'}")


@both_storages
@pytest.mark.parametrize("kept", [0.001, 0.3, 0.7, 0.99, 0.9999, 0.999999])
def test_truncated_file(tmp_path, storage, kept):
    write_bag(tmp_path / "bag", make_record(samples=3000), storage=storage)
    file = bag_file(tmp_path / "bag")
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), tmp_path / "bag")
    remedy = {"mcap": f"mcap recover {file}", "sqlite3": ".recover"}[storage]
    assert remedy in refusal(RecordError, read_bag, file)


@both_storages
def test_damaged_file_never_escapes(tmp_path, storage):
    rng = np.random.default_rng(1)
    write_bag(tmp_path / "bag", make_record(samples=50), storage=storage)
    file = bag_file(tmp_path / "bag")
    whole = np.frombuffer(file.read_bytes(), np.uint8)
    refused = 0
    for _ in range(200):
        damaged = whole.copy()
        damaged[rng.integers(whole.size, size=rng.integers(1, 40))] = rng.integers(256)
        file.write_bytes(damaged.tobytes())
        try:
            read_bag(file)
        except RecordError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 50


@both_storages
def test_file_of_another_kind(tmp_path, storage):
    file = tmp_path / f"noise{SUFFIX[storage]}"
    file.write_bytes(bytes(range(256)) * 40)
    assert holds(refusal(RecordError, read_bag, file), file, "recover")


@pytest.mark.parametrize("text", ["", "[", "rosbag2_bagfile_information: 3\n", "other: {}\n", "\xff\xfe"])
def test_broken_metadata(tmp_path, text):
    write_bag(tmp_path / "bag", make_record())
    (tmp_path / "bag" / "metadata.yaml").write_bytes(text.encode("latin-1"))
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), tmp_path / "bag", "metadata.yaml")


@pytest.mark.parametrize("value", ["-1", ".nan", "null", "[]", "{a: 1}"])
@pytest.mark.parametrize("key", ["name", "message_count"])
def test_metadata_with_a_topic_of_the_wrong_type(tmp_path, key, value):
    write_bag(tmp_path / "bag", make_record())
    file = tmp_path / "bag" / "metadata.yaml"
    broken, count = re.subn(rf"(?<=[ -] {key}: ).*", value, file.read_text())
    assert count
    file.write_text(broken)
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), tmp_path / "bag", "metadata.yaml")


def test_metadata_without_its_file(tmp_path):
    write_bag(tmp_path / "bag", make_record())
    (tmp_path / "bag" / "bag.mcap").unlink()
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), tmp_path / "bag", "bag.mcap")


def test_recorder_that_lives(tmp_path):
    bag = BagWriter(tmp_path / "bag")
    for row in range(20_000):
        bag.write(row, state(row))
    assert holds(refusal(RecordError, read_bag, tmp_path / "bag"), bag.partial)
    assert holds(refusal(RecordError, read_bag, bag.partial / "bag"), "mcap recover")
    assert holds(refusal(RecordError, BagWriter, tmp_path / "bag"), bag.partial)
    bag.discard()
    assert os.listdir(tmp_path) == []


@both_storages
def test_nothing_is_overwritten(tmp_path, storage):
    record = make_record()
    write_bag(tmp_path / "bag", record, storage=storage)
    taken = refusal(RecordError, write_bag, tmp_path / "bag", make_record(samples=2), storage=storage)
    assert holds(taken, tmp_path / "bag")
    assert_same(read_bag(tmp_path / "bag"), record)
    (tmp_path / "file").write_text("")
    assert refusal(RecordError, write_bag, tmp_path / "file", record, storage=storage) == taken.replace(
        str(tmp_path / "bag"), str(tmp_path / "file")
    )
    below = refusal(RecordError, write_bag, tmp_path / "file" / "bag", record, storage=storage)
    assert holds(below, tmp_path / "file" / "bag", os.strerror(errno.ENOTDIR))
    assert sorted(os.listdir(tmp_path)) == ["bag", "file"]


@both_storages
def test_exception_discards(tmp_path, storage):
    with pytest.raises(KeyError), BagWriter(tmp_path / "bag", storage=storage) as bag:
        bag.write(0, state(0))
        assert partial_path(tmp_path / "bag").is_dir()
        assert not (tmp_path / "bag").exists()
        raise KeyError
    assert os.listdir(tmp_path) == []


def test_place_taken_meanwhile(tmp_path):
    bag = BagWriter(tmp_path / "bag")
    bag.write(0, state(0))
    (tmp_path / "bag").write_text("mine")
    assert holds(refusal(RecordError, bag.close), tmp_path / "bag", os.strerror(errno.ENOTDIR))
    assert (tmp_path / "bag").read_text() == "mine"
    assert len(read_bag(bag.partial / "bag")) == 1


def test_storage_that_does_not_exist(tmp_path):
    message = refusal(UsageError, BagWriter, tmp_path / "bag", storage="rosbag1")
    assert holds(message, "'rosbag1'", "mcap", "sqlite3")


def test_time_that_no_stamp_can_hold(tmp_path):
    record = make_record(samples=3)
    record.time_ns[0] = -(10**9)
    assert holds(refusal(RecordError, write_bag, tmp_path / "bag", record), "sample 0", "-1 s", "2^31 s")
    assert os.listdir(tmp_path) == []


FILL_THE_DISK = """
import sys
import numpy as np
from slpi_ros.io.bag_writer import write_bag
from slpi_ros.errors import RecordError
from slpi_ros.io.record import OUT_OF_ORDER, Record

n = 30_000
record = Record(time_ns=np.arange(n), voltage={"x": np.ones(n)}, displacement={"x": np.ones(n)})
try:
    write_bag(sys.argv[1], record, storage=sys.argv[2])
except RecordError as error:
    print(error)
"""


@both_storages
def test_full_disk(tmp_path, storage):
    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, 2**20))

    command = [sys.executable, "-c", FILL_THE_DISK, str(tmp_path / "bag"), storage]
    done = subprocess.run(command, preexec_fn=limit, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert holds(done.stdout, tmp_path / "bag")
    assert done.stdout.count("\n") == 1
    assert os.listdir(tmp_path) == []
