"""One axis of a path that repeats: from each pass to the correction of the next one, and the rules for safety."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import ModelError, length
from slpi_ros.learning.first_guess import first_guess, ringing
from slpi_ros.learning.harmonics import TEST_ABOVE, ComplexArray, Harmonics
from slpi_ros.learning.passes import Judged, agreed, judge
from slpi_ros.model.axis_model import AxisModel

# Gain of a step towards the desired path, at first.
GAIN = 0.6
# What keeps the error where it is, as long as passes still make it smaller.
NOT_YET = "not yet learned"
# A pass is worse than the best from this ratio of their errors on, beyond this many standard deviations of the noise.
WORSE, WORSE_BY_NOISE = 1.1, 4.0
# Times that learning goes back to the best pass without a better one since, and passes in a row that cannot be learned
# from, until it is held.
MOST_RETURNS, MOST_REFUSED = 2, 3
# How a text begins that says why learning is held.
HELD = "held"
# Passes after which the best one is forgotten, as the stage is another one by then.
BEST_PASSES = 50
# Largest part of the stroke that learning may add to the desired path, by default.
LIMIT_SHARE = 0.25
# A path closes if its ends differ by less than this many of its largest steps; otherwise it is led back to its
# beginning over this share of it, and the correction begins and ends at 0, over this share.
CLOSING_STEPS, LED_BACK, TAPER = 1.5, 0.25, 0.02
# Samples in a row at a voltage limit that count as held there, and share of the range by which it is reached.
HELD_SAMPLES, AT_LIMIT = 3, 1e-6
# Readings further from the path than this many strokes are none.
FAR = 10.0
# Hashes of passes that are kept to find a replayed one, and passes whose figures are kept.
KEPT_HASHES, KEPT_PASSES = 64, 10_000
# Largest answer to a change of the path that is still taken for one, as a multiple of the change.
ANSWER = 5.0
# A change has settled where a pass differs from the one before by this share of what it has changed; most passes that
# are waited for. Before that, a pass that is so much worse than the best leads back at once.
SETTLED, MOST_DWELL, AT_ONCE = 0.2, 6, 1.5
# What settles within the passes that are waited for falls to less than this share, in power, from each to the next.
FALLING = 0.7
# A change of a path that closes comes in without a jump, which an identified mode would answer to: over this many of
# its periods, and at most this share of the pass.
ONSET_PERIODS, ONSET = 5.0, 0.25
# A mode has its part in the harmonics within this share of its frequency.
BAND = 0.2
# A path that is followed is the one asked for within this (m).
SAME_PATH = 1e-13
# A harmonic's error counts beyond this many standard deviations.
CLEAR = 2.0


@dataclass(frozen=True)
class PassReport:
    """Figures of one pass of one axis.

    `error` is what repeats and can be learned: rms of measured - desired without the mean and the drift of the pass,
    which are `offset` (m) and `drift` (m over the pass); `absolute` is the rms with both. `bumps`: samples left out.
    `reason`: why the pass was not learned from, or what it led to; "" if it was learned from. `limited_by`: what keeps
    the error where it is. `bandwidth` (Hz): below it the phase of every harmonic is known.
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


@dataclass(frozen=True)
class _Best:
    number: int
    power: float  # m^2, mean square error
    correction: FloatArray


