"""The promise of the calibrator in the demo: the best run, and why promise and run differ."""

from collections.abc import Sequence

import numpy as np
import plots

# The error of the demo agrees with that of the calibration within this factor.
FACTOR = 1.5


def best_of(runs: Sequence[plots.Run]) -> int:
    """Return the number of the run with the smallest mean error."""
    return int(np.argmin([np.abs(run.error).mean() for run in runs]))


def kept(promised: float, without_offset: float, runs: Sequence[plots.Run]) -> str:
    """Return a sentence about the promised mean error (m) and that of the demo; where they differ, about the reason.

    `without_offset` (m): what is left of the promise without its offset, by which the zero moved along that path.
    """
    run = runs[-1]
    mean = float(np.abs(run.error).mean())
    said = f" The calibrator promised a mean error of {promised * 1e9:.1f} nm; here it is {mean * 1e9:.1f} nm"
    best = runs[best_of(runs)]
    if best is not run:
        said += f", and {np.abs(best.error).mean() * 1e9:.1f} nm with {best.name}"
    if promised / FACTOR <= mean <= promised * FACTOR and best is run:
        return f"{said}."
    if mean < promised and best is run:
        moved = f": the zero moved less than then, when {without_offset * 1e9:.1f} nm were left without that"
        return f"{said}, less than promised{moved * (without_offset * FACTOR <= promised)}."
    # What may have changed since the calibration, by what it would leave of the error.
    still, passed = np.ones_like(run.t), run.t - run.t[0]
    causes = {
        "the zero, which is off by {:.1f} nm at the begin and moves by {:.2f} nm/s": ((still, passed), 1e9),
        "the time, by which the stage is {:.2f} ms late": ((-np.gradient(run.desired, run.t),), 1e3),
        "the sensitivity, which is off by {:.3f} %": ((run.desired - run.desired.mean(),), 1e2),
    }
    left = {}
    for name, (columns, unit) in causes.items():
        matrix = np.column_stack(columns)
        sizes = np.linalg.lstsq(matrix, run.error, rcond=None)[0]
        left[name.format(*sizes * unit)] = float(np.abs(run.error - matrix @ sizes).mean())
    # Modes, lags and delays act where the path accelerates.
    strength = np.abs(np.gradient(np.gradient(run.desired, run.t), run.t))
    calm = run.error[strength <= np.median(strength)]
    left["the acceleration of the path, judged by the half that accelerates least"] = float(np.abs(calm).mean())
    asked = "zero, time, sensitivity and acceleration"
    if run.late and run.late[0] > run.t[0]:
        asked = "zero, time, sensitivity, acceleration and the busy computer"
        name = f"the busy computer, which sent {len(run.late)} setpoints late, the first after {run.late[0]:.1f} s"
        left[f"{name}, judged by the path before it"] = float(np.abs(run.error[run.t < run.late[0]]).mean())
    name = min(left, key=left.__getitem__)
    if left[name] > FACTOR * promised:
        return f"{said}. None of {asked} explains it: {left[name] * 1e9:.1f} nm are left at least."
    return f"{said}. Of {asked} it is {name}: without it {left[name] * 1e9:.1f} nm are left."
