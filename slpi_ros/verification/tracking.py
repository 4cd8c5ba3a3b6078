"""Tracking error of a compensated path, and its causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.arrays.rates import rates
from slpi_ros.errors import RecordError
from slpi_ros.verification.step_answers import StepAnswer, followed_up_to, step_answers

# A delay is accepted if it reduces the difference between model and desired displacement by this factor.
BETTER = 1.1
# A voltage is at a limit if it stays at the extreme of the record for at least this many samples.
FEWEST_AT_LIMIT = 3
# Longest delay that is searched for, in seconds and as a share of the record, and number of steps of the search.
LONGEST_DELAY, DELAY_SHARE, DELAY_STEPS = 0.5, 0.05, 200

# A delay varies if one for each of so many parts of the path reduces the difference by this factor.
VARIES, DELAY_WINDOWS = 1.8, 100
# Percentiles that are told as its range.
VARIED = (0.05, 0.95)

# What each part of a tracking error is, and what helps.
CAUSES = {
    "zero": "the zero has moved since the model was identified, or the path counts from another one: ~/set_zero",
    "memory": "the stage was in another state than the compensator assumed: ~/reset_memory",
    "limits": "the voltage was at a limit: a smaller path",
    "delay": "the stage is later than its model: a delay is found by slpi diagnose; a model with it sends ahead by it "
    "what is known of the path, so as a trajectory",
    "rate": "loops wider or narrower than those of the model, the faster the more: slpi diagnose on faster records",
    "command": "the voltages are not those of this model: slew limit, feedback, a reset, another model, or a computer "
    "that was busy, see the log of the compensator",
    "model": "the hysteresis and what else the model does not hold: slpi diagnose, slpi refit",
    "noise": "what does not repeat: sensor noise, vibration, line interference",
}
LATE = (
    "the voltages are late: single messages act when they come, the points of a trajectory at their times; or else the "
    "slew limit, a driver that buffers, or stamps that are not the times meant"
)
VARYING = "the voltages come late, and not always equally: computer or driver was busy, or the slew limit was reached"


@dataclass(frozen=True)
class ErrorPart:
    """Number of samples, and their rms and maximum error (m), for a part of the samples."""

    name: str
    samples: int
    rms: float
    maximum: float

    @classmethod
    def of(cls, name: str, error: FloatArray) -> "ErrorPart":
        """Summarise errors, shape (N,), metres, N > 0."""
        return cls(name, error.size, rms(error), float(np.abs(error).max()))

    def to_document(self) -> dict[str, Any]:
        """Return the part as in ``msg_schemas/verification.schema.json``."""
        return {"name": self.name, "samples": self.samples, "rms_m": self.rms, "maximum_m": self.maximum}


# Times are told at which the error is so many times the usual one, if they hold this share of the mean square error in
# at most that share of the path; number of windows that are compared. A gap between readings is told if it is so long
# (s), and so many times the usual interval.
ABOVE_USUAL, MOSTLY, SHORT, WINDOWS, GAP, TIMES_USUAL = 2.5, 0.7, 0.15, 200, 0.02, 5.0


@dataclass(frozen=True)
class Burst:
    """Times (s) of a record in which most of a tracking error lies, the largest part first."""

    times: tuple[tuple[float, float], ...]
    share: float  # of the mean square error
    elsewhere: float  # m, rms error at all other times
    gap: float  # s, longest time without a reading at these times; 0: none that is unusual

    @classmethod
    def of(cls, t: FloatArray, error: FloatArray) -> "Burst | None":
        """Find them for an error (m), (N,), at times (s), (N,); None if the error is not concentrated."""
        length = float(t[-1] - t[0]) / WINDOWS
        if not length > 0.0 or t.size < WINDOWS:
            return None
        window = np.minimum(((t - t[0]) / length).astype(int), WINDOWS - 1)
        squares = np.bincount(window, error**2, WINDOWS)
        counts = np.bincount(window, minlength=WINDOWS)
        means = squares / np.maximum(counts, 1)
        least = max(np.sort(means)[-round(SHORT * WINDOWS)], ABOVE_USUAL**2 * np.median(means[counts > 0]))
        chosen = means >= least
        if squares[chosen].sum() < MOSTLY * squares.sum():
            return None
        # One window between two others belongs to them.
        chosen[1:-1] |= chosen[:-2] & chosen[2:]
        edges = np.flatnonzero(np.diff(np.pad(chosen, 1).astype(np.int8)))
        runs = sorted(zip(edges[::2], edges[1::2], strict=True), key=lambda run: -squares[slice(*run)].sum())
        inside = chosen[window]
        intervals = np.diff(t)
        gaps = intervals[inside[1:] | inside[:-1]]
        gap = float(gaps.max()) if gaps.size else 0.0
        return cls(
            tuple((float(t[0] + first * length), float(t[0] + last * length)) for first, last in runs),
            float(squares[chosen].sum() / squares.sum()),
            rms(error[~inside]),
            gap if gap > max(GAP, TIMES_USUAL * float(np.median(intervals))) else 0.0,
        )


@dataclass(frozen=True)
class Tracking:
    """Tracking error of a compensated path of N samples, and its causes."""

    error: ErrorPart
    shares: Mapping[str, float]  # of each of `CAUSES` in the mean square error; sum 1, negative: counteracts others
    delay: float  # s, of the displacement behind the desired one
    t: FloatArray  # s, (N,)
    desired: FloatArray  # m, (N,)
    parts: Mapping[str, FloatArray]  # m, (N,), of each cause, with noise in "model"
    behind: float = 0.0  # s, of `delay`, by which the stage is later than its model
    delays: tuple[float, ...] | None = None  # s, range of a delay that varies: 5th and 95th percentile
    noise_rms: float = 0.0  # m, of what does not repeat

    @property
    def whole(self) -> FloatArray:
        """Measured - desired, m, (N,)."""
        return np.asarray(np.sum(list(self.parts.values()), axis=0))

    @property
    def bandwidth(self) -> float | None:
        """Lowest frequency (Hz) at which the error reaches -3 dB of the path; None: the path does not show it."""
        return followed_up_to(self.t, self.desired, self.whole)

    @property
    def steps(self) -> tuple[StepAnswer, ...]:
        """Answers to the steps of the path, by rising size."""
        return step_answers(self.t, self.desired, self.whole, self.noise_rms)

    @property
    def rms(self) -> dict[str, float]:
        """Error (m rms) of each cause, the largest first; the squares add up to that of the whole."""
        found = {cause: self.error.rms * float(np.sqrt(max(share, 0.0))) for cause, share in self.shares.items()}
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def rest_rms(self) -> float:
        """Error without its part by the zero, m rms."""
        return self.error.rms * float(np.sqrt(max(1.0 - self.shares["zero"], 0.0)))

    @property
    def burst(self) -> Burst | None:
        """When most of the error without the zero occurs; None if it is spread over the path."""
        return Burst.of(self.t, np.sum([part for cause, part in self.parts.items() if cause != "zero"], axis=0))

    @property
    def blame(self) -> str:
        """The cause with the largest share."""
        return max(self.shares, key=lambda cause: self.shares[cause])

    def advice(self, cause: str) -> str:
        """Return what a cause is, and what helps."""
        if cause != "delay":
            return CAUSES[cause]
        return VARYING if self.delays else LATE if 2.0 * self.behind < self.delay else CAUSES[cause]

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "rms_m": self.error.rms,
            "maximum_m": self.error.maximum,
            "samples": self.error.samples,
            "shares": dict(self.shares),
            "blame": self.blame,
            "delay_s": self.delay,
            "delay_range_s": list(self.delays) if self.delays else None,
            "bandwidth_Hz": self.bandwidth,
            "step_answers": [each.to_document() for each in self.steps],
        }


def track(
    where: tuple[str, str],
    t: FloatArray,
    v: FloatArray,
    y: FloatArray,
    desired: FloatArray,
    estimated: FloatArray,
    assumed: Sequence[FloatArray],
    *,
    zero: float,
    noise_rms: float,
) -> Tracking:
    """Decompose the tracking error, measured `y` - `desired`, by cause; all signals of shape (N,), s, V and m.

    ``m`` is the model from the initial state of the record, `estimated`, ``a`` the one from the initial state that the
    compensator seems to have assumed, one of `assumed`, and ``d`` the desired displacement, NaN where there was none
    (``d'``: later)::

        y - d = (y - zero - m) + zero + (m - a) + (a - d') + (d' - d)
                 model, rate, noise      memory   command   delay

    Of the first part, what goes with the rate of the model is a delay of the stage, or a rate dependence. RecordError,
    which names record and axis `where`, if there is no desired displacement.
    """
    at = np.isfinite(desired) & np.isfinite(y)
    if np.count_nonzero(at) < 2:
        raise RecordError(f"{where[0]}: axis '{where[1]}': no desired displacement while it was measured; record both")
    t, v, y, d, estimated = t[at], v[at], y[at], desired[at], estimated[at]
    begun = min((each[at] for each in assumed), key=lambda each: rms(each - d))
    delay, delays = _delay(t, d, begun)
    late = np.interp(t - (delay if delays is None else delays), t, d)
    command = begun - late
    limited = _at_limit(v, command)
    # Voltages for displacements that count from another zero, or feedback that takes a zero out.
    shift = float(np.median(command))
    shift = 0.0 if limited.any() or abs(shift) < float(np.std(command)) else shift
    command = command - shift
    residual = y - zero - estimated
    behind, stage_late, by_rate = _with_rate(t, estimated, residual)
    model = residual - stage_late - by_rate
    # The median of the residual is zero, which is not that of the loops where the stage is late.
    median = float(np.median(model) - np.median(residual))
    parts = {
        "zero": np.full(t.size, zero + shift + median),
        "memory": estimated - begun,
        "limits": np.where(limited, command, 0.0),
        "delay": late - d + stage_late,
        "rate": by_rate,
        "command": np.where(limited, 0.0, command),
        "model": model - median,
    }
    error = y - d
    total, rest = float(error @ error), error - parts["zero"]
    shares = {cause: float(part @ rest) / total if total else 0.0 for cause, part in parts.items()}
    shares["zero"] = 1.0 - float(rest @ rest) / total if total else 0.0
    noise = min(noise_rms**2 * error.size / total if total else 0.0, max(shares["model"], 0.0))
    shares |= {"model": shares["model"] - noise, "noise": noise}
    return Tracking(
        error=ErrorPart.of(where[0], error),
        shares={cause: shares[cause] for cause in CAUSES},
        delay=delay + behind,
        behind=behind,
        t=t,
        desired=d,
        parts=parts,
        delays=None if delays is None else tuple(np.quantile(delays, VARIED).tolist()),
        noise_rms=noise_rms,
    )


def _delay(t: FloatArray, desired: FloatArray, model: FloatArray) -> tuple[float, FloatArray | None]:
    """Return the delay (s) of the model behind the desired displacement, and that of each sample, (N,), if it varies.

    0 if no delay is clearly better. What counts is the rms of each window, and not its square: a large step that the
    slew limit held back would else decide on the delay of the whole path.
    """
    longest = min(LONGEST_DELAY, DELAY_SHARE * float(t[-1] - t[0]))
    shifts = np.linspace(0.0, longest, DELAY_STEPS + 1)
    window = np.minimum(((t - t[0]) / (t[-1] - t[0]) * DELAY_WINDOWS).astype(int), DELAY_WINDOWS - 1)
    counts = np.maximum(np.bincount(window, minlength=DELAY_WINDOWS), 1)

    def left(shift: float | FloatArray) -> FloatArray:
        """Return the mean square (m^2) of what each window leaves at a delay (s)."""
        rest = model - np.interp(t - shift, t, desired)
        return np.bincount(window, (rest - np.median(rest)) ** 2, DELAY_WINDOWS) / counts

    by_window = np.array([left(shift) for shift in shifts.tolist()])
    misses = np.sqrt(by_window).mean(axis=1)
    best = int(np.argmin(misses))
    best = best if misses[best] < misses[0] / BETTER else 0
    own = np.argmin(by_window, axis=0)
    # At rest every delay serves.
    own = np.where(by_window.min(axis=0) < by_window[best] / BETTER, own, best)
    centres = t[0] + (np.arange(DELAY_WINDOWS) + 0.5) / DELAY_WINDOWS * (t[-1] - t[0])
    delays = np.interp(t, centres, shifts[own])
    # One that differs in a few windows alone is no delay of the path: what is left there is a matter of the voltages.
    low, high = np.quantile(delays, VARIED)
    if low < high and float(np.sqrt(left(delays)).mean()) * VARIES < misses[best]:
        return float(np.median(delays)), delays
    return float(shifts[best]), None


def _with_rate(t: FloatArray, model: FloatArray, residual: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return the delay (s) of the stage behind the model, and the residual (m), (N,), of this and of a rate dependence.

    A delay adds what is proportional to the rate, a rate dependence what goes with its logarithm. Zero unless clearly
    better than loops that are wider at every rate, which are an error of the hysteresis.
    """
    none = np.zeros(t.size)
    speed = rates(t, model)
    moving = speed > 0.0
    if not moving.any():
        return 0.0, none, none
    rate = speed * np.sign(np.gradient(model))
    log_rate = np.sign(rate) * np.log1p(speed / np.median(speed[moving]))
    columns = [np.ones(t.size), np.sign(rate), rate, log_rate]
    fits = []
    for chosen in ((0, 1), (0, 1, 2), (0, 1, 3), (0, 1, 2, 3)):
        matrix = np.column_stack([columns[each] for each in chosen])
        found = dict(zip(chosen, np.linalg.lstsq(matrix, residual, rcond=None)[0].tolist(), strict=True))
        delayed, by_rate = (found.get(each, 0.0) * columns[each] for each in (2, 3))
        fits.append((rms(residual - matrix @ np.array(list(found.values()))), found.get(2, 0.0), delayed, by_rate))
    best = fits[0]
    for fit in fits[1:]:
        # A stage cannot be ahead of its model.
        if fit[1] <= 0.0 and fit[0] < best[0] / BETTER:
            best = fit
    return -best[1], best[2], best[3]


def _at_limit(v: FloatArray, command: FloatArray) -> Mask:
    """Return the mask of samples, shape (N,), with the voltage at a limit and a desired displacement beyond it."""
    margin = 1e-6 * float(np.ptp(v))
    limited = np.zeros(v.size, dtype=bool)
    for extreme, missing in ((v.max(), command < 0.0), (v.min(), command > 0.0)):
        there = np.abs(v - extreme) <= margin
        edges = np.flatnonzero(np.diff(np.pad(there, 1).astype(np.int8)))
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if stop - start >= FEWEST_AT_LIMIT:
                limited[start:stop] |= missing[start:stop]
    return limited


def rms(error: FloatArray) -> float:
    """Return the rms of errors, (N,), in their unit."""
    return float(np.sqrt(np.mean(error**2)))
