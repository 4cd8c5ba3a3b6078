"""Decisions of the command line, the identify node and the fleet about hostile bags: how often do they disagree?"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
from hostile_bags import SPOILS, by_node, disagreement, quick_fits, write_hostile

# Delay of the sensor in a quarter of the bags, seconds.
DELAY = 0.03


def main() -> int:
    """Print each disagreement, and how many there are."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bags", type=int, default=200)
    parser.add_argument("--seed", type=int, help="default: another one each time")
    options = parser.parse_args()
    seed = np.random.SeedSequence(options.seed).entropy if options.seed is None else options.seed
    rng, names = np.random.default_rng(seed), list(SPOILS)
    refused, disagreements = 0, 0
    for number in range(options.bags):
        with tempfile.TemporaryDirectory() as folder, quick_fits():
            bag = write_hostile(Path(folder), names[number % len(names)], int(rng.integers(2**31)))
            delay = DELAY if rng.random() < 0.25 else 0.0
            told = disagreement(bag, Path(folder), delay)
            refused += bool(by_node(bag, Path(folder), delay).refused)
            if told:
                disagreements += 1
                print(told)
    print(f"seed {seed}: {options.bags} bags, {refused} refused, {disagreements} disagreements")
    return 1 if disagreements else 0


if __name__ == "__main__":
    sys.exit(main())
