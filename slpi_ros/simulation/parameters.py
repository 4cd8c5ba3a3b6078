"""Parameters of the hysteresis and of the sensor of a simulated axis."""

import math
from dataclasses import dataclass, fields

import numpy as np

from slpi_ros.errors import UsageError


@dataclass(frozen=True)
class AxisParameters:
    """Hysteresis and sensor noise of one axis of a simulated stage; UsageError if a value is out of range."""

    stroke: float = 22e-6  # m, height of the closed loop between 0 V and `nominal_voltage`
    hysteresis: float = 0.14  # width of that loop at the middle voltage, as a share of the stroke
    nominal_voltage: float = 100.0  # V
    threshold_min: float = -20.0  # V, of the relays; below 0 V: there is a remanence at 0 V
    threshold_max: float = 120.0  # V
    levels: int = 280  # of the relay grid
    # Curvature of the displacement over the sum of relays and reversible part, as a share of the stroke: positive if
    # the flexure stiffens towards the upper end. With it, loops between the same voltages differ.
    stiffening: float = 0.0

    # The exponential material:
    width_scale: float = 40.0  # V, relay width at which the density has decreased to 1/e
    width_growth: float = 0.3  # its relative change from the middle to the upper end of the threshold range
    bias_slope: float = 0.3  # part of the logarithm of the density at the upper end that is odd in the bias
    bias_bow: float = 0.2  # the even part
    curvature: float = 0.1  # cubic share of the reversible part; negative: saturates towards the ends of the range

    # The power-law material, whose loops are similar at all amplitudes:
    exponent: float = 0.0  # peaks grow as voltage, from `origin`, to this power; 0: the exponential material
    origin: float = 0.0  # V
    width_exponent: float = 1.0  # by which the density decreases with relay width

    noise_rms: float = 8e-9  # m, Gaussian
    quantisation: float = 1e-9  # m, resolution of the sensor; 0: none
    offset: float = 0.0  # m, sensor reading at rest

    def __post_init__(self) -> None:
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
        ):
            if not holds:
                raise UsageError(f"stage: {name} is {getattr(self, name)}; it must be {need}")

    @classmethod
    def random(cls, seed: int) -> "AxisParameters":
        """Return a random plausible axis: 20 to 25 µm, 12 to 17 % hysteresis, a density that varies with bias."""
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
