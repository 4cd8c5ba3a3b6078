#!/bin/sh
# Good guess: the times that the summary of an mcap file tells, given to iter_messages as start_time and end_time, give
# every message, as start_time and end_time of rosbags do.
# Really: message_end_time is the stamp of the last message, and end_time excludes its own moment: the last message is
# left out. The end_time of rosbags is one nanosecond later, and with it every message comes.
# mcap 1.6.0, mcap/reader.py: iter_messages (end_time is deprecated since, and still exclusive; ending_at includes it);
# rosbags 0.11.9, rosbag2/reader.py: Reader.end_time.
# Met by: who reads a bag piece by piece: a record loses a sample in each piece, and the last voltage of a drive.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check mcap==1.6.0 rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'PY'
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

warnings.simplefilter("ignore", DeprecationWarning)
NAME = "std_msgs/msg/Float64"
store = get_typestore(Stores.ROS2_JAZZY)
with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.MCAP) as writer:
    connection = writer.add_connection("/volts", NAME, typestore=store)
    for number in range(5):
        writer.write(connection, (number + 1) * 10**9, store.serialize_cdr(store.types[NAME](float(number)), NAME))
with Reader(Path("bag")) as reader:
    end = reader.end_time
    by_rosbags = sum(1 for _ in reader.messages(start=reader.start_time, stop=end))
(file,) = Path("bag").glob("*.mcap")
with file.open("rb") as stream:
    reader = make_reader(stream)
    told = reader.get_summary().statistics
    both = {"start_time": told.message_start_time, "end_time": told.message_end_time}
    by_mcap = sum(1 for _ in reader.iter_messages(**both))
print(f"mcap {version('mcap')}, rosbags {version('rosbags')}; 5 messages, the last at 5 s")
print(f"rosbags: end_time {end}, {by_rosbags} messages from start_time to end_time")
print(f"mcap: message_end_time {told.message_end_time}, {by_mcap} messages")
if (end, by_rosbags, told.message_end_time, by_mcap) != (5_000_000_001, 5, 5_000_000_000, 4):
    sys.exit("the behaviour has changed")
PY
