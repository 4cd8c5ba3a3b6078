"""All benchmarks, one after the other, and what has become slower since the kept figures.

Figures are ratios of times measured side by side, so that they do not depend on the machine; smaller is better.
"""

import argparse
import json
from pathlib import Path

import accuracy
import engine
import identification

KEPT = Path(__file__).with_name("kept_figures.json")
# A figure that has grown by more than this share is marked.
WORSE = 0.2


def compared(figures: dict[str, float], kept: dict[str, float]) -> list[str]:
    """Return a line for each figure: its value, the kept one, and a mark if it has become worse."""
    lines = []
    for name, value in figures.items():
        before = kept.get(name)
        change = "      new" if before is None else f"{before:9.2f}"
        mark = "   WORSE" if before is not None and value > (1.0 + WORSE) * before else ""
        lines.append(f"{name:<64}{value:9.2f}{change}{mark}")
    return lines


def main() -> None:
    """Print all tables, and compare the figures with the kept ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {KEPT.name}")
    parser.add_argument("--speed", action="store_true", help="only the speed of the engine and of the identification")
    options, _ = parser.parse_known_args()
    figures: dict[str, float] = {}
    for part in (engine, identification) if options.speed else (engine, identification, accuracy):
        print(f"\n== {part.__doc__.splitlines()[0]}")
        found = part.main()
        figures |= found if isinstance(found, dict) else {}
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    print(f"\n== Ratios now and kept; WORSE: by more than {WORSE:.0%}")
    print("\n".join(compared(figures, kept)))
    if options.keep:
        KEPT.write_text(json.dumps({name: round(value, 4) for name, value in figures.items()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
