"""The published SLPI model: a classical PI model for each separated loop, each by its own quadratic program."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

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
from slpi_ros.hysteresis.prandtl_ishlinskii import PrandtlIshlinskii, play
from slpi_ros.hysteresis.slpi_published import (
    Loop,
    SeparatedLoops,
    SingleLoop,
    UnidentifiedLoopWarning,
    at_vertex,
    separate,
)
from slpi_ros.identification.bases import LEAST_GAIN, OperatorWeights
from slpi_ros.identification.design_matrix import Walk
from slpi_ros.identification.least_squares import FIRST_SMOOTHNESS, RIDGE, Fitted, Problem, held_out_errors, solve_qp
from slpi_ros.identification.samples import FEWEST, NEVER_TURNS, Samples, only_one
from slpi_ros.model.axis_model import Start

FloatArray = NDArray[np.float64]

OPERATORS = 10
# Spacing of the thresholds (V), where it suits the outer loop: 10 to 40 of it in the span.
SPACING = 5.0
# A loop needs this many samples of its own; shorter ones are left to the nearest loop that is identified.
FEWEST_OF_LOOP = 4
# The same goes for an inner loop of which less than this share is to be fitted: the rest would be a guess.
LEAST_SHARE = 0.4
# Within the dead band lie the peaks of the noise of a measured voltage, in standard deviations; never more than this
# share of the voltage range.
NOISE_PEAK_TO_PEAK = 8.0
LARGEST_DEAD_BAND = 0.02


def fit_primed(samples: Sequence[Samples]) -> Fitted:
    """Fit the loops of one record so that those of level 1 and more close."""
    return _fit(only_one(samples, "slpi-published"), at_rest=False)


def fit_at_rest(samples: Sequence[Samples]) -> Fitted:
    """Fit the loops of one record with play operators that start at rest, as published."""
    return _fit(only_one(samples, "slpi-published"), at_rest=True)


def default_thresholds(span: float) -> FloatArray:
    """Return the paper's thresholds 0, 5, ..., 45 V (Tables 2 to 5), shape (10,), volts.

    They are made for an outer loop of 100 V. Where its `span` (V) is below 50 or above 200, they are 0, 5, ..., 45 % of
    it.
    """
    spacing = SPACING if 10 <= span / SPACING <= 40 else span / 20
    return spacing * np.arange(OPERATORS, dtype=np.float64)


def voltage_dead_band(v: FloatArray) -> float:
    """Return the dead band (V) that the noise of a measured voltage, shape (N,), volts, asks for.

    Noise is what changes from sample to sample otherwise than smoothly; a commanded voltage has next to none.
    """
    if v.size < FEWEST:
        return 0.0
    # Third differences of white noise are sqrt(20) as large as the noise.
    noise = float(1.4826 * np.median(np.abs(np.diff(v, 3))) / np.sqrt(20))
    return min(NOISE_PEAK_TO_PEAK * noise, LARGEST_DEAD_BAND * float(np.ptp(v)))


def least_iterations(samples: int, all_samples: int) -> int:
    """Return the least number of iterations of the quadratic program of a loop of `samples`, Eq. 9, rounded up."""
    return int(np.ceil(10.0 * np.sqrt(4.0 * samples / all_samples + 1.0)))


def _fit(samples: Samples, *, at_rest: bool) -> Fitted:
    def predict(kept: NDArray[np.bool_]) -> FloatArray:
        return _predict(*fit_loops(samples, kept, at_rest=at_rest), samples.v)

    loops, offset = fit_loops(samples, samples.fitted, at_rest=at_rest)
    # The first rise is never left out: a record shows it once.
    after_first_rise = np.arange(samples.v.size) > int(np.argmax(samples.v))
    if not np.any(samples.fitted & after_first_rise):
        raise IdentificationError(NEVER_TURNS)
    return Fitted(
        hysteresis=loops,
        starts=(Start(float(samples.v[0]), offset),),
        y=samples.y[samples.fitted],
        voltage_range=samples.voltage_range,
        errors=(_predict(loops, offset, samples.v) - samples.y)[samples.fitted],
        held_out=held_out_errors(samples, samples.fitted & after_first_rise, predict),
        covered=len(loops.loops) / len(separate(samples.v, dead_band=loops.dead_band).loops),
    )


def _predict(loops: SeparatedLoops, offset: float, v: FloatArray) -> FloatArray:
    with warnings.catch_warnings():
        # Loops too short to be identified are no news here.
        warnings.simplefilter("ignore", UnidentifiedLoopWarning)
        return loops.along(float(v[0]), offset).forward_array(v)


def fit_loops(
    samples: Samples, fitted: NDArray[np.bool_], *, at_rest: bool, thresholds: FloatArray | None = None
) -> tuple[SeparatedLoops, float]:
    """Fit a PI model to each separated loop of a record.

    Parameters
    ----------
    samples : Samples
    fitted : ndarray of bool, shape (N,)
        Samples whose displacement counts.
    at_rest : bool
        As published; else primed.
    thresholds : ndarray, shape (n,), volts, optional
        Of every loop; see `default_thresholds`.

    Returns
    -------
    SeparatedLoops
    float, metres
        Displacement at rest.

    Raises
    ------
    IdentificationError
        If the outer loop has too few samples.
    """
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
                "check that voltage and displacement belong together"
            ) from None
    return SeparatedLoops(tuple(identified.values()), dead_band), identified[0].vertex[1]


def _run_ins(level: int, thresholds: FloatArray, at_rest: bool) -> list[float | None]:
    """Return the states in which the operators of a loop may start; see `SingleLoop`."""
    if at_rest:
        return [None]
    return [0.0] if level else [*thresholds.tolist(), None]


class Plays(NamedTuple):
    """Play operators fitted to one loop.

    Parameters
    ----------
    weights : ndarray, shape (n,), metres per volt
    start : float, metres
        Displacement at the vertex.
    run_in : float or None, volts
        As in `SingleLoop`.
    rms : float, metres
        Error of the fit.
    """

    weights: FloatArray
    start: float
    run_in: float | None
    rms: float


def fit_plays(
    drive: FloatArray,
    y: FloatArray,
    used: NDArray[np.bool_],
    thresholds: FloatArray,
    run_in: float | None,
    *,
    through_zero: bool,
    iterations: int,
) -> Plays:
    """Fit a PI model (Eq. 8) by a quadratic program: least squares, no weight negative, the first one positive.

    Parameters
    ----------
    drive : ndarray, shape (m,), volts
        From 0 on.
    y : ndarray, shape (m,), metres
    used : ndarray of bool, shape (m,)
        Samples whose displacement counts.
    thresholds : ndarray, shape (n,), volts
    run_in : float or None, volts
        As in `SingleLoop`.
    through_zero : bool
        Whether the displacement is 0 at the start; else that is found too.
    iterations : int
        At least so many; see `least_iterations`.
    """
    plays = [at_vertex(play(r), run_in).forward_array(drive)[used] for r in thresholds.tolist()]
    design = np.column_stack(plays if through_zero else [*plays, np.ones(np.count_nonzero(used))])
    scale = float(np.ptp(y[used])) or 1.0
    matrix = design.T @ design
    matrix[np.diag_indices_from(matrix)] += RIDGE * float(np.trace(matrix))
    bound = np.zeros(thresholds.size)
    bound[0] = LEAST_GAIN / float(np.ptp(drive))
    not_negative = sp.csr_array(sp.eye_array(bound.size, matrix.shape[0]))
    vector = design.T @ y[used] / scale
    x = scale * solve_qp(matrix, vector, not_negative, bound, least_iterations=iterations)
    weights = np.maximum(x[: bound.size], 0.0)
    rms = float(np.sqrt(np.mean((design @ x - y[used]) ** 2)))
    return Plays(weights, 0.0 if through_zero else float(x[-1]), run_in, rms)


class _SingleLoopFit:
    """One loop in its own coordinates."""

    def __init__(self, loop: Loop, samples: Samples, fitted: NDArray[np.bool_], thresholds: FloatArray) -> None:
        self._loop, self._thresholds = loop, thresholds
        path = loop.path
        self._v = loop.direction * (samples.v[path] - samples.v[loop.vertex])
        self._vertex = float(samples.v[loop.vertex]), float(samples.y[loop.vertex])
        self._y = loop.direction * (samples.y[path] - self._vertex[1])
        self._used = fitted[path]
        # The vertex is where it was measured; only where it was not, it is found.
        self._vertex_known = bool(fitted[loop.vertex])
        self._iterations = least_iterations(self._v.size, samples.v.size)

    def solve(self, run_in: float | None) -> Plays:
        """Fit the loop's operators, which start as `run_in` says."""
        return fit_plays(
            self._v,
            self._y,
            self._used,
            self._thresholds,
            run_in,
            through_zero=self._vertex_known,
            iterations=self._iterations,
        )

    def loop(self, solution: Plays, below: SingleLoop | None) -> SingleLoop:
        """Return the loop with a solution's weights, on the loop `below`."""
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
    """Return how far a vertex (V, m) lies from where the model of the loop `below` leads (V, m)."""
    v, y = (below.direction * (vertex[k] - below.vertex[k]) for k in (0, 1))
    by_voltage, by_displacement = below.memory(), below.memory()
    if direction == below.direction:
        # The vertex lies on the way back.
        by_voltage.forward(below.span[0])
        by_displacement.inverse(below.span[1])
    missed = v - by_displacement.inverse(y), y - by_voltage.forward(v)
    return below.direction * missed[0], below.direction * missed[1]


