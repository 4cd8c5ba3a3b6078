"""Fits of the published models: SLPI (a classical PI model for each separated loop), multi-slope PI, simplified MPI."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import IdentificationError, UsageError
from slpi_ros.hysteresis.multi_slope import (
    BACK,
    AmplitudeScaled,
    MultiSlope,
    cycles,
    falling_envelope,
    rising_envelope,
    thresholds_for,
)
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii
from slpi_ros.hysteresis.reversals import monotone_runs
from slpi_ros.hysteresis.slpi_published import (
    Loop,
    SeparatedLoops,
    SingleLoop,
    UnidentifiedLoopWarning,
    separate,
)
from slpi_ros.identification.bases import LEAST_GAIN, OperatorWeights, banded
from slpi_ros.identification.design_matrix import Walk
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, RIDGE, Fitted, Problem, held_out_errors
from slpi_ros.identification.quadratic_program import QuadraticProgram
from slpi_ros.identification.samples import FEWEST, NEVER_TURNS, Samples, only_one
from slpi_ros.model.axis_model import Start

OPERATORS = 10
# Spacing of the thresholds (V) for outer loops with a span of 10 to 40 spacings.
SPACING = 5.0
# Fewest fitted samples of an identified loop; the nearest identified loop replaces a shorter one.
FEWEST_OF_LOOP = 4
# Least share of fitted samples of an identified inner loop; below, the nearest identified loop replaces it.
LEAST_SHARE = 0.4
# Dead band in standard deviations of the noise of a measured voltage, and its upper limit as a share of the voltage
# range.
NOISE_PEAK_TO_PEAK = 8.0
LARGEST_DEAD_BAND = 0.02


def fit_primed(samples: Sequence[Samples]) -> Fitted:
    """Fit the loops of one record with play operators that start as after a reversal, so that inner loops close."""
    return _fit(only_one(samples, "slpi-published"), at_rest=False)


def fit_at_rest(samples: Sequence[Samples]) -> Fitted:
    """Fit the loops of one record with play operators that start at rest, as published."""
    return _fit(only_one(samples, "slpi-published"), at_rest=True)


def default_thresholds(span: float) -> FloatArray:
    """Return the paper's thresholds 0, 5, ..., 45 V (Tables 2 to 5), shape (10,), volts."""
    # These suit an outer loop of 100 V. For a `span` (V) below 50 or above 200, they are 0, 5, ..., 45 % of the span.
    spacing = SPACING if 10 <= span / SPACING <= 40 else span / 20
    return spacing * np.arange(OPERATORS, dtype=np.float64)


def voltage_dead_band(v: FloatArray) -> float:
    """Return the dead band (V) for the noise of a measured voltage, shape (N,), volts; nearly 0 for a commanded one."""
    if v.size < FEWEST:
        return 0.0
    # Third differences of white noise are sqrt(20) as large as the noise.
    noise = float(1.4826 * np.median(np.abs(np.diff(v, 3))) / np.sqrt(20))
    return min(NOISE_PEAK_TO_PEAK * noise, LARGEST_DEAD_BAND * float(np.ptp(v)))


def _fit(samples: Samples, *, at_rest: bool) -> Fitted:
    def predict(kept: Mask) -> FloatArray:
        return _predict(*fit_loops(samples, kept, at_rest=at_rest), samples.v)

    loops, offset = fit_loops(samples, samples.fitted, at_rest=at_rest)
    # The first rise is in every fit: it occurs once in a record.
    after_first_rise = np.arange(samples.v.size) > int(np.argmax(samples.v))
    if not np.any(samples.fitted & after_first_rise):
        raise IdentificationError(NEVER_TURNS)
    return Fitted(
        hysteresis=loops,
        starts=(Start(float(samples.v[0]), offset),),
        y=samples.y[samples.fitted],
        voltage_range=samples.voltage_range,
        errors=(_predict(loops, offset, samples.v) - samples.y)[samples.fitted],
        validate=lambda: held_out_errors(samples, samples.fitted & after_first_rise, predict),
        again=fit_at_rest if at_rest else fit_primed,
        covered=len(loops.loops) / len(separate(samples.v, dead_band=loops.dead_band).loops),
    )


