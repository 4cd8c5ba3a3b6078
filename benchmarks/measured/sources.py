"""Extraction of the tables of measured records from the files of public repositories, one function a layout.

Each function takes the files of a record, in the order of the manifest, and returns the lines of the table without its
header. What was assumed (rate, scale, zero) is stated here and nowhere else.
"""

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Lines = Iterator[str]

# Micrometres per count of the strain gauges of the three axes of the AFM scanner; approximate.
AFM_SCALE_UM = {"x": 3.4074801003e-4, "y": 3.25118668e-4, "z": 3.396923744e-4}
# Seconds between two readings of the AFM scanner; approximate.
AFM_PERIOD_S = 1.2
# Millimetres per volt of the laser sensor of the HASEL actuator, volts per volt of its amplifier's monitor, and the
# reading below which the sensor has no echo.
HASEL_UM_PER_V, HASEL_V_PER_V, HASEL_LOST_V = 4000.0, 2000.0, 1.0
# Samples of rest at the start that give the HASEL actuator's zero, and samples that are averaged to one.
HASEL_REST, HASEL_MEAN = 1000, 10
# Neighbours of a lost reading that are lost with it.
HASEL_BESIDE = 3
# Samples at the start of the nanopositioner's records that are left out: the step that brings it to the hold.
NTNU_SKIPPED = 1500
# Every fifth sample of the catheter is taken.
TENDON_STEP = 5


class ExtractionError(ValueError):
    """A file that does not hold what the manifest says."""


def _plain(data: bytes, delimiter: str | None = None, skip: int = 0) -> FloatArray:
    return np.loadtxt(io.BytesIO(data), delimiter=delimiter, skiprows=skip, dtype=np.float64)


def _matlab(data: bytes) -> Any:
    return scipy.io.loadmat(io.BytesIO(data), squeeze_me=True, struct_as_record=False)


def picma_major(files: Sequence[bytes]) -> Lines:
    """Columns: amplifier input (V), .., displacement (um); 200 samples per second."""
    table = _plain(files[0])
    for index, row in enumerate(table):
        yield f"{index / 200:.6f},{row[0]:.6f},{row[4]:.6f}"


def picma_decay_grow(files: Sequence[bytes]) -> Lines:
    """Columns as in `picma_major`, and the desired displacement (um)."""
    table = _plain(files[0])
    for index, row in enumerate(table):
        yield f"{index / 200:.6f},{row[0]:.6f},{row[4]:.6f},{row[8]:.6f}"


def piezo_150v(files: Sequence[bytes]) -> Lines:
    """Columns: empty, time (s), displacement (um), voltage (V)."""
    for line in files[0].decode("ascii").splitlines():
        _, time, displacement, voltage = line.split(",")
        yield f"{time},{voltage},{displacement}"


def ntnu(files: Sequence[bytes]) -> Lines:
    """Read a capture of a dSPACE system, 10,000 samples per second: sensor (V), the same filtered, drive (V)."""
    (capture,) = (value for name, value in _matlab(files[0]).items() if not name.startswith("__"))
    measured, _, drive = (np.asarray(signal.Data, dtype=np.float64) for signal in capture.Y)
    for index in range(NTNU_SKIPPED, measured.size):
        yield f"{index / 10000:.8g},{drive[index]:.8g},{measured[index]:.8g}"


def afm_raw(files: Sequence[bytes], axes: str) -> Lines:
    """Read voltages (V) and counts of three strain gauges; a count of 0 is a drop-out of the serial link."""
    document = _matlab(files[0])
    counts = np.asarray(document["SG"], dtype=np.float64)[:, : len(axes)]
    counts[counts == 0.0] = np.nan
    y = (counts - counts[0]) * [AFM_SCALE_UM[axis] for axis in axes]
    for index, voltage in enumerate(document["V"]):
        cells = (f"{AFM_PERIOD_S * index:.2f}", f"{voltage:.4f}", *(f"{value:.4f}" for value in y[index]))
        yield ",".join(cells)


def afm_double_sine(files: Sequence[bytes]) -> Lines:
    """Read the x axis."""
    return afm_raw(files, "x")


def afm_triangle_sine(files: Sequence[bytes]) -> Lines:
    """Read all three axes."""
    return afm_raw(files, "xyz")


def afm_cycles(files: Sequence[bytes]) -> Lines:
    """Read the first 120 of 720 cycles of the x axis; the file holds the voltages of one cycle."""
    document = _matlab(files[0])
    counts = np.asarray(document["SG"], dtype=np.float64)[:12000, 0]
    voltages = np.resize(np.asarray(document["V"], dtype=np.float64), counts.size)
    for index, (voltage, count) in enumerate(zip(voltages, counts - counts[0], strict=True)):
        yield f"{AFM_PERIOD_S * index:.8g},{voltage:.8g},{AFM_SCALE_UM['x'] * count:.8g}"


