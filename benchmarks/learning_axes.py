"""Two axes that move each other learn their paths at once, or one learns its line while the other moves on."""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from learning import RATE_HZ, FloatArray, Run, Specimen, identified, path_of, rms

import slpi_ros

LINE = "raster 20"
# Share of the motion of one axis in the displacement of the other.
LEAST_COUPLING, MOST_COUPLING = 0.01, 0.03
# Lines of the raster in which the slow axis covers its range.
LINES = 200


def coupled(
    displacements: dict[str, FloatArray], coupling: dict[str, float], rest: dict[str, float]
) -> dict[str, FloatArray]:
    """Return the displacements (m, (N,)) with a share of the other axis's motion from rest."""
    return {
        name: own + coupling[name] * sum(displacements[other] - rest[other] for other in displacements if other != name)
        for name, own in displacements.items()
    }


def compare(seed: int, slow: bool, passes: int, models: Path | None) -> dict[str, dict[str, list[float]]]:
    """Return the true error (nm) of every pass of each axis, with the learner and with the inverse alone."""
    specimens = {"x": Specimen.draw(seed), "y": Specimen.draw(seed + 1)}
    axes = {name: identified(one, models).axes["x"] for name, one in specimens.items()}
    paths = {name: path_of(LINE, specimens[name], axes[name]) for name in specimens}
    n = paths["x"].size
    paths["y"] = np.roll(paths["y"], n // 4)
    rng = np.random.default_rng([11, seed])
    coupling = {name: float(rng.uniform(LEAST_COUPLING, MOST_COUPLING)) for name in axes}
    whole = np.linspace(paths["y"].min(), paths["y"].max(), LINES * n)
    learning = ["x"] if slow else ["x", "y"]

    def run(learner: slpi_ros.Learner | None) -> dict[str, list[float]]:
        beginning = {"x": paths["x"], "y": whole[:n] if slow else paths["y"]}
        runs = {name: Run(specimens[name], axes[name], beginning[name]) for name in axes}
        rest = {name: float(beginning[name][0]) for name in axes}
        errors: dict[str, list[float]] = {name: [] for name in learning}
        for number in range(passes):
            asked = dict(learner.path()) if learner else {name: paths[name] for name in learning}
            if slow:
                asked["y"] = whole[number * n : (number + 1) * n]
            followed = {name: runs[name].follow(asked[name]) for name in axes}
            true = coupled({name: x for name, (_, x, _) in followed.items()}, coupling, rest)
            noise = {name: y - x for name, (_, x, y) in followed.items()}
            for name in learning:
                errors[name].append(rms(true[name], paths[name], np.ones(n)))
            if learner:
                learner.update(
                    {name: true[name] + noise[name] for name in learning},
                    {name: followed[name][0] for name in learning},
                )
        return errors

    model, t = slpi_ros.StageModel(axes), np.arange(n) / RATE_HZ
    learner = slpi_ros.Learner(model, t, {name: paths[name] for name in learning})
    return {"learner": run(learner), "alone": run(None)}


def main() -> int:
    """Print a row for each axis of each pair of stages; return 1 if a pass is worse than those of the inverse alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=6, help="pairs of stages")
    parser.add_argument("--seed", type=int, default=0, help="of the first pair")
    parser.add_argument("--passes", type=int, default=20)
    parser.add_argument("--models", type=Path, help="folder in which identified models are kept")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{LINE} Hz on two axes that move each other; true error, rms nm, without mean")
    print(f"{'pair':<8}{'other axis':<12}{'axis':<6}{'noise':>6}{'first':>9}{'alone':>9}{'5':>9}{options.passes:>9}")
    rows = above = worse = 0
    for seed in range(options.seed, options.seed + 2 * options.count, 2):
        for slow in (False, True):
            errors = compare(seed, slow, options.passes, options.models)
            for number, (name, own) in enumerate(errors["learner"].items()):
                alone, noise = errors["alone"][name], 1e9 * Specimen.draw(seed + number).noise
                rows += 1
                above += own[-1] > noise
                harm = max(own) > 1.1 * max(max(alone), noise)
                worse += harm
                other = "moves on" if slow else "learns"
                print(f"{seed:<8}{other:<12}{name:<6}{noise:>6.1f}{own[0]:>9.1f}{alone[-1]:>9.1f}"
                      f"{own[min(5, len(own) - 1)]:>9.1f}{own[-1]:>9.1f}{'  worse' if harm else ''}",
                      flush=True)  # fmt: skip
    print(f"above the noise in the end: {above} of {rows}; a pass worse than the inverse alone: {worse}")
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