# Cycles count as of one amplitude when theirs differ by less than this share of the largest.
SAME_AMPLITUDE = 0.02


@dataclass(frozen=True)
class MultiSlopeBasis(OperatorWeights):
    """The MPI model: one weight for each operator; parameters as those of `MultiSlope`."""

    origin: float
    amplitude: float
    thresholds: FloatArray
    symmetric_rest: bool = False

    @classmethod
    def over(cls, low: float, high: float) -> "MultiSlopeBasis":
        """Return the basis with the paper's thresholds for the voltages from `low` to `high` (V)."""
        return cls(low, high - low, thresholds_for(high - low))

    def branch_part(self, walk: Walk) -> sp.csr_array:
        """Return how far each operator has moved along the branch."""
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
        """Return the MPI model."""
        return MultiSlope(self.origin, self.amplitude, self.thresholds, np.maximum(x[:-1], 0.0))


def cycle_peaks(v: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the amplitude and the peak displacement of each cycle of a record, in its order.

    A cycle starts within 1 % of the voltage range of the lowest voltage, and goes beyond that. It is left out if its
    displacement is not known there, or within 1 % of its highest voltage.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y : ndarray, shape (N,), metres
        Not finite where it is not known.

    Returns
    -------
    amplitudes : ndarray, shape (c,), volts
        Largest voltage of each cycle, above the lowest one of the record.
    peaks : ndarray, shape (c,), metres
        Largest displacement of each cycle, above that at its start.
    """
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
    """Return the knots of ``X_p`` over amplitude for the SMPI model: cycles of nearly equal amplitude are averaged.

    Parameters
    ----------
    v : ndarray, shape (N,), volts
    y : ndarray, shape (N,), metres

    Returns
    -------
    voltages : ndarray, shape (m,), volts
    displacements : ndarray, shape (m,), metres

    Raises
    ------
    IdentificationError
        If the record holds no cycle, or the peaks do not rise with the amplitude.
    """
    amplitudes, peaks = cycle_peaks(v, y)
    if not amplitudes.size:
        raise IdentificationError("no cycle starts at the lowest voltage; drive from there up and back, per amplitude")
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
    """Peak displacement over drive frequency, ``X_p = a f^b`` (MPI paper, Eq. 1).

    Parameters
    ----------
    a : float, metres
        Peak displacement at 1 Hz.
    b : float
        Negative when the peak sinks with the frequency.
    """

    a: float
    b: float

    def __call__(self, frequency: ArrayLike) -> FloatArray:
        """Return the peak displacement (m) at `frequency` (Hz), of its shape."""
        return self.a * np.asarray(frequency, dtype=np.float64) ** self.b


def fit_peak_frequency(frequency: ArrayLike, peak: ArrayLike) -> PeakFrequency:
    """Fit ``X_p = a f^b`` with the least sum of squared errors of the peaks.

    Parameters
    ----------
    frequency : array_like, shape (n,), Hz
    peak : array_like, shape (n,), metres

    Raises
    ------
    IdentificationError
        If there are not two frequencies, or a value is not positive and finite.
    """
    f, x = np.asarray(frequency, dtype=np.float64), np.asarray(peak, dtype=np.float64)
    if f.ndim != 1 or f.shape != x.shape or np.unique(f).size < 2:
        raise IdentificationError(
            f"X_p = a f^b: frequencies {f.shape}, peaks {x.shape}; give a peak of each of two frequencies or more"
        )
    for name, unit, values in (("frequency", "Hz", f), ("peak", "m", x)):
        bad = ~(np.isfinite(values) & (values > 0))
        if bad.any():
            raise IdentificationError(f"X_p = a f^b: {name} {values[bad][0]:g} {unit} is not positive; leave it out")
    # In logarithms the fit is linear, but weighs errors of small peaks more: a start only. In units of the mean peak.
    mean = x.mean()
    slope, level = np.polyfit(np.log(f), np.log(x / mean), 1)
    best = least_squares(
        lambda p: np.exp(p[0] + p[1] * np.log(f)) - x / mean, (level, slope), ftol=1e-15, xtol=1e-15, gtol=1e-15
    )
    return PeakFrequency(float(mean * np.exp(best.x[0])), float(best.x[1]))


def fit_amplitude_scaled(records: Sequence[Samples]) -> Fitted:
    """Fit the SMPI model to one record.

    Raises
    ------
    UsageError
        If there are several records.
    IdentificationError
        If too few samples belong to cycles of the largest amplitude.
    """
    samples = only_one(records, "smpi")
    largest = in_largest_cycles(samples.v)
    count = int(np.count_nonzero(samples.fitted & largest))
    if count < FEWEST:
        raise IdentificationError(
            f"{count} samples in cycles up to the highest voltage; at least {FEWEST} are needed: "
            "drive from the lowest voltage to the highest and back"
        )

    def predict(kept: NDArray[np.bool_]) -> FloatArray:
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
        held_out=held_out_errors(samples, samples.fitted, predict),
        covered=problem.basis.covered(problem.design.local[problem.weights > 0]),
    )


def in_largest_cycles(v: FloatArray) -> NDArray[np.bool_]:
    """Return which samples belong to a cycle that reaches the highest voltage of a record, shape (N,)."""
    low, high = float(v.min()), float(v.max())
    chosen = np.zeros(v.size, dtype=bool)
    for first, last in cycles(v, low + BACK * (high - low)):
        chosen[first : last + 1] |= v[first : last + 1].max() >= high - SAME_AMPLITUDE * (high - low)
    return chosen


def _ends(samples: Samples) -> tuple[float, float]:
    return float(samples.v.min()), float(samples.v.max())


def _fit_scaled(samples: Samples, kept: NDArray[np.bool_], largest: NDArray[np.bool_]) -> tuple[AmplitudeScaled, float]:
    """Return the model fitted to the samples `kept`, and the displacement at the start (m)."""
    part = replace(samples, fitted=kept & largest)
    problem = Problem.pose([part], MultiSlopeBasis.over(*_ends(samples)))
    x = problem.solve(FIRST_SMOOTHNESS) * problem.scale
    base = problem.basis.shape(x, problem.gain)
    assert isinstance(base, MultiSlope)
    # Of all fitted samples: a few peaks say nothing of the samples between them.
    model = AmplitudeScaled(base, *peak_line(samples.v, np.where(samples.fitted, samples.y, np.nan)))
    # Displacement at the start: at the low end, where all cycles begin, the model must be right.
    relative = model.along(float(samples.v[0]), 0.0).forward_array(samples.v)
    low, high = _ends(samples)
    at_low_end = kept & (samples.v <= low + BACK * (high - low))
    return model, float(np.median((samples.y - relative)[at_low_end if at_low_end.any() else kept]))