def hasel(files: Sequence[bytes]) -> Lines:
    """Read time (s), command, sensor (V), monitor of the voltage and current, 2,000 samples per second."""
    try:
        import h5py
    except ImportError:
        raise ExtractionError("these files need h5py: pip install h5py") from None
    with h5py.File(io.BytesIO(files[0]), "r") as file:
        data = np.asarray(file["data"], dtype=np.float64)
    zero = float(np.mean(data[2, :HASEL_REST]))
    # Above its range the sensor has no echo: a straight line between the neighbours.
    at, sensor = np.arange(data.shape[1]), data[2]
    lost = np.convolve(sensor < HASEL_LOST_V, np.ones(2 * HASEL_BESIDE + 1), "same") > 0.5
    sensor[lost] = np.interp(at[lost], at[~lost], sensor[~lost])
    whole = data.shape[1] // HASEL_MEAN * HASEL_MEAN
    time, _, sensor, monitor, _ = data[:, :whole].reshape(data.shape[0], -1, HASEL_MEAN).mean(axis=2)
    for t, volts, read in zip(time, monitor, sensor, strict=True):
        yield f"{t:.4f},{HASEL_V_PER_V * volts:.2f},{HASEL_UM_PER_V * (read - zero):.2f}"


def pzt19(files: Sequence[bytes]) -> Lines:
    """Join pulses, first all negative ones, then all positive ones, at 1,000 samples per second."""
    loops = _matlab(files[0])["Loops"]
    # Charge (C) over area (m^2), in uC/cm^2.
    scale, loop = 100.0 / float(loops.sample.s), loops.feloop
    pulses: list[tuple[FloatArray, FloatArray]] = []
    for side in ("p", "n"):
        for part in ("init", "ref", "refnext"):
            if not hasattr(loop, part) or (part == "refnext" and loops.opts.refnum > 2):
                continue
            one = getattr(loop, part)
            field, charge = np.atleast_1d(one.E)[0], np.atleast_1d(one.P)[0]
            pulses.append((getattr(field, side), getattr(charge, side)))
    # Between two pulses the tester waits.
    index, last, wait = 0, 0.0, round(1000 * float(loops.opts.delay))
    for volts, charges in pulses:
        polarisation = last + scale * (charges - charges[0])
        for v, p in zip(volts, polarisation, strict=True):
            yield f"{index / 1000:.5f},{v:.4f},{p:.5f}"
            index += 1
        index, last = index + wait, float(polarisation[-1])


def ferro_forc(files: Sequence[bytes]) -> Lines:
    """Read a measurement of a ferroelectric tester: time (s), voltage (V), .., polarisation (uC/cm^2)."""
    for line in files[0].decode("latin-1").splitlines():
        cells = line.split("\t")
        try:
            time, volts, charge = float(cells[0]), float(cells[1]), float(cells[4])
        except (IndexError, ValueError):
            continue
        yield f"{time:.7f},{volts:.6f},{charge:.6f}"


def tendon(files: Sequence[bytes]) -> Lines:
    """Columns: time (s), displacement of the tendon (mm), five others, angle of the tip (degrees), two others."""
    for row in _plain(files[0], ",", skip=1)[::TENDON_STEP]:
        yield f"{row[0]:.5f},{row[1]:.5f},{row[6]:.5f}"


def mirror(files: Sequence[bytes]) -> Lines:
    """Read a capture of a dSPACE system: time (s), amplifier output, LVDT with its sign turned, amplifier input (V)."""
    (capture,) = (value for name, value in _matlab(files[0]).items() if not name.startswith("__"))
    _, sensor, drive = (np.asarray(signal.Data, dtype=np.float64) for signal in capture.Y)
    for t, v, y in zip(np.asarray(capture.X.Data, dtype=np.float64), drive, -sensor, strict=True):
        yield f"{t:.6f},{v:.8g},{y:.8g}"


EXTRACTIONS: Mapping[str, Callable[[Sequence[bytes]], Lines]] = {
    one.__name__: one
    for one in (
        picma_major,
        picma_decay_grow,
        piezo_150v,
        ntnu,
        afm_double_sine,
        afm_triangle_sine,
        afm_cycles,
        hasel,
        pzt19,
        ferro_forc,
        tendon,
        mirror,
    )
}


def table_of(extraction: str, header: str, files: Sequence[bytes]) -> bytes:
    """Return the table as a CSV file.

    Raises
    ------
    ExtractionError
        If the files do not hold what the extraction expects, or a package that reads them is missing.
    """
    try:
        lines = [header, *EXTRACTIONS[extraction](files)]
    except (KeyError, IndexError, ValueError, AttributeError, OSError) as error:
        if isinstance(error, ExtractionError):
            raise
        raise ExtractionError(f"extraction '{extraction}': {type(error).__name__}: {error}") from error
    return ("\n".join(lines) + "\n").encode("ascii")
