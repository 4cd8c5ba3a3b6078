"""What an export can be written as: its files, and whether they may be written into a folder."""

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from slpi_ros.errors import UsageError
from slpi_ros.export.c_source import c_files
from slpi_ros.export.fmu import MARK, NAMES, fmu_files
from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.vectors import float_remarks, program_files
from slpi_ros.io.atomic_file import all_or_nothing, is_replaceable, output_folder

# Bytes at both ends of a file, in which slpi finds its mark if it wrote the file.
ENDS = 2000


@dataclass(frozen=True)
class Target:
    """One kind of export: the names of its files, what is in them, and the command that follows."""

    names: tuple[str, ...]
    files: Callable[[ExportedStage], Mapping[str, str] | Mapping[str, bytes]]
    _next: str  # with the folder as ``{}``
    remarks: Callable[[ExportedStage], list[str]]  # on what was written

    def allow(self, folder: str, *, overwrite: bool) -> list[str]:
        """Check that the files may be written; return remarks on what they replace. UsageError if not."""
        others = [Path(folder) / name for name in self.names if not _own(Path(folder) / name)]
        if others and not overwrite:
            raise UsageError(f"{others[0]}: exists and was not written by slpi; give another folder, or --overwrite")
        return [f"{other}: replaced what was there" for other in others]

    def write(self, folder: str, stage: ExportedStage) -> list[str]:
        """Write the files; return their names."""
        made = self.files(stage)
        with output_folder(folder, *made) as place:
            for name, content in made.items():
                with all_or_nothing(place / name) as file:
                    file.buffer.write(content if isinstance(content, bytes) else content.encode())
        return list(made)

    def next(self, folder: str) -> str:
        """Return the command that follows."""
        return self._next.format(shlex.quote(folder))


def _own(path: Path) -> bool:
    """Return whether there is no such file, or one that slpi wrote."""
    if not is_replaceable(path) or path.is_dir():
        return False
    try:
        content = path.read_bytes() if path.exists() else b""
        return not content or MARK in content[:ENDS] + content[-ENDS:]
    except OSError:
        return False


def _c(stage: ExportedStage) -> Mapping[str, str]:
    return c_files(stage) | program_files(stage)


TARGETS: Mapping[str, Target] = {
    "c": Target(
        ("slpi_inverse.h", "slpi_inverse.c", "slpi_test.c"),
        _c,
        "cd {} && cc -std=c11 -O2 slpi_inverse.c slpi_test.c -lm -o slpi_test && ./slpi_test",
        float_remarks,
    ),
    "fmu": Target(NAMES, fmu_files, "fmpy validate {}/slpi_inverse_fmi3.fmu", lambda stage: []),
}