def _predict(loops: SeparatedLoops, offset: float, v: FloatArray) -> FloatArray:
    with warnings.catch_warnings():
        # Loops too short to be identified are expected here.
        warnings.simplefilter("ignore", UnidentifiedLoopWarning)
        return loops.along(float(v[0]), offset).forward_array(v)


def fit_loops(
    samples: Samples, fitted: Mask, *, at_rest: bool, thresholds: FloatArray | None = None
) -> tuple[SeparatedLoops, float]:
    """Fit a PI model to each separated loop of a record; return the loops and the displacement at rest (m)."""
    # Play operators start in their state after a reversal or, as published, `at_rest`.
    dead_band = voltage_dead_band(samples.v)
    separation = separate(samples.v, dead_band=dead_band)
    samples = replace(samples, v=separation.voltage)
    if thresholds is None:
        thresholds = default_thresholds(float(np.ptp(samples.v[separation.loops[0].samples])))
    identified: dict[int, SingleLoop] = {}
    for number, loop in enumerate(separation.loops):
        count = int(np.count_nonzero(fitted[loop.samples]))
        seen = LEAST_SHARE * loop.samples.size if loop.level else 0
        if count < max(FEWEST_OF_LOOP, seen):
            if not loop.level:
                raise IdentificationError(
                    f"the outer loop has {count} usable samples; record a rise to the highest voltage and the way back"
                )
            continue
        single = _SingleLoopFit(loop, samples, fitted, thresholds)
        fits = [single.solve(run_in) for run_in in _run_ins(loop.level, thresholds, at_rest)]
        best = min(fits, key=lambda fit: fit.rms)
        try:
            identified[number] = single.loop(best, identified.get(loop.below) if loop.level else None)
        except UsageError:
            raise IdentificationError(
                f"the loop from {samples.v[loop.vertex]:g} V (sample {loop.vertex}) does not fit the one below it; "
                "check that voltage and displacement belong to the same axis"
            ) from None
    return SeparatedLoops(tuple(identified.values()), dead_band), identified[0].vertex[1]


def _run_ins(level: int, thresholds: FloatArray, at_rest: bool) -> list[float | None]:
    """Return the candidate initial states of a loop's operators; see `SingleLoop`."""
    if at_rest:
        return [None]
    return [0.0] if level else [*thresholds.tolist(), None]


class Plays(NamedTuple):
    """Play operators fitted to one loop."""

    weights: FloatArray  # m/V, (n,)
    start: float  # m, at the vertex
    run_in: float | None  # V, initial state of the operators, as in `SingleLoop`
    rms: float  # m


def fit_plays(
    drive: FloatArray,
    y: FloatArray,
    used: Mask,
    thresholds: FloatArray,
    run_in: float | None,
    *,
    through_zero: bool,
) -> Plays:
    """Fit a PI model (Eq. 8) by a quadratic program: least squares, no weight negative, the first one positive."""
    # `drive` (V) and `y` (m), shape (m,), are relative to the vertex of the loop. If `through_zero`, the displacement
    # there is 0, otherwise it is a parameter of the fit.
    plays = plays_from_vertex(drive, thresholds, run_in)[used]
    design = plays if through_zero else np.column_stack([plays, np.ones(len(plays))])
    scale = float(np.ptp(y[used])) or 1.0
    matrix = design.T @ design
    matrix[np.diag_indices_from(matrix)] += RIDGE * float(np.trace(matrix))
    bound = np.zeros(thresholds.size)
    bound[0] = LEAST_GAIN / float(np.ptp(drive))
    not_negative = banded((1.0,), bound.size, matrix.shape[0])
    vector = design.T @ y[used] / scale
    x = scale * QuadraticProgram(matrix, not_negative, bound).solve(vector).x
    weights = np.maximum(x[: bound.size], 0.0)
    rms = float(np.sqrt(np.mean((design @ x - y[used]) ** 2)))
    return Plays(weights, 0.0 if through_zero else float(x[-1]), run_in, rms)


