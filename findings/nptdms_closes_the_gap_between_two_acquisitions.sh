#!/bin/sh
# Good guess: a TDMS file to which LabVIEW has appended a second acquisition, a minute later, gives the times of both.
# Really: the properties of a channel are those that were written last, for all of its samples. time_track(absolute_time=
# True) begins at the start of the second acquisition and goes on without a gap: the first sample is a minute late, the
# last one is dated after the end of the acquisition.
# npTDMS 1.10.0, nptdms/tdms.py: TdmsChannel.time_track, and reader.py: _update_object_properties (a later segment
# replaces properties of the earlier ones).
# Met by: who imports records of a stage that LabVIEW appended to one file: drift, creep and pauses are gone.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check npTDMS==1.10.0 numpy==2.4.6
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter

begins = [np.datetime64("2026-05-01T10:00:00", "us"), np.datetime64("2026-05-01T10:01:00", "us")]
with TdmsWriter("stage.tdms") as writer:
    for volts, begin in enumerate(begins):
        waveform = {"wf_start_time": begin, "wf_start_offset": 0.0, "wf_increment": 1e-3}
        writer.write_segment([ChannelObject("stage", "x_V", np.full(1000, float(volts)), properties=waveform)])
channel = TdmsFile.read("stage.tdms")["stage"]["x_V"]
times = channel.time_track(absolute_time=True)
print(f"npTDMS {version('npTDMS')}; 1000 samples from 10:00:00 on, 1000 from 10:01:00 on")
for place in (0, 999, 1000, 1999):
    print(f"sample {place}, {channel[place]:g} V: {times[place]}")
gap = (times[1000] - times[999]) / np.timedelta64(1, "ms")
if times[0] != begins[1] or round(gap) != 1:
    sys.exit("the behaviour has changed")
PY
