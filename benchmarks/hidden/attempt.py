"""One attempt to draw a record with hidden effects: stage, excitation, and effects whose strength is set afterwards."""

from collections.abc import Iterable
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from slpi_ros.excitation.legs import DriveSpec
from slpi_ros.simulation.parameters import AxisParameters

from .drives import drive, log_uniform
from .nature import DRAWS, NAMES, Nature, Setting
from .physics import Amplifier, BoucWen, Physics, own_motion, sensed
from .size import beyond_hysteresis, beyond_identified

FloatArray = NDArray[np.float64]
Base = AxisParameters | BoucWen

BASES = ("preisach", "stiffening", "bouc_wen")
NOISE = (3e-9, 15e-9)
# Relative tolerance of a requested size.
CLOSE = 0.15
# Slow effects, which need long records.
SLOW = {"creep", "gain_drift", "thermal_drift", "self_heating"}
# Effects for which the drive of an axis without effects may be designed. None is added, so that a seed draws the same.
OF_OTHERS = [name for name in NAMES[: NAMES.index("self_heating")] if name != "cross_coupling"]
# Sample rate of the voltages before a record, hertz.
RATE_BEFORE = 100.0
# Shortest duration of a record if the number of samples allows it, seconds.
SHORTEST = 20.0


class Drives:
    """Voltages of one record of a stage, and the voltages before its first sample, starting from rest.

    Parameters
    ----------
    stage : dict of axis name to AxisParameters or BoucWen
    t : ndarray, shape (N,), seconds
    v : dict of axis name to ndarray, shape (N,), volts
    before : dict of axis name to ndarray, shape (M,), volts, optional
        Unrecorded voltages, `RATE_BEFORE` samples per second, the last one just before the first sample.
    """

    def __init__(
        self,
        stage: dict[str, Base],
        t: FloatArray,
        v: dict[str, FloatArray],
        before: dict[str, FloatArray] | None = None,
    ) -> None:
        self.stage, self.t, self.v = stage, t, v
        self._before = before or {axis: np.empty(0) for axis in v}
        self._own: dict[tuple[object, ...], FloatArray] = {}

    def reading(self, axis: str, physics: Physics) -> FloatArray:
        """Return the noise-free sensor reading of an axis with the given physics; the other axes have no effects."""
        motion = {name: self._motion(name, physics if name == axis else Physics()) for name in self.v}
        return sensed(physics, self.t, motion, axis)

    def _motion(self, axis: str, physics: Physics) -> FloatArray:
        parts = (physics.amplifier, physics.viscosity, physics.creep, physics.stop, physics.flexure, physics.warmth)
        key = (axis, *parts, physics.ageing)
        if key not in self._own:
            stage, before = self.stage[axis], self._before[axis]
            t = np.concatenate([self.t[0] + np.arange(-before.size, 0) / RATE_BEFORE, self.t])
            v = np.concatenate([before, self.v[axis]])
            y = own_motion(stage, replace(physics, ageing=None), t, v)[before.size :]
            if physics.ageing:
                # The course of the sensitivity is relative to the start of the record.
                y = stage.offset + physics.ageing.scaled(self.t, self.v[axis], y - stage.offset)
            self._own[key] = y
        return self._own[key]


