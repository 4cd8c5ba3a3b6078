"""Excitation drives that separate one effect from the others, for cases in which the calibration drive cannot."""

from collections.abc import Sequence

from slpi_ros.effects.excitation import MEAN_SPEED, WIPED, Excitation, safe_duration
from slpi_ros.effects.registry import EFFECTS, base_name
from slpi_ros.errors import UsageError
from slpi_ros.excitation.legs import DriveSpec, Path


def for_effect(name: str) -> Excitation:
    """Return the excitation drive for an effect; UsageError if there is no such effect."""
    if name not in EFFECTS:
        raise UsageError(f"no drive for the effect '{name}'; choose one of {', '.join(EFFECTS)}")
    excitation: Excitation = EFFECTS[name].excitation
    return excitation


def effect_path(name: str, spec: DriveSpec) -> Path:
    """Return the path of the drive for an effect from and to the low end; a full loop first resets the hysteresis."""
    path = Path()
    full = max(WIPED * spec.duration / 3, safe_duration(1.0))
    path.hold(WIPED * spec.duration / 3)
    path.to(1.0, full)
    path.to(0.0, full)
    for_effect(name).draw(path, spec)
    path.to(0.0, max(path.at, 0.1) / MEAN_SPEED)
    return path


def separating(names: Sequence[str]) -> str:
    """Return the effect whose drive separates ambiguous effects (likeliest first): the first one if none does."""
    names = [base_name(name) for name in names]
    owners = [
        name for name in EFFECTS if name in names and not set(names).isdisjoint(EFFECTS[name].excitation.separates)
    ]
    return min(owners, key=lambda name: EFFECTS[name].excitation.order, default=names[0])
