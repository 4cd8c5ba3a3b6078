"""One axis of a path that repeats: from each pass to the correction of the next one, and the rules for safety."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import ModelError, length
from slpi_ros.learning.dynamics import Dynamics, Measured, Pass
from slpi_ros.learning.first_guess import amplification, first_guess, known_modes, ringing
from slpi_ros.learning.harmonics import ComplexArray, Harmonics
from slpi_ros.learning.passes import Judged, agreed, held_back, judge
from slpi_ros.learning.spectrum import PathSpectrum
from slpi_ros.model.axis_model import AxisModel

# Gain of a step towards the desired path, at first, and by what it grows again with each better pass once it is less.
GAIN, GROWING = 0.8, 1.3
# What keeps the error where it is, as long as passes still make it smaller.
NOT_YET = "not yet learned"
# A pass is worse than the best from this ratio of their errors on, beyond this many standard deviations of the noise
# and of what is transient.
WORSE, WORSE_BY_NOISE, UNSURE = 1.1, 4.0, 3.0
# Times that learning goes back to the best pass without a better one since, and passes in a row that cannot be learned
# from, until it is held.
MOST_RETURNS, MOST_REFUSED = 2, 3
# How a text begins and ends that says why learning is held.
HELD, ANEW = "held", "forget what was learned to begin again"
# Passes after which the best one is forgotten, as the stage is another one by then.
BEST_PASSES = 50
# Largest part of the stroke that learning may add to the desired path, by default.
LIMIT_SHARE = 0.25
# Readings further from the path than this many strokes are none.
FAR = 10.0
# Hashes of passes that are kept to find a replayed one, and passes whose figures are kept.
KEPT_HASHES, KEPT_PASSES = 64, 10_000
# Passes that the dynamics are estimated from, the last ones, and most samples of them.
HISTORY, HISTORY_SAMPLES = 12, 60_000
# Largest answer to a change of the path that is still taken for one, as a multiple of the change.
ANSWER = 5.0
# A change of a path that closes comes in without a jump, which an identified mode would answer to: over this many of
# its periods, and at most this share of the pass.
ONSET_PERIODS, ONSET = 5.0, 0.25
# The path is not changed before the third pass, or where identified modes ring on from pass to pass, until so many of
# their time constants have passed: an error that still grows would be blamed on what was changed. Most such passes.
RUNG_UP, MOST_UNCHANGED = 2.0, 3
# A path that is followed is the one asked for within this (m).
SAME_PATH = 1e-13
# A harmonic's error counts beyond this many standard deviations.
CLEAR = 2.0
# Passes after the first two in which what does not settle at once may still be large.
SETTLING = 3
# The best path once more has not settled as long as a pass has less than this share of the mean square error of the one
# before; most passes that are waited for.
FALLING, MOST_SETTLING = 0.85, 6
# Passes after the best one in which a calculated transient may explain a larger error.
TRANSIENT = 4
# Least share of a larger error that the response to a change explains, if the change is its cause.
CAUSES = 0.5


@dataclass(frozen=True)
class PassReport:
    """Figures of one pass of one axis.

    `error` is what repeats and can be learned: rms of measured - desired without the mean and the drift of the pass,
    which are `offset` (m) and `drift` (m over the pass); `absolute` is the rms with both. `bumps`: samples left out.
    `reason`: why the pass was not learned from, or what it led to; "" if it was learned from. `limited_by`: what keeps
    the error where it is. `bandwidth` (Hz): below it the phase of every harmonic is known. Errors are NaN without a
    reading.
    """

    number: int
    error: float
    absolute: float
    offset: float
    drift: float
    bumps: int
    learned: bool
    reason: str
    limited_by: str
    bandwidth: float

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> "PassReport":
        """Return the report of a document."""
        known = {one.name: document[one.name] for one in fields(cls)}
        return cls(**known | {name: math.nan for name in ("error", "absolute") if known[name] is None})

    def to_document(self) -> dict[str, Any]:
        """Return the report as a part of a document; null for errors without a reading."""
        return {name: None if value != value else value for name, value in asdict(self).items()}


def usual_limit(axis: AxisModel) -> float:
    """Return the most (m) that learning may add to the desired path of an axis, unless another limit is given."""
    low, high = axis.displacement_range
    return LIMIT_SHARE * (high - low)


@dataclass(frozen=True)
class _Best:
    number: int
    power: float  # m^2, mean square error
    correction: FloatArray
    reading: FloatArray  # m, (N,), without offset and drift


class AxisLearner:
    """The state of learning of one axis; see `Learner`."""

    def __init__(
        self, axis: AxisModel, dt: float, desired: FloatArray, limit: float | None, voltage: tuple[float, float]
    ) -> None:
        self.axis, self.dt, self.desired, self.voltage = axis, dt, desired, voltage
        self.limit = usual_limit(axis) if limit is None else limit
        self.spectrum = PathSpectrum(desired, dt)
        self.wanted, self.frequency = self.spectrum.of(desired), self.spectrum.frequency
        self.correction = np.zeros(desired.size)
        self.passes: list[PassReport] = []
        self.gain, self.held, self.returns, self.refused = GAIN, "", 0, 0
        self.record = math.inf  # m^2, least mean square error of a pass so far
        self.best: _Best | None = None
        self._deviating: Mask | None = None
        self._last = np.zeros(desired.size)  # correction of the pass before that was learned from
        self._before = np.zeros(desired.size)  # correction at the end of the pass before
        self._offset: float | None = None
        self._hashes: list[str] = []
        self._clipped = self._told = ""
        modes, duration = ringing(axis), desired.size * dt
        slowest = max((ONSET_PERIODS / hertz for hertz, _ in modes), default=0.0)
        rising = max(1.0, min(ONSET * desired.size, slowest / dt))
        longest = max((time for _, time in modes), default=0.0) if self.spectrum.closed else 0.0
        self._unchanged = int(np.clip(math.ceil(RUNG_UP * longest / duration) + 1, 2, MOST_UNCHANGED))
        self._onset = 0.5 - 0.5 * np.cos(np.pi * np.minimum((np.arange(desired.size) + (rising == 1.0)) / rising, 1.0))
        self._lead_in: FloatArray | None = None
        self._returned = 0  # passes of the best path again, until it has settled
        self._settling = math.inf  # m^2, mean square error of the pass before
        self._worst = 0.0  # m^2, largest mean square error of a pass from which learning went back
        self._history: list[Pass] = []
        self._undisturbed: Pass | None = None  # the second pass, from which on the path is changed
        noise = np.full(self.frequency.size, self.spectrum.size * max(axis.quality.floor_rms, 1e-12) ** 2)
        amplified = amplification(axis, self.frequency)
        self.harmonics = Harmonics.first(*first_guess(axis, dt, self.frequency), noise, amplified)
        self.dynamics = Dynamics(
            self.spectrum.size, dt, self.spectrum.closed,
            lambda frequency: first_guess(axis, dt, frequency), known_modes(axis, dt),
        )  # fmt: skip

    @property
    def path(self) -> FloatArray:
        """The desired path of the next pass, (N,), metres: a change of `aim` comes in without a jump."""
        correction = self.correction
        if self.spectrum.closed:
            correction = self._before + self._onset * (correction - self._before)
        return self._within_range(correction)

    @property
    def aim(self) -> FloatArray:
        """The desired path of the passes after the next one, (N,), metres."""
        return self._within_range(self.correction)

    def is_followed_by(self, asked: FloatArray) -> bool:
        """Return whether what was asked of the compensator in a pass (m, (N,)) is the path with a correction."""
        return bool(np.abs(asked - self.desired).max() <= self.limit + SAME_PATH)

    def _within_range(self, correction: FloatArray) -> FloatArray:
        low, high = self.axis.displacement_range
        low, high = min(low, float(self.desired.min())), max(high, float(self.desired.max()))
        return np.asarray(np.clip(self.desired + correction, low, high))

    @property
    def noise(self) -> float:
        """Standard deviation of one reading from pass to pass, metres."""
        return math.sqrt(self.spectrum.power(self.harmonics.noise))

    def update(
        self,
        measured: FloatArray,
        voltage: FloatArray | None = None,
        followed: FloatArray | None = None,
        unusable: str = "",
    ) -> PassReport:
        """Learn from a pass of which the path `followed` (m; default: `path`) was asked; shape (N,), m and V.

        `unusable`: why it is not to be learned from, if that is known.
        """
        if followed is not None and not np.allclose(followed, self.path, rtol=0.0, atol=SAME_PATH):
            if self.is_followed_by(followed):
                self.correction = self._before = followed - self.desired
            else:
                unusable = unusable or "what was asked of the compensator is another path"
        commanded = self.path - self.desired
        self._before = self.correction
        seen = (
            self.axis.correct(np.arange(measured.size, dtype=np.float64) * self.dt, measured)
            if self.axis.corrects
            else measured
        )
        low, high = self.axis.displacement_range
        seen = np.where(np.abs(seen - self.desired) <= FAR * (high - low), seen, np.nan)
        first = not self.harmonics.passes
        expected, spread = self._expected(commanded)
        floor = math.sqrt(self.spectrum.power(np.full(self.frequency.size, self.harmonics.noise.min())))
        error = next((one.error for one in reversed(self.passes) if one.learned), math.inf)
        judged = judge(seen, expected, spread, floor, self._deviating, error)
        if self._lead_in is not None and not judged.reason:
            judged = agreed(self._lead_in, judged, self.desired, floor)
        # What a limit held back, or was not used for another reason, tells nothing of the sensor.
        known = unusable or self._replayed(measured, commanded)
        if not known and voltage is not None and (known := held_back(voltage, self.voltage)):
            self._clipped = "voltage range"
        reason = known or judged.reason
        offset, drift = self._offset_and_drift(judged, expected, first=first)
        clean = judged.measured - offset - drift * (np.arange(measured.size) / measured.size - 0.5)
        rest = (clean - self.desired)[np.isfinite(clean)]
        whole = (seen - self.desired)[np.isfinite(seen)]
        rms, absolute = (float(np.sqrt(np.mean(x**2))) if x.size else math.nan for x in (rest, whole))
        self._remember(commanded, None if reason else clean)
        if reason:
            self._refuse(reason, new=bool((commanded != self._last).any()), answered=not known)
        else:
            self._learn(commanded, clean, judged, rms)
            self._offset = offset
        report = PassReport(
            len(self.passes) + 1, rms, absolute, offset, drift, int(np.count_nonzero(judged.bumps)), not reason,
            reason or self._told, self.held or (self.limited_by(drift) if self.passes else NOT_YET), self.bandwidth,
        )  # fmt: skip
        self.passes.append(report)
        del self.passes[:-KEPT_PASSES]
        return report

    def _expected(self, commanded: FloatArray) -> tuple[FloatArray, float]:
        """Return the expected reading (m, (N,)) of a pass, and its standard deviation (m)."""
        harmonics, power = self.harmonics, self.spectrum.power
        if not harmonics.passes:
            return self.desired, math.inf
        whole, correction = self.spectrum.whole, self.spectrum.of(self.correction)
        following = [*self._history, Pass(whole(commanded), None)]
        transient = self.dynamics.transient(following, whole(self.correction))
        change = np.abs(self.spectrum.of(commanded - self._last)) ** 2
        spread = power(harmonics.variance(correction) + harmonics.noise) + ANSWER**2 * power(change)
        # What is transient is expected with a doubt of its own size; and the first passes have not settled.
        spread += power(np.abs(transient) ** 2)
        if harmonics.passes <= SETTLING or self._returned:
            spread += next((one.error for one in reversed(self.passes) if one.learned), 0.0) ** 2
        return self.spectrum.signal(harmonics.expected(correction) + transient), math.sqrt(spread)

    def _remember(self, commanded: FloatArray, clean: FloatArray | None) -> None:
        whole = self.spectrum.whole
        self._history.append(Pass(whole(commanded), None if clean is None else whole(clean)))
        kept = max(2, min(HISTORY, HISTORY_SAMPLES // self.spectrum.size))
        if len(self._history) > kept:
            self._history.pop(0)
            self.dynamics.forget_oldest()

    def _learn(self, commanded: FloatArray, clean: FloatArray, judged: Judged, rms: float) -> None:
        self._told, self.refused = "", 0
        if self._lead_in is None and not self.passes:
            # The first pass comes from rest, and nothing was there to compare it with: no step is made for it.
            self._lead_in, self._deviating = clean, judged.deviating
            self._told = "the first pass: compared with the next"
            return
        self._lead_in = None
        self._deviating, self._last = judged.deviating, commanded
        steady, unsure = self._estimate(clean)
        self._release(rms)
        if len(self.passes) + 1 < self._unchanged:
            self._told = "the path as it is: its modes are still ringing up"
            return
        if self._worth_a_step(clean, rms, steady, unsure) and not self.held:
            self._step()

    def _worth_a_step(self, clean: FloatArray, rms: float, steady: float, unsure: float) -> bool:
        """Judge a pass against the best one; return whether a step may follow.

        `rms` (m) is its error, `steady` (m^2) its mean square error without what is transient, and `unsure` (m^2) the
        mean variance of that. What is transient may be wrong: a better pass has to be so with it and without it.
        """
        number, power, best = len(self.passes) + 1, max(steady, rms**2), self.best
        if best is not None and number - best.number > BEST_PASSES:
            best = None
        if best is not None and self._returned:
            return self._settled_again(best, clean, rms**2)
        self._returned = 0
        if best is None or power < best.power:
            if power < self.record - self._scatter():
                self.returns, self.gain = 0, min(GROWING * self.gain, GAIN)
            self.record = min(self.record, power)
            self.best = _Best(number, power, self.correction, clean)
            return True
        least = min(steady, rms**2) if number - best.number <= TRANSIENT else rms**2
        harmful = rms**2 > self._harm + self._scatter()
        if not harmful and least <= self._much_worse(best.power, unsure):
            return True
        if not harmful and not self._may_be_of_changes(rms - math.sqrt(best.power)):
            # The stage has changed by itself.
            self.best = _Best(number, power, self.correction, clean)
            return True
        if self.held and harmful:
            self._give_up()
        else:
            self._return(f"worse than pass {best.number}: {length(rms)} after {length(math.sqrt(best.power))}", rms)
        return False

    def _settled_again(self, best: _Best, clean: FloatArray, power: float) -> bool:
        """Judge the best path once more: its error was lucky, or what has come between is still settling."""
        falling, self._settling = power < FALLING * self._settling, power
        self._returned += 1
        if falling and self._returned <= MOST_SETTLING:
            self._told = "its changes are still settling"
            return False
        self._returned = 0
        self.best = replace(best, power=power, reading=clean)
        if power > self._harm + self._scatter():
            self._give_up()
            return False
        return True

    def _release(self, rms: float) -> None:
        """Learn on, if the path as it was at first is by now worse than what learning was held for.

        A mode near a harmonic of the path takes some passes to ring up: the first ones were better than any can be.
        """
        at_first = self.returns >= MOST_RETURNS and np.array_equal(self.correction, self._start)
        if self.held and at_first and rms**2 > self._worst + self._scatter():
            self.held, self.returns, self.best, self.record, self._returned = "", 0, None, math.inf, 0

    def _give_up(self) -> None:
        """Follow the path as it was at first: nothing that was learned is better."""
        self.correction, self.best = self._start, None

    def _may_be_of_changes(self, more: float) -> bool:
        """Return whether what was changed since the best pass may have made the error larger by so much (m)."""
        assert self.best is not None
        change = np.abs(self.spectrum.of(self.correction - self.best.correction))
        largest = np.abs(self.harmonics.gain) + np.sqrt(self.harmonics.gain_variance)
        return math.sqrt(self.spectrum.power((largest * change) ** 2)) > CAUSES * more

    def _much_worse(self, power: float, unsure: float) -> float:
        """Return the mean square error (m^2) from which on a pass is worse than one with an error of `power` (m^2)."""
        return (WORSE * math.sqrt(power) + UNSURE * math.sqrt(unsure)) ** 2 + self._scatter()

    @property
    def _start(self) -> FloatArray:
        """Correction (m, (N,)) before anything was learned."""
        return (
            np.zeros(self.desired.size)
            if self._undisturbed is None
            else self._undisturbed.commanded[: self.desired.size]
        )

    @property
    def _harm(self) -> float:
        """Mean square error (m^2) of a pass from which on it is worse than the first ones were."""
        return max((WORSE * one.error for one in self.passes[: self._unchanged] if one.learned), default=math.inf) ** 2

    def _estimate(self, clean: FloatArray) -> tuple[float, float]:
        """Learn the dynamics and the harmonics from a pass.

        Return its mean square error without what is transient, and the mean variance of that (m^2).
        """
        h, seen, correction = self.harmonics, self.spectrum.of(clean), self.spectrum.of(self.correction)
        if self._undisturbed is None:
            self._undisturbed = self._history[-1]
        begun = self._undisturbed
        path = self.wanted + np.fft.rfft(begun.commanded)
        rest = h.of_hysteresis(path)
        aim = self.spectrum.whole(self.correction)
        answer = self.dynamics.answer(Measured(self._history, aim, begun, path, rest, h.noise, h.of_hysteresis))
        settled = seen - answer.transient
        if h.passes:
            self.harmonics = h.after(correction, settled, answer)
        else:
            self.harmonics = h.begun(correction, settled, answer, path, rest)
        power = self.spectrum.power
        return power(np.abs(self.wanted - settled) ** 2), power(answer.transient_variance)

    def _step(self) -> None:
        harmonics = self.harmonics.step(self.spectrum.of(self.correction), self.wanted, self.gain)
        error = np.abs(self.left) ** 2
        power = self.spectrum.power
        taken = power(error - np.abs(self.left - self.harmonics.gain * harmonics) ** 2)
        added = power(self.harmonics.scatter * float(np.mean(np.abs(harmonics[1:]) ** 2)))
        harmonics = harmonics * (taken / max(taken + added, 1e-300) if taken > 0.0 else 1.0)
        wanted = self.correction + self.spectrum.signal(harmonics) * self.spectrum.taper
        allowed = np.clip(wanted, -self.limit, self.limit)
        low, high = self.axis.displacement_range
        inside = np.clip(self.desired + allowed, min(low, self.desired.min()), max(high, self.desired.max()))
        reached = inside - self.desired
        beyond = np.abs(reached - allowed) > 1e-12
        self._clipped = "learn_limit" if (allowed != wanted).any() else "voltage range" if beyond.any() else ""
        self.correction = reached

    def _return(self, why: str, rms: float) -> None:
        """Go back to the best pass with half the gain; the second time without a better one since, hold."""
        assert self.best is not None
        self.correction = self.best.correction
        self._returned, self._settling, self._worst = 1, rms**2, max(self._worst, rms**2)
        # A step that is taken of the last pass shall not hide what the next one shows.
        self.harmonics = self.harmonics.at(self.spectrum.of(self.best.correction), self.spectrum.of(self.best.reading))
        self._told = f"{why}; back to the best, at half the gain"
        self._blame_change(why)

    def _blame_change(self, why: str) -> None:
        """Halve the gain; the second time without a better pass since, hold."""
        self.gain, self.returns = 0.5 * self.gain, self.returns + 1
        if self.returns >= MOST_RETURNS:
            self.held = f"{HELD}: {why}, for the second time; {ANEW}"

    def _refuse(self, reason: str, *, new: bool, answered: bool) -> None:
        """Leave a pass alone, and go back to the best path from a new one; after several in a row, hold.

        `answered`: it is refused as its readings are no answer to what was commanded. They may still be one, of a mode
        that nobody knows of, so that a new path is to blame as if it were worse.
        """
        self._told = reason
        self.refused += 1
        if self.best is not None and (new or self.refused >= MOST_REFUSED):
            self.correction, self._returned, self._settling = self.best.correction, 1, math.inf
            if answered:
                self._blame_change(f"{reason}, after a change")
        if self.refused >= MOST_REFUSED:
            why = f"{MOST_REFUSED} passes in a row were not learned from, the last as {reason}"
            self.held = f"{HELD}: {why}; {ANEW}"

    def limited_by(self, drift: float) -> str:
        """Return what keeps the error where it is: noise, bandwidth, learn_limit, voltage range, drift, or learning."""
        if self._clipped:
            return self._clipped
        left, harmonics = self.left, self.harmonics
        sure = np.abs(left) ** 2 > CLEAR**2 * (harmonics.variance(self.spectrum.of(self.correction)) + harmonics.noise)
        known = harmonics.phase_known
        power = np.abs(left) ** 2
        learnable, beyond = self.spectrum.power(power * (sure & known)), self.spectrum.power(power * (sure & ~known))
        if max(learnable, beyond) < self.noise**2:
            return "drift" if abs(drift) > self.noise else "noise"
        return "bandwidth" if beyond > learnable else NOT_YET

    @property
    def left(self) -> ComplexArray:
        """Expected error of the next pass by harmonic, (K,), metres (as `numpy.fft.rfft`), without the mean."""
        left = self.wanted - self.harmonics.expected(self.spectrum.of(self.correction))
        left[0] = 0.0
        return np.asarray(left)

    @property
    def bandwidth(self) -> float:
        """Frequency (Hz) below which the phase of every harmonic is known."""
        unknown = np.flatnonzero(~self.harmonics.phase_known[1:]) + 1
        return float(self.frequency[unknown[0] if unknown.size else -1])

    def begun_again(self) -> "AxisLearner":
        """Return what begins again from the desired path."""
        return AxisLearner(self.axis, self.dt, self.desired, self.limit, self.voltage)

    def _scatter(self) -> float:
        """Return by how much (m^2) the mean square error of a pass may differ by its noise."""
        noise = self.harmonics.noise[1:]
        freedom = 2.0 * float(noise.sum()) ** 2 / float((noise**2).sum())
        return WORSE_BY_NOISE * self.noise**2 * math.sqrt(2.0 / freedom)

    def _offset_and_drift(self, judged: Judged, expected: FloatArray, *, first: bool) -> tuple[float, float]:
        """Return mean error (m) and drift over the pass (m).

        The drift is what both the mean against the pass before and the slope within this pass say, whichever is less.
        """
        known = np.isfinite(judged.measured)
        if not known.any():
            return 0.0, 0.0
        offset = float(np.mean((judged.measured - self.desired)[known]))
        if first or self._offset is None:
            return offset, 0.0
        shares = np.linspace(-0.5, 0.5, known.size)[known]
        slope = float(np.polynomial.polynomial.polyfit(shares, (judged.measured - expected)[known], 1)[1])
        moved = offset - self._offset
        return offset, math.copysign(min(abs(slope), abs(moved)), moved) if slope * moved > 0.0 else 0.0

    def _replayed(self, measured: FloatArray, commanded: FloatArray) -> str:
        """Return that a pass is the copy of an earlier one, although another path was commanded; "" if not."""
        if not np.isfinite(measured).any():
            return ""
        known = hashlib.sha256(np.ascontiguousarray(measured).tobytes()).hexdigest()
        path = hashlib.sha256(commanded.tobytes()).hexdigest()
        earlier = [each.split(":")[1] for each in self._hashes if each.startswith(known)]
        self._hashes = [*self._hashes, f"{known}:{path}"][-KEPT_HASHES:]
        # Steps of the sensor that are larger than its noise and than the change of the path hide the change.
        steps = np.diff(np.unique(measured[np.isfinite(measured)]))
        step = float(steps.min()) if steps.size else 0.0
        hidden = step > max(self.noise, float(np.abs(commanded - self._last).max()))
        if any(each != path for each in earlier) and not hidden:
            return "every reading is that of an earlier pass: the sensor's data are replayed"
        return ""

    def to_document(self) -> dict[str, Any]:
        """Return what was learned as a part of a document, metres and seconds."""
        h = self.harmonics
        return {
            "desired_m": self.desired.tolist(),
            "correction_m": self.correction.tolist(),
            "last_correction_m": self._last.tolist(),
            "before_m": self._before.tolist(),
            "clipped": self._clipped,
            "lead_in_m": _listed(self._lead_in),
            "undisturbed": self._undisturbed and self._undisturbed.to_document(),
            "history": [one.to_document() for one in self._history],
            "dynamics": self.dynamics.to_document(),
            "returned": self._returned,
            "worst_m2": self._worst,
            "settling_m2": self._settling if math.isfinite(self._settling) else None,
            "record_m2": self.record if math.isfinite(self.record) else None,
            "learn_limit_m": self.limit,
            "gain": self.gain,
            "held": self.held,
            "returns": self.returns,
            "refused": self.refused,
            "offset_m": self._offset,
            "deviating": None if self._deviating is None else np.flatnonzero(self._deviating).tolist(),
            "best": self.best
            and {
                "number": self.best.number,
                "power_m2": self.best.power,
                "correction_m": self.best.correction.tolist(),
                "reading_m": self.best.reading.tolist(),
            },
            "hashes": self._hashes,
            "harmonics": {
                "gain": _pairs(h.gain),
                "gain_variance": h.gain_variance.tolist(),
                "without_m": _pairs(h.without),
                "without_variance_m2": h.without_variance.tolist() if h.passes else [],
                "covariance_m": _pairs(h.covariance),
                "noise_m2": h.noise.tolist(),
                "answered_m": _pairs(h.answered),
                "scatter": h.scatter.tolist(),
                "misfit": h.misfit.tolist(),
                "innovation": _pairs(h.innovation),
                "innovation_product": h.innovation_product.tolist(),
                "innovation_square": h.innovation_square.tolist(),
                "changed": h.changed.tolist(),
                "answers": _pairs(h.answers),
                "passes": h.passes,
            },
            "passes": [one.to_document() for one in self.passes],
        }

    def _check_sizes(self, document: Mapping[str, Any]) -> None:
        """Raise ModelError if an array of a document is not one of this path."""
        n, numbers, best = self.desired.size, document["harmonics"], document["best"] or {}
        arrays = [(name, values, self.harmonics.noise.size) for name, values in numbers.items() if name != "passes"]
        if not numbers["passes"]:
            arrays = [one for one in arrays if one[0] != "without_variance_m2"]
        arrays += [(name, document[name], n) for name in ("last_correction_m", "before_m", "lead_in_m")]
        arrays += [(name, best[name], n) for name in best if name in ("correction_m", "reading_m")]
        passes = [*document["history"], *([document["undisturbed"]] if document["undisturbed"] else [])]
        arrays += [(name, values, self.spectrum.size) for one in passes for name, values in one.items()]
        for name, values, size in arrays:
            if values is not None:
                _check_size(name, values, size)

    def resume(self, document: Mapping[str, Any], *, same_model: bool) -> None:
        """Go on from a document of the same path; of another model, only the correction of the path is taken over.

        ModelError if parts of the document are of another size or do not belong together.
        """
        _check_size("correction_m", document["correction_m"], self.desired.size)
        if same_model:
            self._check_sizes(document)
        self.correction = self._last = np.clip(document["correction_m"], -self.limit, self.limit)
        self._before = self._last if not same_model else np.clip(document["before_m"], -self.limit, self.limit)
        if not same_model:
            return
        numbers, h = document["harmonics"], self.harmonics
        self._clipped = document["clipped"]
        self._last, self._lead_in = np.array(document["last_correction_m"]), _array(document["lead_in_m"])
        self._history = [Pass.of(one) for one in document["history"]]
        self._undisturbed = document["undisturbed"] and Pass.of(document["undisturbed"])
        self.dynamics.resume(document["dynamics"])
        self._returned = document["returned"]
        self._settling = math.inf if document["settling_m2"] is None else document["settling_m2"]
        self._worst = document["worst_m2"]
        self.record = math.inf if document["record_m2"] is None else document["record_m2"]
        self.gain, self.held = document["gain"], document["held"]
        self.returns, self.refused, self._offset = document["returns"], document["refused"], document["offset_m"]
        if document["deviating"] is not None:
            deviating = np.array(document["deviating"], dtype=np.intp)
            self._deviating = np.isin(np.arange(self.desired.size), deviating)
        if best := document["best"]:
            self.best = _Best(
                best["number"], best["power_m2"], np.array(best["correction_m"]), np.array(best["reading_m"])
            )
        self._hashes = list(document["hashes"])
        self.passes = [PassReport.of(one) for one in document["passes"]]
        self.harmonics = replace(
            h,
            gain=_complex(numbers["gain"]),
            gain_variance=np.array(numbers["gain_variance"]),
            without=_complex(numbers["without_m"]),
            without_variance=np.array(numbers["without_variance_m2"]) if numbers["passes"] else h.without_variance,
            covariance=_complex(numbers["covariance_m"]),
            noise=np.array(numbers["noise_m2"]),
            answered=_complex(numbers["answered_m"]),
            scatter=np.array(numbers["scatter"]),
            misfit=np.array(numbers["misfit"]),
            innovation=_complex(numbers["innovation"]),
            innovation_product=np.array(numbers["innovation_product"]),
            innovation_square=np.array(numbers["innovation_square"]),
            changed=np.array(numbers["changed"]),
            answers=_complex(numbers["answers"]),
            passes=numbers["passes"],
        )
        with np.errstate(all="ignore"):
            expected, spread = self._expected(self.path - self.desired)
            whole = float(np.sum(expected)) + self._scatter() + (spread if self.harmonics.passes else 0.0)
        if not math.isfinite(whole) or (self.best and self.best.number > self.passes[-1].number):
            raise ModelError("its numbers do not belong together; learn the path again")


def _check_size(name: str, values: Any, size: int) -> None:
    """Raise ModelError if the last dimension of an array is of another size, or a value is not finite."""
    found = np.array(values, dtype=np.float64)
    if found.shape[-1:] != (size,) or not np.isfinite(found).all():
        raise ModelError(f"{name} is not {size} finite numbers; learn the path again")


def _listed(x: FloatArray | None) -> list[float] | None:
    return None if x is None else x.tolist()


def _array(values: list[float] | None) -> FloatArray | None:
    return None if values is None else np.array(values, dtype=np.float64)


def _pairs(x: ComplexArray) -> list[list[float]]:
    return [x.real.tolist(), x.imag.tolist()]


def _complex(pairs: list[list[float]]) -> ComplexArray:
    return np.array(pairs[0]) + 1j * np.array(pairs[1])
