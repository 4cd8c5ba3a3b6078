#!/bin/sh
# Good guess: the approximate quantile of Dask is near that of pandas, within a percent.
# Really: it merges those of the partitions. Where the numbers are sorted by time and the partitions differ, as errors
# that rise when a stage warms up do, 90 % of the errors are said to be below 0.60 and are below 0.80 of the largest.
# Dask 2026.8.0, dask/dataframe/dask_expr/_collection.py: Series.quantile ("Approximate quantiles") and
# dask/array/percentile.py: merge_percentiles.
# Met by: who judges a fleet of stages by the quantiles of long records on Dask.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check dask==2026.8.0 pandas==3.0.1 numpy==2.4.6 pyarrow==26.0.1
cd "$folder"
venv/bin/python - <<'PY'
import sys
from importlib.metadata import version

import dask.dataframe
import numpy as np
import pandas

# Errors in um: none for half of the time, then rising by 1 um.
errors = pandas.DataFrame({"error_um": np.r_[np.zeros(1000), np.linspace(0.0, 1.0, 1000)]})
exact = errors["error_um"].quantile(0.9)
found = {
    count: float(dask.dataframe.from_pandas(errors, npartitions=count)["error_um"].quantile(0.9).compute())
    for count in (1, 5)
}
print(f"Dask {version('dask')}, the 90 % quantile of 2000 errors: pandas {exact:.3f} um")
for count, value in found.items():
    print(f"in {count} partitions: {value:.3f} um")
if not (abs(found[1] - exact) < 0.01 and 0.55 < found[5] < 0.65):
    sys.exit("the behaviour has changed")
PY