def plays_from_vertex(drive: FloatArray, thresholds: FloatArray, run_in: float | None) -> FloatArray:
    """Return the motion (V) of play operators, (m, n), along a path (V, (m,)), from their states by `at_vertex`."""
    # Within a monotone run an operator depends on the present voltage and its state at the start of the run alone.
    state = np.zeros(thresholds.size) if run_in is None else np.maximum(thresholds - run_in, -thresholds)
    moved, at_vertex = np.empty((drive.size, thresholds.size)), state
    for first, end in monotone_runs(drive):
        v = drive[first:end, None]
        moved[first:end] = np.maximum(v - thresholds, np.minimum(v + thresholds, state))
        state = moved[end - 1]
    return np.asarray(moved - at_vertex)


class _SingleLoopFit:
    """Fit of one loop in coordinates relative to its vertex."""

    def __init__(self, loop: Loop, samples: Samples, fitted: Mask, thresholds: FloatArray) -> None:
        self._loop, self._thresholds = loop, thresholds
        path = loop.path
        self._v = loop.direction * (samples.v[path] - samples.v[loop.vertex])
        self._vertex = float(samples.v[loop.vertex]), float(samples.y[loop.vertex])
        self._y = loop.direction * (samples.y[path] - self._vertex[1])
        self._used = fitted[path]
        # A measured vertex is fixed; otherwise its displacement is a parameter of the fit.
        self._vertex_known = bool(fitted[loop.vertex])

    def solve(self, run_in: float | None) -> Plays:
        """Fit the loop's operators from the initial state `run_in` (V)."""
        return fit_plays(
            self._v,
            self._y,
            self._used,
            self._thresholds,
            run_in,
            through_zero=self._vertex_known,
        )

    def loop(self, solution: Plays, below: SingleLoop | None) -> SingleLoop:
        """Return the loop with the fitted weights; `below` is the loop that contains it, None for the outer loop."""
        loop = self._loop
        vertex = self._vertex[0], self._vertex[1] + loop.direction * solution.start
        return SingleLoop(
            level=loop.level,
            direction=loop.direction,
            vertex=vertex,
            span=(float(np.max(self._v)), float(np.max(np.abs(self._y[self._used] - solution.start)))),
            offset=_offset(vertex, loop.direction, below) if below else (0.0, 0.0),
            model=PrandtlIshlinskii(self._thresholds, solution.weights),
            run_in=solution.run_in,
        )


def _offset(vertex: tuple[float, float], direction: int, below: SingleLoop) -> tuple[float, float]:
    """Return the distance (V, m) of a vertex (V, m) from the branch that the model of the loop `below` predicts."""
    v, y = (below.direction * (vertex[k] - below.vertex[k]) for k in (0, 1))
    by_voltage, by_displacement = below.memory(), below.memory()
    if direction == below.direction:
        # The vertex lies on the returning branch.
        by_voltage.forward(below.span[0])
        by_displacement.inverse(below.span[1])
    missed = v - by_displacement.inverse(y), y - by_voltage.forward(v)
    return below.direction * missed[0], below.direction * missed[1]


# Cycles have the same amplitude if their amplitudes differ by less than this share of the largest.
SAME_AMPLITUDE = 0.02


