"""The exported C source, compiled and loaded, and the stream of Python beside it on the same steps."""

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from slpi_ros.errors import SlpiError
from slpi_ros.export.c_source import c_files
from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.vectors import code_of, surround

FloatArray = NDArray[np.float64]
_COUNT = count()

WARNINGS = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror")
SHIM = """
#include <stddef.h>
#include "slpi_inverse.c"
size_t slpi_size(void);
size_t slpi_size(void) { return sizeof(slpi_inverse_t); }
int slpi_depth(const slpi_inverse_t *inverse, int axis);
int slpi_depth(const slpi_inverse_t *inverse, int axis) { return inverse->axis[axis].memory.now.depth; }
void slpi_run(slpi_inverse_t *inverse, int n, const slpi_real *dt, const slpi_real *y, const slpi_real *given,
    slpi_real *v, int *code);
void slpi_run(slpi_inverse_t *inverse, int n, const slpi_real *dt, const slpi_real *y, const slpi_real *given,
    slpi_real *v, int *code)
{
    (void)given;
    for (int k = 0; k < n; k++) {
#ifdef SLPI_SURROUNDINGS
        for (int i = 0; i < SLPI_SURROUNDINGS; i++) {
            /* Not a number: none comes, and none is taken. */
            slpi_inverse_set(inverse, i, given[k * SLPI_SURROUNDINGS + i]);
        }
#endif
        code[k] = slpi_inverse_step(inverse, dt[k], y + k * SLPI_AXES, v + k * SLPI_AXES);
    }
}
"""


def compiler(name: str = "gcc") -> str:
    """Return a compiler of this machine."""
    found = shutil.which(name) or (shutil.which("cc") if name == "gcc" else None)
    if found is None:
        pytest.skip(f"no {name} on this machine")
    return found


def write(folder: Path, stage: ExportedStage) -> None:
    for name, text in c_files(stage).items():
        (folder / name).write_text(text)


@dataclass
class Built:
    """A compiled inverse with its state."""

    library: ctypes.CDLL
    axes: int
    quantities: int
    number: type

    def __post_init__(self) -> None:
        self.library.slpi_size.restype = ctypes.c_size_t
        self.size = self.library.slpi_size()
        self.state = ctypes.create_string_buffer(self.size)
        self.dtype = np.float32 if self.number is ctypes.c_float else np.float64
        self.start()

    def _at(self, values: NDArray) -> ctypes.c_void_p:
        return values.ctypes.data_as(ctypes.c_void_p)

    def start(self, volts: Sequence[float] | None = None) -> int:
        given = None if volts is None else np.array(volts, dtype=self.dtype)
        return self.library.slpi_inverse_init(self.state, None if given is None else self._at(given))

    def run(
        self, dt: FloatArray, y: FloatArray, given: FloatArray | None = None
    ) -> tuple[FloatArray, NDArray[np.int32]]:
        """Return the voltages, (N, axes), and the codes, (N,), of `dt` (N,) and `y` (N, axes).

        `given` are values of the quantities that the stage follows, (N, quantities), NaN: none comes.
        """
        dt, y = np.ascontiguousarray(dt, dtype=self.dtype), np.ascontiguousarray(y, dtype=self.dtype)
        values = np.full((dt.size, max(self.quantities, 1)), np.nan) if given is None else given
        values = np.ascontiguousarray(values, dtype=self.dtype)
        v, code = np.empty(y.shape, dtype=self.dtype), np.empty(dt.size, dtype=np.int32)
        places = map(self._at, (dt, y, values, v, code))
        self.library.slpi_run(self.state, dt.size, *places)
        return v.astype(np.float64), code

    def drive(self, dt: float, volts: Sequence[float]) -> FloatArray:
        given, y = np.array(volts, dtype=self.dtype), np.empty(self.axes, dtype=self.dtype)
        assert not self.library.slpi_inverse_drive(self.state, self.number(dt), self._at(given), self._at(y))
        return y.astype(np.float64)

    def depth(self, axis: int = 0) -> int:
        return int(self.library.slpi_depth(self.state, axis))


def build(folder: Path, stage: ExportedStage, *flags: str, name: str = "gcc") -> Built:
    """Compile the inverse of a stage in a folder, without warnings, and load it."""
    write(folder, stage)
    (folder / "shim.c").write_text(SHIM)
    # A library that is loaded once is not loaded anew from the same place.
    library = folder / f"inverse{next(_COUNT)}.so"
    command = [compiler(name), *WARNINGS, "-O0", "-shared", "-fPIC", *flags, "shim.c", "-o", str(library), "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    number = ctypes.c_float if "-DSLPI_FLOAT" in flags else ctypes.c_double
    return Built(ctypes.CDLL(str(library)), len(stage.axes), len(stage.quantities), number)


def by_python(
    stage: ExportedStage, t: FloatArray, y: FloatArray, given: FloatArray | None = None
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Return what the stream of Python gives, as `Built.run`, for stamps `t` (N,), s."""
    stream = stage.stream()
    names = [axis.name for axis in stage.axes]
    v, code = np.empty(y.shape), np.zeros(t.size, dtype=np.int32)
    for k, (now, desired) in enumerate(zip(t.tolist(), y.tolist(), strict=True)):
        if given is not None:
            surround(stream, stage, given[k])
        try:
            stream.step(now, dict(zip(names, desired, strict=True)))
        except SlpiError as error:
            code[k] = code_of(error)
        v[k] = [stream.streams[name].voltage for name in names]
    return v, code
