"""Modules of a folder of scripts, imported as the scripts there import each other."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def importable(folder: str) -> Iterator[None]:
    """Let the modules of a folder of the repository be imported by their names alone."""
    path = str(Path(__file__).resolve().parents[1] / folder)
    sys.path.append(path)
    try:
        yield
    finally:
        sys.path.remove(path)
