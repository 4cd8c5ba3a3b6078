"""The choice of the next drive: the cheapest record that promises most of what is still open."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from slpi_ros.calibration.settings import CALIBRATION, EFFECT, CalibrationSettings
from slpi_ros.diagnosis.result import AMBIGUOUS, UNEXPLAINED, AxisDiagnosis
from slpi_ros.effects.registry import EFFECTS
from slpi_ros.excitation.drives import CALIBRATION as CALIBRATION_DRIVE
from slpi_ros.excitation.effects import separating
from slpi_ros.model.axis_model import ABOVE_NOISE

# A cause that is named is worth this part of its share until the drive for it has been recorded; nothing below
# LEAST is worth a record. No drive is recorded more often than MOST.
CONFIRMED, LEAST, MOST = 0.3, 0.05, 2


@dataclass(frozen=True)
class Choice:
    """The next drive, one of `DRIVES`: axes that move, duration (s), what is open and how this record helps."""

    drive: str
    axes: tuple[str, ...]
    seconds: float
    why: str


def next_drive(
    settings: CalibrationSettings,
    found: Mapping[str, AxisDiagnosis] | None,
    recorded: Sequence[tuple[str, Sequence[str]]],
    left: float,
) -> Choice | None:
    """Return the drive with the largest promise per second; None if none is worth its time or fits into `left` (s)."""
    # The promise of a drive is the share of the mean square error of an axis that it may explain. One axis moves in
    # each, so that the others need not be diagnosed on it; only coupling takes them all.
    best, chosen = 0.0, None
    for axis in settings.axes:
        for drive, promise, why in _promises(found[axis] if found else None):
            known = sum(name == drive and axis in axes for name, axes in recorded)
            if known >= (MOST if found else 1):
                continue
            several = drive in EFFECTS and EFFECTS[drive].excitation.least_axes > 1
            axes = settings.axes if several else (axis,)
            seconds = (CALIBRATION if drive == CALIBRATION_DRIVE else EFFECT) * len(axes)
            if seconds <= left and promise > LEAST and promise / seconds > best:
                best = promise / seconds
                chosen = Choice(drive, axes, seconds, f"axis {axis}: {why}")
    return chosen


def _promises(found: AxisDiagnosis | None) -> list[tuple[str, float, str]]:
    """Return drives, the share of the error that each may explain, and why."""
    if found is None:
        lacking = {name: effect.excitation.lacking for name, effect in EFFECTS.items()}
        return [(name, *share_and_why) for name, share_and_why in lacking.items() if share_and_why]
    offers = []
    if found.verdict == AMBIGUOUS:
        for named in found.effects:
            if named.alternatives:
                drive = separating((named.name, *named.alternatives))
                others = ", ".join(named.alternatives)
                offers.append((drive, named.share_of_residual, f"{named.name} may as well be {others}"))
    if found.verdict == UNEXPLAINED and found.after_rms > ABOVE_NOISE * found.repeatability_rms:
        share = 1.0 - (found.repeatability_rms / found.after_rms) ** 2
        offers.append((CALIBRATION_DRIVE, share, "an error that no known cause explains; more loops of every size"))
    if found.after_rms > ABOVE_NOISE * found.repeatability_rms:
        for named in found.effects:
            if not named.alternatives:
                share = CONFIRMED * named.share_of_residual
                offers.append(
                    (named.name, share, f"{named.name} is named; a drive of its own determines its parameters")
                )
    return offers
