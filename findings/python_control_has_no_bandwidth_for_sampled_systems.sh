#!/bin/sh
# Good guess: control.bandwidth gives the bandwidth of a discrete closed loop, as control.margin gives its margins; at
# 1 kHz that of a lag of 10 ms is 100 rad/s.
# Really: the crossing is bracketed on the unit circle and then searched with the transfer function at j w instead of
# exp(j w T): bisect fails with ValueError ("f(a) and f(b) must have different signs").
# python-control 0.10.2, control/lti.py: LTI.bandwidth, "np.abs(self(w*1j))".
# Met by: who tunes the feedback of a stage as it runs, sampled.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check control==0.10.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import control
import numpy as np

lag = control.tf([1.0], [0.01, 1.0])
sampled = control.c2d(lag, 1e-3)
integral = control.tf([0.02, 0.0], [1.0, -1.0], 1e-3)
loop = control.feedback(control.series(sampled, integral))
print(f"python-control {version('control')}; continuous: {control.bandwidth(lag):.1f} rad/s")
for name, system in (("sampled lag", sampled), ("sampled closed loop", loop)):
    try:
        print(f"{name}: {control.bandwidth(system):.1f} rad/s")
    except ValueError as error:
        print(f"{name}: ValueError: {error}")
        gain = np.abs(system(np.exp(1j * np.linspace(0.0, np.pi, 100_001))))
        print(f"  by its gain: {1e3 * np.pi * np.argmax(gain < gain[0] / np.sqrt(2.0)) / 100_000:.1f} rad/s")
    else:
        sys.exit("the behaviour has changed")
PY
