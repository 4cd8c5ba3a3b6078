"""Draw a stage, hide effects in it, and simulate a record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.excitation.drives import calibration_drive
from slpi_ros.excitation.legs import DriveSpec
from slpi_ros.io.record import Record
from slpi_ros.simulation.surroundings import Sensor

from .attempt import BASES, CLOSE, NOISE, RATE_BEFORE, Base, Draw, Drives, together
from .drives import log_uniform, wandering
from .nature import NAMES, Parameters, Setting, another_time
from .physics import Physics, own_motion

FloatArray = NDArray[np.float64]

# Limits of the size of a hidden effect relative to the noise floor.
SIZES = (3.0, 20.0)
# Limits of the sensor noise (m rms) if a requested size cannot be reached by the strength of the effect.
ANY_NOISE = (1.5e-9, 40e-9)
ATTEMPTS = 60
# Resolution of all sensors, metres.
_DIGIT = 1e-9
MOST_SAMPLES = 80_000
# For further records: duration of the motion before the record (s), largest shift of the zero (m), one hour (ns).
SECONDS_BEFORE, LARGEST_ZERO, HOUR = (8.0, 20.0), 1e-6, 3_600_000_000_000


@dataclass(frozen=True)
class Truth:
    """One hidden effect.

    Parameters
    ----------
    axis : str
    name : str
        Name of the effect in the package.
    parameters : mapping
        Parameters by their names in the package, SI units; if the simulated physics differs from the effect in the
        package, only the common ones.
    strength : float
    physics : Physics
        Physics with this effect only.
    size_over_floor : float
        Rms of the part of this effect alone that a refit of the hysteresis cannot explain (`size.beyond_hysteresis`,
        for saturation `size.beyond_identified`), divided by the noise floor. Further records keep the first value.
    contribution : ndarray, shape (N,), metres
        Reading with all effects minus the reading without this one.
    """

    axis: str
    name: str
    parameters: Parameters
    strength: float
    physics: Physics
    size_over_floor: float
    contribution: FloatArray


@dataclass(frozen=True)
class Hidden:
    """A record and the effects hidden in it.

    Parameters
    ----------
    record : Record
        The only input of a diagnosis.
    truth : tuple of Truth
        Hidden effects; empty for a clean stage.
    base : str
        Kind of hysteresis, one of `BASES`.
    reading : dict of axis name to ndarray, shape (N,), metres
        Readings without noise.
    clean : dict of axis name to ndarray, shape (N,), metres
        Readings without noise and without any effect.
    floor : dict of axis name to float, metres
        Noise floor of the sensor: noise and quantization, rms.
    stage : dict of axis name to AxisParameters or BoucWen
        Hysteresis of each axis.
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
        """Return the reduction of the rms error, %, from a refitted hysteresis alone to one with the true effects."""
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
    """Draw a stage, hide effects on one of its axes, and simulate a record.

    Parameters
    ----------
    seed : int
        The same arguments give the same record.
    effects : sequence of str
        No, one or two of `NAMES`.
    base : str, optional
        One of `BASES`; drawn from the first two by default.
    size : float, optional
        Size of each effect relative to the noise floor; drawn between `SIZES` by default.
    axes : int, optional
        Number of axes, 1 or 2; by default mostly 1, but 2 for cross-coupling.
    samples : int
        Maximum number of samples of the record.

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
    """Return a record of the same stage under calibration excitation, without any effects."""
    rng = np.random.default_rng([hidden.seed, 4711])
    records = {}
    for number, (axis, stage) in enumerate(hidden.stage.items()):
        high = float(hidden.record.voltage[axis].max())
        t, v = calibration_drive(0.0, high, duration=duration, rate=rate, seed=hidden.seed + number)
        y = own_motion(stage, Physics(), t, v)
        records[axis] = v, Sensor(_noise(hidden, axis), _DIGIT, int(rng.integers(2**31))).read(y)
    time_ns = np.round(t * 1e9).astype(np.int64)
    voltage, displacement = ({axis: pair[index] for axis, pair in records.items()} for index in (0, 1))
    return Record(time_ns, voltage, displacement, "calibration", hidden.record.hardware_id)


def again(
    hidden: Hidden, number: int, voltage: dict[str, FloatArray], rate: float, *, from_rest: bool = False
) -> Hidden:
    """Return another record of the same stage: other voltages, another initial state, another zero offset.

    Drift of zero and sensitivity follow another course, and hum has another phase; all else is as in `hidden`.

    Parameters
    ----------
    hidden : Hidden
    number : int
        Number of the record; the same number gives the same history, zero, noise and drift.
    voltage : dict of axis name to ndarray, shape (N,), volts
    rate : float, hertz
    from_rest : bool
        Whether the stage was never moved before the record.
    """
    rng = np.random.default_rng([hidden.seed, number, 815])
    highs = {axis: float(v.max()) for axis, v in hidden.record.voltage.items()}
    seconds = float(rng.uniform(*SECONDS_BEFORE))
    before = {
        axis: wandering(DriveSpec(0.0, high, seconds, RATE_BEFORE), float(voltage[axis][0]) / high, rng)
        for axis, high in highs.items()
    }
    t = np.arange(next(iter(voltage.values())).size) / rate
    drives = Drives(hidden.stage, t, voltage, None if from_rest else before)
    truth = tuple(_another_time(each, drives, rng, rate, highs) for each in hidden.truth)
    victim = truth[0].axis if truth else ""
    parts = {each.name: each.physics for each in truth}
    zero = {axis: float(rng.uniform(-LARGEST_ZERO, LARGEST_ZERO)) for axis in voltage}
    reading, clean = (
        {axis: zero[axis] + y for axis, y in _readings(drives, victim, some).items()} for some in (parts, {})
    )
    measured = {
        axis: Sensor(_noise(hidden, axis), _DIGIT, int(rng.integers(2**31))).read(y) for axis, y in reading.items()
    }
    time_ns = hidden.record.time_ns[0] + number * HOUR + np.round(t * 1e9).astype(np.int64)
    return replace(
        hidden,
        record=Record(time_ns, voltage, measured, f"{hidden.record.source}-{number}", hidden.record.hardware_id),
        truth=tuple(replace(one, contribution=_contribution(drives, victim, parts, one.name)) for one in truth),
        reading=reading,
        clean=clean,
    )


def _another_time(
    truth: Truth, drives: Drives, rng: np.random.Generator, rate: float, highs: dict[str, float]
) -> Truth:
    other = next((axis for axis in drives.v if axis != truth.axis), "")
    setting = Setting(drives.t, drives.v[truth.axis], rate, 0.0, highs[truth.axis], other)
    physics, parameters = another_time(truth.name, truth.physics, truth.parameters, truth.strength, setting, rng)
    return replace(truth, physics=physics, parameters=parameters)


def _noise(hidden: Hidden, axis: str) -> float:
    """Return the noise (m rms) of a sensor without its quantization."""
    return float(np.sqrt(hidden.floor[axis] ** 2 - _DIGIT**2 / 12))


def _strengths(draw: Draw, size: float | None) -> dict[str, tuple[float, float]] | None:
    """Return strength and rms (m) of each effect; None if an effect cannot have the wanted size."""
    found: dict[str, tuple[float, float]] = {}
    for name, nature in draw.natures.items():
        wanted = size or log_uniform(draw.rng, 1.15 * SIZES[0], SIZES[1] / 1.15)
        noise = draw.noise[draw.victim]
        strength, rms = draw.strength(nature, wanted * noise)
        if not found:
            # If the strength has reached a bound, the noise is adapted instead.
            noise = draw.noise[draw.victim] = float(np.clip(rms / wanted, *(ANY_NOISE if size else NOISE)))
        over = rms / noise
        low, high = ((1 - CLOSE) * size, (1 + CLOSE) * size) if size else SIZES
        if not low <= over <= high:
            return None
        found[name] = strength, rms
    return found


def _recorded(draw: Draw, strengths: Mapping[str, tuple[float, float]], base: str, seed: int) -> Hidden:
    floor = {axis: float(np.hypot(noise, _DIGIT / np.sqrt(12))) for axis, noise in draw.noise.items()}
    parts = {name: draw.natures[name].physics(strength) for name, (strength, _) in strengths.items()}
    reading = _readings(draw.drives, draw.victim, parts)
    truth = tuple(
        Truth(
            draw.victim,
            name,
            draw.natures[name].parameters(strength),
            strength,
            parts[name],
            rms / floor[draw.victim],
            _contribution(draw.drives, draw.victim, parts, name),
        )
        for name, (strength, rms) in strengths.items()
    )
    measured = {
        axis: Sensor(draw.noise[axis], _DIGIT, int(draw.rng.integers(2**31))).read(y) for axis, y in reading.items()
    }
    record = Record(draw.time_ns, draw.v, measured, f"hidden-{seed}", "simulated")
    return Hidden(record, truth, base, reading, _readings(draw.drives, draw.victim, {}), floor, draw.stage, seed)


def _readings(drives: Drives, victim: str, parts: Mapping[str, Physics]) -> dict[str, FloatArray]:
    physics = together(parts.values())
    return {axis: drives.reading(axis, physics if axis == victim else Physics()) for axis in drives.v}


def _contribution(drives: Drives, victim: str, parts: Mapping[str, Physics], name: str) -> FloatArray:
    """Return the reading with all effects minus the reading without one of them."""
    without = together(part for other, part in parts.items() if other != name)
    return drives.reading(victim, together(parts.values())) - drives.reading(victim, without)
