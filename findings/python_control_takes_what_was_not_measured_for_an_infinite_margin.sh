#!/bin/sh
# Good guess: the gain margin of a measured frequency response that ends below the crossing of -180 degrees is NaN, or is
# told to be unknown.
# Really: control.margin gives infinity, as for a loop that is stable with any gain. Measured to 95 Hz this loop has an
# infinite margin; measured on, 6.5.
# python-control 0.10.2, control/margins.py, lines 419 to 421: inf where no crossing was found in the data.
# Met by: who decides by the measured response of a stage by how much its feedback may be raised.
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

s = control.tf("s")
loop = 200.0 / (s * (1.0 + s / 500.0) * (1.0 + s / 800.0))
found = {"the loop": control.margin(loop)[0]}
for highest in (95.0, 200.0):
    omega = 2.0 * np.pi * np.geomspace(0.5, highest, 200)
    measured = control.frd(loop(1j * omega), omega)
    found[f"measured to {highest:g} Hz"] = control.margin(measured)[0]
print(f"python-control {version('control')}, gain margins")
for name, margin in found.items():
    print(f"{name}: {margin:.3g}")
if not np.allclose(list(found.values()), [6.5, np.inf, 6.5], rtol=1e-3):
    sys.exit("the behaviour has changed")
PY
