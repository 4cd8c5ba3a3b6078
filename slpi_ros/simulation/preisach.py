"""Hysteresis of a simulated piezo stage: Preisach relays and a reversible curve."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import UsageError
from slpi_ros.simulation.parameters import AxisParameters


class ExponentialMaterial:
    """A relay density that decreases exponentially with width and varies with bias, and a cubic reversible curve."""

    def __init__(self, parameters: AxisParameters) -> None:
        self._parameters = parameters
        low, high = parameters.threshold_min, parameters.threshold_max
        self._centre, self._half_range = (low + high) / 2, (high - low) / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return relay weights, arbitrary unit, for mean and distance (V) of the thresholds, arrays of one shape."""
        # The decay with width varies with bias, because a product of the two would be unrealistically simple.
        b = (bias - self._centre) / self._half_range
        scale = self._parameters.width_scale * (1 + self._parameters.width_growth * b)
        density = np.exp(self._parameters.bias_slope * b + self._parameters.bias_bow * b**2 - width / scale)
        return np.asarray(density, dtype=np.float64)

    def reversible(self, voltage: float) -> float:
        """Return the reversible part at a voltage (V), in arbitrary units."""
        x = (voltage - self._centre) / self._half_range
        return x + self._parameters.curvature * x**3


class PowerLawMaterial:
    """A scale-free relay density: loops of all amplitudes are similar.

    With thresholds relative to `origin`, the density of relays that switch up at ``a`` and down at ``b <= a`` is
    ``mu(a, b) = a^(p-2) (b/a)^m``, with ``p`` the `exponent` and ``m`` the `width_exponent`. Below the origin the
    density is its mirror image, and no relay has thresholds on both sides: a preloaded stack returns to its start. The
    sum over a triangle of relays is the Everett function

    ``E(a, b) = a^p [(1 - r^p) / p - (1 - r^(m+1)) / (m+1)] / (m+1-p)``, ``r = b/a``,

    homogeneous of degree ``p``. The rise from the origin is ``V^p``, nearly straight for ``p`` near 1; the slope of the
    fall, ``r^(p-1) - r^m``, is small after the reversal and then increases: for ``p = m = 1`` the parabola of
    Rayleigh's law, with a width that grows with the amplitude instead of its square.

    References
    ----------
    I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Sec. 1.2 (Everett function).
    """

    def __init__(self, parameters: AxisParameters) -> None:
        self._origin, self._exponent = parameters.origin, parameters.exponent
        self._width_exponent = parameters.width_exponent
        self._half_cell = (parameters.threshold_max - parameters.threshold_min) / parameters.levels / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return relay weights, integrated over cells with mean and distance (V) of the thresholds at the centre."""
        # The density at the centre of a cell is inaccurate close to the origin, which determines small loops.
        up, down = bias + width / 2, bias - width / 2
        up_low, up_high = up - self._half_cell, up + self._half_cell
        down_low, down_high = down - self._half_cell, down + self._half_cell
        outer = self.everett(up_high, down_low) + self.everett(up_low, down_high)
        return np.maximum(outer - self.everett(up_low, down_low) - self.everett(up_high, down_high), 0.0)

    def everett(self, up: FloatArray, down: FloatArray) -> FloatArray:
        """Return the sum of the relays that switch in a fall from `up` to `down` (V); 0 if `down` exceeds `up`."""
        a, b = up - self._origin, down - self._origin
        return self._above_origin(a, b) + self._above_origin(-b, -a)

    def reversible(self, voltage: float) -> float:
        """Return the reversible part at a voltage (V), in arbitrary units."""
        x = voltage - self._origin
        return float(np.sign(x) * abs(x) ** self._exponent)

    def _above_origin(self, up: FloatArray, down: FloatArray) -> FloatArray:
        p, m = self._exponent, self._width_exponent
        up = np.maximum(up, 0.0)
        ratio = np.divide(np.clip(down, 0.0, up), up, out=np.ones_like(up), where=up > 0)
        fall = (1 - ratio**p) / p - (1 - ratio ** (m + 1)) / (m + 1)
        return np.asarray(up**p * fall / (m + 1 - p), dtype=np.float64)


Material = ExponentialMaterial | PowerLawMaterial


def material(parameters: AxisParameters) -> Material:
    """Return the material of a stage: with an `exponent` other than 0 the power law, else the exponential density."""
    return PowerLawMaterial(parameters) if parameters.exponent else ExponentialMaterial(parameters)


Density = Callable[[FloatArray, FloatArray], FloatArray]


class RelayTriangle:
    """A weighted sum of relays that switch up at one threshold and down at a lower one (Mayergoyz, Eq. (1.1))."""

    # Row ``i`` and column ``j <= i`` of the state matrix hold a group of relays with up-thresholds uniformly
    # distributed from ``low + i h`` to ``low + (i + 1) h`` and down-thresholds ``(i - j) h`` below; the state is the
    # share of the group that is up. With discrete thresholds, the level spacing ``h`` (V) would produce steps of tens
    # of nanometres. ``density(bias, width)`` returns the weights of relays by mean and distance (V) of their
    # thresholds, (levels, levels).

    def __init__(self, low: float, high: float, levels: int, density: Density) -> None:
        self._low, self._high = low, high
        self._spacing = (high - low) / levels
        threshold = low + self._spacing * (np.arange(levels) + 0.5)
        up, down = threshold[:, None], threshold[None, :]
        self._weight: FloatArray = np.tril(density((up + down) / 2, np.maximum(up - down, 0.0)))
        self._state: FloatArray = np.zeros((levels, levels))
        self._index = np.arange(levels, dtype=np.float64)
        self._used = np.tri(levels)
        self.all_down()

    def all_down(self) -> None:
        """Switch all relays down, as at the lowest voltage."""
        self._state[:] = 0.0
        self._position = 0.0
        self.output = 0.0
        self.voltage = self._low

    def scale(self, factor: float) -> None:
        """Multiply all weights, and the output, by `factor`."""
        self._weight *= factor
        self.output *= factor

    @property
    def state(self) -> FloatArray:
        """Share of relays that are up in each group, shape (levels, levels), 0 for unused elements; a copy."""
        return self._state * self._used

    def check(self, voltage: float) -> None:
        """Raise UsageError if a voltage (V) is not a number within the threshold range."""
        if not self._low <= voltage <= self._high:
            raise UsageError(f"stage: {voltage} V is not within {self._low} to {self._high} V; clip it")

    def step(self, voltage: float) -> float:
        """Apply a voltage (V); return the weighted sum of the states, in the unit of the density."""
        self.check(voltage)
        position = (voltage - self._low) / self._spacing
        if position > self._position:
            self._rise(position)
        elif position < self._position:
            self._fall(position)
        self._position, self.voltage = position, voltage
        return self.output

    def _rise(self, position: float) -> None:
        # Rows below the old voltage are already up; rows above the new voltage are not reached.
        first, end = int(self._position), min(int(position) + 1, len(self._index))
        share = np.minimum(position - self._index[first:end, None], 1.0)
        state = self._state[first:end, :end]
        self._switch(self._weight[first:end, :end], state, np.maximum(state, share))

    def _fall(self, position: float) -> None:
        first, end = int(position), min(int(self._position) + 1, len(self._index))
        share = np.maximum(position - self._index[None, first:end], 0.0)
        state = self._state[first:, first:end]
        self._switch(self._weight[first:, first:end], state, np.minimum(state, share))

    def _switch(self, weight: FloatArray, state: FloatArray, after: FloatArray) -> None:
        # np.sum would check its arguments first, which takes as long as the sum.
        self.output += float(np.add.reduce(weight * (after - state), axis=None))
        state[:] = after


@dataclass(frozen=True)
class LoopFigure:
    """Displacements (m) that characterise a closed major loop."""

    start: float  # at the lower voltage before the first rise
    bottom: float  # at the lower voltage
    top: float  # at the upper voltage
    rising_middle: float  # at the middle voltage
    falling_middle: float  # at the middle voltage

    @property
    def stroke(self) -> float:
        """Height of the closed loop, metres."""
        return self.top - self.bottom

    @property
    def hysteresis(self) -> float:
        """Width of the loop at the middle voltage, as a share of the stroke."""
        return (self.falling_middle - self.rising_middle) / self.stroke

    @property
    def remanence(self) -> float:
        """Displacement that remains at the lower voltage after the first rise and fall, metres."""
        return self.bottom - self.start


def measure_loop(respond: Callable[[float], float], low: float, high: float) -> LoopFigure:
    """Drive two major loops from `low` to `high` (V) from rest; return the values of the second, closed one."""
    middle = (low + high) / 2
    start, _, bottom = respond(low), respond(high), respond(low)
    rising_middle, top, falling_middle = respond(middle), respond(high), respond(middle)
    respond(low)
    return LoopFigure(start, bottom, top, rising_middle, falling_middle)


class PreisachHysteresis:
    """Hysteresis of one axis: a relay sum plus a reversible function of the voltage, bent by a stiffening flexure."""

    def __init__(self, parameters: AxisParameters) -> None:
        self._parameters = parameters
        self._material = material(parameters)
        low, high = parameters.threshold_min, parameters.threshold_max
        self._relays = RelayTriangle(low, high, parameters.levels, self._material.density)
        self._reversible_gain = self._share_stroke()
        self._zero = 0.0
        self._bottom = measure_loop(self._unbowed, 0.0, parameters.nominal_voltage).bottom
        self.rest()
        self._zero = self._bowed(self._sum(0.0))

    def rest(self) -> None:
        """Reset to rest: all relays down at the lowest voltage, then 0 V for a long time."""
        self._relays.all_down()
        self._relays.step(0.0)

    def check(self, voltage: float) -> None:
        """Raise UsageError if a voltage (V) is not a number within the threshold range."""
        self._relays.check(voltage)

    def step(self, v: float, relay_voltage: float) -> float:
        """Apply one voltage (V) to the reversible part and one to the relays; return the displacement (m)."""
        self._relays.step(relay_voltage)
        return self._bowed(self._sum(v))

    def _bowed(self, unbowed: float) -> float:
        force = unbowed - self._bottom
        bow = 4.0 * self._parameters.stiffening * force * (1.0 - force / self._parameters.stroke)
        return self._bottom + force + bow - self._zero

    def _sum(self, voltage: float) -> float:
        return self._relays.output + self._reversible_gain * self._material.reversible(voltage)

    def _unbowed(self, voltage: float) -> float:
        self._relays.step(voltage)
        return self._sum(voltage)

    def _share_stroke(self) -> float:
        """Scale the relays to the specified hysteresis; return the gain of the reversible part for the full stroke."""
        wanted, nominal = self._parameters, self._parameters.nominal_voltage
        relays = measure_loop(self._relays.step, 0.0, nominal)
        share = wanted.hysteresis / relays.hysteresis
        if share > 1:
            raise UsageError(
                f"stage: hysteresis is {wanted.hysteresis}, but relays of width_scale {wanted.width_scale} V "
                f"give at most {relays.hysteresis:.3f}; lower it or raise width_scale"
            )
        self._relays.scale(share * wanted.stroke / relays.stroke)
        return (1 - share) * wanted.stroke / (self._material.reversible(nominal) - self._material.reversible(0.0))
