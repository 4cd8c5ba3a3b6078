"""Draw a stage, hide effects in it, and record it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.io.record import Record
from slpi_ros.simulation.preisach import Sensor

from .attempt import BASES, CLOSE, NOISE, Base, Draw, together
from .drives import log_uniform
from .nature import NAMES, Parameters
from .physics import Physics, own_motion

FloatArray = NDArray[np.float64]

# How large a hidden effect is beside the noise floor.
SIZES = (3.0, 20.0)
# Where a size is asked for that the strength cannot give, other sensors are allowed too.
ANY_NOISE = (1.5e-9, 40e-9)
ATTEMPTS = 60
# Metres; the last digit of every sensor.
_DIGIT = 1e-9
MOST_SAMPLES = 80_000


@dataclass(frozen=True)
class Truth:
    """One hidden effect.

    Parameters
    ----------
    axis : str
    name : str
        Of the package's vocabulary.
    parameters : mapping
        By the package's names, SI; where the physics is another, only those that it shares.
    size_over_floor : float
        What a refit of the hysteresis would leave of it were it alone (rms, `size.beyond_hysteresis`; of a saturation
        `size.beyond_identified`), over the noise.
    contribution : ndarray, shape (N,), metres
        The reading with everything less the reading without this.
    """

    axis: str
    name: str
    parameters: Parameters
    size_over_floor: float
    contribution: FloatArray


@dataclass(frozen=True)
class Hidden:
    """A record and what is in it.

    Parameters
    ----------
    record : Record
        All that a diagnosis may see.
    truth : tuple of Truth
        Empty for a clean stage.
    base : str
        One of `BASES`.
    reading : dict of axis name to ndarray, shape (N,), metres
        Without noise.
    clean : dict of axis name to ndarray, shape (N,), metres
        Without noise and without any effect.
    floor : dict of axis name to float, metres
        Noise and last digit of the sensor, rms.
    stage : dict of axis name to StageParameters or BoucWen
        The hysteresis.
    seed : int
    """

    record: Record
    truth: tuple[Truth, ...]
    base: str
    reading: dict[str, FloatArray]
    clean: dict[str, FloatArray]
    floor: dict[str, float]
    stage: dict[str, Base]
    seed: int

    def best_gain_percent(self, axis: str) -> float:
        """Return the fall of the rms error, %, from a refitted hysteresis alone to one with the true effects."""
        sizes = [truth.size_over_floor for truth in self.truth if truth.axis == axis]
        size = float(np.linalg.norm(sizes))
        return 100.0 * (1.0 - 1.0 / np.hypot(1.0, size))


def hide(
    seed: int,
    effects: Sequence[str] = (),
    *,
    base: str | None = None,
    size: float | None = None,
    axes: int | None = None,
    samples: int = MOST_SAMPLES,
) -> Hidden:
    """Draw a stage, hide effects on one of its axes, and record it.

    Parameters
    ----------
    seed : int
        The same arguments give the same record.
    effects : sequence of str
        None, one or two of `NAMES`.
    base : str, optional
        One of `BASES`; drawn from the first two by default.
    size : float, optional
        Of each effect, over the noise floor; drawn from `SIZES` by default.
    axes : int, optional
        1 or 2; by default mostly 1, but 2 where one axis is to show on another.
    samples : int
        The most that the record may have.

    Returns
    -------
    Hidden

    Raises
    ------
    RuntimeError
        If no such record can be drawn.
    """
    effects = tuple(effects)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, attempt, *(NAMES.index(effect) for effect in effects)])
        kind = base or str(rng.choice(BASES[:2]))
        count = axes or (2 if "cross_coupling" in effects or rng.random() < 0.15 else 1)
        draw = Draw(rng, effects, kind, count, samples)
        strengths = _strengths(draw, size)
        if strengths is not None:
            return _recorded(draw, strengths, kind, seed)
    raise RuntimeError(f"no record with {effects} of size {size} in {ATTEMPTS} attempts of seed {seed}")


def calibration_of(hidden: Hidden, duration: float = 40.0, rate: float = 500.0) -> Record:
    """Return a record of the calibration drive of the same stage, before any effect befell it."""
    rng = np.random.default_rng([hidden.seed, 4711])
    records = {}
    for number, (axis, stage) in enumerate(hidden.stage.items()):
        high = float(hidden.record.voltage[axis].max())
        t, v = calibration_drive(0.0, high, duration=duration, rate=rate, seed=hidden.seed + number)
        y = own_motion(stage, Physics(), t, v)
        noise = float(np.sqrt(hidden.floor[axis] ** 2 - _DIGIT**2 / 12))
        records[axis] = v, Sensor(noise, _DIGIT, int(rng.integers(2**31))).read(y)
    time_ns = np.round(t * 1e9).astype(np.int64)
    voltage, displacement = ({axis: pair[index] for axis, pair in records.items()} for index in (0, 1))
    return Record(time_ns, voltage, displacement, "calibration", hidden.record.hardware_id)


def _strengths(draw: Draw, size: float | None) -> dict[str, tuple[float, float]] | None:
    """Return strength and rms (m) of each effect; None where one cannot be of the wanted size."""
    found: dict[str, tuple[float, float]] = {}
    for name, nature in draw.natures.items():
        wanted = size or log_uniform(draw.rng, 1.15 * SIZES[0], SIZES[1] / 1.15)
        noise = draw.noise[draw.victim]
        strength, rms = draw.strength(nature, wanted * noise)
        if not found:
            # The noise gives way where the strength has come to a bound.
            noise = draw.noise[draw.victim] = float(np.clip(rms / wanted, *(ANY_NOISE if size else NOISE)))
        over = rms / noise
        low, high = ((1 - CLOSE) * size, (1 + CLOSE) * size) if size else SIZES
        if not low <= over <= high:
            return None
        found[name] = strength, rms
    return found


def _recorded(draw: Draw, strengths: Mapping[str, tuple[float, float]], base: str, seed: int) -> Hidden:
    parts = {name: draw.natures[name].physics(strength) for name, (strength, _) in strengths.items()}
    physics = {axis: together(parts.values()) if axis == draw.victim else Physics() for axis in draw.axes}
    reading = {axis: draw.reading(axis, physics[axis]) for axis in draw.axes}
    measured = {
        axis: Sensor(draw.noise[axis], _DIGIT, int(draw.rng.integers(2**31))).read(y) for axis, y in reading.items()
    }
    floor = {axis: float(np.hypot(noise, _DIGIT / np.sqrt(12))) for axis, noise in draw.noise.items()}
    truth = []
    for name, (strength, rms) in strengths.items():
        without = draw.reading(draw.victim, together(part for other, part in parts.items() if other != name))
        truth.append(
            Truth(
                draw.victim,
                name,
                draw.natures[name].parameters(strength),
                rms / floor[draw.victim],
                reading[draw.victim] - without,
            )
        )
    record = Record(draw.time_ns, draw.v, measured, f"hidden-{seed}", "simulated")
    clean = {axis: draw.reading(axis, Physics()) for axis in draw.axes}
    return Hidden(record, tuple(truth), base, reading, clean, floor, draw.stage, seed)
