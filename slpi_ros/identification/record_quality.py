"""What a record is worth, before any fit: its clock, its signals, its drive."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.identification import drive
from slpi_ros.identification import signal_statistics as readings
from slpi_ros.identification.samples import NEAR_END, part_of, select_samples
from slpi_ros.io.record import Record

FloatArray = NDArray[np.float64]

# Steps in time that are longer than this many periods: samples are missing; a whole gap.
_LOST, _GAP = 1.5, 5.0
# A voltage is smooth only up to this share of its range: what computed it may be made of pieces.
_LEAST_SPIKE = 0.001


@dataclass(frozen=True)
class ClockQuality:
    """The stamps of a record.

    Parameters
    ----------
    samples : int
    duration, period : float, seconds
        From first to last, and from one to the next in the middle of all.
    jitter : float, seconds
        Standard deviation of the steps, missing samples apart.
    lost : int
        Samples that are missing between others.
    gaps : int
        Steps of more than five periods.
    longest_gap : float, seconds
        The longest step.
    duplicates : int
        Stamps that come again.
    unseen : int
        Gaps within which the voltage moved: it may have turned there.
    """

    samples: int
    duration: float
    period: float
    jitter: float
    lost: int
    gaps: int
    longest_gap: float
    duplicates: int
    unseen: int


@dataclass(frozen=True)
class SignalQuality:
    """The readings of a voltage (V) or a displacement (m).

    Parameters
    ----------
    low, high : float
        The range.
    noise : float
        Rms of what changes from reading to reading.
    digit : float
        Step between possible readings; 0 for none that could be found.
    missing : int
        Readings that are NaN.
    stuck : int
        Readings that repeat the one before for three and more in a row, though the other signal moves.
    longest_stuck : int
        The longest such row.
    clipped : int
        Those of them at the lowest or the highest value.
    stale : int
        Single readings that repeat an earlier one, though the other signal moves.
    spikes : int
        Single readings that stand out otherwise.
    """

    low: float
    high: float
    noise: float
    digit: float
    missing: int
    stuck: int
    longest_stuck: int
    clipped: int
    stale: int
    spikes: int

    @property
    def range(self) -> float:
        """From the lowest to the highest value."""
        return self.high - self.low


@dataclass(frozen=True)
class DriveQuality:
    """What the voltage does.

    Parameters
    ----------
    turns : int
        Reversals.
    covered : float
        Share of all pairs of last turning point and present voltage that were visited.
    samples_per_run : float
        Samples from one turn to the next, in the middle of all.
    speeds : tuple of float, V/s
        At which swings of one size were run through.
    holds : tuple of float, seconds
        How long the voltage rested, each time that it did.
    begins_at_end : bool
        Whether the record begins at an end of its voltage range, so that the memory is known from there on.
    wiped : float or None, seconds
        When both ends have been visited, which wipes the memory; None if never.
    """

    turns: int
    covered: float
    samples_per_run: float
    speeds: tuple[float, ...]
    holds: tuple[float, ...]
    begins_at_end: bool
    wiped: float | None


@dataclass(frozen=True)
class Quality:
    """What a record of one axis is worth; `findings` says it in words.

    Parameters
    ----------
    axis : str
    clock : ClockQuality
    voltage, displacement : SignalQuality
    drive : DriveQuality
    notes : tuple of str
        Those of the record.
    """

    axis: str
    clock: ClockQuality
    voltage: SignalQuality
    displacement: SignalQuality
    drive: DriveQuality
    notes: tuple[str, ...]


def assess(record: Record, axis: str, *, start: float | None = None, stop: float | None = None) -> Quality:
    """Measure what a record is worth for an identification.

    Parameters
    ----------
    record : Record
    axis : str
        One of its axes.
    start, stop : float, seconds, optional
        The part to be fitted, as for `identify`; voltage before it belongs to the drive.

    Returns
    -------
    Quality

    Raises
    ------
    UsageError
        If the record has no such axis.
    RecordError, IdentificationError
        If it is no record of a driven axis: too few samples, out of order, without motion, in wrong units.
    """
    samples = select_samples(record, axis, start, stop)
    driving, wiped = samples.v, np.flatnonzero(samples.wiped)[:1]
    # A long record leaves no room for what is not needed any more.
    del samples
    t, v, y = record.t, record.voltage[axis], record.displacement[axis]
    part = slice(*part_of(t, start, stop))
    until = slice(0, part.stop)
    driven = np.isfinite(v[until])
    when = t[until] if driven.all() else t[until][driven]
    voltage, displacement = _signals(t[part], v[part], y[part])
    return Quality(
        axis=axis,
        clock=_clock(t[part], v[part], NEAR_END * voltage.range),
        voltage=voltage,
        displacement=displacement,
        drive=_drive(when, driving, voltage, float(when[wiped[0]]) if wiped.size else None),
        notes=record.notes,
    )


def _clock(t: FloatArray, v: FloatArray, still: float) -> ClockQuality:
    steps = np.diff(t)
    period = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    lost = steps > _LOST * period
    gaps = np.flatnonzero(steps > _GAP * period)
    regular = steps[~lost & (steps > 0.0)]
    return ClockQuality(
        samples=t.size,
        duration=float(t[-1] - t[0]),
        period=period,
        jitter=float(np.std(regular)) if regular.size else 0.0,
        lost=int(np.sum(np.rint(steps[lost] / period) - 1.0)) if period else 0,
        gaps=int(gaps.size),
        longest_gap=float(steps.max(initial=0.0)),
        duplicates=int(np.count_nonzero(steps == 0.0)),
        unseen=int(np.count_nonzero(np.abs(v[gaps + 1] - v[gaps]) > still)),
    )


def _signals(t: FloatArray, v: FloatArray, y: FloatArray) -> tuple[SignalQuality, SignalQuality]:
    """Return the quality of voltage and displacement, shape (N,) each."""
    both = np.isfinite(v) & np.isfinite(y)
    missing = [int(np.count_nonzero(~np.isfinite(signal))) for signal in (v, y)]
    if not both.all():
        t, v, y = t[both], v[both], y[both]
    gain = readings.spread(y) / readings.spread(v)
    noise_v, noise_y = readings.noise(v, t), readings.noise(y, v, t)
    digit_v, digit_y = readings.digit(v), readings.digit(y)
    stopped = readings.stopped(v, y, gain, noise_y)
    frozen = readings.frozen(y, v, gain, noise_y, digit_y)
    off_v = readings.lone_outliers(v, y, 1.0 / gain, max(noise_v, digit_v, _LEAST_SPIKE * np.ptp(v)), noise_y)
    off_y = readings.lone_outliers(y, v, gain, max(noise_y, digit_y), noise_v)
    # Of two that stand out at once it is the driver that jumped, and the other one followed.
    off_y = np.setdiff1d(off_y, off_v)
    return (
        _signal(v, missing[0], noise_v, digit_v, stopped, off_v),
        _signal(y, missing[1], noise_y, digit_y, frozen, off_y),
    )


def _signal(
    x: FloatArray,
    missing: int,
    noise: float,
    digit: float,
    repeats: readings.Repeats,
    outliers: NDArray[np.int64],
) -> SignalQuality:
    low, high = float(x.min()), float(x.max())
    several = repeats.where(repeats.length > 2)
    single = repeats.where(repeats.length == 2)
    ends = several.where(np.isin(x[several.first], (low, high)))
    stale = np.union1d(readings.stale(x, outliers, noise), single.first + 1)
    return SignalQuality(
        low=low,
        high=high,
        noise=noise,
        digit=digit,
        missing=missing,
        stuck=several.readings,
        longest_stuck=int(several.length.max(initial=0)),
        clipped=ends.readings,
        stale=int(stale.size),
        spikes=int(np.setdiff1d(outliers, stale).size),
    )


def _drive(t: FloatArray, v: FloatArray, voltage: SignalQuality, wiped: float | None) -> DriveQuality:
    runs = drive.Runs.of(t, v, drive.smallest_turn(v, voltage.noise))
    near = NEAR_END * np.ptp(v)
    return DriveQuality(
        turns=runs.turns,
        covered=drive.covered(v, runs),
        samples_per_run=float(np.median(np.diff(runs.ends))),
        speeds=runs.speeds,
        holds=tuple(drive.holds(t, v, drive.hold_band(v, voltage.noise, voltage.digit)).tolist()),
        begins_at_end=bool(min(v[0] - v.min(), v.max() - v[0]) <= near),
        wiped=wiped,
    )
