"""Tracking error of a compensated path, and its causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError
from slpi_ros.model.coverage import rates

# A delay is accepted if it reduces the difference between model and desired displacement by this factor.
BETTER = 1.1
# A voltage is at a limit if it stays at the extreme of the record for at least this many samples.
FEWEST_AT_LIMIT = 3
# Longest delay that is searched for, in seconds and as a share of the record, and number of steps of the search.
LONGEST_DELAY, DELAY_SHARE, DELAY_STEPS = 0.5, 0.05, 200

# What each part of a tracking error is, and what helps.
CAUSES = {
    "zero": "the zero has moved since the model was identified, or the path counts from another one: ~/set_zero",
    "memory": "the stage was in another state than the compensator assumed: ~/reset_memory",
    "limits": "the voltage was at a limit: a smaller path",
    "delay": "the stage is late: send the path as a trajectory, with the delay in the model",
    "rate": "loops wider or narrower than those of the model, the faster the more: slpi diagnose on faster records",
    "command": "the voltages are not those of this model: slew limit, feedback, a reset, another model, or points of a "
    "trajectory that were skipped, which the log of the compensator tells",
    "model": "the hysteresis and what else the model does not hold: slpi diagnose, slpi refit",
    "noise": "what does not repeat: sensor noise, vibration, line interference",
}


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


@dataclass(frozen=True)
class Tracking:
    """Tracking error of a compensated path of N samples, and its causes."""

    error: ErrorPart
    shares: Mapping[str, float]  # of each of `CAUSES` in the mean square error; sum 1, negative: counteracts others
    delay: float  # s, of the displacement behind the desired one
    t: FloatArray  # s, (N,)
    desired: FloatArray  # m, (N,)
    parts: Mapping[str, FloatArray]  # m, (N,), of each cause, with noise in "model"

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
    def blame(self) -> str:
        """The cause with the largest share."""
        return max(self.shares, key=lambda cause: self.shares[cause])

    def to_document(self) -> dict[str, Any]:
        """Return the figures as in ``msg_schemas/verification.schema.json``."""
        return {
            "rms_m": self.error.rms,
            "maximum_m": self.error.maximum,
            "samples": self.error.samples,
            "shares": dict(self.shares),
            "blame": self.blame,
            "delay_s": self.delay,
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
    delay = _delay(t, d, begun)
    late = np.interp(t - delay, t, d)
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
        t=t,
        desired=d,
        parts=parts,
    )


def _delay(t: FloatArray, desired: FloatArray, model: FloatArray) -> float:
    """Return the delay (s) of the model behind the desired displacement; 0 if no delay is clearly better."""
    longest = min(LONGEST_DELAY, DELAY_SHARE * float(t[-1] - t[0]))
    shifts = np.linspace(0.0, longest, DELAY_STEPS + 1)
    misses = [float(np.std(model - np.interp(t - shift, t, desired))) for shift in shifts.tolist()]
    best = int(np.argmin(misses))
    return float(shifts[best]) if misses[best] < misses[0] / BETTER else 0.0


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
