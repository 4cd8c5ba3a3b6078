"""The model of a stage: for each axis a hysteresis model, where its memory starts, and what it was identified on."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.errors import RecordError, SlpiError, UnreachableError, UsageError
from slpi_ros.hysteresis import slpi, smpi
from slpi_ros.hysteresis.kinds import Hysteresis, PathModel
from slpi_ros.hysteresis.memory import Memory
from slpi_ros.hysteresis.runs import require_finite
from slpi_ros.stream import ROUNDING, AxisStream, Limits, accepted_range, refusal

FloatArray = NDArray[np.float64]
Signal = ArrayLike | Mapping[str, ArrayLike]


class HeldAtLimitWarning(UserWarning):
    """Some desired displacements are out of reach and were held at a voltage limit."""


@dataclass(frozen=True)
class Start:
    """Where the memory starts: at `voltage` (V) and `displacement` (m).

    `history` holds the voltages (V) at which the drive is taken to have turned before, oldest first: a long fall to
    the first of them wiped the memory. Empty: the stage has never been moved.
    """

    voltage: float
    displacement: float
    history: tuple[float, ...] = ()


@dataclass(frozen=True)
class FitQuality:
    """How well the model describes the record it comes from, free-run, metres.

    Parameters
    ----------
    rms, maximum : float, metres
        Error over the samples fitted.
    held_out_rms : float, metres
        Error over blocks left out of the fit, from cross-validation.
    floor_rms : float, metres
        Noise of the sensor, estimated from the record.
    samples : int
        Samples fitted.
    covered : float
        Share of the surface's cells that the record visited, 0..1.
    source : str
        The record.
    """

    rms: float
    maximum: float
    held_out_rms: float
    floor_rms: float
    samples: int
    covered: float
    source: str


@dataclass(frozen=True)
class AxisModel:
    """One axis.

    Parameters
    ----------
    kind : str
        Name of the hysteresis model.
    hysteresis : Hysteresis
    start : Start
    voltage_range : (float, float), volts
    displacement_range : (float, float), metres
        What the record covered. `compensate` keeps to these voltages.
    quality : FitQuality
    """

    kind: str
    hysteresis: Hysteresis
    start: Start
    voltage_range: tuple[float, float]
    displacement_range: tuple[float, float]
    quality: FitQuality

    @property
    def causal(self) -> bool:
        """Whether the model can follow a path that is not known in advance."""
        return not isinstance(self.hysteresis, PathModel)

    def memory(self) -> Memory:
        """Return a fresh memory at the start.

        Raises
        ------
        UsageError
            If the model is not causal.
        """
        start = self.start
        if isinstance(self.hysteresis, PathModel):
            raise UsageError(
                f"kind '{self.kind}' needs the whole path in advance and cannot follow it sample by sample; "
                "give it a whole path, or identify kind 'slpi'"
            )
        if not start.history:
            return Memory(self.hysteresis, start.voltage, start.displacement)
        first, *turns = (*start.history, start.voltage)
        # Displacement is known at the end of the history: walk it once to learn how far it leads.
        way = Memory(self.hysteresis, first, 0.0, primed=True).forward_array(np.array([first, *turns]))[-1]
        memory = Memory(self.hysteresis, first, start.displacement - float(way), primed=True)
        for v in turns:
            memory.forward(v)
        return memory

    def stream(self, limits: Limits | None = None) -> AxisStream:
        """Return a fresh stream within `limits` and the identified voltages."""
        allowed = (limits or Limits(-inf, inf)).within(self.voltage_range)
        return AxisStream(self.memory(), self.displacement_range, allowed)

    def simulate(self, v: FloatArray) -> FloatArray:
        """Return the displacement, shape (N,), metres, for the voltage `v`, shape (N,), volts."""
        return (self._known_path() or self.memory()).forward_array(v)

    def _known_path(self) -> slpi.KnownPath | smpi.KnownPath | None:
        """Return what moves a model that is not causal along whole paths."""
        if isinstance(self.hysteresis, PathModel):
            return self.hysteresis.along(self.start.voltage, self.start.displacement)
        return None

    def compensate(self, y: FloatArray, limits: Limits | None = None) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the voltage for a desired displacement `y`, shape (N,), metres, and where it waits at a limit.

        Raises
        ------
        UnreachableError
            If a displacement lies far outside the identified ones.
        UsageError
            If a displacement is not finite.
        """
        require_finite(y)
        low, high = self.displacement_range
        accepted = accepted_range(self.displacement_range)
        far = (y < accepted[0]) | (y > accepted[1])
        if far.any():
            at = int(np.argmax(far))
            raise UnreachableError(f"sample {at}: {refusal(float(y[at]), accepted)}")
        allowed = (limits or Limits(-inf, inf)).within(self.voltage_range)
        lower, upper = allowed.lower, allowed.upper
        v = (self._known_path() or self.stream(limits).memory).inverse_array(y, lower, upper)
        held = (v <= lower) | (v >= upper)
        if held.any():
            # At a limit a wish may just be met.
            with warnings.catch_warnings():
                # What stands in for loops that were never identified has been said.
                warnings.simplefilter("ignore", slpi.UnidentifiedLoopWarning)
                missed = (self._known_path() or self.stream(limits).memory).forward_array(v) - y
            held &= np.abs(missed) > ROUNDING * (high - low)
        return v, held


