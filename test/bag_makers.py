"""Bags as others write them: by rosbags and by the mcap package, never by the code under test."""

import shutil
from pathlib import Path

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
ARRAY = "std_msgs/msg/Float64MultiArray"
VECTOR = "geometry_msgs/msg/Vector3Stamped"


def header(stamp_ns=0, frame_id=""):
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return STORE.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)


def joint_state(stamp_ns=0, names=("x",), position=(1.0,), effort=(2.0,), frame_id=""):
    arrays = {"position": position, "velocity": (), "effort": effort}
    arrays = {name: np.array(values, float) for name, values in arrays.items()}
    return STORE.types[JOINT_STATE](header=header(stamp_ns, frame_id), name=list(names), **arrays)


def float64(value):
    return STORE.types[FLOAT64](data=float(value))


def array(*values, labels=()):
    dimension = STORE.types["std_msgs/msg/MultiArrayDimension"]
    dim = [dimension(label=label, size=len(values), stride=len(values)) for label in labels]
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"](dim=dim, data_offset=0)
    return STORE.types[ARRAY](layout=layout, data=np.array(values, float))


def vector(stamp_ns, x, y, z, frame_id=""):
    xyz = STORE.types["geometry_msgs/msg/Vector3"](x=float(x), y=float(y), z=float(z))
    return STORE.types[VECTOR](header=header(stamp_ns, frame_id), vector=xyz)


def serialised(message) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def rosbags_bag(path, topics, storage="mcap", compression="none") -> Path:
    """Write a bag with rosbags: topic to (time of the log, message) pairs, each topic of one type."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, pairs[0][1].__msgtype__, typestore=STORE)
            for topic, pairs in topics.items()
        }
        rows = [(logged, topic, message) for topic, pairs in topics.items() for logged, message in pairs]
        for logged, topic, message in sorted(rows, key=lambda row: row[0]):
            writer.write(connections[topic], logged, serialised(message))
    return path


def split_bag(path, parts, storage="mcap", compression="none") -> Path:
    """Write each part by itself and join them as rosbag2 does; the first one has all topics."""
    path.mkdir()
    names, metadata = [], []
    for number, topics in enumerate(parts):
        part = rosbags_bag(path / f"part{number}", topics, storage, compression)
        (file,) = (file for file in part.iterdir() if file.name != "metadata.yaml")
        names.append(f"{path.name}_{number}{''.join(file.suffixes)}")
        metadata.append((part / "metadata.yaml").read_text().replace(file.name, names[-1]))
        file.rename(path / names[-1])
        shutil.rmtree(part)
    listed = "".join(f"\n  - {name}" for name in names)
    text = metadata[0].replace(f"relative_file_paths:\n  - {names[0]}", f"relative_file_paths:{listed}")
    (path / "metadata.yaml").write_text(text)
    return path


def mcap_file(path, rows, **options) -> Path:
    """Write a lone file with the mcap package: rows of (topic, time of the log, type, serialised message)."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile="ros2", library="test")
        schemas, channels = {}, {}
        for sequence, (topic, logged, kind, data) in enumerate(rows):
            if kind not in schemas:
                definition, _ = STORE.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_schema(kind, "ros2msg", definition.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic.rstrip("#"), "cdr", schemas[kind])
            writer.add_message(channels[topic], logged, data, logged, sequence)
        writer.finish()
    return path
