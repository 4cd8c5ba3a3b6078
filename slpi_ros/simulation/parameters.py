"""Parameters of a simulated stage."""

import math
from dataclasses import dataclass, fields

import numpy as np

from slpi_ros.errors import UsageError


@dataclass(frozen=True)
class StageParameters:
    """Parameters of one axis of a simulated stage; UsageError if a value is not finite or out of range.

    `stroke` (m), `hysteresis`: height of the closed loop between 0 V and `nominal_voltage` (V), and its width at the
    middle voltage as a share of the stroke. `threshold_min`, `threshold_max` (V): range of the relay thresholds; one
    that begins below 0 V leaves a remanence at 0 V. `levels`: of the relay grid. `width_scale` (V): distance between
    the two thresholds of a relay at which the density has decreased to 1/e; `width_growth`: its relative change from
    the middle to the upper end of the threshold range. `bias_slope`, `bias_bow`: parts, odd and even in the bias, of
    the logarithm of the density at the upper end of the threshold range relative to its middle. `curvature`: cubic
    share of the reversible part; negative values saturate towards the ends of the threshold range. `stiffening`:
    curvature of the displacement as a function of the summed relay and reversible parts, as a share of the stroke:
    positive if the flexure stiffens towards the upper end. With curvature, loops between the same voltages differ.

    `exponent`: of the power-law material (`PowerLawMaterial`), whose loops are similar at all amplitudes: peaks grow as
    voltage, from `origin` (V), to this power. 0 selects the exponential material, to which alone `width_scale`,
    `width_growth`, `bias_slope`, `bias_bow` and `curvature` apply. `width_exponent`: exponent by which the density of
    the power law decreases with relay width.

    `noise_rms` (m): standard deviation of the Gaussian sensor noise. `quantisation` (m): resolution of the sensor.
    `offset` (m): sensor reading at rest. `creep_gain`: creep per decade of time, as a share of the displacement,
    between the shortest and longest time constants `creep_shortest` and `creep_longest` (s). `resonance_frequency`
    (Hz), `resonance_damping`: undamped frequency and damping ratio of the flexure mode. `amplifier_lag` (s): time
    constant of the amplifier; the relays see the lagged voltage. A `quantisation`, `creep_gain`, `resonance_frequency`
    or `amplifier_lag` of 0 means none.
    """

    stroke: float = 22e-6
    hysteresis: float = 0.14
    nominal_voltage: float = 100.0
    threshold_min: float = -20.0
    threshold_max: float = 120.0
    levels: int = 280
    width_scale: float = 40.0
    width_growth: float = 0.3
    bias_slope: float = 0.3
    bias_bow: float = 0.2
    curvature: float = 0.1
    stiffening: float = 0.0
    noise_rms: float = 8e-9
    quantisation: float = 1e-9
    offset: float = 0.0
    exponent: float = 0.0
    origin: float = 0.0
    width_exponent: float = 1.0
    creep_gain: float = 0.0
    creep_shortest: float = 1e-3
    creep_longest: float = 100.0
    resonance_frequency: float = 0.0
    resonance_damping: float = 0.04
    amplifier_lag: float = 0.0

    def __post_init__(self) -> None:
        """Validate the parameters."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value):
                raise UsageError(f"stage: {item.name} is {value}; give a finite number")
        for name, holds, need in (
            ("stroke", self.stroke > 0, "more than 0 m"),
            ("hysteresis", 0 <= self.hysteresis < 1, "a share from 0 to below 1"),
            ("threshold_min", self.threshold_min <= 0, "0 V or less, so that the stage can rest at 0 V"),
            ("nominal_voltage", self.nominal_voltage > 0, "more than 0 V"),
            ("threshold_max", self.threshold_max >= self.nominal_voltage, "at least nominal_voltage"),
            ("levels", self.levels >= 2, "at least 2"),
            ("width_scale", self.width_scale > 0, "more than 0 V"),
            ("width_growth", abs(self.width_growth) < 1, "between -1 and 1"),
            ("curvature", self.curvature > -1 / 3, "more than -1/3, else the displacement would decrease"),
            ("stiffening", abs(self.stiffening) <= 0.1, "from -0.1 to 0.1"),
            ("noise_rms", self.noise_rms >= 0, "0 m or more"),
            ("quantisation", self.quantisation >= 0, "0 m or more"),
            ("exponent", self.exponent == 0 or 1 <= self.exponent <= 1.5, "from 1 to 1.5, or 0 for none"),
            ("origin", self.threshold_min <= self.origin <= 0, "from threshold_min to 0 V"),
            ("width_exponent", 1 <= self.width_exponent <= 10, "from 1 to 10"),
            ("creep_gain", 0 <= self.creep_gain <= 0.2, "from 0 to 0.2 for one decade"),
            ("creep_shortest", self.creep_shortest > 0, "more than 0 s"),
            ("creep_longest", self.creep_longest > self.creep_shortest, "more than creep_shortest"),
            ("resonance_frequency", self.resonance_frequency >= 0, "0 Hz or more"),
            ("resonance_damping", 0 < self.resonance_damping < 1, "between 0 and 1"),
            ("amplifier_lag", self.amplifier_lag >= 0, "0 s or more"),
        ):
            if not holds:
                raise UsageError(f"stage: {name} is {getattr(self, name)}; it must be {need}")

    @property
    def has_dynamics(self) -> bool:
        """Whether the displacement depends on time in addition to the sequence of voltages."""
        return bool(self.creep_gain or self.resonance_frequency or self.amplifier_lag)

    @classmethod
    def random(cls, seed: int) -> "StageParameters":
        """Return a random plausible stage: 20 to 25 µm, 12 to 17 % hysteresis, a density that varies with bias.

        The same `seed` gives the same stage; sensor noise and quantisation have their default values.
        """
        rng = np.random.default_rng(seed)

        def draw(low: float, high: float) -> float:
            return float(rng.uniform(low, high))

        return cls(
            stroke=draw(20e-6, 25e-6),
            hysteresis=draw(0.12, 0.17),
            width_scale=draw(30.0, 60.0),
            width_growth=draw(-0.4, 0.4),
            bias_slope=draw(0.5, 1.4),
            bias_bow=draw(-0.4, 0.4),
            curvature=draw(-0.1, 0.2),
            offset=draw(-0.2e-6, 0.2e-6),
            stiffening=draw(-0.01, 0.01),
        )
