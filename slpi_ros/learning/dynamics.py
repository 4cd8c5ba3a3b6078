"""Linear answer of the displacement to a change of the path, estimated from all passes at once, ringing included.

The gains of the harmonics of a path are values of one frequency response: that of a short impulse response and of some
lightly damped modes. So few numbers are learned from all harmonics and passes together, and what still rings from the
pass before is a part of the estimate and not a disturbance that must be waited for.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import ModelError
from slpi_ros.learning.first_guess import DOUBT
from slpi_ros.learning.harmonics import Answer, ComplexArray
from slpi_ros.learning.least_squares import Row, normal, solved, variance_of
from slpi_ros.learning.modes import Mode, ModeAnswers, candidates
from slpi_ros.learning.saved import Arrays, read, saved

# Memory (s) of the impulse response beside the modes, its least and most samples, and those of them before the change:
# a sensor or a time stamp may be early.
MEMORY, LEAST_TAPS, MOST_TAPS, EARLY = 10e-3, 4, 48, 2
# Prior standard deviation of a mode's residue, as a multiple of that of a mode with a static gain of 1.
RESIDUE = 2.0
# Prior standard deviations of a mode's frequency and decay, relative, and iterations of the estimate of poles.
POLE, DECAY, ITERATIONS = 5e-3, 0.4, 3
# Standard deviations by which a frequency may move: two modes that become one explain everything.
REACH = 2.0
# Frequencies at a mode and beside it, relative, for which the first guess counts, too.
BESIDE = (-0.1, -0.05, -0.01, 0.0, 0.01, 0.05, 0.1)
# A mode is looked for in the first passes, in the last rows of the estimate, as long as there are fewer. It counts if
# it takes this share of what is left, weighted, and so much of it (chi squared). Share of rounding errors.
SEARCH_PASSES, SEARCHED, MOST_MODES, EXPLAINED, CLEARLY, RIDGE = 8, 5, 3, 0.15, 15.0, 1e-6
# Standard deviation of what is known exactly, as a share of that of an estimate.
EXACT = 1e-9
# What is saved of a pass, and of the estimate.
PASS_ARRAYS: Arrays = dict.fromkeys(("commanded", "reading"), (float, ("period",)))
MODES: Arrays = dict.fromkeys(("modes", "begun"), (float, ("modes", 4)))
ARRAYS: Arrays = {
    **dict.fromkeys(("residues", "rings"), (complex, ("modes",))), "parameters": (float, ("parameters",)),
    "oldest": (float, ("oldest", "oldest and one")), "carried": (float, ("carried", "carried and one")),
}  # fmt: skip


@dataclass(frozen=True)
class Pass:
    """What was commanded beyond the desired path, and the reading without its offset and drift; m, (N,)."""

    commanded: FloatArray
    reading: FloatArray | None  # None: not learned from


@dataclass(frozen=True)
class Measured:
    """Passes, and how well each of their harmonics is known."""

    # In a row up to the one that was just measured; of the first, the answers to what was before it are not known.
    passes: Sequence[Pass]
    # What the last pass has made of the correction, without what was for this pass only, (N,), metres.
    aim: FloatArray
    undisturbed: Pass  # the one before the first change
    desired: ComplexArray  # the path of that pass, (K,), metres
    rest: FloatArray  # variance of what is not linear in `desired`, (K,), metres squared
    noise: FloatArray  # (K,), metres squared
    # Returns the variance (m^2, (K,)) of what is not linear in a change of the path (m, (K,)).
    of_change: Callable[[ComplexArray], FloatArray]


class Dynamics:
    """Estimates the answer to a change of the path.

    The reading of pass j is ``y_j = d + (g * u)_j + n_j``: ``d`` repeats, ``u`` is what is commanded beyond the desired
    path, over all passes, and ``g`` the answer to an impulse: free in its first samples, then a sum of modes. The
    difference of successive passes does not depend on ``d`` and is linear in the samples of ``g``, the residues of its
    modes and (for a small change) their poles. All are the least-squares estimate, weighted by harmonic, with the first
    guess as a measurement of its own.

    Parameters
    ----------
    size : int
        Samples of a period of the path, N.
    dt : float, seconds
    follow : bool
        Whether passes follow one another without a pause, so that one still has answers to the changes before.
    first_guess : callable
        Returns gain and variance, (M,) each, at frequencies (Hz, (M,)).
    modes : sequence of Mode

    References
    ----------
    R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, IEEE Press 2012, Ch. 6 (transients as
    answers with the same poles). T. Chen, H. Ohlsson, L. Ljung, On the estimation of transfer functions,
    regularizations and Gaussian processes - revisited, Automatica 48 (2012).
    """

    def __init__(
        self,
        size: int,
        dt: float,
        follow: bool,
        first_guess: Callable[[FloatArray], tuple[ComplexArray, FloatArray]],
        modes: Sequence[Mode],
    ) -> None:
        self._size, self._follow = size, follow
        self._taps = int(np.clip(round(MEMORY / dt), LEAST_TAPS, MOST_TAPS))
        self._w: FloatArray = np.asarray(2.0 * np.pi * np.fft.rfftfreq(size), dtype=np.float64)
        # As many frequencies as the impulse response resolves, and some beside each mode.
        grid = np.linspace(0.0, np.pi, self._taps // 2 + 1)
        beside = np.outer([mode.angle for mode in modes if not mode.exact], 1.0 + np.array(BESIDE))
        self._guess_w = np.concatenate([grid, beside[beside < np.pi]])
        self._guess, self._guess_variance = first_guess(self._guess_w / (2.0 * np.pi * dt))
        self.restart(modes)

    def restart(self, modes: Sequence[Mode]) -> None:
        """Begin the estimate anew, with these modes."""
        self.modes = self.begun = tuple(modes)
        self.residues = self.rings = np.zeros(len(self.modes), dtype=np.complex128)
        # Samples of the impulse response and residues.
        self.parameters: FloatArray | None = None
        # What the oldest pass, and those that were forgotten, say of them: normal matrix, its last column the vector.
        self.oldest: FloatArray | None = None
        self.carried: FloatArray | None = None

    def transient(self, passes: Sequence[Pass], aim: FloatArray) -> ComplexArray:
        """Return the expected transient, (K,), metres, of the last pass, of which nothing is measured yet.

        `aim`: what will be commanded beyond the desired path in all passes after it, (N,), metres.
        """
        if self.parameters is None or not self._follow:
            return np.zeros(self._w.size, dtype=np.complex128)
        poles = ModeAnswers(self.modes, self.residues, self.rings)
        answers = self._answers(passes, poles, len(passes) - 1)[-1] - self._settled(aim, poles)
        linear = answers[:, : self.parameters.size]
        pairs = np.stack([self.rings.real, self.rings.imag], axis=1).ravel()
        rung = poles.ringing(self._size, len(passes) - 1)[:, : pairs.size]
        return np.asarray(linear @ self.parameters + rung @ pairs)

    def answer(self, given: Measured) -> Answer:
        """Return the estimate after some passes, the last of which was just measured."""
        search = len(given.passes) <= SEARCH_PASSES and sum(not mode.exact for mode in self.begun) < MOST_MODES
        for _ in range(ITERATIONS if self.modes else 1):
            found = self._estimate(given, search=search)
            search = False
            if self._missing is not None:
                self._add(self._missing)
                return self.answer(given)
        return found

    def _add(self, mode: Mode) -> None:
        self.modes, self.begun = (*self.modes, mode), (*self.begun, mode)
        none = np.zeros(1, dtype=np.complex128)
        self.residues, self.rings = np.append(self.residues, none), np.append(self.rings, none)
        self.parameters = None

    def to_document(self) -> dict[str, Any]:
        """Return the estimate as a part of a document."""
        modes = {name: [[*map(float, astuple(mode))] for mode in getattr(self, name)] for name in MODES}
        return saved(self, ARRAYS) | modes

    def resume(self, document: Mapping[str, Any]) -> None:
        """Go on from a document of the same path and model; ModelError if its parts are of different sizes."""
        count = len(document["modes"])
        own = self._taps + 2 * count
        sizes: dict[str | int, int] = {"modes": count, "parameters": own}
        found = read(document, {**MODES, **ARRAYS}, sizes)
        modes, begun = (
            tuple(Mode(rate, angle, bool(exact), unsure) for rate, angle, exact, unsure in found[name].tolist())
            for name in MODES
        )
        self.restart(begun)
        self.modes = modes
        for name in ARRAYS:
            setattr(self, name, found[name])
        wrong = [
            one
            for one in (self.oldest, self.carried)
            if one is not None and not len(one) + 1 == one.shape[1] <= own + 1
        ]
        if wrong:
            raise ModelError(f"its parts do not fit to {count} modes; learn the path anew")

    def _estimate(self, given: Measured, *, search: bool) -> Answer:
        passes, undisturbed, of_change = given.passes, given.undisturbed, given.of_change
        assert undisturbed.reading is not None
        poles = ModeAnswers(self.modes, self.residues, self.rings)
        answers, fixed = self._answers(passes, poles), self._response(self._w, poles)
        rung = [poles.ringing(self._size, j) for j in range(len(passes))]
        no_ringing = np.zeros_like(rung[0])
        rows: list[Row] = []
        last: int | None = None
        free: int | None = None
        reading = undisturbed.reading
        for j, one in enumerate(passes):
            if one.reading is None:
                continue
            if np.array_equal(one.reading, undisturbed.reading):
                free = j
            if last is not None:
                moved = np.fft.rfft(one.commanded - passes[last].commanded)
                differ = np.fft.rfft(one.reading - reading)
                # What settles slowly ends elsewhere than it begins: its harmonics fall with their number.
                settling = float(np.abs(differ[1:4]).max()) ** 2 / np.maximum(np.arange(differ.size), 1) ** 2
                answered = self._joined(answers[j] - answers[last], rung[j] - rung[last])
                variance = 2.0 * given.noise + (of_change(moved) if moved.any() else settling)
                rows.append(Row(answered, differ, variance, j, last))
            last, reading = j, one.reading
        # The path itself: what it excites, but for what is left of its hysteresis.
        whole = self._joined(fixed * given.desired[:, None], no_ringing if free is None else rung[free])
        rows.append(Row(whole, np.fft.rfft(undisturbed.reading), given.rest + given.noise, free, None))
        prior = self._prior(poles, float(np.std(undisturbed.reading)))
        rows, parameters, covariance = solved(rows, prior)
        self.oldest = self._own_part(rows[0], parameters) if rows[0].before == 0 else None
        self._missing = self._missing_mode(passes, given.desired, rows, parameters, covariance) if search else None

        response = self._joined(fixed, no_ringing)
        gain, now = response @ parameters, np.zeros_like(response)
        if self._follow:
            now = self._joined(answers[-1] - self._settled(given.aim, poles), rung[-1])
        found = Answer(
            # A gain is not the same along the path, as the slope of a hysteresis is not.
            gain, variance_of(response, covariance) + (DOUBT * np.abs(gain)) ** 2, now @ parameters,
            variance_of(now, covariance),
        )  # fmt: skip
        self._take(parameters)
        return found

    def forget_oldest(self) -> None:
        """Keep what the oldest pass says of the dynamics: it will not be among the passes any more.

        From now on the poles are those that were estimated, and what rings from before is unknown again.
        """
        self.modes = tuple(replace(mode, exact=True) for mode in self.modes)
        self.rings = self.rings * np.array([mode.step**self._size for mode in self.modes])
        if self.oldest is not None:
            self.carried = self.oldest if self.carried is None else self.carried + self.oldest
            self.oldest = None

    def _own_part(self, row: Row, parameters: FloatArray) -> FloatArray:
        """Return normal matrix and vector of a row for the samples of the impulse response and the residues only."""
        count = self._taps + 2 * len(self.modes)
        rest = row.explained - row.columns[:, count:] @ parameters[count:]
        return np.column_stack(normal(row.columns[1:, :count], rest[1:], 1.0 / np.maximum(row.variance[1:], 1e-300)))

    def _take(self, parameters: FloatArray) -> None:
        """Take over an estimate, (P,)."""
        count = len(self.modes)
        pairs = parameters[self._taps :].reshape(3 * count, 2)
        moves, unit = pairs[count : 2 * count].tolist(), np.array([1.0, 1j])
        self.rings = pairs[2 * count : 3 * count] @ unit
        self.residues, self.parameters = pairs[:count] @ unit, parameters[: self._taps + 2 * count]
        self.modes = tuple(
            mode.moved(*by).near(begun.angle, REACH * max(POLE * begun.angle, begun.unsure))
            for mode, by, begun in zip(self.modes, moves, self.begun, strict=True)
        )

    def _response(self, w: FloatArray, poles: ModeAnswers) -> ComplexArray:
        """Return the frequency response of each parameter, (len(w), P), at `w` (rad/sample)."""
        lags = np.arange(self._taps) - EARLY
        return np.concatenate([np.exp(-1j * np.outer(w, lags)), poles.response(w)], axis=1)

    def _answers(self, passes: Sequence[Pass], poles: ModeAnswers, begin: int = 0) -> list[ComplexArray]:
        """Return the spectrum of each parameter's answer in each pass from number `begin` on, (K, P)."""
        if not self._follow:
            # Each begins from rest, and ends long before the next one.
            return [self._settled(one.commanded, poles) for one in passes[begin:]]
        late, found = self._taps - 1 - EARLY, []
        commanded = [one.commanded for one in passes]
        modal = poles.answers(commanded, begin)
        for j in range(begin, len(passes)):
            u = commanded[j]
            before = commanded[j - 1] if j else u
            whole = np.concatenate([np.resize(before[::-1], late)[::-1], u, np.resize(u, EARLY)])
            shifted = np.lib.stride_tricks.sliding_window_view(whole, self._size)[::-1]
            found.append(np.concatenate([np.fft.rfft(shifted, axis=1).T, modal[j - begin]], axis=1))
        return found

    def _settled(self, aim: FloatArray, poles: ModeAnswers) -> ComplexArray:
        """Return the spectrum of each parameter's answer to endless passes, (K, P)."""
        return np.asarray(self._response(self._w, poles) * np.fft.rfft(aim)[:, None])

    def _joined(self, answers: ComplexArray, ringing: ComplexArray) -> ComplexArray:
        """Return the columns of all parameters: samples, residues, moves of poles, ringing from before."""
        both = 2 * len(self.modes)
        own, moves = answers[:, : self._taps + both], answers[:, self._taps + both :]
        return np.concatenate([own, moves + ringing[:, both:], ringing[:, :both]], axis=1)

    def _prior(self, poles: ModeAnswers, scale: float) -> tuple[FloatArray, FloatArray]:
        """Return information matrix and vector of what is known before the passes; `scale`: of ringing, metres."""
        none = np.zeros((self._guess_w.size, 4 * len(self.modes)), dtype=np.complex128)
        guessed = self._joined(self._response(self._guess_w, poles), none)
        information, vector = normal(guessed, self._guess, 1.0 / self._guess_variance)
        # Of the samples nothing more is known.
        sds, means = [math.inf] * self._taps, [0.0] * self._taps
        for mode in self.modes:
            sds += [RESIDUE * mode.angle] * 2
        for mode, begun in zip(self.modes, self.begun, strict=True):
            exact = EXACT if mode.exact else 1.0
            sds += [exact * DECAY * begun.rate, exact * max(POLE * begun.angle, begun.unsure)]
        sds += [scale] * (2 * len(self.modes))
        means += [0.0] * (2 * len(self.modes))
        for mode, begun in zip(self.modes, self.begun, strict=True):
            means += [0.0, 0.0] if mode.exact else [mode.rate - begun.rate, begun.angle - mode.angle]
        means += [0.0] * (len(sds) - len(means))
        weights = 1.0 / np.array(sds) ** 2
        information, vector = information + np.diag(weights), vector + np.array(means) * weights
        if self.carried is not None:
            count = len(self.carried)
            information[:count, :count] += self.carried[:, :-1]
            vector[:count] += self.carried[:, -1]
        return information, vector

    def _missing_mode(
        self,
        passes: Sequence[Pass],
        desired: ComplexArray,
        rows: Sequence[Row],
        parameters: FloatArray,
        covariance: FloatArray,
    ) -> Mode | None:
        """Return the mode that explains most of what the estimate leaves; None if none explains enough of it."""
        rows = [*rows[-SEARCHED:]]
        left = [(row.explained - row.columns @ parameters)[1:] for row in rows]
        weights = [1.0 / np.maximum(row.variance[1:], 1e-300) for row in rows]
        weighted = [(row.columns[1:].conj() * w[:, None]).T for row, w in zip(rows, weights, strict=True)]
        whole = sum(float(np.sum(w * np.abs(x) ** 2)) for w, x in zip(weights, left, strict=True))
        best, most = None, max(CLEARLY, EXPLAINED * whole)
        for mode in candidates(self._size, self.modes):
            cross, own, gained = np.zeros((parameters.size, 4)), np.zeros((4, 4)), np.zeros(4)
            columns = self._of_mode(mode, passes, desired, rows)
            for c, x, w, a in zip(columns, left, weights, weighted, strict=True):
                cross += (a @ c).real
                own += (c.conj().T @ (c * w[:, None])).real
                gained += (c.conj().T @ (w * x)).real
            scale = 1.0 / np.sqrt(np.maximum(np.diag(own), 1e-300))
            free = (own - cross.T @ covariance @ cross) * np.outer(scale, scale) + RIDGE * np.eye(4)
            reduction = float((gained * scale) @ np.linalg.solve(free, gained * scale))
            if reduction > most:
                best, most = mode, reduction
        return best

    def _of_mode(
        self, mode: Mode, passes: Sequence[Pass], desired: ComplexArray, rows: Sequence[Row]
    ) -> list[ComplexArray]:
        """Return what the residue of a mode and its ringing from before explain of rows, (K - 1, 4) each."""
        poles = ModeAnswers((mode,), np.zeros(1, dtype=np.complex128), np.zeros(1, dtype=np.complex128))
        response = poles.response(self._w)[:, :2]
        answers = poles.answers([one.commanded for one in passes], 0) if self._follow else []

        @cache
        def rung(number: int | None) -> ComplexArray:
            return np.zeros_like(response) if number is None else poles.ringing(self._size, number)[:, :2]

        found = []
        for row in rows:
            ringing = rung(row.now)
            if row.before is None or row.now is None:
                answered = response * desired[:, None]
            else:
                ringing = ringing - rung(row.before)
                if self._follow:
                    answered = (answers[row.now] - answers[row.before])[:, :2]
                else:
                    moved = np.fft.rfft(passes[row.now].commanded - passes[row.before].commanded)
                    answered = response * moved[:, None]
            found.append(np.concatenate([answered, ringing], axis=1)[1:])
        return found
