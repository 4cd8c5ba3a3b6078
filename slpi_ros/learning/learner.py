"""A path that repeats: from what each pass measured, what to ask of the compensator in the next one."""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import ModelError, UsageError, length
from slpi_ros.io.atomic_file import all_or_nothing
from slpi_ros.io.input_limits import MODEL_BYTES, read_input
from slpi_ros.io.schemas import format_document, validate
from slpi_ros.io.stage_name import stage_name
from slpi_ros.learning.axis_learner import AxisLearner, PassReport
from slpi_ros.model.document import format_model
from slpi_ros.model.stage_model import Signal, StageModel, check_time

SCHEMA = "slpi_ros/learned/2"
# Fewest samples of a pass, and largest deviation of a sampling interval from their mean.
FEWEST, UNEVEN = 8, 0.2


class Learner:
    """Learns the correction of a path that repeats, pass by pass, harmonic by harmonic.

    The correction is made to the desired path, before the inverse, so that what is learned is nearly linear. Each
    harmonic has a complex gain that is learned, too, see `slpi_ros.learning.harmonics.Harmonics`; the rules that keep
    learning from doing harm are in `slpi_ros.learning.axis_learner.AxisLearner`.

    Parameters
    ----------
    model : StageModel
        The model with which the path is compensated.
    t : array_like, shape (N,), seconds
        Evenly spaced times of one pass. A path that closes is taken to go on without a pause.
    desired : array_like, shape (N,), or mapping of axis name to array_like, shape (N,), metres
        The desired path.
    axis : str, optional
        The axis that an array without name is of; default: that of a model with one axis.
    learn_limit : float or mapping of axis name to float, optional, metres
        Most that learning may add to the desired path; default: a quarter of the identified stroke.
    limits : (float, float), optional, volts
        Voltage limits; default: the identified voltage range of each axis.

    Raises
    ------
    UsageError
        If an axis, a length or a value does not fit, or the path is far from the range of the model.
    """

    def __init__(
        self,
        model: StageModel,
        t: ArrayLike,
        desired: Signal,
        *,
        axis: str | None = None,
        learn_limit: float | Mapping[str, float] | None = None,
        limits: tuple[float, float] | None = None,
    ) -> None:
        self.model, self._named = model, isinstance(desired, Mapping)
        self.t = check_time(t)
        if self.t.size < FEWEST:
            raise UsageError(f"a pass of {self.t.size} samples is too short; give at least {FEWEST}")
        # The same for the same path at any time of day.
        dt = self._interval = round(float(self.t[-1] - self.t[0]) / (self.t.size - 1), 12)
        if not dt > 0.0 or float(np.abs(np.diff(self.t) - dt).max()) > UNEVEN * dt:
            raise UsageError("the times of a pass are not evenly spaced; interpolate the path at even times")
        most = dict(learn_limit) if isinstance(learn_limit, Mapping) else dict.fromkeys(model.axes, learn_limit)
        for name, each in most.items():
            model.axis(name)
            number = isinstance(each, (int, float, np.number)) and not isinstance(each, bool)
            if each is not None and not (number and 0.0 < each < np.inf):
                raise UsageError(f"learn_limit is {each!r}; give a positive number of metres")
        self._default = axis or (next(iter(model.axes)) if len(model.axes) == 1 else "")
        self.axes: dict[str, AxisLearner] = {}
        for name, path in self._by_axis(desired, "desired").items():
            if not np.isfinite(path).all():
                raise UsageError(f"axis '{name}': the desired path holds values that are not finite; leave them out")
            one = model.axis(name)
            (low, high), reached = one.displacement_range, (float(path.min()), float(path.max()))
            if max(low - reached[0], reached[1] - high) > high - low:
                raise UsageError(
                    f"axis '{name}': the desired path goes from {length(reached[0])} to {length(reached[1])}, the "
                    f"model from {length(low)} to {length(high)}; give a path within that, in metres"
                )
            self.axes[name] = AxisLearner(one, dt, path, most.get(name), _allowed(name, one.voltage_range, limits))
        if not self.axes:
            raise UsageError("desired holds no axis; give the path of one at least")

    def path(self) -> Any:
        """Return what to compensate in the next pass, metres, in the form of `desired`; at first the desired path."""
        return self._in_form({name: axis.path for name, axis in self.axes.items()})

    def update(
        self,
        measured: Signal,
        voltage: Signal | None = None,
        *,
        followed: Signal | None = None,
        unusable: Mapping[str, str] | None = None,
    ) -> Any:
        """Learn from the pass that has just ended.

        Parameters
        ----------
        measured : as `desired`, metres
            Readings of the sensors at the times of the pass; NaN where there is none.
        voltage : as `desired`, optional, volts
            Voltage in the pass, NaN where it is not known: a pass that a limit held back is not learned from.
        followed : as `desired`, optional, metres
            What was asked of the compensator in the pass; default: the last `path`. A pass that had begun before `path`
            was known, or that was repeated by hand, followed an earlier one. A pass of another path, more than
            `learn_limit` from this one, is not learned from.
        unusable : mapping of axis name to str, optional
            Why the pass is not to be learned from, if that is known: a limit held the voltage back.

        Returns
        -------
        PassReport, or dict of axis name to PassReport
            In the form of `desired`.
        """
        seen = self._by_axis(measured, "measured")
        applied = {} if voltage is None else self._by_axis(voltage, "voltage")
        if missing := self.axes.keys() - seen.keys():
            raise UsageError(f"no readings of axis '{min(missing)}'; give those of every axis of the path")
        asked = {} if followed is None else self._by_axis(followed, "followed")
        for name, path in asked.items():
            if not np.isfinite(path).all():
                raise UsageError(f"axis '{name}': followed holds values that are not finite; leave the pass out")
        why = unusable or {}
        return self._in_form(
            {
                name: axis.update(seen[name], applied.get(name), asked.get(name), why.get(name, ""))
                for name, axis in self.axes.items()
            }
        )

    @property
    def passes(self) -> dict[str, list[PassReport]]:
        """Figures of all passes, by axis."""
        return {name: list(axis.passes) for name, axis in self.axes.items()}

    def forget(self) -> None:
        """Begin again from the desired path."""
        self.axes = {name: axis.begun_again() for name, axis in self.axes.items()}

    def to_document(self) -> dict[str, Any]:
        """Return what was learned as a JSON document (schema ``learned``), with the identity of path and model."""
        return {
            "schema": SCHEMA,
            "hardware_id": self.model.hardware_id,
            "interval_s": self._interval,
            "path": path_identity(self.t, {name: axis.desired for name, axis in self.axes.items()}),
            "axes": {name: {"model": self._identity(name)} | axis.to_document() for name, axis in self.axes.items()},
        }

    def resume(self, document: Mapping[str, Any], source: str = "learned") -> list[str]:
        """Go on from a document of the same stage and path; return remarks.

        Of another model, learning begins again from the correction of the path. ModelError, which begins with `source`,
        if the document is not valid, or of another stage or path; then nothing of it is taken over.
        """
        check_version(document, source)
        try:
            json.dumps(document, allow_nan=False)
        except ValueError:
            raise ModelError(f"{source}: a number in it is not finite; learn the path again") from None
        if stage_name(document["hardware_id"]) != stage_name(self.model.hardware_id):
            raise ModelError(
                f"{source}: learned on stage '{document['hardware_id']}', the model is of '{self.model.hardware_id}'; "
                "learn the path of this stage again"
            )
        own = path_identity(self.t, {name: axis.desired for name, axis in self.axes.items()})
        if document["path"] != own or document["axes"].keys() != self.axes.keys():
            raise ModelError(f"{source}: learned for another path; give the file of this path, or learn it again")
        remarks, axes = [], {name: axis.begun_again() for name, axis in self.axes.items()}
        for name, axis in axes.items():
            learned = document["axes"][name]
            same = learned["model"] == self._identity(name)
            try:
                axis.resume(learned, same_model=same)
            except ModelError as error:
                raise ModelError(f"{source}: axis '{name}': {error}") from None
            except (ArithmeticError, LookupError, TypeError, ValueError) as error:
                what = f"it has no {error}" if isinstance(error, KeyError) else "its numbers do not belong together"
                raise ModelError(f"{source}: axis '{name}': {what}; learn the path again") from None
            if not same:
                remarks.append(f"axis '{name}': another model; learned anew, from the correction of the path so far")
        self.axes = axes
        return remarks

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the document of what was learned to a file, atomically; ModelError if it cannot be written."""
        text = format_document(self.to_document(), "learned")
        with all_or_nothing(path, ModelError) as file:
            file.write(text)

    def load(self, path: str | os.PathLike[str]) -> list[str]:
        """Go on from a file that `save` wrote; return remarks. ModelError as `resume`, or if it cannot be read."""
        return self.resume(read_learned(path), str(path))

    def _identity(self, axis: str) -> str:
        return hashlib.sha256(format_model(StageModel({axis: self.model.axes[axis]})).encode()).hexdigest()

    def _by_axis(self, signal: Signal, what: str) -> dict[str, FloatArray]:
        if not isinstance(signal, Mapping):
            if not self._default:
                raise UsageError(
                    f"the model holds axes {', '.join(self.model.axes)}; give {what} as a mapping of axis name to "
                    "array, or name the axis"
                )
            signal = {self._default: signal}
        found: dict[str, FloatArray] = {}
        for name, values in signal.items():
            self.model.axis(name)
            try:
                if np.iscomplexobj(values):
                    raise TypeError("it is complex")
                found[name] = np.array(values, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise UsageError(f"axis '{name}': {what} is not an array of numbers: {error}") from None
            if found[name].shape != self.t.shape:
                raise UsageError(
                    f"axis '{name}': {what} has shape {found[name].shape}, the pass has {self.t.shape}; give one value "
                    "for each time"
                )
        return found

    def _in_form(self, by_axis: dict[str, Any]) -> Any:
        return by_axis if self._named else next(iter(by_axis.values()))


def _allowed(name: str, own: tuple[float, float], limits: Any) -> tuple[float, float]:
    """Return the voltage limits (V) within the identified range of an axis."""
    if limits is None:
        return own
    try:
        low, high = (float(each) for each in limits)
    except (TypeError, ValueError):
        raise UsageError(f"limits are {limits!r}; give two voltages, the lower one first") from None
    sound = low < high
    low, high = max(own[0], low), min(own[1], high)
    if not (sound and low < high):
        raise UsageError(
            f"axis '{name}': limits {limits!r} leave nothing of the identified range {own[0]:g} to {own[1]:g} V; give "
            "two voltages, the lower one first"
        )
    return low, high


def path_identity(t: FloatArray, desired: Mapping[str, FloatArray]) -> str:
    """Return a hash of a path, (N,), s and m by axis, whatever its stamp: times to 1 us, displacements to 1 pm."""
    digest = hashlib.sha256(np.round(1e6 * (t - t[0])).astype(np.int64).tobytes())
    for name in sorted(desired):
        digest.update(name.encode() + np.round(1e12 * desired[name]).astype(np.int64).tobytes())
    return digest.hexdigest()


def check_version(document: object, source: str) -> None:
    """Raise ModelError if a document, as from ``json.loads``, is of another version, or not valid."""
    version = document.get("schema", SCHEMA) if isinstance(document, Mapping) else SCHEMA
    if version != SCHEMA:
        raise ModelError(f"{source}: of version {str(version)[:60]!r}, this one reads {SCHEMA}; learn the path again")
    validate(document, "learned", source)


def read_learned(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a document of what was learned from a file; ModelError if it is none."""
    try:
        document = json.loads(read_input(path, MODEL_BYTES).decode())
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no JSON document"
        raise ModelError(f"{path}: cannot read what was learned: {reason}; leave it out to learn again") from None
    check_version(document, str(path))
    found: dict[str, Any] = document
    return found
