"""All benchmarks, one after the other, and what has become slower since the kept figures.

Figures are ratios of times measured side by side, so that they do not depend on the machine; smaller is better.
"""

import argparse

import accuracy
import engine
import identification
import kept

SECTION, COMMAND = "speed", "make bench"
# A figure that has grown by more than this share is marked.
WORSE = 0.2


def compared(figures: dict[str, float], earlier: dict[str, float]) -> list[str]:
    """Return a line for each figure: its value, the kept one, and a mark if it has become worse."""
    lines = []
    for name, value in figures.items():
        before = earlier.get(name)
        change = "      new" if before is None else f"{before:9.2f}"
        mark = "   WORSE" if before is not None and value > (1.0 + WORSE) * before else ""
        lines.append(f"{name:<64}{value:9.2f}{change}{mark}")
    return lines


def main() -> None:
    """Print all tables, and compare the figures with the kept ones."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help=f"write the figures to {kept.KEPT.name}")
    parser.add_argument("--speed", action="store_true", help="only the speed of the engine and of the identification")
    options, _ = parser.parse_known_args()
    figures: dict[str, float] = {}
    for part in (engine, identification) if options.speed else (engine, identification, accuracy):
        print(f"\n== {part.__doc__.splitlines()[0]}")
        found = part.main()
        figures |= found if isinstance(found, dict) else {}
    print(f"\n== Ratios now and kept; WORSE: by more than {WORSE:.0%}")
    print("\n".join(compared(figures, kept.read(SECTION).get("figures", {}))))
    if options.keep:
        kept.write(SECTION, COMMAND, {name: round(value, 4) for name, value in figures.items()})


if __name__ == "__main__":
    main()
