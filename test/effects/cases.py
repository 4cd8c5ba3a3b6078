"""Hypothesis strategies: an effect of every kind, and smooth signals for it."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from slpi_ros.effects.base import Effect, EffectContext
from slpi_ros.effects.clock import Clock
from slpi_ros.effects.contact import Contact
from slpi_ros.effects.creep import Creep
from slpi_ros.effects.cross_coupling import CrossCoupling
from slpi_ros.effects.delay import Delay
from slpi_ros.effects.filters import Mode
from slpi_ros.effects.gain_drift import GainDrift
from slpi_ros.effects.hum import Hum, Line
from slpi_ros.effects.lag import Lag
from slpi_ros.effects.rate_dependence import RateDependence
from slpi_ros.effects.resonance import Resonance
from slpi_ros.effects.saturation import Saturation
from slpi_ros.effects.self_heating import SelfHeating
from slpi_ros.effects.sensor_periodic import SensorPeriodic
from slpi_ros.effects.slew import Slew
from slpi_ros.effects.steps import Steps
from slpi_ros.effects.surroundings import Quantity, Surroundings
from slpi_ros.effects.thermal_drift import ThermalDrift

FloatArray = NDArray[np.float64]


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_subnormal=False)


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """Draw positive numbers evenly over the orders of magnitude."""
    return numbers(np.log10(low), np.log10(high)).map(lambda x: float(10**x))


@st.composite
def creeps(draw: st.DrawFn) -> Creep:
    if draw(st.booleans()):
        return Creep(exponent=draw(numbers(0.02, 0.9)), gain=draw(numbers(1e-3, 0.1)))
    gains = draw(st.lists(numbers(-0.02, 0.05).filter(bool), min_size=1, max_size=8))
    taus = draw(st.lists(powers(1e-3, 1e3), min_size=len(gains), max_size=len(gains)))
    return Creep(tuple(taus), tuple(gains))


@st.composite
def drifts(draw: st.DrawFn) -> ThermalDrift:
    values = draw(st.lists(numbers(-1e-6, 1e-6), min_size=1, max_size=5))
    steps = draw(st.lists(numbers(0.01, 1), min_size=len(values), max_size=len(values)))
    return ThermalDrift(tuple(np.cumsum(steps).tolist()), tuple(values))


def staircases() -> st.SearchStrategy[Steps]:
    jumps = st.dictionaries(numbers(0.0, 2.0), numbers(-1e-6, 1e-6), max_size=5)
    return jumps.map(lambda found: Steps(tuple(sorted(found)), tuple(found[t] for t in sorted(found))))


@st.composite
def gain_drifts(draw: st.DrawFn) -> GainDrift:
    gains = draw(st.lists(numbers(-0.3, 0.3), min_size=1, max_size=5))
    steps = draw(st.lists(numbers(0.01, 1), min_size=len(gains), max_size=len(gains)))
    return GainDrift(tuple(np.cumsum(steps).tolist()), tuple(gains), draw(numbers(-1e-5, 1e-5)))


def self_heatings(leads: int = 0) -> st.SearchStrategy[SelfHeating]:
    """Draw self-heating, at times so strong that a move reaches its bound; the first `leads` records may start warm."""
    gains = st.tuples(st.sampled_from((-1.0, 1.0)), powers(1e-9, 1e-2)).map(lambda drawn: drawn[0] * drawn[1])
    starts = st.lists(st.just(0.0) | powers(1.0, 1e7), max_size=leads).map(tuple)
    return st.builds(SelfHeating, gains, powers(0.5, 300), numbers(-1e-5, 1e-5), starts)


@st.composite
def sensors(draw: st.DrawFn) -> SensorPeriodic:
    period = draw(powers(1e-7, 1e-5))
    return SensorPeriodic(period, draw(numbers(0, 0.98)) * period / (2 * np.pi), draw(numbers(-7, 7)))


@st.composite
def saturations(draw: st.DrawFn) -> Saturation:
    limits = draw(numbers(-20, 30)), draw(numbers(60, 120))
    return Saturation(draw(st.sampled_from((-np.inf, limits[0]))), draw(st.sampled_from((np.inf, limits[1]))))


def rate_laws(most: float = 3.0, leads: int = 0) -> st.SearchStrategy[RateDependence]:
    """Draw rate laws with a threshold up to `most` volts; the first `leads` records may start off equilibrium."""
    return st.builds(
        RateDependence,
        *(st.just(0.0) | powers(1e-3, most), powers(1e-2, 1e3), st.just(0.0) | powers(1e-9, 1e-7)),
        st.lists(numbers(-most, most), max_size=leads).map(tuple),
    )


@st.composite
def resonances(draw: st.DrawFn) -> Resonance:
    """Draw one to three modes, ringing or well damped, that carry all of the motion, or a part of it."""
    shares = draw(st.lists(numbers(0.05, 1), min_size=1, max_size=3))
    total = draw(st.just(1.0) | numbers(0.02, 0.999))
    gains = (total * np.array(shares) / sum(shares)).tolist()
    return Resonance(tuple(Mode(draw(powers(20, 2000)), draw(powers(1e-3, 2) | st.just(1.0)), gain) for gain in gains))


@st.composite
def surroundings(draw: st.DrawFn) -> Surroundings:
    """Draw up to two quantities of those of a record, so weak that the sensitivity stays well above 0."""
    topics = draw(
        st.lists(st.sampled_from(("/room/temperature", "/load", "/unknown")), min_size=1, max_size=2, unique=True)
    )
    return Surroundings(
        tuple(
            Quantity(
                topic,
                draw(st.sampled_from(("", "force.z"))) if topic == "/load" else "",
                reference=draw(numbers(-1, 1)),
                offset_gain=draw(st.just(0.0) | numbers(-1e-6, 1e-6)),
                sensitivity_gain=draw(st.just(0.0) | numbers(-0.05, 0.05)),
                time_constant=draw(st.just(0.0) | powers(1e-2, 1e3)),
                lowest=-1.0,
                highest=1.0,
            )
            for topic in topics
        ),
        draw(numbers(-1e-5, 1e-5)),
    )


LINES = st.builds(Line, powers(1, 1000), powers(1e-10, 1e-7), numbers(-7, 7))

BY_NAME: dict[str, st.SearchStrategy[Effect]] = {
    "delay": st.builds(Delay, numbers(-0.2, 0.2)),
    "lag": st.builds(Lag, powers(1e-4, 1)),
    "slew": st.builds(Slew, powers(1, 1e4)),
    "saturation": saturations(),
    "rate_dependence": rate_laws(),
    "creep": creeps(),
    "contact": st.builds(Contact, numbers(-5e-6, 2e-5), powers(0.05, 5)),
    "resonance": resonances(),
    "self_heating": self_heatings(),
    "surroundings": surroundings(),
    "gain_drift": gain_drifts(),
    "cross_coupling": st.builds(CrossCoupling, st.dictionaries(st.sampled_from("yz"), numbers(-0.4, 0.4), min_size=1)),
    "thermal_drift": drifts(),
    "clock": st.builds(Clock, numbers(-1e-3, 1e-3)),
    "steps": staircases(),
    "sensor_periodic": sensors(),
    "hum": st.builds(Hum, st.lists(LINES, min_size=1, max_size=3).map(tuple)),
}
EVERY = st.sampled_from(sorted(BY_NAME)).flatmap(BY_NAME.__getitem__) | rate_laws(leads=3) | self_heatings(leads=3)
# They change what moves, and leave what rests as it is.
ABOUT_MOTION = ("delay", "lag", "slew", "rate_dependence", "creep", "resonance", "cross_coupling")


@dataclass(frozen=True)
class Record:
    """A signal, shape (N,), V or m, that begins at rest, and what is around it."""

    signal: FloatArray
    around: EffectContext

    @property
    def span(self) -> float:
        return float(np.ptp(self.signal))


@st.composite
def records(draw: st.DrawFn, acts_on: str) -> Record:
    """Draw a smooth motion of three tones up to 3 Hz, faded in, at even stamps."""
    rate, size = draw(st.sampled_from((500.0, 1000.0, 4000.0))), draw(st.integers(700, 1500))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    t = np.arange(size) / rate
    u = 50 + 40 * _motion(t, rng)
    others = {"y": 1e-5 * _motion(t, rng)} if draw(st.booleans()) else {}
    signal = 2e-7 * u + 1e-9 * u**1.5 + 1e-6 * _motion(t, rng) if acts_on == "displacement" else u
    beside = {"/room/temperature": _motion(t, rng), "/load": _motion(t, rng), "/load:force.z": _motion(t, rng)}
    return Record(signal, EffectContext(t, others, voltage=u, surroundings=beside))


def _motion(t: FloatArray, rng: np.random.Generator) -> FloatArray:
    fade = np.sin(np.clip(t / t[-1] * 2, 0, 1) * np.pi / 2) ** 4
    tones = [np.sin(2 * np.pi * rng.uniform(0.6, 3) * t + rng.uniform(0, 6)) for _ in range(3)]
    return np.asarray(fade * sum(tones) / 3)


@st.composite
def effects_and_records(draw: st.DrawFn, names: tuple[str, ...] = tuple(BY_NAME)) -> tuple[Effect, Record]:
    effect = draw(BY_NAME[draw(st.sampled_from(names))])
    return effect, draw(records(effect.acts_on))
