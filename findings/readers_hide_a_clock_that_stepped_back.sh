#!/bin/sh
# Good guess: readers give the messages of a bag as they were recorded, so that a clock that was set back shows as a stamp
# that is smaller than the one before.
# Really: mcap and rosbags sort by log time, in both storages of rosbag2, and so does the mcap reader for streams that
# cannot seek. The seconds after the step come before those ahead of it, rising; an end of the motion stands before its
# beginning, and no stamp tells it.
# mcap 1.6.0, mcap/reader.py: iter_messages(log_time_order=True); rosbags 0.11.9, rosbag2/storage_sqlite3.py ("ORDER BY
# timestamp") and storage_mcap.py (heapq.merge of sorted chunks).
# Met by: who reads bags of a computer whose clock NTP or a person had set back while it recorded.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check mcap==1.6.0 rosbags==0.11.9
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version
from pathlib import Path

from mcap.reader import NonSeekingReader, make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

NAME = "std_msgs/msg/Float64"
store = get_typestore(Stores.ROS2_JAZZY)
# Seconds; after four messages the clock goes back by eight.
stamps = [10, 11, 12, 13, 6, 7, 8, 9]
found = {}
for plugin in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
    bag = Path(f"bag_{plugin.name}")
    with Writer(bag, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/volts", NAME, typestore=store)
        for number, stamp in enumerate(stamps):
            message = store.types[NAME](float(number))
            writer.write(connection, stamp * 10**9, store.serialize_cdr(message, NAME))
    with Reader(bag) as reader:
        given = [store.deserialize_cdr(data, NAME).data for _, _, data in reader.messages()]
    found[f"rosbags, {plugin.name}"] = given
(file,) = Path("bag_MCAP").glob("*.mcap")


def by_mcap(reader, **named):
    return [store.deserialize_cdr(message.data, NAME).data for _, _, message in reader.iter_messages(**named)]


with file.open("rb") as stream:
    found["mcap"] = by_mcap(make_reader(stream))
    stream.seek(0)
    found["mcap, as in the file"] = by_mcap(make_reader(stream), log_time_order=False)
with file.open("rb") as stream:
    found["mcap, without seeking"] = by_mcap(NonSeekingReader(stream))
print(f"mcap {version('mcap')}, rosbags {version('rosbags')}; recorded in the order 0 to 7")
for name, given in found.items():
    print(f"{name}: {', '.join(f'{each:g}' for each in given)}")
recorded = found.pop("mcap, as in the file")
if recorded != [0, 1, 2, 3, 4, 5, 6, 7] or any(given != [4, 5, 6, 7, 0, 1, 2, 3] for given in found.values()):
    sys.exit("the behaviour has changed")
PY
