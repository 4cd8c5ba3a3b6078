"""Standard uncertainty of the displacement that a model promises, as a budget by component (GUM, JCGM 100:2008).

It is that of the displacement of the stage about the desired one, driven without feedback by the model's voltage.
docs/explanation/uncertainty.md says what each component assumes, and what is not in it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import exp, hypot, inf, log1p, sqrt
from numbers import Real
from typing import TypeVar

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.effects.base import FollowedGain
from slpi_ros.errors import ModelError, UsageError
from slpi_ros.model.axis_model import ABOVE_NOISE, RESOLUTION, AxisModel, StartMemory
from slpi_ros.model.unknown_memory import UnknownMemory

# Equal parts of the displacement range for which a model document holds the error.
REGIONS = 10
# Coverage factor of an expanded uncertainty: about 95 % for a normal distribution.
COVERAGE_FACTOR = 2.0
# Standard deviation of a rectangular distribution of width 1.
RECTANGULAR = 1.0 / sqrt(12.0)
# An error with a cause that is not in the model is no chance: on another path it may stay at its bound. That of a
# rectangular distribution is this multiple of its rms.
SYSTEMATIC = sqrt(3.0)
Scalars = TypeVar("Scalars", float, FloatArray)
# Points of the table over the range.
POINTS = 200
# Components of the budget, with what each of them is.
COMPONENTS = {
    "fit": "covariance of the fit to the records",
    "left": "what the model leaves unexplained, and its resolution",
    "uncovered": "regions and rates that the records do not cover",
    "memory": "unknown memory of the hysteresis at the start, and creep from before it",
    "age": "drift and creep since the last reset or calibration",
    "surroundings": "recorded quantities: their gains, readings in use, and values that are not known",
}


@dataclass(frozen=True)
class Budget:
    """Standard uncertainty (m) of a displacement by component, each of shape (N,)."""

    fit: FloatArray
    left: FloatArray
    uncovered: FloatArray
    memory: FloatArray
    age: FloatArray
    surroundings: FloatArray

    @property
    def combined(self) -> FloatArray:
        """Combined standard uncertainty, shape (N,), metres; the components are independent of each other."""
        return np.asarray(np.sqrt(sum(getattr(self, part.name) ** 2 for part in fields(self))))

    @property
    def expanded(self) -> FloatArray:
        """Expanded uncertainty, shape (N,), metres, with the coverage factor `COVERAGE_FACTOR`."""
        return COVERAGE_FACTOR * self.combined


class AxisUncertainty:
    """The uncertainty of one axis; ModelError if the model does not hold what it needs.

    Parameters
    ----------
    axis : AxisModel
    start_memory : str
        Assumed initial state, as for `StageModel.compensate`.
    known_memory : bool, optional
        Whether this state is known. By default only that after ``wiped``: otherwise the stage may have moved since.
    felt : (float, float), volts, optional
        Voltage range that the hysteresis may have felt before. By default that of the record.
    """

    def __init__(
        self,
        axis: AxisModel,
        start_memory: StartMemory = "end",
        known_memory: bool | None = None,
        felt: tuple[float, float] | None = None,
    ) -> None:
        quality = axis.quality
        if quality.regions is None or quality.drift is None or quality.duration is None or quality.fastest is None:
            raise ModelError(
                "the model does not hold what its uncertainty needs (errors by region, drift); it is of an earlier "
                "version: identify or diagnose again from its bags"
            )
        if not axis.causal:
            raise ModelError(
                f"the uncertainty of kind '{axis.kind}' is not known, as it needs the complete path in advance; "
                "identify kind 'slpi'"
            )
        self._axis, self._start_memory, self._felt = axis, start_memory, felt or axis.felt_range
        self.known_memory = start_memory == "wiped" if known_memory is None else known_memory
        self.low, high = axis.displacement_range
        self.stroke = high - self.low
        self.scale = (POINTS - 1) / self.stroke
        self.fastest = quality.fastest
        self.fit, self.left, self.unvisited = self._by_displacement()
        base = self.fit**2 + self.left**2
        self.within = base + self.unvisited**2
        # Beyond the record an error grows no further than to that of a stage that may be anywhere in its range.
        self.most = RECTANGULAR * self.stroke
        self.drift_square = quality.drift**2
        self.duration = quality.duration
        unsure = [effect.unsure for effect in axis.effects]
        self.gain_drift_square = sum(one.gain_drift for one in unsure)
        self.gain_origin = next((one.origin for one in unsure if one.gain_drift), 0.0)
        # A stage creeps after moves that are anywhere in its range.
        self.relaxations = [(tau, share * self.most) for one in unsure for tau, share in one.relaxations]
        slope = self.stroke / (axis.voltage_range[1] - axis.voltage_range[0])
        self.creep = hypot(*(hypot(one.slow_share * self.most, one.slow_volts * slope) for one in unsure))
        self.quantities = [quantity for one in unsure for quantity in one.quantities]
        self.quantity_origin = next((one.origin for one in unsure if one.quantities), 0.0)

    def _by_displacement(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return covariance of the fit, what is left, and unvisited regions, (`POINTS`,) each, m, over the range."""
        quality = self._axis.quality
        errors = np.array([np.nan if one is None else one for one in quality.regions or ()])
        centres = (np.arange(REGIONS) + 0.5) / REGIONS
        at = np.linspace(0.0, 1.0, POINTS)
        visited = np.flatnonzero(np.isfinite(errors))
        if not visited.size:
            visited, errors = np.arange(REGIONS), np.full(REGIONS, quality.rms)
        # The error of the fit is that of samples that were not fitted: larger than those fitted by the variance of the
        # prediction, and those smaller than the true one by as much.
        held_out = max(quality.held_out_rms, quality.left_out_rms or 0.0, quality.rms)
        rms = max(quality.rms, 1e-300)
        new = np.interp(at, centres[visited], errors[visited] * (held_out / rms)) ** 2
        own = np.interp(at, centres[visited], errors[visited]) ** 2
        variance = (new - own) / 2.0
        noise = quality.floor_rms**2
        left = np.maximum(new - variance - noise, 0.0)
        if self._systematic:
            left = left * SYSTEMATIC**2
        left += (RESOLUTION * self.stroke) ** 2
        # In a region without samples the error of the nearest one grows with the distance in regions.
        distance = np.abs(at[:, None] - centres[visited]).min(axis=1) * REGIONS - 0.5
        apart = np.where(distance > 1e-9, 1.0 + distance, 0.0) ** 2
        # Of the pairs of turning points that no sample determines, the curves have as much variance as those of the
        # others have been found to have, divided by the share of these.
        uncovered = (1.0 - quality.covered) / max(quality.covered, 1e-2)
        return np.sqrt(variance), np.sqrt(left), np.sqrt((variance + left) * (apart + uncovered))

    @property
    def _systematic(self) -> bool:
        """Whether what is left has a cause that is not in the model: by the verdict, else by the noise."""
        quality = self._axis.quality
        if quality.verdict is None:
            return max(quality.held_out_rms, quality.rms) > ABOVE_NOISE * quality.floor_rms
        return quality.verdict in ("unexplained", "partly_named")

    def budget(
        self,
        t: FloatArray,
        y: FloatArray,
        v: FloatArray,
        age: float = 0.0,
        surroundings: Mapping[str, FloatArray] | None = None,
    ) -> Budget:
        """Return the budget along a path.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
        y : ndarray, shape (N,), metres
            Desired displacement.
        v : ndarray, shape (N,), volts
            Voltage for it.
        age : float, seconds
            Time from the last reset or calibration to the first sample. Default 0.
        surroundings : mapping of str to ndarray, shape (N,), optional
            Known values of the quantities that the stage follows.

        Raises
        ------
        UsageError
            If the age is negative or no finite number.
        """
        require_age(age)
        place = np.clip((y - self.low) * self.scale, 0, POINTS - 1).astype(np.int64)
        dt, dv = np.diff(t), np.abs(np.diff(v))
        rate = np.concatenate([[0.0], np.divide(dv, dt, out=np.zeros_like(dv), where=dt > 0.0)])[: t.size]
        since = age + (t - t[:1])
        faster = np.maximum(rate / self.fastest - 1.0, 0.0) if self.fastest > 0.0 else np.zeros_like(t)
        rates = np.minimum(self.within[place] * faster**2, self.most**2)
        values = {} if surroundings is None else surroundings
        unknown = self.unknown_memory()
        memory = unknown.along(t, v) if unknown else np.zeros_like(v)
        return Budget(
            fit=self.fit[place],
            left=self.left[place],
            uncovered=np.sqrt(self.unvisited[place] ** 2 + rates),
            memory=np.sqrt(memory + self._relaxing_square(since)),
            age=np.sqrt(self._age_square(since, y)),
            surroundings=np.sqrt(self._surroundings_square(values, y)),
        )

    def at(self, y: float, age: float, surroundings: Mapping[str, float] | None = None) -> Budget:
        """Return the budget, shape (1,), at a displacement (m) and a time (s) since a reset, at rates of the record.

        `surroundings` are known values of the quantities that the stage follows, by name, in their units.
        """
        known = self if self.known_memory else AxisUncertainty(self._axis, self._start_memory, known_memory=True)
        values = {key: np.array([value]) for key, value in (surroundings or {}).items()}
        return known.budget(np.zeros(1), np.array([y]), np.zeros(1), age, values)

    def unknown_memory(self) -> UnknownMemory | None:
        """Return how the unknown memory is forgotten from the initial state on; None if the memory is known."""
        return None if self.known_memory else UnknownMemory(self._axis, self._start_memory, self._felt)

    def _relaxing_square(self, since: FloatArray) -> FloatArray:
        """Return the square (m^2) of what still relaxes after the moves before the start, or those of the reset."""
        return (
            np.asarray(sum((size * np.exp(-since / tau) for tau, size in self.relaxations), np.zeros_like(since))) ** 2
        )

    def _age_square(self, since: FloatArray, y: FloatArray) -> FloatArray:
        slow = self.drift_square + self.gain_drift_square * (y - self.gain_origin) ** 2
        # The zero of the model is that at the beginning of its record.
        return slow * (since + self.duration) + (self.creep * np.log1p(since / self.duration)) ** 2

    def _surroundings_square(self, values: Mapping[str, FloatArray], y: FloatArray) -> FloatArray:
        total = np.zeros_like(y)
        for one in self.quantities:
            total += _quantity_square(one, values.get(one.followed.key), y - self.quantity_origin)
        return total

    def stream(self, age: float = 0.0) -> "StreamingUncertainty":
        """Return the same for samples one by one; `age` (s) is the time since the last reset or calibration."""
        require_age(age)
        return StreamingUncertainty(self, age)


