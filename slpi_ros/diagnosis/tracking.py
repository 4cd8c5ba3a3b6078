"""Tracking error of a compensated path, and its causes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError

# A delay is accepted if it reduces the difference between model and desired displacement by this factor.
BETTER = 1.1
# A voltage is at a limit if it stays at the extreme of the record for at least this many samples.
FEWEST_AT_LIMIT = 3
# Longest delay that is searched for, in seconds and as a share of the record, and number of steps of the search.
LONGEST_DELAY, DELAY_SHARE, DELAY_STEPS = 0.5, 0.05, 200

CAUSES = {
    "zero": "the zero of the sensor has moved since the model was identified",
    "memory": "the compensator started from another memory than the stage had",
    "limits": "the voltage was at a limit",
    "delay": "the displacement follows the desired one later",
    "command": "the voltages are not those of this model: rate limits, feedback, a reset or another model",
    "effects": "the stage does what the model does not hold; `slpi diagnose` names it",
    "model": "the model's hysteresis is not that of the stage",
    "noise": "noise of the sensor",
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
    effects: tuple[str, ...]  # identified by a diagnosis of the record
    t: FloatArray  # s, (N,)
    desired: FloatArray  # m, (N,)
    parts: Mapping[str, FloatArray]  # m, (N,), of each cause, with noise and effects in "model"

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
            "effects": list(self.effects),
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
    effects: tuple[tuple[str, ...], float],
) -> Tracking:
    """Decompose the tracking error, measured `y` - `desired`, by cause; all signals of shape (N,), s, V and m.

    ``m`` is the model from the initial state of the record, `estimated`, ``a`` the one from the initial state that the
    compensator seems to have assumed, one of `assumed`, and ``d`` the desired displacement, NaN where there was none
    (``d'``: delayed as the stage is)::

        y - d = (y - zero - m) + zero + (m - a) + (a - d') + (d' - d)
                 model, noise           memory    command    delay

    `effects` are the names of a diagnosis, and the share of the model's part that they explain. RecordError, which
    names record and axis `where`, if there is no desired displacement.
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
    parts = {
        "zero": np.full(t.size, zero),
        "memory": estimated - begun,
        "limits": np.where(limited, command, 0.0),
        "delay": late - d,
        "command": np.where(limited, 0.0, command),
        "model": y - zero - estimated,
    }
    error = y - d
    total = float(error @ error)
    shares = {cause: float(part @ error) / total if total else 0.0 for cause, part in parts.items()}
    names, explained = effects
    noise = min(noise_rms**2 * error.size / total if total else 0.0, max(shares["model"], 0.0))
    by_effects = explained * max(shares["model"] - noise, 0.0)
    shares |= {"model": shares["model"] - noise - by_effects, "effects": by_effects, "noise": noise}
    return Tracking(
        error=ErrorPart.of(where[0], error),
        shares={cause: shares[cause] for cause in CAUSES},
        delay=delay,
        effects=names,
        t=t,
        desired=d,
        parts=parts,
    )


def _delay(t: FloatArray, desired: FloatArray, model: FloatArray) -> float:
    """Return the delay (s) of the model behind the desired displacement; 0 if no delay is clearly better."""
    longest = min(LONGEST_DELAY, DELAY_SHARE * float(t[-1] - t[0]))
    shifts = np.linspace(0.0, longest, DELAY_STEPS + 1)
    misses = [rms(model - np.interp(t - shift, t, desired)) for shift in shifts.tolist()]
    best = int(np.argmin(misses))
    return float(shifts[best]) if misses[best] < misses[0] / BETTER else 0.0


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
