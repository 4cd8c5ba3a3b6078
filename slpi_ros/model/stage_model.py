"""The model of a stage: one for each axis, and how the axes move along with each other."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slpi_ros.effects.cross_coupling import Coupling
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.model.axis_model import AxisModel, Mask, StartMemory
from slpi_ros.model.limits import Limits
from slpi_ros.model.streaming import StageStream, StreamingInverse

FloatArray = NDArray[np.float64]
Signal = ArrayLike | Mapping[str, ArrayLike]


class HeldAtLimitWarning(UserWarning):
    """Some desired displacements are out of reach and were held at a voltage limit."""


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
        time, voltage = self._signals(t, v, "voltage")
        own: dict[str, FloatArray] = {}
        for name, signal in voltage.items():
            with _naming(name, "voltage"):
                own[name] = self.axis(name).uncoupled_displacement(time, signal)
        motions = {name: y - self.axes[name].start.displacement for name, y in own.items()}
        seen = {name: self.axes[name].seen(time, y, motions) for name, y in own.items()}
        return seen if isinstance(v, Mapping) else next(iter(seen.values()))

    def compensate(self, t: ArrayLike, y: Signal, start_memory: StartMemory = "end") -> Any:
        """Return the voltage that gives a desired displacement; the inverse of `simulate` where both start alike.

        Parameters
        ----------
        t : array_like, shape (N,), seconds
            Not decreasing.
        y : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), metres
        start_memory : str
            The memory that the stage is taken to have: ``end`` of the record (default), ``start`` of it, or ``wiped``;
            see `AxisModel.initial`.

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
        answers = self.command(t, y, start_memory=start_memory)
        for _, held in answers.values():
            if held.any():
                warnings.warn(held_message(held), HeldAtLimitWarning, stacklevel=2)
        voltage = {name: v for name, (v, _) in answers.items()}
        return voltage if isinstance(y, Mapping) else next(iter(voltage.values()))

    def command(
        self, t: ArrayLike, y: Signal, limits: Limits | None = None, start_memory: StartMemory = "end"
    ) -> dict[str, tuple[FloatArray, Mask]]:
        """Return the voltage that gives a desired displacement, and where it waits at a limit.

        Parameters
        ----------
        t, y, start_memory
            As in `compensate`.
        limits : Limits, optional
            Of every axis; the identified voltages are never left.

        Returns
        -------
        dict of axis name to (ndarray, shape (N,), volts, and ndarray of bool, shape (N,))

        Raises
        ------
        SlpiError
            As `compensate`.
        """
        time, desired = self._signals(t, y, "displacement")
        own: dict[str, FloatArray] = {}
        for name, signal in desired.items():
            with _naming(name, "displacement"):
                own[name] = self.axis(name).remove_sensor_effects(time, signal)
        if self.coupling.on:
            starts = {name: self.axes[name].start.displacement for name in own}
            apart = self.coupling.decouple({name: z - starts[name] for name, z in own.items()}, {})
            own = {name: starts[name] + motion for name, motion in apart.items()}
        answers: dict[str, tuple[FloatArray, Mask]] = {}
        for name, z in own.items():
            with _naming(name, "displacement"):
                answers[name] = self.axes[name].command(time, z, limits, start_memory)
        return answers

    def stream(self, axis: str, start_memory: StartMemory = "end") -> StreamingInverse:
        """Return a causal compensator of one axis: ``step(t, y) -> v``, seconds and metres to volts.

        Other axes are taken to rest; `start_memory` is as in `compensate`.
        """
        return self.axis(axis).stream(start_memory=start_memory)

    def streams(self, start_memory: StartMemory = "end") -> StageStream:
        """Return a causal compensator of all axes, ``step(t, {axis: y}) -> {axis: v}``, seconds and metres to volts.

        Raises
        ------
        UsageError
            If a model is not causal.
        """
        streams = {name: axis.stream(start_memory=start_memory) for name, axis in self.axes.items()}
        return StageStream(streams, self.coupling, self.origins)

    @cached_property
    def coupling(self) -> Coupling:
        """How the axes move along with each other."""
        return Coupling({name: axis.chain.gains for name, axis in self.axes.items()})

    @property
    def origins(self) -> dict[str, float]:
        """Where each axis starts, metres: from there its motion counts for the others."""
        return {name: axis.start.displacement for name, axis in self.axes.items()}

    def _signals(self, t: ArrayLike, signal: Signal, what: str) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return time and the signal of each axis, shape (N,) each, once they fit each other."""
        time = check_time(t)
        if not isinstance(signal, Mapping):
            if len(self.axes) != 1:
                raise UsageError(
                    f"the model holds axes {', '.join(self.axes)}; give {what} as a mapping of axis name to array"
                )
            signal = {next(iter(self.axes)): signal}
        signals = {}
        for name, values in signal.items():
            self.axis(name)
            signals[name] = _as_array(values, f"axis '{name}': {what}")
            if signals[name].shape != time.shape:
                raise UsageError(
                    f"axis '{name}': {what} has shape {signals[name].shape}, time has {time.shape}; "
                    "give one value for each time"
                )
        return time, signals


@contextmanager
def _naming(axis: str, what: str) -> Iterator[None]:
    """Let errors name the axis and the signal."""
    try:
        yield
    except SlpiError as error:
        raise type(error)(f"axis '{axis}', {what}: {error}") from None


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