class AxisLearner:
    """The state of learning of one axis; see `Learner`."""

    def __init__(
        self, axis: AxisModel, dt: float, desired: FloatArray, limit: float | None, voltage: tuple[float, float]
    ) -> None:
        self.axis, self.dt, self.desired, self.voltage = axis, dt, desired, voltage
        low, high = axis.displacement_range
        self.limit = LIMIT_SHARE * (high - low) if limit is None else limit
        steps = np.abs(np.diff(desired))
        self.closed = bool(abs(desired[0] - desired[-1]) <= CLOSING_STEPS * float(steps.max(initial=0.0)))
        self.taper = np.ones(desired.size)
        if not self.closed:
            edge = max(2, int(TAPER * desired.size))
            rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(edge) / edge)
            self.taper[:edge], self.taper[-edge:] = rise, rise[::-1]
        self.wanted = self._spectrum(desired)
        self.frequency: FloatArray = np.asarray(np.fft.rfftfreq(self._size, dt), dtype=np.float64)
        self.correction = np.zeros(desired.size)
        self.passes: list[PassReport] = []
        self.gain, self.held, self.returns, self.refused = GAIN, "", 0, 0
        self.record = math.inf  # m^2, least mean square error of a pass so far
        self.best: _Best | None = None
        self._deviating: Mask | None = None
        self._last = np.zeros(desired.size)  # correction of the pass before that was learned from
        self._before = np.zeros(desired.size)  # correction at the end of the pass before
        self._aimed = self._before  # what the correction became in the last pass that was learned from
        self._offset: float | None = None
        self._hashes: list[str] = []
        self._clipped = self._told = ""
        # Readings (m) of the pass before, and of that before the last change of the path; passes since, and how many it
        # takes until they have settled.
        self._previous: FloatArray | None = None
        self._changed: FloatArray | None = None
        self._since = 0
        self._dwell: int | None = None
        self._moved = math.inf  # m^2, mean square difference of the last two passes
        # Harmonics near an identified mode that rings from pass to pass, passes until it has settled, and passes since
        # these harmonics were changed: the first pass comes from rest.
        self._ringing = np.zeros(self.frequency.size, dtype=np.bool_)
        self._ring_dwell, self._ring_since = 1, 0
        slowest = 0.0
        for hertz, seconds in ringing(axis):
            slowest = max(slowest, ONSET_PERIODS / hertz)
            passes = _passes_until_settled(self._size * dt, seconds)
            if passes > 1:
                self._ringing |= np.abs(self.frequency - hertz) < BAND * hertz
                self._ring_dwell = max(self._ring_dwell, passes)
        rising = max(1.0, min(ONSET * desired.size, slowest / dt))
        self._onset = 0.5 - 0.5 * np.cos(np.pi * np.minimum((np.arange(desired.size) + (rising == 1.0)) / rising, 1.0))
        self._lead_in: FloatArray | None = None
        self._returned = False  # the next pass is that of the best path again
        noise = np.full(self.frequency.size, self._size * max(axis.quality.floor_rms, 1e-12) ** 2)
        guess, variance = first_guess(axis, dt, self.frequency)
        self._guess = Harmonics.first(guess, variance, noise)
        self.harmonics = self._guess

    @property
    def path(self) -> FloatArray:
        """The desired path of the next pass, (N,), metres: a change of `aim` comes in without a jump."""
        correction = self.correction
        if self.closed:
            correction = self._before + self._onset * (correction - self._before)
        return self._within_range(correction)

    @property
    def aim(self) -> FloatArray:
        """The desired path of the passes after the next one, (N,), metres."""
        return self._within_range(self.correction)

    def _within_range(self, correction: FloatArray) -> FloatArray:
        low, high = self.axis.displacement_range
        low, high = min(low, float(self.desired.min())), max(high, float(self.desired.max()))
        return np.asarray(np.clip(self.desired + correction, low, high))

    @property
    def _still(self) -> bool:
        """Whether the modes have settled since their harmonics were changed."""
        return self._ring_since >= self._ring_dwell

    @property
    def noise(self) -> float:
        """Standard deviation of one reading from pass to pass, metres."""
        return math.sqrt(self._power(self.harmonics.noise))

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
            self.correction = self._before = followed - self.desired
        commanded = self.path - self.desired
        self._before = self.correction
        self._ring_since += 1
        seen = (
            self.axis.correct(np.arange(measured.size, dtype=np.float64) * self.dt, measured)
            if self.axis.corrects
            else measured
        )
        low, high = self.axis.displacement_range
        seen = np.where(np.abs(seen - self.desired) <= FAR * (high - low), seen, np.nan)
        first = not self.harmonics.passes
        correction = self._spectrum(commanded)
        expected = self.desired if first else self._signal(self.harmonics.expected(correction))
        floor = math.sqrt(self._power(np.full(self.frequency.size, self.harmonics.noise.min())))
        change = self._spectrum(commanded - self._last)
        own = ANSWER**2 * self._power(np.abs(change) ** 2)
        power = own + self._power(self.harmonics.variance(correction) + self.harmonics.noise) if not first else math.inf
        error = next((one.error for one in reversed(self.passes) if one.learned), math.inf)
        if self._previous is not None and not change.any():
            # The same path again: the same reading, but for what is still settling.
            expected, power = self._previous, 2.0 * self.noise**2
            if not self._still or self._dwell is None or self._since < self._dwell:
                # What is settling, and a mode that begins to ring, may change as much as the error.
                power += error**2
        judged = judge(seen, expected, math.sqrt(power), floor, self._deviating, error)
        if self._lead_in is not None and not judged.reason:
            judged = agreed(self._lead_in, judged, self.desired, floor)
        reason = unusable or self._replayed(measured) or judged.reason or self._held_back(voltage)
        offset, drift = self._offset_and_drift(judged, expected, first=first)
        clean = judged.measured - offset - drift * (np.arange(measured.size) / measured.size - 0.5)
        rest = (clean - self.desired)[np.isfinite(clean)]
        whole = (seen - self.desired)[np.isfinite(seen)]
        rms, absolute = (float(np.sqrt(np.mean(x**2))) if x.size else 0.0 for x in (rest, whole))
        if reason:
            self._refuse(reason, new=bool(change.any()))
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

    def _learn(self, commanded: FloatArray, clean: FloatArray, judged: Judged, rms: float) -> None:
        self._told, self.refused = "", 0
        if self._lead_in is None and not self.passes:
            # The first pass comes from rest, and nothing was there to compare it with: no step is made for it.
            self._lead_in, self._deviating = clean, judged.deviating
            self._told = "the first pass: compared with the next"
            return
        lead_in, self._lead_in = self._lead_in, None
        settled = self._settled(clean)
        self._deviating, self._last, self._aimed = judged.deviating, commanded, self.correction
        if not settled and not (self.best and rms**2 > AT_ONCE**2 * self.best.power + self._scatter()):
            self._told = "its changes are still settling"
            return
        h, seen, correction = self.harmonics, self._spectrum(clean), self._spectrum(commanded)
        if h.passes:
            self.harmonics = h.after(correction, seen, self._due)
        else:
            self.harmonics = h.begun(
                self.wanted + correction, seen, seen if lead_in is None else self._spectrum(lead_in)
            )
        number, best = len(self.passes) + 1, self.best
        if best is not None and number - best.number > BEST_PASSES:
            best = None
        again = best is not None and self._returned
        self._returned = False
        if best is not None and again:
            # The best path once more: its error was lucky, or what has come between is still settling.
            self.best = replace(best, power=max(best.power, 0.5 * (best.power + rms**2)))
        elif self._still and (best is None or rms**2 < best.power):
            if rms**2 < self.record - self._scatter():
                self.returns = 0
            self.record = min(self.record, rms**2)
            self.best = _Best(number, rms**2, self.correction)
        elif best and rms**2 > (WORSE if self._still else AT_ONCE) ** 2 * best.power + self._scatter():
            self._return(f"worse than pass {best.number}: {length(rms)} after {length(math.sqrt(best.power))}")
            return
        if self.held:
            return
        if not self._still and self._testing:
            self._told = "its changes are still settling"
        else:
            self._step()

    @property
    def _due(self) -> Mask:
        """Harmonics, (K,), that are learned from this pass: those of a mode only when it has settled."""
        return ~self._ringing | self._still

    @property
    def _testing(self) -> bool:
        """Whether the gain of a mode is not known yet: nothing else is changed while it answers to a test."""
        h, unknown = self.harmonics, self._ringing & ~self.harmonics.phase_known
        error = np.abs(self.left) > TEST_ABOVE * np.sqrt(h.variance(self._spectrum(self.correction)))
        return bool((unknown & error).any())

    def _settled(self, clean: FloatArray) -> bool:
        """Return whether the answer to the last change of the path has settled: a lightly damped mode rings for passes.

        The first change of the path is followed until a pass is like the one before; later ones as many passes.
        """
        if (self.correction != self._aimed).any():
            self._since, self._changed, self._moved = 0, self._previous, math.inf
        self._since, before = self._since + 1, self._previous
        self._previous = clean
        if self._changed is None or before is None:
            return True
        if self._since > 1 and self._dwell is None:
            moved, answered = (
                self._power(np.abs(self._spectrum(clean - other)) ** 2 * ~self._ringing)
                for other in (before, self._changed)
            )
            settled = moved < max(SETTLED**2 * answered, 4.0 * self.noise**2) or self._since > MOST_DWELL
            # What differs as much as between the passes before does not settle: it does not repeat.
            if settled or moved > FALLING * self._moved:
                self._dwell = self._since - 1
            self._moved = moved
        return self._dwell is not None and self._since >= self._dwell

    def _step(self) -> None:
        harmonics = self.harmonics.step(self._spectrum(self.correction), self.wanted, self.gain) * self._due
        error = np.abs(self.left) ** 2
        taken = self._power(error - np.abs(self.left - self.harmonics.gain * harmonics) ** 2)
        added = self._power(self.harmonics.scatter * float(np.mean(np.abs(harmonics[1:]) ** 2)))
        harmonics = harmonics * (taken / max(taken + added, 1e-300) if taken > 0.0 else 1.0)
        if harmonics[self._ringing].any():
            self._ring_since = 0
        step = self._signal(harmonics) * self.taper
        wanted = self.correction + step
        allowed = np.clip(wanted, -self.limit, self.limit)
        low, high = self.axis.displacement_range
        inside = np.clip(self.desired + allowed, min(low, self.desired.min()), max(high, self.desired.max()))
        reached = inside - self.desired
        beyond = np.abs(reached - allowed) > 1e-12
        self._clipped = "learn_limit" if (allowed != wanted).any() else "voltage range" if beyond.any() else ""
        self.correction = reached

    def _return(self, why: str) -> None:
        """Go back to the best pass with half the gain; the second time without a better one since, hold."""
        assert self.best is not None
        self.correction, self.gain, self.returns = self.best.correction, 0.5 * self.gain, self.returns + 1
        # What was learned from passes that had not settled may be wrong: the gains are learned anew, and how long it
        # takes to settle.
        self._returned, self._dwell, self._ring_since = True, None, 0
        self.harmonics = self.harmonics.doubted(self._guess)
        self._told = f"{why}; back to the best, at half the gain"
        if self.returns >= MOST_RETURNS:
            self.held = f"{HELD}: {why}, for the second time"

    def _refuse(self, reason: str, *, new: bool) -> None:
        """Leave a pass alone, and go back to the best path from a new one; after several in a row, hold."""
        self._told = reason
        self.refused += 1
        if self.best is not None and (new or self.refused >= MOST_REFUSED):
            self.correction, self._returned, self._ring_since = self.best.correction, True, 0
        if self.refused >= MOST_REFUSED:
            self.held = f"{HELD}: {MOST_REFUSED} passes in a row were not learned from, the last as {reason}"

    def limited_by(self, drift: float) -> str:
        """Return what keeps the error where it is: noise, bandwidth, learn_limit, voltage range, drift, or learning."""
        if self._clipped:
            return self._clipped
        left, harmonics = self.left, self.harmonics
        sure = np.abs(left) ** 2 > CLEAR**2 * (harmonics.variance(self._spectrum(self.correction)) + harmonics.noise)
        known = harmonics.phase_known
        power = np.abs(left) ** 2
        learnable, beyond = self._power(power * (sure & known)), self._power(power * (sure & ~known))
        if max(learnable, beyond) < self.noise**2:
            return "drift" if abs(drift) > self.noise else "noise"
        return "bandwidth" if beyond > learnable else NOT_YET

    @property
    def left(self) -> ComplexArray:
        """Expected error of the next pass by harmonic, (K,), metres (as `numpy.fft.rfft`), without the mean."""
        left = self.wanted - self.harmonics.expected(self._spectrum(self.correction))
        left[0] = 0.0
        return np.asarray(left)

    @property
    def bandwidth(self) -> float:
        """Frequency (Hz) below which the phase of every harmonic is known."""
        unknown = np.flatnonzero(~self.harmonics.phase_known[1:]) + 1
        return float(self.frequency[unknown[0] if unknown.size else -1])

    def forget(self) -> None:
        """Begin anew from the desired path."""
        self.__init__(self.axis, self.dt, self.desired, self.limit, self.voltage)  # type: ignore[misc]

    @property
    def _size(self) -> int:
        return self.desired.size + (0 if self.closed else max(16, int(LED_BACK * self.desired.size)))

    def _spectrum(self, x: FloatArray) -> ComplexArray:
        """Return the harmonics of a signal (m, (N,)), led back to its beginning if the path does not close."""
        count = self._size - x.size
        if count:
            share = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 1.0) / (count + 1.0))
            x = np.concatenate([x, x[-1] + (x[0] - x[-1]) * share])
        return np.asarray(np.fft.rfft(x))

    def _signal(self, spectrum: ComplexArray) -> FloatArray:
        return np.asarray(np.fft.irfft(spectrum, self._size)[: self.desired.size])

    def _power(self, power: FloatArray) -> float:
        """Return the mean square (m^2) of a signal with these squares of harmonics (m^2, (K,)), without the mean."""
        twice = np.full(power.size, 2.0)
        if self._size % 2 == 0:
            twice[-1] = 1.0
        return float((twice * power)[1:].sum()) / self._size**2

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

    def _replayed(self, measured: FloatArray) -> str:
        """Return that a pass is the copy of an earlier one, although another path was commanded; "" if not."""
        known = hashlib.sha256(np.ascontiguousarray(measured).tobytes()).hexdigest()
        path = hashlib.sha256(self.path.tobytes()).hexdigest()
        earlier = [each.split(":")[1] for each in self._hashes if each.startswith(known)]
        self._hashes = [*self._hashes, f"{known}:{path}"][-KEPT_HASHES:]
        if any(each != path for each in earlier):
            return "every reading is that of an earlier pass: the sensor's data are replayed"
        return ""

    def _held_back(self, voltage: FloatArray | None) -> str:
        """Return that a limit held the voltage back; "" if none did, or the voltage is not known."""
        if voltage is None:
            return ""
        (low, high), margin = self.voltage, AT_LIMIT * (self.voltage[1] - self.voltage[0])
        at = (voltage <= low + margin) | (voltage >= high - margin)
        runs = np.convolve(at, np.ones(HELD_SAMPLES), "valid") >= HELD_SAMPLES - 0.5
        if not runs.any():
            return ""
        self._clipped = "voltage range"
        return f"the voltage is held at a limit at {int(np.count_nonzero(at))} of its samples"

    def to_document(self) -> dict[str, Any]:
        """Return what was learned as a part of a document, metres and seconds."""
        h = self.harmonics
        return {
            "desired_m": self.desired.tolist(),
            "correction_m": self.correction.tolist(),
            "last_correction_m": self._last.tolist(),
            "previous_m": _listed(self._previous),
            "changed_m": _listed(self._changed),
            "lead_in_m": _listed(self._lead_in),
            "since": self._since,
            "ring_since": self._ring_since,
            "dwell": self._dwell,
            "moved_m2": self._moved if math.isfinite(self._moved) else None,
            "returned": self._returned,
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
                "passes": h.passes,
            },
            "passes": [asdict(one) for one in self.passes],
        }

    def resume(self, document: Mapping[str, Any], *, same_model: bool) -> None:
        """Go on from a document of the same path; of another model, only the correction of the path is taken over."""
        correction = np.array(document["correction_m"])
        if correction.shape != self.desired.shape:
            raise ModelError(f"{correction.size} corrections for a path of {self.desired.size} samples; learn it anew")
        low, high = -self.limit, self.limit
        self.correction = self._last = self._before = self._aimed = np.clip(correction, low, high)
        if not same_model:
            return
        numbers, h = document["harmonics"], self.harmonics
        if len(numbers["noise_m2"]) != h.noise.size:
            raise ModelError(f"{len(numbers['noise_m2'])} harmonics, not {h.noise.size}; learn the path anew")
        self._last = self._aimed = np.array(document["last_correction_m"])
        self._previous, self._changed = _array(document["previous_m"]), _array(document["changed_m"])
        self._lead_in, self._since = _array(document["lead_in_m"]), document["since"]
        self._ring_since = document["ring_since"]
        self._dwell, self._returned = document["dwell"], document["returned"]
        self._moved = math.inf if document["moved_m2"] is None else document["moved_m2"]
        self.record = math.inf if document["record_m2"] is None else document["record_m2"]
        self.gain, self.held = document["gain"], document["held"]
        self.returns, self.refused, self._offset = document["returns"], document["refused"], document["offset_m"]
        if document["deviating"] is not None:
            self._deviating = np.zeros(self.desired.size, dtype=np.bool_)
            self._deviating[np.array(document["deviating"], dtype=np.intp)] = True
        if best := document["best"]:
            self.best = _Best(best["number"], best["power_m2"], np.array(best["correction_m"]))
        self._hashes = list(document["hashes"])
        self.passes = [PassReport(**one) for one in document["passes"]]
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
            passes=numbers["passes"],
        )


def _passes_until_settled(duration: float, ringing: float) -> int:
    """Return from which pass (`duration`, s) after a change on a mode that rings (s) has settled to `SETTLED`."""
    if ringing <= 0.0:
        return 1
    share = duration / ringing
    # Mean of the decay over the first pass; each further one is less by exp(-share).
    first = -math.expm1(-share) / share
    return min(1 + max(math.ceil(math.log(first / SETTLED) / share), 0), MOST_DWELL)


def _listed(x: FloatArray | None) -> list[float] | None:
    return None if x is None else x.tolist()


def _array(values: list[float] | None) -> FloatArray | None:
    return None if values is None else np.array(values, dtype=np.float64)


def _pairs(x: ComplexArray) -> list[list[float]]:
    return [x.real.tolist(), x.imag.tolist()]


def _complex(pairs: list[list[float]]) -> ComplexArray:
    return np.array(pairs[0]) + 1j * np.array(pairs[1])