@dataclass(frozen=True)
class MultiSlopeBasis(OperatorWeights):
    """Basis of the MPI model, one weight for each operator; `origin`, `amplitude`, `thresholds` as in `MultiSlope`."""

    origin: float
    amplitude: float
    thresholds: FloatArray
    symmetric_rest: bool = False

    @classmethod
    def over(cls, low: float, high: float) -> "MultiSlopeBasis":
        """Return the basis with the paper's thresholds for the voltages from `low` to `high` (V)."""
        return cls(low, high - low, thresholds_for(high - low))

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return the motion (V) of each operator along the branch of each sample, shape (N, size)."""
        upper, lower = np.maximum(walk.v, walk.v_origin), np.minimum(walk.v, walk.v_origin)
        waits = rising_envelope(upper[:, None] - self.origin, self.thresholds) - self._falling(lower)
        moved = np.maximum(0.0, waits) * walk.direction[:, None]
        if walk.long_fall.any():
            fallen, rest = walk.v[walk.long_fall], walk.v_rest[walk.long_fall]
            moved[walk.long_fall] = self._falling(fallen) - self._falling(rest)
        return sp.csr_array(moved)

    def _falling(self, v: FloatArray) -> FloatArray:
        """Return the falling envelopes, shape (N, size)."""
        return falling_envelope(v[:, None] - self.origin, self.thresholds, self.amplitude)

    def shape(self, x: FloatArray, gain: float) -> MultiSlope:
        """Return the MPI model with the weights `x` (m/V); `gain` is not used."""
        return MultiSlope(self.origin, self.amplitude, self.thresholds, np.maximum(x[:-1], 0.0))


def cycle_peaks(v: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return amplitude (V) and peak displacement (m) of each cycle of a record, shape (c,), in chronological order."""
    # A cycle starts at a voltage within 1 % of the range above the lowest voltage, and rises above that band. It is
    # omitted if its displacement is unknown at its start, or at all voltages within 1 % of the range below its peak.
    # Amplitudes are relative to the lowest voltage of the record, peaks to the start of the cycle.
    if not v.size:
        return np.empty(0), np.empty(0)
    origin, near = v.min(), BACK * np.ptp(v)
    found = []
    for first, last in cycles(v, origin + near):
        top, known = v[first : last + 1].max(), first + np.flatnonzero(np.isfinite(y[first : last + 1]))
        v_known, y_known = v[known], y[known]
        if known.size and v_known[0] <= origin + near < top and v_known.max() >= top - near:
            found.append((v_known.max() - origin, y_known.max() - y_known[0]))
    amplitudes, peaks = np.array(found, dtype=np.float64).reshape(-1, 2).T
    return amplitudes, peaks