@dataclass(frozen=True)
class StageModel:
    """The model of a stage, as a model document holds it.

    Parameters
    ----------
    axes : mapping of axis name to AxisModel
    hardware_id : str
        The stage it was identified on; "" when unknown.
    created : str
        ISO 8601 time of identification, UTC.
    """

    axes: Mapping[str, AxisModel]
    hardware_id: str = ""
    created: str = ""

    def axis(self, name: str) -> AxisModel:
        """Return one axis; UsageError when the model does not hold it."""
        if name not in self.axes:
            raise UsageError(f"the model has no axis '{name}'; it holds {', '.join(self.axes)}")
        return self.axes[name]

    def simulate(self, t: ArrayLike, v: Signal) -> Any:
        """Return the displacement that a voltage gives, free-run from the model's start.

        Parameters
        ----------
        t : array_like, shape (N,), seconds
            Not decreasing.
        v : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), volts
            A bare array stands for the model's only axis.

        Returns
        -------
        ndarray, shape (N,), or dict of axis name to ndarray, shape (N,), metres
            In the form of `v`.

        Raises
        ------
        SlpiError
            If axes, lengths or values do not fit.
        """
        return self._each_axis(t, v, "voltage", lambda axis, signal: axis.simulate(signal))

    def compensate(self, t: ArrayLike, y: Signal) -> Any:
        """Return the voltage that gives a desired displacement; the inverse of `simulate`.

        Parameters
        ----------
        t : array_like, shape (N,), seconds
            Not decreasing.
        y : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), metres

        Returns
        -------
        ndarray, shape (N,), or dict of axis name to ndarray, shape (N,), volts
            In the form of `y`, within the identified voltages. Displacements just out of reach wait at the limit,
            with a `HeldAtLimitWarning`.

        Raises
        ------
        UnreachableError
            If a displacement lies far outside the identified ones.
        SlpiError
            If axes, lengths or values do not fit.
        """

        def invert(axis: AxisModel, signal: FloatArray) -> FloatArray:
            v, held = axis.compensate(signal)
            if held.any():
                warnings.warn(held_message(held), HeldAtLimitWarning, stacklevel=5)
            return v

        return self._each_axis(t, y, "displacement", invert)

    def stream(self, axis: str) -> AxisStream:
        """Return a causal compensator of one axis: ``step(t, y) -> v``, seconds and metres to volts."""
        return self.axis(axis).stream()

    def _each_axis(
        self, t: ArrayLike, signal: Signal, what: str, convert: Callable[[AxisModel, FloatArray], FloatArray]
    ) -> Any:
        time = check_time(t)
        if isinstance(signal, Mapping):
            converted = {}
            for name, values in signal.items():
                converted[name] = self._one(name, time, values, what, convert)
            return converted
        if len(self.axes) != 1:
            raise UsageError(
                f"the model holds axes {', '.join(self.axes)}; give {what} as a mapping of axis name to array"
            )
        return self._one(next(iter(self.axes)), time, signal, what, convert)

    def _one(
        self,
        name: str,
        t: FloatArray,
        values: ArrayLike,
        what: str,
        convert: Callable[[AxisModel, FloatArray], FloatArray],
    ) -> FloatArray:
        axis = self.axis(name)
        signal = _as_array(values, f"axis '{name}': {what}")
        if signal.shape != t.shape:
            raise UsageError(
                f"axis '{name}': {what} has shape {signal.shape}, time has {t.shape}; give one value for each time"
            )
        try:
            return convert(axis, signal)
        except SlpiError as error:
            raise type(error)(f"axis '{name}', {what}: {error}") from None


def check_time(t: ArrayLike) -> FloatArray:
    """Return `t` as an array, shape (N,), seconds; RecordError unless it is finite and does not decrease."""
    time = _as_array(t, "time")
    if time.ndim != 1 or not np.isfinite(time).all():
        raise RecordError(f"time has shape {time.shape}; give one finite value for each sample")
    back = np.flatnonzero(np.diff(time) < 0)
    if back.size:
        at = int(back[0]) + 1
        raise RecordError(
            f"time runs backwards at sample {at}: {time[at]:.9g} s after {time[at - 1]:.9g} s; sort the samples"
        )
    return time


def _as_array(values: ArrayLike, what: str) -> FloatArray:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{what} is no array of numbers: {error}") from None


def held_message(held: NDArray[np.bool_]) -> str:
    """Say how many displacements are out of reach, and from where on."""
    return (
        f"{np.count_nonzero(held)} of {held.size} desired displacements need a voltage beyond the limits, "
        f"first sample {int(np.argmax(held))}; held at the limit"
    )
