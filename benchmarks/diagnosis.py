"""Diagnosis of hidden effects: detection rate, correct names, parameter errors; a full run takes some hours.

Every record is drawn from a seed, written as a bag, identified and diagnosed, and only then compared with the truth.
The model is identified from the same record, or with ``--second-record`` from a record made before the effect occurred.
"""

import os

# To be set before NumPy is imported: the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections.abc import Iterator
from itertools import combinations
from multiprocessing import get_context

import diagnosis_tables as tables
import numpy as np
from diagnosis_score import Case, run
from hidden import CONFUSABLE, NAMES

CLEAN_FOR_EACH_DRAW, PAIRS_FOR_EACH_DRAW = 5, 2
SIZES = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0)


def cases(draws: int, seed: int, only: str | None) -> Iterator[Case]:
    """Yield cases of single effects, pairs, clean records and Bouc-Wen stages; with `only`, cases of that effect."""
    chosen = [only] if only else list(NAMES)
    for name in chosen:
        yield from (Case("single", seed + index, (name,)) for index in range(draws))
    pairs = [pair for pair in combinations(NAMES, 2) if set(pair) not in CONFUSABLE and (not only or only in pair)]
    for index in range(PAIRS_FOR_EACH_DRAW * draws):
        rng = np.random.default_rng([seed, index])
        yield Case("pair", seed + index, pairs[int(rng.integers(len(pairs)))])
    if not only:
        yield from (Case("clean", seed + index) for index in range(CLEAN_FOR_EACH_DRAW * draws))
        yield from (Case("bouc_wen", seed + index, base="bouc_wen") for index in range(draws))


def sized_cases(draws: int, seed: int, only: str | None) -> Iterator[Case]:
    """Yield cases of single effects with every size."""
    for name in [only] if only else NAMES:
        for size in SIZES:
            yield from (Case("sized", seed + index, (name,), size=size) for index in range(draws))


def main() -> None:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10, help="records of each effect; clean ones five times as many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=NAMES, help="this effect alone, and pairs with it")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--sizes", action="store_true", help="the detection rate over the size instead")
    parser.add_argument("--second-record", action="store_true", help="the model is of a record without the effect")
    options = parser.parse_args()
    drawn = (sized_cases if options.sizes else cases)(options.draws, options.seed, options.only)
    chosen = [Case(**{**vars(case), "second_record": options.second_record}) for case in drawn]
    outcomes = []
    with get_context("spawn").Pool(options.processes) as pool:
        for outcome in pool.imap(run, chosen):
            print(tables.line(outcome), flush=True)
            outcomes.append(outcome)
    tables.sizes(outcomes) if options.sizes else tables.everything(outcomes)


if __name__ == "__main__":
    main()