def require_age(age: float) -> None:
    """Raise UsageError if an age (s) is negative or no finite number."""
    if not isinstance(age, Real) or not 0.0 <= float(age) < inf:
        raise UsageError(f"age is {age!r}; give the seconds since the last reset or calibration, 0 or more")


class StreamingUncertainty:
    """Standard uncertainty sample by sample: ``u = step(t, y, v)``, the same as `AxisUncertainty.budget`."""

    def __init__(self, of: AxisUncertainty, age: float = 0.0) -> None:
        self._of, self._age = of, age
        self._within: list[float] = of.within.tolist()
        self._low, self._scale = of.low, of.scale
        self._drift = of.drift_square
        self._more = bool(of.gain_drift_square or of.creep or of.quantities)
        self._fastest = of.fastest if of.fastest > 0.0 else inf
        self._values: dict[str, float] = {}
        self._unknown = of.unknown_memory()
        self._memory, self._since = 0.0, inf
        # Time (s), displacement (m) and voltage (V) of the last two samples.
        self._before = self._last = (0.0, 0.0, 0.0)

    def reset(self, t: float) -> None:
        """Note that the memory is known, and the age counts, from time `t` (s) on: after a reset."""
        self._unknown, self._memory, self._age, self._since = None, 0.0, 0.0, t

    def surround(self, values: Mapping[str, float]) -> None:
        """Note values of quantities that the stage follows, by name, in their units."""
        self._values.update(values)

    def note(self, t: float, y: float, v: float) -> None:
        """Follow a sample: time (s), displacement (m) and its voltage (V)."""
        if self._since == inf:
            self._last, self._since = (t, 0.0, v), t
        if self._unknown:
            self._memory = self._unknown.step(t, v)
        self._before, self._last = self._last, (t, y, v)

    def step(self, t: float, y: float, v: float) -> float:
        """Return the standard uncertainty (m) of the displacement `y` (m) for the voltage `v` (V) at time `t` (s)."""
        self.note(t, y, v)
        return self.present

    @property
    def present(self) -> float:
        """Standard uncertainty of the last displacement, metres."""
        (before, _, v_before), (t, y, v) = self._before, self._last
        place = int((y - self._low) * self._scale)
        square = within = self._within[0 if place < 0 else place if place < POINTS else POINTS - 1]
        dt, dv = t - before, abs(v - v_before)
        if dv > self._fastest * dt and dt > 0.0:
            square += min(within * (dv / dt / self._fastest - 1.0) ** 2, self._of.most**2)
        since = self._age + (t - self._since)
        if self._more:
            square += self._others(since, y)
        return sqrt(square + self._memory + self._drift * (since + self._of.duration))

    def _others(self, since: float, y: float) -> float:
        """Return the square (m^2) of what few stages have: drift of the sensitivity, creep, followed quantities."""
        of = self._of
        square = of.gain_drift_square * (since + of.duration) * (y - of.gain_origin) ** 2
        square += (of.creep * log1p(since / of.duration)) ** 2
        square += sum(size * exp(-since / tau) for tau, size in of.relaxations) ** 2
        moved = y - of.quantity_origin
        for one in of.quantities:
            square += _quantity_square(one, self._values.get(one.followed.key), moved)
        return square


def _quantity_square(one: FollowedGain, value: Scalars | None, moved: Scalars) -> Scalars:
    """Return the square of the uncertainty (m^2) for values or None, `moved` (m) away from the origin."""
    (_, reference, lowest, highest), (zero, sensitivity), (own, of_sensitivity), error = one
    follows = zero + sensitivity * moved
    if value is None:
        # It is anywhere in its recorded range.
        return (follows * (RECTANGULAR * (highest - lowest))) ** 2
    return (own * own + (of_sensitivity * moved) ** 2) * (value - reference) ** 2 + (follows * error) ** 2
