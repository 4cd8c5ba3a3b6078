"""The quality of a record in words: what is fine, what to watch, and what makes a fit impossible."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from slpi_ros.errors import IdentificationError
from slpi_ros.identification.record_quality import ClockQuality, DriveQuality, Quality, SignalQuality
from slpi_ros.identification.samples import NEVER_TURNS

Level = Literal["ok", "warn", "stop"]

# Fewer lone outliers than this share of the readings are no matter: a fit weighs them down.
_OUTLIERS = 1e-3
# Share of the period.
_JITTER = 0.1
# Step between readings, in noise: what is coarser hides what the noise would average out.
_COARSE = 1.5
# Shares of the range.
_NOISY_VOLTAGE, _NOISY_DISPLACEMENT = 2e-4, 0.01
# Share of the pairs of turning point and voltage.
_FEW_PAIRS = 0.4
# What no fit can mend, as a share of the range, and in readings from turn to turn.
_USELESS_DIGIT, _USELESS_RUN = 0.05, 4.0


@dataclass(frozen=True)
class Finding:
    """One sentence about a record.

    Parameters
    ----------
    level : {"ok", "warn", "stop"}
        "stop" where no fit is possible; the text says what to record instead.
    text : str
    """

    level: Level
    text: str


def findings(quality: Quality) -> list[Finding]:
    """Say what the quality of a record means.

    Parameters
    ----------
    quality : Quality
        From `assess`.

    Returns
    -------
    list of Finding
        On the clock, displacement, voltage and drive, in this order, and what was noted when the record was made.
    """
    samples = quality.clock.samples
    return [
        *_clock(quality.clock),
        *_displacement(quality.displacement),
        *_readings("displacement", quality.displacement, samples),
        *_voltage(quality.voltage),
        *_readings("voltage", quality.voltage, samples),
        *_drive(quality),
        *(Finding("warn", note) for note in quality.notes),
    ]


def require_usable(found: Iterable[Finding], where: str) -> None:
    """Raise IdentificationError for the first finding of level "stop"; its message begins with `where`."""
    for finding in found:
        if finding.level == "stop":
            raise IdentificationError(f"{where}: {finding.text}")


def _warn_if(problem: bool, text: str, consequence: str) -> Finding:
    return Finding("warn", f"{text}: {consequence}") if problem else Finding("ok", text)


def _clock(clock: ClockQuality) -> Iterator[Finding]:
    if clock.duplicates > 0.5 * clock.samples:
        text = f"{_of(clock.duplicates, clock.samples)} with the stamp of the one before: nothing can be said of time"
        yield Finding("warn", f"{text}; record the stamps of the sensor")
        return
    period = clock.period or 1.0
    text = f"{clock.samples} samples in {clock.duration:.6g} s, {1.0 / period:.5g} per second"
    jitter = clock.jitter / period
    yield _warn_if(jitter > _JITTER, f"{text}, jitter {jitter:.1%} of the period", "lags will be uncertain")
    if clock.lost:
        text = f"{clock.lost} samples missing between {clock.samples} others, {clock.longest_gap:.4g} s at most"
        yield Finding("warn", text)
    if clock.unseen:
        yield Finding(
            "warn", f"{clock.unseen} gaps within which the voltage moved: unseen turns leave the memory in doubt"
        )
    if clock.duplicates:
        yield Finding("warn", f"{_of(clock.duplicates, clock.samples)} with the stamp of the one before")


def _displacement(y: SignalQuality) -> Iterator[Finding]:
    noise = f"{y.noise * 1e9:.3g} nm rms" if y.noise else "below its digits"
    yield _warn_if(
        y.noise > _NOISY_DISPLACEMENT * y.range,
        f"displacement from {y.low * 1e6:.5g} to {y.high * 1e6:.5g} um, noise {noise}",
        "a large part of the range; go the same way several times",
    )
    digits = f"displacement in steps of {y.digit * 1e9:.3g} nm"
    if y.digit > max(_USELESS_DIGIT * y.range, 2.0 * y.noise):
        yield Finding("stop", f"{digits}: too coarse for a loop; set the sensor to a smaller range")
    elif y.digit > 0.1 * y.noise:
        yield _warn_if(y.digit > _COARSE * y.noise, digits, "coarser than the noise, which cannot average them out")


def _voltage(v: SignalQuality) -> Iterator[Finding]:
    text = f"voltage from {v.low:.5g} to {v.high:.5g} V"
    noisy = v.noise > _NOISY_VOLTAGE * v.range
    if noisy or v.noise > 1e-6 * v.range:
        text += f", noise {v.noise * 1e3:.3g} mV rms"
    yield _warn_if(noisy, text, "small reversals are not to be told from noise")


def _readings(name: str, signal: SignalQuality, samples: int) -> Iterator[Finding]:
    if signal.missing:
        yield Finding("warn", f"{name} missing (nan) for {_of(signal.missing, samples)}")
    if signal.clipped:
        text = f"{name} clipped at an end of its range for {_of(signal.clipped, samples)}"
        yield Finding("warn", f"{text}: what goes further is not seen")
    if stuck := signal.stuck - signal.clipped:
        text = f"{name} stuck for {_of(stuck, samples)}, up to {signal.longest_stuck} in a row"
        slow = ": the sensor is slower than the record" if stuck > 0.5 * samples else ""
        yield Finding("warn", f"{text}{slow}; where noise should tell them apart they are not fitted")
    if signal.stale:
        text = f"{name} stale, a reading of before, in {_of(signal.stale, samples)}"
        yield Finding("warn" if signal.stale > _OUTLIERS * samples else "ok", text)
    if signal.spikes:
        text = f"{name} with lone outliers in {_of(signal.spikes, samples)}"
        yield Finding("warn" if signal.spikes > _OUTLIERS * samples else "ok", text)


def _drive(quality: Quality) -> Iterator[Finding]:
    drive, clock, y = quality.drive, quality.clock, quality.displacement
    if not drive.turns:
        yield Finding("stop", NEVER_TURNS)
        return
    per_run = drive.samples_per_run * (1.0 - (y.missing + y.stuck) / clock.samples)
    if per_run < _USELESS_RUN:
        rate = 25.0 / (drive.samples_per_run * clock.period)
        text = f"{per_run:.2g} readings from turn to turn"
        yield Finding("stop", f"{text}: record {rate:.2g} samples per second or more, all of them, or drive slower")
        return
    yield _warn_if(
        drive.covered < _FEW_PAIRS,
        f"{drive.turns} turns; {drive.covered:.0%} of all pairs of turning point and voltage visited",
        "loops that begin elsewhere cannot be identified; turn at more voltages",
    )
    yield _memory(drive)
    yield Finding("ok", _speeds_and_holds(drive))


def _memory(drive: DriveQuality) -> Finding:
    if drive.begins_at_end:
        return Finding("ok", "memory known: the record begins at an end of its voltage range")
    remedy = "begin with a move over the whole range"
    if drive.wiped is None:
        return Finding("warn", f"memory unknown: the voltage never goes over its whole range; {remedy}")
    return Finding("warn", f"memory unknown until {drive.wiped:.4g} s, where both ends have been visited; {remedy}")


def _speeds_and_holds(drive: DriveQuality) -> str:
    match drive.speeds:
        case ():
            text, lacking = "no two moves alike to compare speeds", ["lag", "delay", "rate dependence"]
        case (speed,):
            text, lacking = f"one speed, {speed:.3g} V/s", ["lag", "delay", "rate dependence"]
        case (slow, *_, fast):
            text, lacking = f"{len(drive.speeds)} speeds from {slow:.3g} to {fast:.3g} V/s", []
    if drive.holds:
        text += f", {len(drive.holds)} hold{'s' * (len(drive.holds) > 1)} of up to {max(drive.holds):.3g} s"
    else:
        text += ", no hold"
        lacking.append("creep")
    return text + (f": cannot tell {', '.join(lacking)} from hysteresis" if lacking else "")


def _of(count: int, samples: int) -> str:
    return f"{count} of {samples} samples ({100.0 * count / samples:.2g} %)"
