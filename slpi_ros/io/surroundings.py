"""Scalar quantities that a bag holds beside the stage: temperature, humidity, pressure, force, other stages."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from slpi_ros.arrays import FloatArray, IntArray, Mask
from slpi_ros.errors import RecordError
from slpi_ros.io.alignment import Signals
from slpi_ros.io.input_limits import LimitError
from slpi_ros.io.messages import JOINT_STATE, QUANTITY_TYPES, SECOND_NS, kind_of, read_message
from slpi_ros.io.record import Course

# Topics of one stage itself: what goes with its displacement, or with the error of a model, is no cause of it.
OWN = (
    "desired_displacement",
    "measured_displacement",
    "tracking_error",
    "displacement_uncertainty",
    "recorded_trajectory",
    "voltage_command",
)
# Largest number of quantities that are read without being named.
MOST = 64
# Readings are smoothed from this number on, and as far as their white noise exceeds this share of their range; of more
# than `MOST_READINGS` the means of equal numbers are taken.
FEWEST_READINGS, NOISY, MOST_READINGS = 12, 2e-3, 700
# What smoothing takes away is noise if its rms is at most this multiple of that.
IS_NOISE = 1.3
# Ratio of the median magnitude of second differences of white noise to its standard deviation.
SECOND_DIFFERENCES = 0.6745 * 6.0**0.5
# A reading of a larger magnitude is missing: its square is no number.
LARGEST = 1e100
# Of at least this number of readings, up to so many in a row are no readings of the quantity if they are beyond the
# range of nearly all others, between these quantiles, by this multiple of it.
FEWEST_TO_JUDGE, IN_A_ROW, USUAL, FAR = 20, 2, (0.05, 0.95), 5.0


class Chosen(NamedTuple):
    """A topic, and the field of its messages; "" for all fields."""

    topic: str
    field: str

    @classmethod
    def of(cls, text: str) -> "Chosen":
        """Return the choice that ``TOPIC[:FIELD]`` names."""
        topic, _, field = text.partition(":")
        return cls(topic, field)


def key_of(topic: str, field: str, msgtype: str) -> str:
    """Return the name of a quantity: its topic, and the field where the messages have several."""
    return f"{topic}:{field}" if QUANTITY_TYPES[msgtype].named else topic


def topics_beside(types: Mapping[str, str], stage: str) -> list[str]:
    """Return the topics with quantities, by their types, beside the topic `stage` of the stage itself.

    Of joint states only those of other stages: topics of the same last name.
    """
    last = stage.rsplit("/", 1)[-1]
    found = []
    for topic, msgtype in types.items():
        name = topic.rsplit("/", 1)[-1]
        if topic == stage or msgtype not in QUANTITY_TYPES or name in OWN:
            continue
        if msgtype != JOINT_STATE or name == last:
            found.append(topic)
    return sorted(found)


def courses(signals: Signals, chosen: Chosen, msgtype: str, since_start: FloatArray) -> Iterator[tuple[str, Course]]:
    """Yield name and course of each quantity of a topic with a value; RecordError if it lacks the chosen field.

    `chosen` holds the full name of the topic, and `since_start` are the times of `since_start_of`.
    """
    kind, order = QUANTITY_TYPES[msgtype], np.argsort(since_start, kind="stable")
    fields = {
        f"{field}.{name}" if kind.named else field: column
        for field, columns in signals.fields.items()
        for name, column in columns.items()
    }
    if chosen.field and chosen.field not in fields:
        raise RecordError(
            f"topic '{chosen.topic}' has no field '{chosen.field}'; its messages, {msgtype}, have {', '.join(fields)}"
        )
    for field, column in fields.items():
        if (not chosen.field or field == chosen.field) and np.isfinite(column).any():
            yield key_of(chosen.topic, field, msgtype), (since_start[order], np.array(column)[order])


def since_start_of(signals: Signals, first_ns: int, state: Signals) -> FloatArray:
    """Return the times (s), shape (n,), of messages from the first stamp (ns) of a record of the messages `state`.

    They are the header stamps if both have them, on one clock. Else they are the times of recording, less the usual
    delay between stamp and recording of `state`.
    """
    stamp, of_state = signals.stamp, state.stamp
    if stamp is not None and of_state is not None and _overlap(stamp, of_state):
        times: IntArray = stamp
    elif of_state is not None and of_state.min() <= first_ns <= of_state.max():
        times = signals.logged - round(float(np.median(state.logged - of_state)))
    else:
        times = signals.logged
    return (times - first_ns) / SECOND_NS


def _overlap(one: IntArray, other: IntArray) -> bool:
    return bool(max(one.min(), other.min()) <= min(one.max(), other.max()))


def value_of(data: bytes, msgtype: str, field: str) -> float | None:
    """Return the value in a serialised message; None if it cannot be decoded or has no such field."""
    try:
        message = read_message(data, msgtype)
    except (struct.error, UnicodeDecodeError, MemoryError, LimitError):
        return None
    if not kind_of(msgtype).named:
        (values,) = message.values.values()
        return float(values[0])
    part, _, name = field.partition(".")
    if part not in message.values or name not in message.names:
        return None
    values, place = message.values[part], message.names.index(name)
    return float(values[place]) if place < values.size else None


def clean(course: Course) -> Course:
    """Return a course without missing and wild readings, at increasing times."""
    t, value = course
    known = np.isfinite(t) & (np.abs(value) < LARGEST)
    t, value = t[known], value[known]
    later = np.diff(t, prepend=-np.inf) > 0.0
    t, value = t[later], value[later]
    kept = ~wild(value)
    return t[kept], value[kept]


def wild(value: FloatArray) -> Mask:
    """Return which readings, (n,), are no readings of the quantity: single ones far from all others, shape (n,)."""
    # A thermometer that has just been switched on says 85 degrees, one without contact -127.
    if value.size < FEWEST_TO_JUDGE:
        return np.zeros(value.size, dtype=bool)
    low, high = np.quantile(value, USUAL)
    far = (value < low - FAR * (high - low)) | (value > high + FAR * (high - low))
    ends = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]]).astype(np.int8)))
    for begin, end in ends.reshape(-1, 2).tolist():
        far[begin:end] &= end - begin <= IN_A_ROW
    # What is constant but for single readings is not known to be without them.
    return np.asarray(far & (high > low), dtype=bool)


def smoothed(course: Course) -> Course:
    """Return the readings of a `clean` course without most of their noise: between them the quantity is linear."""
    t, value = course
    # An error of the quantity itself makes its gain look smaller: by the share of the noise in its variance.
    if t.size < FEWEST_READINGS:
        return t, value
    noise = float(np.median(np.abs(np.diff(value, 2)))) / SECOND_DIFFERENCES
    if not noise > NOISY * float(np.ptp(value)):
        return t, value
    from scipy.interpolate import make_smoothing_spline

    each = -(-t.size // MOST_READINGS)
    whole = t.size // each * each
    at, means = (x[:whole].reshape(-1, each).mean(axis=1) for x in (t, value))
    # The weight of the roughness is chosen by generalised cross-validation, in units of the readings' interval.
    x, scale = (at - at[0]) / float(np.median(np.diff(at))), float(np.std(means)) or 1.0
    smooth = means.mean() + scale * make_smoothing_spline(x, (means - means.mean()) / scale)(x)
    # A load that is put on and taken off has corners, which are no noise.
    taken = value - np.interp(t, at, smooth)
    return (at, smooth) if np.std(taken) <= IS_NOISE * noise else (t, value)


def named_in(surroundings: Mapping[str, Course], wanted: Sequence[str]) -> dict[str, Course]:
    """Return the quantities that ``TOPIC[:FIELD]`` name, with or without leading slash and namespace."""
    found = {}
    for text in wanted:
        topic, field = Chosen.of(text)
        for key, course in surroundings.items():
            own, _, own_field = key.partition(":")
            same = own == topic or own.endswith("/" + topic.strip("/"))
            if same and (not field or not own_field or field == own_field):
                found[key] = course
    return found