class Draw:
    """One attempt: a stage, its excitation, and effects whose strength is set afterwards."""

    def __init__(self, rng: np.random.Generator, effects: tuple[str, ...], base: str, axes: int, samples: int) -> None:
        self.rng, self.axes = rng, ("x", "y")[:axes]
        self.victim = str(rng.choice(self.axes))
        duration, rate = _timing(rng, effects, samples)
        self.stage = {axis: _stage(rng, base) for axis in self.axes}
        self.noise = {axis: float(rng.uniform(*NOISE)) for axis in self.axes}
        specs = {axis: DriveSpec(0.0, float(rng.uniform(70.0, 110.0)), duration, rate) for axis in self.axes}
        self.v = {
            axis: drive(spec, effects if axis == self.victim else _others(rng), rng) for axis, spec in specs.items()
        }
        self.time_ns = _stamps(rng, self.v[self.victim].size, rate)
        self.t = (self.time_ns - self.time_ns[0]) * 1e-9
        spec = specs[self.victim]
        other = next((axis for axis in self.axes if axis != self.victim), "")
        setting = Setting(self.t, self.v[self.victim], rate, spec.low, spec.high, other)
        self.natures = {effect: DRAWS[effect](rng, setting) for effect in effects}
        self.drives = Drives(self.stage, self.t, self.v)

    def rms(self, physics: Physics) -> float:
        """Return the rms (m) of the part of an effect that a refit of the hysteresis cannot explain."""
        with_it, without = (self.drives.reading(self.victim, part) for part in (physics, Physics()))
        if physics.amplifier and physics.amplifier.clips:
            return beyond_identified(self.time_ns, self.v[self.victim], with_it)
        return beyond_hysteresis(self.v[self.victim], with_it - without)

    def strength(self, nature: Nature, wanted: float) -> tuple[float, float]:
        """Return a strength for which `rms` is about the wanted value (m), and the value (m) for this strength."""
        strength = float(np.sqrt(nature.weakest * nature.strongest))
        found = self.rms(nature.physics(strength))
        for _ in range(3):
            if abs(found / wanted - 1.0) < CLOSE:
                break
            after = float(np.clip(strength * wanted / max(found, 1e-12), nature.weakest, nature.strongest))
            if after == strength:
                break
            strength, found = after, self.rms(nature.physics(after))
        return strength, found


def _timing(rng: np.random.Generator, effects: tuple[str, ...], samples: int) -> tuple[float, float]:
    """Return duration (s) and sample rate (Hz)."""
    rates = [1000.0, 2000.0] if {"resonance", "delay"} & set(effects) else [500.0, 1000.0, 2000.0]
    rate = float(rng.choice([rate for rate in rates if rate * SHORTEST < samples] or rates[:1]))
    shortest = 40.0 if SLOW & set(effects) else SHORTEST
    return min(log_uniform(rng, shortest, 80.0), (samples - 1) / rate), rate


def _stage(rng: np.random.Generator, base: str) -> Base:
    if base == "bouc_wen":
        softening = float(rng.uniform(0.03, 0.08))
        return BoucWen(
            gain=float(rng.uniform(0.2e-6, 0.28e-6)),
            share=float(rng.uniform(0.25, 0.45)),
            softening=softening,
            asymmetry=softening * float(rng.uniform(-0.5, 0.5)),
            offset=float(rng.uniform(-0.2e-6, 0.2e-6)),
        )
    drawn = AxisParameters.random(int(rng.integers(2**31)))
    return drawn if base == "stiffening" else replace(drawn, stiffening=0.0)


def _others(rng: np.random.Generator) -> tuple[str, ...]:
    """Return a random effect for which the excitation of an axis without effects is designed."""
    return (str(rng.choice(OF_OTHERS)),)


def _stamps(rng: np.random.Generator, count: int, rate: float) -> NDArray[np.int64]:
    late = rng.uniform(0.0, 0.1, count) if rng.random() < 0.2 else np.zeros(count)
    start = 1_700_000_000_000_000_000 + int(rng.integers(10**15))
    return start + np.round((np.arange(count) + late) / rate * 1e9).astype(np.int64)


def together(parts: Iterable[Physics]) -> Physics:
    """Return the physics that combines the parts of several."""
    found: dict[str, object] = {}
    for part in parts:
        for item in fields(part):
            value = getattr(part, item.name)
            if item.name == "amplifier" and value and "amplifier" in found:
                value = _one_amplifier(found["amplifier"], value)
            if value:
                found[item.name] = value
    return Physics(**found)


def _one_amplifier(first: Amplifier, second: Amplifier) -> Amplifier:
    plain = Amplifier()
    changed = {item.name: getattr(second, item.name) for item in fields(second)}
    return replace(first, **{name: value for name, value in changed.items() if value != getattr(plain, name)})
