"""Assessment of a record before a fit: time stamps, signals and excitation."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import minimum_filter1d

from slpi_ros.arrays import FloatArray, IntArray
from slpi_ros.errors import IdentificationError, length
from slpi_ros.identification import bad_readings, drive, signal_statistics
from slpi_ros.identification.drive import SPEED_FACTOR
from slpi_ros.identification.held_readings import Held, held_readings, left_out, slower_sensor
from slpi_ros.identification.samples import NEAR_END, NEVER_TURNS, WINDOW, bounds, select_thinned, windows
from slpi_ros.io.record import Record, release

# Time steps, in periods, above which samples are missing, and above which the step is a gap.
_LOST, _GAP = 1.5, 5.0
# Samples to which the drive of a record longer than `WINDOW` is thinned, besides its reversals.
_DRIVE_SAMPLES = 500_000
# Change of the voltage from reading to reading beside that over two, from which there are two signals.
_ALTERNATES = 10.0
# Median change of a voltage from sample to sample, as a share of its range, of one that jumps from turn to turn.
_JUMPS = 0.01
# Number of samples within which stamps recover after a late stamp.
_CATCHES_UP = 51


@dataclass(frozen=True)
class ClockQuality:
    """Quality of the time stamps of a record; times in seconds."""

    samples: int
    duration: float
    period: float  # median
    jitter: float  # standard deviation of the time steps, without those at missing samples
    lost: int  # missing samples
    gaps: int  # steps of more than five periods
    longest_gap: float
    duplicates: int  # samples with the stamp of the preceding one
    unseen: int  # gaps within which the voltage moved: reversals may be missing


@dataclass(frozen=True)
class SignalQuality:
    """Quality of the readings of a voltage (V) or a displacement (m)."""

    low: float
    high: float
    noise: float  # rms, from reading to reading
    digit: float  # resolution; 0: none found
    missing: int  # NaN or infinite
    stuck: int  # repeated readings in runs of three or more while the other signal moves
    longest_stuck: int
    clipped: int  # stuck readings at the lowest or the highest value
    stale: int  # single readings that repeat an earlier one while the other signal moves
    spikes: int  # other single outliers
    mixed: int = 0  # early, late or a mixture of two neighbouring values
    mixed_share: float = 0.0  # of those tested, which are not next to a reversal
    infinite: int = 0
    mixed_size: float = 0.0  # typical largest error: half the change between the neighbours
    alternating: bool = False  # every other reading belongs to another signal
    held: float = 1.0  # samples for which each reading is repeated; the other figures are those of fresh readings

    @property
    def range(self) -> float:
        """Difference between the highest and the lowest reading."""
        return self.high - self.low


@dataclass(frozen=True)
class DriveQuality:
    """Properties of the excitation voltage."""

    turns: int  # reversals
    covered: float  # share of all pairs of last reversal voltage and present voltage that were visited
    samples_per_run: float  # median, between reversals
    usual_step: float  # median change from sample to sample, share of the range
    speeds: tuple[float, ...]  # V/s, of runs in one direction with about equal voltage change, as in `Runs`
    rising: tuple[float, float]  # V/s, of the slowest and the fastest rising run; zeros: none
    falling: tuple[float, float]
    holds: tuple[float, ...]  # s
    begins_at_end: bool  # at an end of its voltage range: the initial state is known
    after_reset: float | None  # s, by when both ends were visited, which resets the hysteresis state

    @property
    def speed_range(self) -> tuple[float, float]:
        """Speeds (V/s) of the slowest and the fastest run."""
        ways = [way for way in (self.rising, self.falling) if way[1] > 0.0] or [(0.0, 0.0)]
        return min(slowest for slowest, _ in ways), max(fastest for _, fastest in ways)


@dataclass(frozen=True)
class Quality:
    """Quality of the record of one axis; `findings` describes it in sentences."""

    axis: str
    clock: ClockQuality
    voltage: SignalQuality
    displacement: SignalQuality
    drive: DriveQuality
    notes: tuple[str, ...]  # how the record was made


def assess(record: Record, axis: str, *, start: float | None = None, stop: float | None = None) -> Quality:
    """Assess the quality of a record for an identification.

    Parameters
    ----------
    record : Record
        Record to assess.
    axis : str
        Name of one of its axes.
    start, stop : float, seconds, optional
        Part to be fitted, as for `identify`; the assessment of the excitation includes the voltage before `start`.

    Returns
    -------
    Quality
        Quality of stamps, signals and excitation.

    Raises
    ------
    UsageError
        If the record has no such axis.
    RecordError, IdentificationError
        If no fit is possible: too few samples, unordered stamps, no motion, or wrong units.
    """
    samples, at = select_thinned(record, axis, start, stop, WINDOW if len(record) <= WINDOW else _DRIVE_SAMPLES)
    after_reset = np.flatnonzero(samples.after_reset)[:1]
    first, until = bounds(record, start, stop)
    stamps, v, y = record.time_ns, record.voltage[axis], record.displacement[axis]
    before, clocks, voltages, displacements = left_out(record, axis), [], [], []
    for begin, end in windows(v, first, until) if until - first > WINDOW else [(first, until)]:
        # Windows of a long record share a sample, so that every time step is counted.
        part = slice(max(begin - 1, first), end)
        t = (stamps[part] - stamps[0]) * 1e-9
        held = Held(before.fresh[part], before.rows) if before else None
        voltage, displacement = _signals(t, v[part], y[part], held)
        clocks.append(_clock(t, v[part], NEAR_END * voltage.range))
        voltages.append(voltage)
        displacements.append(displacement)
        release(stamps, v, y)
    voltage = _whole_signal(voltages)
    when = (stamps[at] - stamps[0]) * 1e-9
    return Quality(
        axis=axis,
        clock=_whole_clock(clocks),
        voltage=voltage,
        displacement=_whole_signal(displacements),
        drive=_drive(when, samples.v, at, voltage, float(when[after_reset[0]]) if after_reset.size else None),
        notes=record.notes,
    )


def _whole_clock(parts: list[ClockQuality]) -> ClockQuality:
    """Return the quality of stamps examined in parts that share a sample."""
    if len(parts) == 1:
        return parts[0]
    totals = {name: sum(getattr(part, name) for part in parts) for name in ("lost", "gaps", "duplicates", "unseen")}
    return ClockQuality(
        samples=sum(part.samples for part in parts) - len(parts) + 1,
        duration=sum(part.duration for part in parts),
        period=float(np.median([part.period for part in parts])),
        jitter=float(np.sqrt(np.mean([part.jitter**2 for part in parts]))),
        longest_gap=max(part.longest_gap for part in parts),
        **totals,
    )


def _whole_signal(parts: list[SignalQuality]) -> SignalQuality:
    """Return the quality of readings examined in parts: sums of counts, medians of noise, resolution and sizes."""
    if len(parts) == 1:
        return parts[0]
    counts = ("missing", "infinite", "stuck", "clipped", "stale", "spikes", "mixed")
    sizes = [part.mixed_size for part in parts if part.mixed]
    return SignalQuality(
        low=min(part.low for part in parts),
        high=max(part.high for part in parts),
        noise=float(np.median([part.noise for part in parts])),
        digit=float(np.median([part.digit for part in parts])),
        longest_stuck=max(part.longest_stuck for part in parts),
        held=float(np.median([part.held for part in parts])),
        alternating=all(part.alternating for part in parts),
        mixed_share=float(np.mean([part.mixed_share for part in parts])),
        mixed_size=float(np.median(sizes)) if sizes else 0.0,
        **{name: sum(getattr(part, name) for part in parts) for name in counts},
    )


def _clock(t: FloatArray, v: FloatArray, still: float) -> ClockQuality:
    steps = np.diff(t)
    period = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0
    late = steps > _LOST * period
    gaps = np.flatnonzero(steps > _GAP * period)
    regular = steps[~late & (steps > 0.0)]
    return ClockQuality(
        samples=t.size,
        duration=float(t[-1] - t[0]),
        period=period,
        jitter=float(np.std(regular)) if regular.size else 0.0,
        lost=_missing(steps / period) if period else 0,
        gaps=int(gaps.size),
        longest_gap=float(steps.max(initial=0.0)),
        duplicates=int(np.count_nonzero(steps == 0.0)),
        unseen=int(np.count_nonzero(np.abs(v[gaps + 1] - v[gaps]) > still)),
    )


def _missing(steps: FloatArray) -> int:
    """Return the number of missing samples, from the steps between stamps in sampling periods, shape (N - 1,)."""
    # Only a lasting delay counts: if a late stamp is followed by shorter steps, no sample is missing.
    behind = np.cumsum(np.maximum(steps, 0.0) - 1.0)
    stays = minimum_filter1d(behind, _CATCHES_UP, origin=-((_CATCHES_UP - 1) // 2), mode="nearest")
    rises = np.rint(np.diff(stays, prepend=0.0))
    return int(rises[rises > 0.0].sum())


def _signals(t: FloatArray, v: FloatArray, y: FloatArray, before: Held | None) -> tuple[SignalQuality, SignalQuality]:
    """Return the quality of voltage and displacement, shape (N,) each; `before`: held readings that were left out."""
    both = np.isfinite(v) & np.isfinite(y)
    missing = [int(np.count_nonzero(~np.isfinite(signal))) for signal in (v, y)]
    if before:
        missing[1] -= int(np.count_nonzero(~before.fresh))
    infinite = [int(np.count_nonzero(np.isinf(signal))) for signal in (v, y)]
    if not both.all():
        t, v, y = t[both], v[both], y[both]
    # The voltage returns with every second reading.
    twice = float(np.median(np.abs(np.diff(v)))) > _ALTERNATES * float(np.median(np.abs(v[2:] - v[:-2])))
    held = held_readings(y, v)
    t, v, y = t[held.fresh], v[held.fresh], y[held.fresh]
    far_v, far_y = bad_readings.far_outliers(v, y)
    v, y = bad_readings.without(v, far_v), bad_readings.without(y, far_y)
    gain = signal_statistics.spread(y) / signal_statistics.spread(v)
    noise_v, noise_y = signal_statistics.noise(v, t), signal_statistics.noise(y, v, t)
    digit_v, digit_y = signal_statistics.digit(v), signal_statistics.digit(y)
    stopped = bad_readings.stopped(v, y, gain, noise_y)
    frozen = bad_readings.frozen(y, v, gain, noise_y, digit_y)
    off_v, off_y = bad_readings.lone_of(t, v, y)
    mixed, judged, _ = bad_readings.mixed_readings(y, v)
    displacement = _signal(y, missing[1], noise_y, digit_y, frozen, off_y, mixed)
    if mixed.size:
        # Half of the displacement between the neighbouring readings.
        ways = np.abs(y[np.minimum(mixed + 1, y.size - 1)] - y[np.maximum(mixed - 1, 0)]) / 2.0
        size, share = float(np.median(ways)), mixed.size / judged
        displacement = replace(displacement, mixed=int(mixed.size), mixed_share=share, mixed_size=size)
    voltage = _signal(v, missing[0], noise_v, digit_v, stopped, off_v)
    voltage = replace(
        voltage, spikes=voltage.spikes + np.setdiff1d(far_v, off_v).size, infinite=infinite[0], alternating=twice
    )
    spikes = displacement.spikes + np.setdiff1d(far_y, off_y).size
    return voltage, replace(
        displacement, spikes=spikes, infinite=infinite[1], held=max(held.rows, before.rows if before else 1.0)
    )


def _signal(
    x: FloatArray,
    missing: int,
    noise: float,
    digit: float,
    repeats: bad_readings.Repeats,
    outliers: IntArray,
    explained: IntArray | tuple[()] = (),
) -> SignalQuality:
    low, high = float(x.min()), float(x.max())
    several = repeats.where(repeats.length > 2)
    single = repeats.where(repeats.length == 2)
    ends = several.where(np.isin(x[several.first], (low, high)))
    stale = np.setdiff1d(np.union1d(bad_readings.stale(x, outliers, noise), single.first + 1), explained)
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
        spikes=int(np.setdiff1d(np.setdiff1d(outliers, stale), explained).size),
    )


def _drive(
    t: FloatArray, v: FloatArray, at: IntArray, voltage: SignalQuality, after_reset: float | None
) -> DriveQuality:
    """Return the properties of a voltage, shape (N,), at samples `at` of a record."""
    runs = drive.Runs.of(t, v, drive.smallest_turn(v, voltage.noise))
    near = NEAR_END * np.ptp(v)
    return DriveQuality(
        turns=runs.turns,
        covered=drive.covered(v, runs),
        samples_per_run=float(np.median(np.diff(at[runs.ends]))),
        usual_step=float(np.median(np.abs(np.diff(v)))) / float(np.ptp(v)),
        speeds=runs.speeds,
        rising=runs.speed_range(1),
        falling=runs.speed_range(-1),
        holds=tuple(drive.holds(t, v, drive.hold_band(v, voltage.noise, voltage.digit)).tolist()),
        begins_at_end=bool(min(v[0] - v.min(), v.max() - v[0]) <= near),
        after_reset=after_reset,
    )


Level = Literal["ok", "warn", "stop"]

# Share of outliers below which no warning is given; a fit reduces their weights.
_OUTLIERS = 1e-3
# Jitter that gives a warning, as a share of the period.
_JITTER = 0.1
# Resolution that gives a warning, in units of the noise; averaging does not improve a coarser one.
_COARSE = 1.5
# Noise that gives a warning, as shares of the range.
_NOISY_VOLTAGE, _NOISY_DISPLACEMENT = 2e-4, 0.01
# Share of visited pairs of reversal voltage and present voltage below which a warning is given.
_FEW_PAIRS = 0.4
# Share of samples with the stamp of the one before from which two recordings may be mixed.
_DOUBLED = 0.05
# Limits beyond which no fit is possible: resolution as a share of the range, readings between reversals.
_USELESS_DIGIT, _USELESS_RUN = 0.05, 4.0


@dataclass(frozen=True)
class Finding:
    """One statement about a record, with numbers; at level "stop" no fit is possible and the text names the remedy."""

    level: Level
    text: str


def findings(quality: Quality) -> list[Finding]:
    """Describe the quality of a record and its consequences.

    Parameters
    ----------
    quality : Quality
        From `assess`.

    Returns
    -------
    list of Finding
        Findings on stamps, displacement, voltage and excitation, in this order, then the notes of the record.
    """
    samples = quality.clock.samples
    if quality.voltage.alternating:
        text = "two publishers in one topic: every other message tells of other voltages"
        return [Finding("stop", f"{text}; stop one of them, and record again")]
    return [
        *_clock_findings(quality.clock),
        *_held(quality),
        *_displacement(quality.displacement),
        *_readings("displacement", quality.displacement, samples),
        *_voltage(quality.voltage),
        *_readings("voltage", quality.voltage, samples),
        *_drive_findings(quality),
        *(Finding("warn", note) for note in quality.notes),
    ]


def missing_samples(record: Record) -> tuple[Finding, ...]:
    """Return what the stamps of a record tell of samples that it lacks, whichever axis moved; empty: none."""
    clocks = []
    for v in record.voltage.values():
        known = v[np.isfinite(v)]
        clocks.append(_clock(record.t, v, NEAR_END * float(np.ptp(known)) if known.size else 0.0))
    return tuple(_missing_findings(max(clocks, key=lambda clock: clock.unseen)))


def require_usable(found: Iterable[Finding], where: str) -> None:
    """Raise IdentificationError for the first finding of level "stop"; its message begins with `where`."""
    for finding in found:
        if finding.level == "stop":
            raise IdentificationError(f"{where}: {finding.text}")


def _warn_if(problem: bool, text: str, consequence: str) -> Finding:
    return Finding("warn", f"{text}: {consequence}") if problem else Finding("ok", text)


def _clock_findings(clock: ClockQuality) -> Iterator[Finding]:
    if clock.duplicates > 0.5 * clock.samples:
        text = f"{_of(clock.duplicates, clock.samples)} with the stamp of the one before: nothing can be said of time"
        yield Finding("warn", f"{text}; record the stamps of the sensor")
        return
    period = clock.period or 1.0
    text = f"{clock.samples} samples in {clock.duration:.6g} s, {1.0 / period:.5g} per second"
    jitter = clock.jitter / period
    yield _warn_if(jitter > _JITTER, f"{text}, jitter {jitter:.1%} of the period", "lags will be uncertain")
    yield from _missing_findings(clock)
    if clock.duplicates:
        yield Finding("warn", f"{_of(clock.duplicates, clock.samples)} with the stamp of the one before")


def _missing_findings(clock: ClockQuality) -> Iterator[Finding]:
    if clock.lost:
        text = f"{clock.lost} samples missing between {clock.samples} others, {clock.longest_gap:.4g} s at most"
        yield Finding("warn", text)
    if clock.unseen:
        yield Finding(
            "warn", f"{clock.unseen} gaps within which the voltage moved: unseen reversals leave the memory uncertain"
        )


def _held(quality: Quality) -> Iterator[Finding]:
    """Say that the sensor is slower than the record."""
    rows = quality.displacement.held
    if rows > 1.0 and quality.clock.period:
        yield Finding("warn", slower_sensor(rows, quality.clock.period))


def _displacement(y: SignalQuality) -> Iterator[Finding]:
    scatter = f"{length(y.noise)} rms" if y.noise else "below its digits"
    yield _warn_if(
        y.noise > _NOISY_DISPLACEMENT * y.range,
        f"displacement from {y.low * 1e6:.5g} to {y.high * 1e6:.5g} µm, scatter of successive readings {scatter}",
        "a large part of the range; go the same way several times",
    )
    digits = f"displacement in steps of {length(y.digit)}"
    if y.digit > max(_USELESS_DIGIT * y.range, 2.0 * y.noise):
        yield Finding("stop", f"{digits}: too coarse for a loop; set the sensor to a smaller range")
    elif y.digit > 0.1 * y.noise:
        yield _warn_if(y.digit > _COARSE * y.noise, digits, "coarser than the noise, which cannot average them out")


def _voltage(v: SignalQuality) -> Iterator[Finding]:
    text = f"voltage from {v.low:.5g} to {v.high:.5g} V"
    noisy = v.noise > _NOISY_VOLTAGE * v.range
    if noisy or v.noise > 1e-6 * v.range:
        text += f", noise {v.noise * 1e3:.3g} mV rms"
    yield _warn_if(noisy, text, "small reversals cannot be distinguished from noise")


def _readings(name: str, signal: SignalQuality, samples: int) -> Iterator[Finding]:
    if missing := signal.missing - signal.infinite:
        yield Finding("warn", f"{name} missing (nan) for {_of(missing, samples)}")
    if signal.infinite:
        yield Finding("warn", f"{name} infinite for {_of(signal.infinite, samples)}: check the link; they are not used")
    if signal.clipped:
        text = f"{name} clipped at an end of its range for {_of(signal.clipped, samples)}"
        yield Finding("warn", f"{text}: what goes further is not seen")
    if stuck := signal.stuck - signal.clipped:
        text = f"{name} stuck for {_of(stuck, samples)}, up to {signal.longest_stuck} in a row"
        yield Finding("warn", f"{text}; where noise should tell them apart they are not fitted")
    if signal.mixed:
        text = f"{name} early, late or mixed with the reading beside it in {_of(signal.mixed, samples)}"
        share = f"{100.0 * signal.mixed_share:.2g} % of those not beside a turn"
        size = f"off by up to {signal.mixed_size * 1e6:.3g} µm"
        yield Finding("warn", f"{text}, {share}, {size}: the link delivers old or mixed values; they are not fitted")
    if signal.stale:
        text = f"{name} stale, repeating an earlier reading, in {_of(signal.stale, samples)}"
        yield Finding("warn" if signal.stale > _OUTLIERS * samples else "ok", text)
    if signal.spikes:
        text = f"{name} with outliers in {_of(signal.spikes, samples)}"
        use = (
            "replaced by a line between their neighbours"
            if name == "voltage"
            else "left out of the fit unless noise or a kink may explain them"
        )
        yield Finding("warn", f"{text}: the other signal does not follow; {use}")


def _drive_findings(quality: Quality) -> Iterator[Finding]:
    drive, clock, y = quality.drive, quality.clock, quality.displacement
    if not drive.turns:
        yield Finding("stop", NEVER_TURNS)
        return
    per_run = drive.samples_per_run * (1.0 - (y.missing + y.stuck) / clock.samples)
    if per_run < _USELESS_RUN:
        rate = 25.0 / (drive.samples_per_run * clock.period)
        text = f"{per_run:.2g} readings from turn to turn"
        if clock.duplicates > _DOUBLED * clock.samples:
            yield Finding(
                "stop",
                f"{text}, {_of(clock.duplicates, clock.samples)} with the stamp of the one before: two recordings in "
                "one, after a clock was set back or from two drivers; leave that part out (--start, --stop) or record "
                "again",
            )
            return
        if drive.usual_step < _JUMPS:
            yield Finding("stop", f"{text}, as the voltage jumps from hold to hold: drive ramps, which show the loops")
            return
        yield Finding(
            "stop", f"{text}: record {float(f'{rate:.2g}'):g} samples per second or more, all of them, or drive slower"
        )
        return
    yield _warn_if(
        drive.covered < _FEW_PAIRS,
        f"{drive.turns} turns; {drive.covered:.0%} of all pairs of turning point and voltage visited",
        "loops that begin elsewhere cannot be identified; turn at more voltages",
    )
    yield _memory(drive)
    if clock.duplicates <= 0.5 * clock.samples:
        yield Finding("ok", _speeds_and_holds(drive))


def _memory(drive: DriveQuality) -> Finding:
    if drive.begins_at_end:
        return Finding("ok", "memory known: the record begins at an end of its voltage range")
    remedy = "begin with a move over the whole range"
    if drive.after_reset is None:
        return Finding("warn", f"memory unknown: the voltage never goes over its whole range; {remedy}")
    return Finding(
        "warn", f"memory unknown until {drive.after_reset:.4g} s, where both ends have been visited; {remedy}"
    )


def _speeds_and_holds(drive: DriveQuality) -> str:
    slowest, fastest = drive.speed_range
    lacking = ["lag", "delay", "rate dependence"]
    match drive.speeds:
        case ():
            text = "no two moves alike to compare speeds"
        case (speed,) if fastest <= SPEED_FACTOR * slowest:
            text = f"one speed, {speed:.3g} V/s"
        case (_,):
            text = f"moves from {slowest:.3g} to {fastest:.3g} V/s, those of one size and direction at one speed"
        case (slow, *_, fast):
            text, lacking = f"{len(drive.speeds)} speeds from {slow:.3g} to {fast:.3g} V/s", []
    if _differ(drive.rising[0], drive.falling[0]) or _differ(drive.rising[1], drive.falling[1]):
        text += f" (rising {_speeds(drive.rising)}, falling {_speeds(drive.falling)})"
    if drive.holds:
        text += f", {len(drive.holds)} hold{'s' * (len(drive.holds) > 1)} of up to {max(drive.holds):.3g} s"
    else:
        text += ", no hold"
        lacking.append("creep")
    return text + (f": cannot tell {', '.join(lacking)} from hysteresis" if lacking else "")


def _speeds(of: tuple[float, float]) -> str:
    """Return the slowest and the fastest speed (V/s) in words."""
    slowest, fastest = (f"{speed:.3g}" for speed in of)
    return f"at {fastest} V/s" if slowest == fastest else f"at {slowest} to {fastest} V/s"


def _differ(one: float, other: float) -> bool:
    """Return whether two speeds (V/s) differ; one of no run, 0, is no other speed."""
    return 0.0 < SPEED_FACTOR * min(one, other) < max(one, other)


def _of(count: int, samples: int) -> str:
    return f"{count} of {samples} samples ({100.0 * count / samples:.2g} %)"
