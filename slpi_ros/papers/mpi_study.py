"""Measurements of the MPI paper on a similar simulated stage, and the models fitted to them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.hysteresis.multi_slope import AmplitudeScaled, MultiSlope
from slpi_ros.hysteresis.turning_points import Memory
from slpi_ros.identification.fit import identify
from slpi_ros.identification.published_kinds import PeakFrequency, fit_peak_frequency
from slpi_ros.identification.signal_statistics import ErrorMetrics, error_metrics
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel
from slpi_ros.simulation.axis import SimulatedAxis

# By amplitude (V): a (µm) and b of Eq. 1.
TABLE_1: dict[float, tuple[float, float]] = {
    20: (12.306, -0.017),
    40: (27.235, -0.018),
    60: (43.448, -0.017),
    80: (59.669, -0.014),
    100: (75.08, -0.013),
    120: (89.189, -0.012),
}
# MPI, by amplitude (V): maximum, mean and "mean square" error, which is its root (µm); then R².
TABLE_2: dict[float, tuple[float, float, float]] = {
    20: (0.4215, 0.1184, 0.1451),
    40: (1.0007, 0.2306, 0.3164),
    60: (0.9785, 0.2554, 0.3217),
    80: (1.2104, 0.2753, 0.3611),
    100: (1.0687, 0.2941, 0.3724),
    120: (1.4441, 0.4002, 0.5053),
}
TABLE_3: dict[float, float] = {20: 0.9960, 40: 0.9983, 60: 0.9993, 80: 0.9996, 100: 0.9997, 120: 0.9996}
# SMPI, likewise.
TABLE_4: dict[float, tuple[float, float, float]] = {
    20: (0.7348, 0.1936, 0.2692),
    40: (1.0278, 0.3300, 0.3986),
    60: (1.7215, 0.5507, 0.6678),
    80: (1.5595, 0.6115, 0.7322),
    100: (1.7403, 0.7126, 0.8491),
}
TABLE_5: dict[float, float] = {20: 0.9939, 40: 0.9973, 60: 0.9970, 80: 0.9982, 100: 0.9985}
# Expected displacement (µm) and frequency (Hz) of the five segments.
TABLE_6 = ((60, 1), (80, 1), (100, 1), (80, 2), (80, 3))

# Mean and "mean square" error (µm), and half-width (µm) of the band that contains most errors: Fig. 11; Fig. 13 and 14.
FEEDFORWARD_MEAN, FEEDFORWARD_ROOT, FEEDFORWARD_BAND = 0.0485, 0.1201, 1.0
COMPOUND_MEAN, COMPOUND_ROOT, COMPOUND_BAND = 0.1192, 0.2949, 0.5


# Amplitudes (V) and frequencies (Hz) of Fig. 4. Models are fitted at the highest frequency.
AMPLITUDES = (20, 40, 60, 80, 100, 120)
FREQUENCIES = (0.1, 0.5, 1, 2, 5, 10, 20)
# Number of cycles of each drive from rest; index of the settled cycle, which is shown and fitted, and of the next one.
CYCLES, SETTLED, NEXT = 4, 2, 3
# Amplitudes (V) of the record for the loop family; its first cycle resets the hysteresis state and is not fitted.
FALLING = (120, 120, 120, 100, 80, 60, 40, 20)
# Amplitude (V), frequency (Hz) and number of cycles of each part of Fig. 8.
VARIABLE = ((120, 20, 2), (80, 20, 2), (40, 20, 2), (120, 2, 2))

MPI, SMPI, PI, FAMILY = "MPI", "SMPI", "classical PI", "loop family"
KINDS = {MPI: "mpi", PI: "pi", FAMILY: "slpi"}
ONE_MPI, OWN_MPI, SCALED_MPI = "MPI of 120 V", "MPI of each amplitude", "and of each frequency, by Eq. 1"


@dataclass(frozen=True)
class Drive:
    """Drive with equal triangles from rest: times (s), voltages (V) and sensor readings `y` (m), shape (N,) each."""

    t: FloatArray
    v: FloatArray
    y: FloatArray

    def cycle(self, number: int) -> slice:
        """Return the slice of the samples of a cycle; the first cycle has the number 0."""
        samples = self.t.size // CYCLES
        return slice(number * samples, (number + 1) * samples)

    @property
    def settled(self) -> tuple[FloatArray, FloatArray]:
        """Voltage (V) and displacement (m) of the cycle that is shown and fitted."""
        return self.v[self.cycle(SETTLED)], self.y[self.cycle(SETTLED)]

    @property
    def first_peak(self) -> float:
        """Largest displacement of the first cycle, metres."""
        return float(self.y[self.cycle(0)].max())

    @property
    def settled_peak(self) -> float:
        """Largest displacement of the settled cycle relative to its start, metres."""
        y = self.settled[1]
        return float(y.max() - y[0])

    @property
    def bows(self) -> tuple[float, float, float]:
        """Mean width of the settled loop, and largest deviations of rise and fall from its chord, over the stroke."""
        share = (self.settled[1] - self.settled[1][0]) / self.settled_peak
        top = share.size // 2
        chord, rise, fall = np.linspace(0.0, 1.0, top + 1), share[: top + 1], np.append(0.0, share[top:][::-1])
        return float(np.mean(fall - rise)), float(np.abs(rise - chord).max()), float(np.abs(fall - chord).max())


@dataclass(frozen=True)
class CycleFit:
    """A model fitted to the settled cycle of a drive."""

    model: AxisModel
    simulated: FloatArray  # m, (n,), on this cycle
    fitted: ErrorMetrics
    following: ErrorMetrics  # errors on the next cycle


@dataclass(frozen=True)
class ScaledFit:
    """The SMPI model on the settled cycle of a drive: simulated (m), shape (n,), and its errors."""

    simulated: FloatArray
    errors: ErrorMetrics


@dataclass(frozen=True)
class VariablePath:
    """The path of Fig. 8."""

    t: FloatArray  # s, (N,)
    y: FloatArray  # m, (N,), readings
    parts: tuple[slice, ...]  # of each amplitude and frequency, as in `VARIABLE`
    models: Mapping[str, FloatArray]  # m, (N,); mean error in the first part 0


@dataclass(frozen=True)
class Study:
    """All measurements and fits."""

    drives: Mapping[tuple[float, float], Drive]  # by amplitude (V) and frequency (Hz)
    peaks: Mapping[float, PeakFrequency]  # Eq. 1, fitted to the peaks of the first cycles, by amplitude (V)
    ringing: Mapping[float, float]  # m, largest, at the highest amplitude, by frequency (Hz)
    fits: Mapping[str, Mapping[float, CycleFit]]  # at the highest frequency, by kind and amplitude (V)
    scaled: Mapping[float, ScaledFit]  # by amplitude (V)
    variable: VariablePath

    @property
    def fastest(self) -> dict[float, Drive]:
        """The drives at the highest frequency, by amplitude (V)."""
        highest = max(frequency for _, frequency in self.drives)
        return {amplitude: drive for (amplitude, f), drive in self.drives.items() if f == highest}


def run_study(
    axis: SimulatedAxis,
    amplitudes: Sequence[float] = AMPLITUDES,
    frequencies: Sequence[float] = FREQUENCIES,
    samples: int = 1000,
) -> Study:
    """Measure an axis at ascending amplitudes (V) and frequencies (Hz), `samples` (even) per cycle; fit models."""
    drives = {(a, f): _drive(axis, a, f, samples) for f in frequencies for a in amplitudes}
    fastest = {a: drives[a, frequencies[-1]] for a in amplitudes}
    peaks = {a: fit_peak_frequency(frequencies, [drives[a, f].first_peak for f in frequencies]) for a in amplitudes}
    fits = {
        name: {amplitude: _fit(drive, kind) for amplitude, drive in fastest.items()} for name, kind in KINDS.items()
    }
    return Study(
        drives=drives,
        peaks=peaks,
        ringing={f: _ringing(axis, amplitudes[-1], f, samples) for f in frequencies},
        fits=fits,
        scaled=_scale(fastest, _shape(fits[MPI][amplitudes[-1]])),
        variable=_variable_path(axis, fits[MPI], peaks, samples),
    )


def triangles(amplitude: float, frequency: float, cycles: int, samples: int = 2000) -> tuple[FloatArray, FloatArray]:
    """Return times (s) and a triangle wave from 0 to `amplitude` (V or m) and back, shape (cycles * samples,) each."""
    k = np.arange(cycles * samples)
    phase = (k % samples) / samples
    return k / (samples * frequency), amplitude * (1.0 - np.abs(2.0 * phase - 1.0))


def triangle_record(
    axis: SimulatedAxis, name: str, amplitudes: Sequence[float], frequency: float, samples: int
) -> Record:
    """Drive one triangle of each amplitude (V) from rest and return the record of the axis `name`."""
    axis.rest()
    v = np.append(np.concatenate([triangles(a, frequency, 1, samples)[1] for a in amplitudes]), 0.0)
    t = np.arange(v.size) / (samples * frequency)
    return _record(t, v, axis.run(t, v)[1], name)


def _record(t: FloatArray, v: FloatArray, y: FloatArray, name: str = "x") -> Record:
    return Record(np.round(t * 1e9).astype(np.int64), {name: v}, {name: y})


def _drive(axis: SimulatedAxis, amplitude: float, frequency: float, samples: int) -> Drive:
    axis.rest()
    t, v = triangles(amplitude, frequency, CYCLES, samples)
    return Drive(t, v, axis.run(t, v)[1])


def _ringing(axis: SimulatedAxis, amplitude: float, frequency: float, samples: int) -> float:
    """Return the largest difference (m) between a settled cycle and that of the same axis without the flexure mode."""
    stiff = SimulatedAxis(axis.parameters, character=replace(axis.character, resonance=0.0))
    t, v = triangles(amplitude, frequency, SETTLED + 1, samples)
    axis.rest()
    apart = (axis.run(t, v)[0] - stiff.run(t, v)[0])[-samples:]
    return float(np.abs(apart).max())


def _fit(drive: Drive, kind: str) -> CycleFit:
    """Fit the settled cycle; the voltage before it determines the hysteresis state."""
    fitted, following = drive.cycle(SETTLED), drive.cycle(NEXT)
    start, stop = drive.t[fitted.start] - 1e-9, drive.t[fitted.stop] - 1e-9
    model = identify(_record(drive.t, drive.v, drive.y), kind, start=start, stop=stop).axis("x")
    y = model.simulate(drive.t, drive.v)
    errors = (error_metrics(drive.y[part], y[part]) for part in (fitted, following))
    return CycleFit(model, y[fitted], *errors)


def _shape(fit: CycleFit) -> MultiSlope:
    assert isinstance(fit.model.hysteresis, MultiSlope)
    return fit.model.hysteresis


def _scale(drives: Mapping[float, Drive], base: MultiSlope) -> dict[float, ScaledFit]:
    """Scale the model `base` to the amplitude (V) of each drive; only an offset is fitted."""
    peaks = np.array([drive.settled_peak for drive in drives.values()])
    path = AmplitudeScaled(base, np.array(list(drives), dtype=np.float64), peaks).along(0.0, 0.0)
    fits = {}
    for amplitude, drive in drives.items():
        v, y = drive.settled
        relative = path.forward_array(v)
        simulated = relative + np.median(y - relative)
        fits[amplitude] = ScaledFit(simulated, error_metrics(y, simulated))
    return fits


def _variable_path(
    axis: SimulatedAxis, fits: Mapping[float, CycleFit], peaks: Mapping[float, PeakFrequency], samples: int
) -> VariablePath:
    """Run the path of Fig. 8 and the models on it; the first part is run twice, and its first run is discarded."""
    path = (VARIABLE[0], *VARIABLE)
    waves = [triangles(amplitude, frequency, cycles, samples) for amplitude, frequency, cycles in path]
    starts = np.cumsum([0.0, *(cycles / frequency for _, frequency, cycles in path)])
    t = np.concatenate([start + wave[0] for start, wave in zip(starts, waves, strict=False)])
    v = np.concatenate([wave[1] for wave in waves])
    axis.rest()
    y = axis.run(t, v)[1]

    def own(exponent: float) -> FloatArray:
        """Simulate each cycle by the model of its amplitude, scaled by relative frequency to the power `exponent`."""
        parts, present = [], 0.0
        for amplitude, frequency, cycles in path:
            scale = (frequency / VARIABLE[0][1]) ** exponent
            shape, cycle = _shape(fits[amplitude]), np.append(triangles(amplitude, frequency, 1, samples)[1], 0.0)
            for _ in range(cycles):
                part = present + scale * Memory(shape).forward_array(cycle)
                parts.append(part[:-1])
                present = float(part[-1])
        return np.concatenate(parts)

    highest = VARIABLE[0][0]
    record = triangle_record(axis, "x", FALLING, VARIABLE[0][1], samples)
    family = identify(record, "slpi", start=1.0 / VARIABLE[0][1]).axis("x")
    models = {
        ONE_MPI: fits[highest].model.simulate(t, v),
        OWN_MPI: own(0.0),
        SCALED_MPI: own(peaks[highest].b),
        FAMILY: family.simulate(t, v),
    }
    bounds = np.cumsum([0, *(cycles * samples for _, _, cycles in path)]).tolist()
    shown, first = slice(bounds[1], None), slice(bounds[1], bounds[2])
    return VariablePath(
        t=t[shown] - t[bounds[1]],
        y=y[shown],
        parts=tuple(slice(a - bounds[1], b - bounds[1]) for a, b in pairwise(bounds[1:])),
        models={name: (x - np.mean(x[first] - y[first]))[shown] for name, x in models.items()},
    )
