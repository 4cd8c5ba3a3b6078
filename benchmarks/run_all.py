"""All benchmarks, one after the other."""

import accuracy
import engine
import identification
import measured


def main() -> None:
    """Print all tables."""
    for part in (engine, identification, measured, accuracy):
        print(f"\n== {part.__doc__.splitlines()[0]}")
        part.main()


if __name__ == "__main__":
    main()
