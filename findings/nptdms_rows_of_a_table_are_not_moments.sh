#!/bin/sh
# Good guess: as_dataframe() of a TDMS group gives a row for each moment, so that a voltage at 100 Hz and a sensor at
# 300 Hz stand in one row where they belong together.
# Really: row k holds sample k of each channel, whatever its rate. The hundredth voltage, after 1 s, stands beside a
# reading after 0.33 s, and behind the last voltage follow rows of NaN. With time_index=True rows are moments, and two
# thirds of the voltages are NaN.
# npTDMS 1.10.0, nptdms/export/pandas_export.py: _channels_to_dataframe.
# Met by: who fits a model on a table of channels with two rates: the stage looks three times as slow as it is.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check npTDMS==1.10.0 numpy==2.4.6 pandas==3.0.1
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter


def channel(name, rate):
    times = np.arange(rate) / rate
    waveform = {"wf_start_time": np.datetime64("2026-05-01", "us"), "wf_start_offset": 0.0, "wf_increment": 1.0 / rate}
    # Its values are its times.
    return ChannelObject("stage", name, times, properties=waveform)


with TdmsWriter("stage.tdms") as writer:
    writer.write_segment([channel("x_V", 100), channel("x_m", 300)])
group = TdmsFile.read("stage.tdms")["stage"]
table = group.as_dataframe()
row = table.iloc[99]
print(f"npTDMS {version('npTDMS')}; one second of both channels, whose values are their times")
print(f"row 99: voltage of {row['x_V']:.3f} s beside the reading of {row['x_m']:.3f} s; {len(table)} rows")
indexed = group.as_dataframe(time_index=True)
print(f"with time_index: {len(indexed)} rows, {int(indexed['x_V'].isna().sum())} without a voltage")
if not (abs(row["x_V"] - 0.99) < 1e-9 and abs(row["x_m"] - 0.33) < 1e-9 and len(table) == 300):
    sys.exit("the behaviour has changed")
PY