def peak_line(v: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ascending amplitudes (V) and mean peak displacements (m) of cycles, for the simplified model (SMPI)."""
    amplitudes, peaks = cycle_peaks(v, y)
    if not amplitudes.size:
        raise IdentificationError("no cycle starts at the lowest voltage; drive up and back from there, per amplitude")
    order = np.argsort(amplitudes)
    amplitudes, peaks = amplitudes[order], peaks[order]
    group = np.zeros(amplitudes.size, dtype=np.int64)
    first = 0
    for i in range(1, amplitudes.size):
        apart = amplitudes[i] - amplitudes[first] > SAME_AMPLITUDE * amplitudes[-1]
        group[i] = group[i - 1] + apart
        first = i if apart else first
    count = np.bincount(group)
    voltages, displacements = (np.bincount(group, x) / count for x in (amplitudes, peaks))
    down = np.flatnonzero(np.diff(displacements, prepend=0.0) <= 0.0)
    if down.size:
        raise IdentificationError(
            f"the peak displacement {displacements[down[0]]:.4g} m at the amplitude {voltages[down[0]]:.4g} V is not "
            "above that of smaller amplitudes; check the record for drift and outliers"
        )
    return voltages, displacements


@dataclass(frozen=True)
class PeakFrequency:
    """Peak displacement as a function of excitation frequency, ``X_p = a f^b`` (MPI paper, Eq. 1)."""

    a: float  # m, at 1 Hz
    b: float

    def __call__(self, frequency: ArrayLike) -> FloatArray:
        """Return the peak displacement (m) at `frequency` (Hz), in the shape of `frequency`."""
        return self.a * np.asarray(frequency, dtype=np.float64) ** self.b


def fit_peak_frequency(frequency: ArrayLike, peak: ArrayLike) -> PeakFrequency:
    """Fit ``X_p = a f^b`` to peak displacements (m) at frequencies (Hz), (n,) each, by nonlinear least squares."""
    from scipy.optimize import least_squares

    f, x = np.asarray(frequency, dtype=np.float64), np.asarray(peak, dtype=np.float64)
    if f.ndim != 1 or f.shape != x.shape or np.unique(f).size < 2:
        raise IdentificationError(
            f"X_p = a f^b: frequencies {f.shape}, peaks {x.shape}; give a peak of each of two frequencies or more"
        )
    for name, unit, values in (("frequency", "Hz", f), ("peak", "m", x)):
        bad = ~(np.isfinite(values) & (values > 0))
        if bad.any():
            raise IdentificationError(f"X_p = a f^b: {name} {values[bad][0]:g} {unit} is not positive; leave it out")
    # Initial guess: the linear fit of logarithms, which overweights small peaks. Peaks are in units of their mean.
    mean = x.mean()
    slope, level = np.polyfit(np.log(f), np.log(x / mean), 1)
    best = least_squares(
        lambda p: np.exp(p[0] + p[1] * np.log(f)) - x / mean, (level, slope), ftol=1e-15, xtol=1e-15, gtol=1e-15
    )
    return PeakFrequency(float(mean * np.exp(best.x[0])), float(best.x[1]))


def fit_amplitude_scaled(records: Sequence[Samples]) -> Fitted:
    """Fit the simplified multi-slope PI model (SMPI) to one record, given as a sequence of one element."""
    samples = only_one(records, "smpi")
    largest = in_largest_cycles(samples.v)
    count = int(np.count_nonzero(samples.fitted & largest))
    if count < FEWEST:
        raise IdentificationError(
            f"{count} samples in cycles up to the highest voltage; at least {FEWEST} are needed: "
            "drive from the lowest voltage to the highest and back"
        )

    def predict(kept: Mask) -> FloatArray:
        model, offset = _fit_scaled(samples, kept, largest)
        return model.along(float(samples.v[0]), offset).forward_array(samples.v)

    model, offset = _fit_scaled(samples, samples.fitted, largest)
    y = model.along(float(samples.v[0]), offset).forward_array(samples.v)
    problem = Problem.pose([samples.only(largest)], MultiSlopeBasis.over(*_ends(samples)))
    return Fitted(
        hysteresis=model,
        starts=(Start(float(samples.v[0]), offset),),
        y=samples.y[samples.fitted],
        voltage_range=samples.voltage_range,
        errors=(y - samples.y)[samples.fitted],
        validate=lambda: held_out_errors(samples, samples.fitted, predict),
        again=fit_amplitude_scaled,
        covered=problem.basis.covered(problem.design.local[problem.weights > 0]),
    )


def in_largest_cycles(v: FloatArray) -> Mask:
    """Return the mask, shape (N,), of samples in cycles that reach the highest voltage of the record."""
    low, high = float(v.min()), float(v.max())
    chosen = np.zeros(v.size, dtype=bool)
    for first, last in cycles(v, low + BACK * (high - low)):
        chosen[first : last + 1] |= v[first : last + 1].max() >= high - SAME_AMPLITUDE * (high - low)
    return chosen


def _ends(samples: Samples) -> tuple[float, float]:
    return float(samples.v.min()), float(samples.v.max())


def _fit_scaled(samples: Samples, kept: Mask, largest: Mask) -> tuple[AmplitudeScaled, float]:
    """Return the model fitted to the samples `kept`, and the initial displacement (m)."""
    part = replace(samples, fitted=kept & largest)
    problem = Problem.pose([part], MultiSlopeBasis.over(*_ends(samples)))
    x = problem.solve(FIRST_SMOOTHNESS).x * problem.scale
    base = problem.basis.shape(x, problem.gain)
    assert isinstance(base, MultiSlope)
    # From all fitted samples, not only those kept: the peaks are few.
    model = AmplitudeScaled(base, *peak_line(samples.v, np.where(samples.fitted, samples.y, np.nan)))
    # Displacement at the start: from the error at the low end, where all cycles begin.
    relative = model.along(float(samples.v[0]), 0.0).forward_array(samples.v)
    low, high = _ends(samples)
    at_low_end = kept & (samples.v <= low + BACK * (high - low))
    return model, float(np.median((samples.y - relative)[at_low_end if at_low_end.any() else kept]))
