"""Model of a stage: the models of all axes and their cross-coupling."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray, Mask
from slpi_ros.errors import RecordError, SlpiError, UsageError
from slpi_ros.io.record import Record
from slpi_ros.io.surroundings import clean, smoothed
from slpi_ros.model.axis_model import AxisModel, StartMemory
from slpi_ros.model.coupling import Coupling
from slpi_ros.model.limits import Limits
from slpi_ros.model.sensor import Sensor, corrected
from slpi_ros.model.streaming import StageStream, StreamingInverse
from slpi_ros.model.uncertainty import AxisUncertainty

Signal = ArrayLike | Mapping[str, ArrayLike]


class HeldAtLimitWarning(UserWarning):
    """Some desired displacements are not reachable; the voltage was held at a limit."""


@dataclass(frozen=True)
class StageModel:
    """Model of all axes of a stage, as stored in a model document.

    Parameters
    ----------
    axes : mapping of axis name to AxisModel
    hardware_id, created : str
        Hardware id of the identified stage, and ISO 8601 time of identification, UTC; "" (default) if unknown.
    """

    axes: Mapping[str, AxisModel]
    hardware_id: str = ""
    created: str = ""

    def axis(self, name: str) -> AxisModel:
        """Return the model of one axis; UsageError if there is no such axis."""
        if name not in self.axes:
            raise UsageError(f"the model has no axis '{name}'; it holds {', '.join(self.axes)}")
        return self.axes[name]

    def simulate(self, t: ArrayLike, v: Signal, surroundings: Mapping[str, ArrayLike] | None = None) -> Any:
        """Return what the sensors will say for a voltage signal, free-run from the initial state of the record.

        Effects of the stage and of its sensors act; drift and lines of the record do not. SlpiError if axes, lengths or
        values are not consistent.

        Parameters
        ----------
        t : array_like, shape (N,), seconds
            Not decreasing.
        v : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), volts
            An array without axis name is allowed for a model with one axis.
        surroundings : mapping of str to array_like, shape (N,), optional
            Values of the quantities that the stage follows, by name, in their units; those left out, and by default
            all, have their reference values.

        Returns
        -------
        ndarray, shape (N,), or dict of axis name to ndarray, shape (N,), metres
            In the form of `v`.
        """
        time, voltage = self._signals(t, v, "voltage")
        if surroundings:
            return self.within(time, surroundings).simulate(time, v)
        own: dict[str, FloatArray] = {}
        for name, signal in voltage.items():
            with _naming(name, "voltage"):
                own[name] = self.axis(name).uncoupled_displacement(time, signal)
        motions = {name: y - self.axes[name].start.displacement for name, y in own.items()}
        seen = {name: self.axes[name].seen(time, y, motions) for name, y in own.items()}
        return seen if isinstance(v, Mapping) else next(iter(seen.values()))

    def compensate(
        self,
        t: ArrayLike,
        y: Signal,
        start_memory: StartMemory = "end",
        surroundings: Mapping[str, ArrayLike] | None = None,
        *,
        uncertainty: bool = False,
        age: float = 0.0,
    ) -> Any:
        """Return the voltage for a desired displacement of the stage, from an assumed initial state.

        Only effects of the stage are inverted. Without effects of sensor and record, this is the inverse of `simulate`.
        UnreachableError if a displacement lies far outside the identified range; other SlpiErrors as `simulate`.

        Parameters
        ----------
        t : array_like, shape (N,), seconds
            Not decreasing.
        y : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), metres
            Where the stage shall be.
        start_memory : str
            Assumed initial state, `AxisModel.initial`: ``end`` (default) or ``start`` of the record, or ``wiped``.
        surroundings : mapping of str to array_like, shape (N,), optional
            As for `simulate`.
        uncertainty : bool
            Whether to return the standard uncertainty of the displacement, too. ModelError if the model does not hold
            what it needs. Default False.
        age : float, seconds
            Time from the last reset or calibration to the first sample, for the uncertainty. Default 0.

        Returns
        -------
        voltage : ndarray, shape (N,), or dict of axis name to ndarray, shape (N,), volts
            In the form of `y`, within the identified voltage range. For displacements slightly outside the reachable
            range the voltage is held at the limit, with a `HeldAtLimitWarning`.
        standard uncertainty : the same in metres, only with `uncertainty`
            Of the displacement about the reachable desired one; `AxisUncertainty.budget` is the same by component.
        """
        answers = self.command(t, y, start_memory=start_memory, surroundings=surroundings)
        for _, held in answers.values():
            if held.any():
                warnings.warn(held_message(held), HeldAtLimitWarning, stacklevel=2)
        voltage = {name: v for name, (v, _) in answers.items()}
        if not uncertainty:
            return voltage if isinstance(y, Mapping) else next(iter(voltage.values()))
        time, desired = self._signals(t, y, "displacement")
        known = {key: _as_array(values, key) for key, values in (surroundings or {}).items()}
        spread = {}
        for name, v in voltage.items():
            own = self.uncertainty(name, start_memory)
            spread[name] = own.budget(time, desired[name], v, age, known).combined
        if isinstance(y, Mapping):
            return voltage, spread
        return next(iter(voltage.values())), next(iter(spread.values()))

    def command(
        self,
        t: ArrayLike,
        y: Signal,
        limits: Limits | None = None,
        start_memory: StartMemory = "end",
        surroundings: Mapping[str, ArrayLike] | None = None,
    ) -> dict[str, tuple[FloatArray, Mask]]:
        """Return by axis the voltage (V), as `compensate`, and where it is held at a limit, shape (N,) each.

        `limits` are those of every axis, within the identified voltage range; default: that range. With a slew or
        acceleration limit the voltage is that of `streams`: it begins at the voltage of the start memory.
        """
        time, desired = self._signals(t, y, "displacement")
        if surroundings:
            return self.within(time, surroundings).command(time, y, limits, start_memory)
        for name, signal in desired.items():
            with _naming(name, "displacement"):
                self.axis(name).require_reachable(signal)
        parts: dict[str, FloatArray | float] = {}
        if self.coupling.on:
            origins = self.origins
            moving = {name: signal - origins[name] for name, signal in desired.items()}
            resting = {
                name: axis.rest(limits, start_memory) - origins[name]
                for name, axis in self.axes.items()
                if name not in moving
            }
            parts = self.coupling.parts(moving, resting)
        answers: dict[str, tuple[FloatArray, Mask]] = {}
        for name, signal in desired.items():
            with _naming(name, "displacement"):
                answers[name] = self.axes[name].command(time, signal, limits, start_memory, parts.get(name, 0.0))
        return answers

    def correct(self, record: Record) -> Record:
        """Return a record with the displacements of the stage instead of the readings of its sensors.

        See `AxisModel.correct`; axes that are not in the model, or not in the record, are unchanged.
        """
        return corrected(record, self.corrections)

    @property
    def corrections(self) -> dict[str, Callable[[FloatArray, FloatArray], FloatArray]]:
        """What `correct` does to the times (s) and readings (m) of each axis whose sensor errors are known."""
        return {name: axis.correct for name, axis in self.axes.items() if axis.corrects}

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the quantities that an axis follows."""
        return tuple(dict.fromkeys(key for axis in self.axes.values() for key in axis.quantities))

    def surrounded(self, record: Record) -> "StageModel":
        """Return the model in the surroundings of a record, on its clock; reference values where it has none."""
        courses = {
            key: smoothed(clean(record.surroundings[key])) for key in self.quantities if key in record.surroundings
        }
        return replace(self, axes={name: axis.surrounded(courses) for name, axis in self.axes.items()})

    def within(self, t: FloatArray, surroundings: Mapping[str, ArrayLike]) -> "StageModel":
        """Return the model in surroundings, (N,) each, at times `t` (s); UsageError if it does not follow one."""
        courses = {}
        for key, values in surroundings.items():
            if key not in self.quantities:
                follows = f"it follows {', '.join(self.quantities)}" if self.quantities else "it follows none"
                raise UsageError(f"the stage does not follow '{key}'; {follows}; leave it out")
            value = _as_array(values, f"'{key}'")
            if value.shape != t.shape or not np.isfinite(value).all():
                raise UsageError(
                    f"'{key}' has shape {value.shape}, time has {t.shape}; give one finite value for each time"
                )
            courses[key] = t, value
        return replace(self, axes={name: axis.surrounded(courses) for name, axis in self.axes.items()})

    def shifted(self, offsets: Mapping[str, float]) -> "StageModel":
        """Return the model with zeros that have moved by `offsets` (m, by axis)."""
        moved = {name: axis.shifted(offsets[name]) if name in offsets else axis for name, axis in self.axes.items()}
        return replace(self, axes=moved)

    @cached_property
    def stage_only(self) -> "StageModel":
        """The model from the voltages to where the stage is: without the effects of sensors and record."""
        return replace(self, axes={name: axis.stage_only for name, axis in self.axes.items()})

    def with_sensor(
        self, *, delay: float | None = None, lag: float | None = None, axes: Sequence[str] | None = None
    ) -> "StageModel":
        """Return the model with another known delay and lag (s) of the sensor, see `Sensor`; default: those it has.

        `axes`: axes with this sensor; default: all. UsageError if a time is not possible, or there is no such axis.
        """
        changed = dict(self.axes)
        for name in self.axes if axes is None else axes:
            own = self.axis(name).sensor
            sensor = Sensor(own.delay if delay is None else delay, own.lag if lag is None else lag)
            changed[name] = replace(self.axis(name), sensor=sensor)
        return replace(self, axes=changed)

    def stream(self, axis: str, start_memory: StartMemory = "end") -> StreamingInverse:
        """Return a causal compensator of one axis: ``step(t, y) -> v``, seconds and metres to volts.

        Other axes are assumed at rest; `start_memory` is as in `compensate`.
        """
        return self.axis(axis).stream(start_memory=start_memory)

    def uncertainty(self, axis: str, start_memory: StartMemory = "end") -> AxisUncertainty:
        """Return the uncertainty of one axis: ``budget`` along a path, ``stream`` sample by sample beside `stream`.

        ModelError if the model does not hold what it needs.
        """
        with _naming(axis, "uncertainty"):
            return AxisUncertainty(self.axis(axis), start_memory)

    def streams(self, start_memory: StartMemory = "end") -> StageStream:
        """Return a causal compensator of all axes, ``step(t, {axis: y}) -> {axis: v}``, seconds and metres to volts.

        UsageError if the model of an axis is not causal.
        """
        streams = {name: axis.stream(start_memory=start_memory) for name, axis in self.axes.items()}
        return StageStream(streams, self.coupling, self.origins)

    @cached_property
    def coupling(self) -> Coupling:
        """Cross-coupling of the axes."""
        return Coupling({name: axis.chain.gains for name, axis in self.axes.items()})

    @property
    def origins(self) -> dict[str, float]:
        """Initial displacement (m) of each axis, from which its motion is measured for cross-coupling."""
        return {name: axis.start.displacement for name, axis in self.axes.items()}

    def _signals(self, t: ArrayLike, signal: Signal, what: str) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Return validated time and signal of each axis, shape (N,) each."""
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
    """Add the names of axis and signal to error messages."""
    try:
        yield
    except SlpiError as error:
        raise type(error)(f"axis '{axis}', {what}: {error}") from None


def seconds_since(when: str, now: float) -> float | None:
    """Return the time (s) from an ISO 8601 time, UTC unless it says another, to `now` (s since 1970); None: no time."""
    try:
        then = datetime.fromisoformat(when)
    except ValueError:
        return None
    return now - (then if then.tzinfo else then.replace(tzinfo=UTC)).timestamp()


def check_time(t: ArrayLike) -> FloatArray:
    """Return `t` as an array, shape (N,), seconds; RecordError unless finite and not decreasing."""
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
        raise UsageError(f"{what} is not an array of numbers: {error}") from None


def held_message(held: Mask) -> str:
    """Return the message for unreachable displacements: number and first sample."""
    return (
        f"{np.count_nonzero(held)} of {held.size} desired displacements need a voltage beyond the limits, "
        f"first sample {int(np.argmax(held))}; held at the limit"
    )
