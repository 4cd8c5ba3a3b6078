"""Co-simulation units (FMI 3.0 and 2.0) of the inverse and of the forward model: sources, and a binary for Linux."""

import hashlib
import io
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

from slpi_ros.errors import SlpiError
from slpi_ros.export.c_source import c_files, comment, templates
from slpi_ros.export.stage import ExportedStage
from slpi_ros.model.limits import MAX_DT

VERSIONS = ("3.0", "2.0")
# Names of the folder of the binary, by version, and the time that every file in a unit has.
PLATFORM, EPOCH = {"3.0": "x86_64-linux", "2.0": "linux64"}, (2000, 1, 1, 0, 0, 0)
FLAGS = ("-std=c11", "-O2", "-shared", "-fPIC", "-fvisibility=hidden")
# Usual step of a simulation (s), and the longest of an inverse with a slew limit, which takes it in parts of MAX_DT.
STEP, LONGEST_STEP = 1e-4, 1000.0
# Says, as the last bytes of the archive, who wrote it.
MARK = b"Written by `slpi export`"


@dataclass(frozen=True)
class Unit:
    """One kind of unit: its identifier, what it is, its variables with units, and the function of the C source."""

    identifier: str
    what: str
    given: tuple[str, str]  # name and unit of an input
    answered: tuple[str, str]  # name and unit of an output
    function: str

    def starts(self, stage: ExportedStage) -> list[float]:
        """Return the inputs at the start: those of the stage at rest where the record ended."""
        if self.given[1] == "V":
            return [axis.allowed.clip(axis.memory.voltage) for axis in stage.axes]
        return [axis.model.rest(axis.limits) for axis in stage.axes]

    def limited(self, stage: ExportedStage) -> bool:
        """Return whether a slew limit of the stage acts on the outputs."""
        return self.answered[1] == "V" and any(axis.allowed.slew < inf for axis in stage.axes)


UNITS = (
    Unit("slpi_inverse", "causal inverse", ("desired", "m"), ("voltage", "V"), "slpi_inverse_step"),
    Unit("slpi_model", "forward model", ("voltage", "V"), ("displacement", "m"), "slpi_inverse_drive"),
)
NAMES = tuple(f"{unit.identifier}_fmi{version[0]}.fmu" for unit in UNITS for version in VERSIONS)


def fmu_files(stage: ExportedStage) -> dict[str, bytes]:
    """Return the units by file name; SlpiError where there is no C compiler for their binaries."""
    made = (fmu(stage, unit, version) for unit in UNITS for version in VERSIONS)
    return dict(zip(NAMES, made, strict=True))


def fmu(stage: ExportedStage, unit: Unit, version: str) -> bytes:
    """Return one unit as the bytes of its archive."""
    file = f"slpi_fmi{version[0]}.c"
    starts = list(map(repr, unit.starts(stage)))
    names = [axis.name for axis in stage.axes]
    told = comment("; ".join(line.strip() for axis in stage.axes for line in axis.describe))
    sources = c_files(stage)
    token = hashlib.sha256(f"{unit}{version}{sources}".encode()).hexdigest()[:32]
    (name_in, unit_in), (name_out, unit_out) = unit.given, unit.answered
    # Only the inverse has feedback.
    loops = stage.loops if name_in == "desired" else ()
    inputs = list(zip(names, starts, strict=True))
    rows = [(f"{name_in}_{name}", "input", unit_in, start) for name, start in inputs]
    rows += [(f"{name_out}_{name}", "output", unit_out, "") for name in names]
    rows += [(f"surrounding_{one.key}", "input", "", repr(one.reference)) for one in stage.quantities]
    rows += [(f"measured_{name}", "input", "m", start) for name, start in inputs if loops]
    variables = [
        {"name": name, "reference": k, "causality": causality, "unit": its_unit, "start": start}
        for k, (name, causality, its_unit, start) in enumerate(rows, 1)
    ]
    context: dict[str, Any] = {
        "limits": [(repr(axis.allowed.lower), repr(axis.allowed.upper)) for axis in stage.axes] if loops else [],
        "quantities": stage.quantities, "limited": unit.limited(stage), "longest": repr(MAX_DT),
        "most": repr(LONGEST_STEP),
        "version": version, "what": unit.what, "file": file, "token": f"{{{token}}}", "variables": variables,
        "function": unit.function, "identifier": unit.identifier,
        "step": repr(loops[0].period if loops else STEP),
        "description": f"{unit.what} of a piezo stage: {told}",
    }  # fmt: skip
    sources[file] = _filled("slpi_fmu.c", context)
    described = _filled(f"fmi{version[0]}.xml", context)
    binary = compiled(sources)
    if version == "3.0":
        sources["buildDescription.xml"] = _filled("build.xml", context)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.comment = MARK
        _put(packed, "modelDescription.xml", described.encode())
        for name, text in sources.items():
            _put(packed, f"sources/{name}", text.encode())
        _put(packed, f"binaries/{PLATFORM[version]}/{unit.identifier}.so", binary)
    return archive.getvalue()


def compiled(sources: dict[str, str]) -> bytes:
    """Return the shared library of some C sources; SlpiError without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise SlpiError("no C compiler for the binary of an FMU; install gcc, or export with --target c")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for name, text in sources.items():
            (folder / name).write_text(text, encoding="utf-8")
        files = [name for name in sources if name.endswith(".c")]
        command = [compiler, *FLAGS, *files, "-o", "unit.so", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            said = (done.stderr.splitlines() or ["it ended without a word"])[0]
            raise SlpiError(f"{compiler}: {said}; the binary of an FMU was not made, export with --target c")
        return (folder / "unit.so").read_bytes()


def _filled(name: str, context: dict[str, Any]) -> str:
    return templates().get_template(f"{name}.j2").render(context)


def _put(packed: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add a file with a time of its own, so that two exports of one model are equal."""
    entry = zipfile.ZipInfo(name, EPOCH)
    entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    packed.writestr(entry, content)
