"""One axis of a simulated piezo stage: amplifier, Preisach relays, a reversible curve, creep, a flexure, a sensor."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.simulation.dynamics import Dynamics
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.paths import measure_loop
from slpi_ros.simulation.sensor import Sensor

FloatArray = NDArray[np.float64]


class Material(Protocol):
    """What a stage needs to know of its piezo."""

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays by bias and width (V), any unit, for RelayTriangle."""

    def reversible(self, voltage: float) -> float:
        """Return the part of the displacement without memory, any unit, at a voltage (V)."""


class ExponentialMaterial:
    """Relays whose number falls exponentially with their width and changes with bias; a cubic reversible curve.

    Parameters
    ----------
    parameters : StageParameters
        Of which the threshold range, `width_scale` and `width_growth`, `bias_slope`, `bias_bow` and `curvature` are
        used.
    """

    def __init__(self, parameters: StageParameters) -> None:
        self._parameters = parameters
        low, high = parameters.threshold_min, parameters.threshold_max
        self._centre, self._half_range = (low + high) / 2, (high - low) / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays.

        Parameters
        ----------
        bias, width : ndarray, one shape, volts
            Mean of the two thresholds and their distance.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
        # The fall with width changes with bias too: a mere product of the two would be too easy a stage.
        b = (bias - self._centre) / self._half_range
        scale = self._parameters.width_scale * (1 + self._parameters.width_growth * b)
        density = np.exp(self._parameters.bias_slope * b + self._parameters.bias_bow * b**2 - width / scale)
        return np.asarray(density, dtype=np.float64)

    def reversible(self, voltage: float) -> float:
        """Return the reversible part at a voltage (V), in arbitrary units."""
        x = (voltage - self._centre) / self._half_range
        return x + self._parameters.curvature * x**3


class PowerLawMaterial:
    """Relays without a scale of their own: loops of every amplitude look alike.

    With thresholds counted from `origin`, the density of relays that switch up at ``a`` and down at ``b <= a`` is
    ``mu(a, b) = a^(p-2) (b/a)^m``, ``p`` the `exponent` and ``m`` the `width_exponent`: a relay's width counts relative
    to its voltage, and the wider ones are rarer. Below the origin the density is its mirror image, and no relay has
    one threshold on either side: a preloaded stack comes back to where it started. The sum over a triangle of relays
    is the Everett function

    ``E(a, b) = a^p [(1 - r^p) / p - (1 - r^(m+1)) / (m+1)] / (m+1-p)``, ``r = b/a``,

    homogeneous of degree ``p``. The rise from the origin is ``V^p``, nearly straight where ``p`` is nearly 1; the fall
    has the slope ``r^(p-1) - r^m``, little after the turn and more and more later: for ``p = m = 1`` the parabola of
    Rayleigh's law, whose opening here grows with the amplitude and not with its square.

    Parameters
    ----------
    parameters : StageParameters
        Of which the threshold range, `levels`, `exponent`, `origin` and `width_exponent` are used.

    References
    ----------
    I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Sec. 1.2 (Everett function).
    """

    def __init__(self, parameters: StageParameters) -> None:
        self._origin, self._exponent = parameters.origin, parameters.exponent
        self._width_exponent = parameters.width_exponent
        self._half_cell = (parameters.threshold_max - parameters.threshold_min) / parameters.levels / 2

    def density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        """Return weights of relays, integrated over the cells of the grid.

        The middle of a cell does not stand for the cell close to the origin, where the loops of small amplitude live.

        Parameters
        ----------
        bias, width : ndarray, one shape, volts
            Mean of the two thresholds and their distance, in the middle of each cell.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
        up, down = bias + width / 2, bias - width / 2
        up_low, up_high = up - self._half_cell, up + self._half_cell
        down_low, down_high = down - self._half_cell, down + self._half_cell
        outer = self.everett(up_high, down_low) + self.everett(up_low, down_high)
        return np.maximum(outer - self.everett(up_low, down_low) - self.everett(up_high, down_high), 0.0)

    def everett(self, up: FloatArray, down: FloatArray) -> FloatArray:
        """Return the sum of the relays that a fall from one voltage to another switches.

        Parameters
        ----------
        up, down : ndarray, one shape, volts
            Where the fall begins and ends; where it would rise, the sum is 0.

        Returns
        -------
        ndarray, same shape
            In arbitrary units.
        """
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


def material(parameters: StageParameters) -> Material:
    """Return the material of a stage.

    Parameters
    ----------
    parameters : StageParameters
        With an `exponent` relays spread by a power law, without one exponentially.

    Returns
    -------
    Material
        Its density and its reversible curve.
    """
    return PowerLawMaterial(parameters) if parameters.exponent else ExponentialMaterial(parameters)


Density = Callable[[FloatArray, FloatArray], FloatArray]


class RelayTriangle:
    """Relays that switch up at one threshold and down at a lower one, summed with weights.

    Row ``i`` and column ``j <= i`` of the state matrix hold a bundle of relays whose up-thresholds are spread
    evenly from ``low + i h`` to ``low + (i + 1) h`` and whose down-thresholds lie ``(i - j) h`` below them;
    the state is the share of the bundle that is up. Without the spread, the level spacing ``h`` would show as
    steps of tens of nanometres.

    Parameters
    ----------
    low, high : float, volts
        Range of the thresholds, and of the voltages the relays accept.
    levels : int
        Number of rows and of columns.
    density : callable
        ``density(bias, width)`` in arbitrary units: the weight of relays whose thresholds have the mean
        ``bias`` (V) and the distance ``width`` (V); called once with arrays of shape (levels, levels).

    Attributes
    ----------
    output : float
        Weighted sum of the states, in the unit of `density`.
    voltage : float, volts
        The voltage of the last step.

    References
    ----------
    I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Eq. (1.1).
    """

    def __init__(self, low: float, high: float, levels: int, density: Density) -> None:
        self._low, self._high = low, high
        self._spacing = (high - low) / levels
        threshold = low + self._spacing * (np.arange(levels) + 0.5)
        up, down = threshold[:, None], threshold[None, :]
        self._weight: FloatArray = np.tril(density((up + down) / 2, np.maximum(up - down, 0.0)))
        self._state: FloatArray = np.zeros((levels, levels))
        self._index = np.arange(levels, dtype=np.float64)
        self.all_down()

    def all_down(self) -> None:
        """Switch every relay down, as the lowest voltage does."""
        self._state[:] = 0.0
        self._position = 0.0
        self.output = 0.0
        self.voltage = self._low

    def scale(self, factor: float) -> None:
        """Multiply every weight, and so the output, by `factor`."""
        self._weight *= factor
        self.output *= factor

    @property
    def state(self) -> FloatArray:
        """Share of relays up in each bundle, shape (levels, levels), 0 where there is none; a copy."""
        return np.tril(self._state)

    def check(self, voltage: float) -> None:
        """Refuse a voltage (V) that is not a number between the lowest and the highest threshold: UsageError."""
        if not self._low <= voltage <= self._high:
            raise UsageError(f"stage: {voltage} V is not within {self._low} to {self._high} V; clip it")

    def step(self, voltage: float) -> float:
        """Apply a voltage and switch the relays it passes.

        Parameters
        ----------
        voltage : float, volts
            Any value between the lowest and the highest threshold.

        Returns
        -------
        float
            The weighted sum of the states, in the unit of the density.

        Raises
        ------
        UsageError
            If the voltage is not a number between the lowest and the highest threshold.
        """
        self.check(voltage)
        position = (voltage - self._low) / self._spacing
        if position > self._position:
            self._rise(position)
        elif position < self._position:
            self._fall(position)
        self._position, self.voltage = position, voltage
        return self.output

    def _rise(self, position: float) -> None:
        # Rows below the old voltage are already up, rows above the new one are not reached.
        first, end = int(self._position), min(int(position) + 1, len(self._index))
        share = np.minimum(position - self._index[first:end, None], 1.0)
        block = (slice(first, end), slice(0, end))
        self._switch(block, np.maximum(self._state[block], share))

    def _fall(self, position: float) -> None:
        first, end = int(position), min(int(self._position) + 1, len(self._index))
        share = np.maximum(position - self._index[None, first:end], 0.0)
        block = (slice(first, None), slice(first, end))
        self._switch(block, np.minimum(self._state[block], share))

    def _switch(self, block: tuple[slice, slice], after: FloatArray) -> None:
        self.output += float(np.sum(self._weight[block] * (after - self._state[block])))
        self._state[block] = after


__all__ = ["PreisachStage", "StageParameters"]


class PreisachStage:
    """A stage whose displacement is a relay sum plus a reversible curve of the voltage, behind a flexure.

    Where its parameters say so, the voltage passes a slow amplifier first, and the displacement creeps and rings.

    Parameters
    ----------
    parameters : StageParameters, optional
        What the axis is made of; the defaults of StageParameters without it.
    seed : int
        Of the sensor noise.

    Attributes
    ----------
    parameters : StageParameters
        As given.

    Raises
    ------
    UsageError
        If so wide a hysteresis needs more than the whole stroke from the relays.
    """

    def __init__(self, parameters: StageParameters | None = None, seed: int = 0) -> None:
        self.parameters = parameters = parameters or StageParameters()
        low, high = parameters.threshold_min, parameters.threshold_max
        self._material = material(parameters)
        self._dynamics = Dynamics(parameters) if parameters.has_dynamics else None
        self._sensor = Sensor(parameters.noise_rms, parameters.quantisation, seed)
        self._relays = RelayTriangle(low, high, parameters.levels, self._material.density)
        self._reversible_gain = self._share_stroke()
        self._zero = 0.0
        self._bottom = measure_loop(self._unbowed, 0.0, parameters.nominal_voltage).bottom
        self.rest()
        self._zero = self._displacement() - parameters.offset

    def rest(self) -> None:
        """Forget the past and the time: all relays down at the lowest voltage, then 0 V for long."""
        self._relays.all_down()
        self._relays.step(0.0)
        if self._dynamics:
            self._dynamics.rest()

    def step(self, t: float, v: float) -> float:
        """Apply one voltage.

        Parameters
        ----------
        t : float, seconds
            When. Without dynamics it means nothing. With them, voltage and displacement are taken as linear since
            the last call; no time passes before the first one after rest.
        v : float, volts
            Within the threshold range.

        Returns
        -------
        float, metres
            The displacement, without sensor errors.

        Raises
        ------
        UsageError
            If `v` is not a number within the threshold range or, with dynamics, `t` goes back.
        """
        if self._dynamics:
            return self._step_in_time(self._dynamics, t, v)
        self._relays.step(v)
        return self._displacement()

    def measure(self, y_true: float) -> float:
        """Read the sensor at a displacement (m) and return the reading (m)."""
        return float(self._sensor.read(np.asarray(y_true)))

    def run(self, t: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Apply a record of voltages, continuing from the present state.

        Parameters
        ----------
        t : ndarray, shape (N,), seconds
            Times of the samples.
        v : ndarray, shape (N,), volts
            Within the threshold range.

        Returns
        -------
        y_true : ndarray, shape (N,), metres
            The displacement.
        y_measured : ndarray, shape (N,), metres
            What the sensor reads.

        Raises
        ------
        UsageError
            If the lengths differ, a voltage is not a number within the threshold range or, with dynamics, a time goes
            back.
        """
        if t.shape != v.shape:
            raise UsageError(f"stage: {t.shape} times for {v.shape} voltages; give one time for each voltage")
        samples = zip(t.tolist(), v.tolist(), strict=True)
        y_true = np.array([self.step(*sample) for sample in samples], dtype=np.float64)
        return y_true, self._sensor.read(y_true)

    def respond(self, v: FloatArray, relay_voltage: FloatArray) -> FloatArray:
        """Apply a path of which the relays see something else than the reversible part; amplifier and time have no say.

        Parameters
        ----------
        v : ndarray, shape (N,), volts
            What the reversible part follows.
        relay_voltage : ndarray, shape (N,), volts
            What switches the relays, within the threshold range.

        Returns
        -------
        ndarray, shape (N,), metres
            The displacement, without sensor errors.
        """
        y = np.empty_like(v)
        for index, (voltage, seen) in enumerate(zip(v.tolist(), relay_voltage.tolist(), strict=True)):
            self._relays.step(seen)
            y[index] = self._bowed(self._sum(voltage))
        return y

    def _step_in_time(self, dynamics: Dynamics, t: float, v: float) -> float:
        self._relays.check(v)
        duration = dynamics.advance(t)
        lagged = dynamics.amplify(duration, v)
        # Rounding must not carry the lagged voltage over the last threshold.
        self._relays.step(min(max(lagged, self.parameters.threshold_min), self.parameters.threshold_max))
        offset = self.parameters.offset
        return offset + dynamics.follow(duration, self._displacement() - offset)

    def _displacement(self) -> float:
        return self._bowed(self._sum(self._relays.voltage))

    def _bowed(self, unbowed: float) -> float:
        force = unbowed - self._bottom
        bow = 4.0 * self.parameters.stiffening * force * (1.0 - force / self.parameters.stroke)
        return self._bottom + force + bow - self._zero

    def _sum(self, voltage: float) -> float:
        return self._relays.output + self._reversible_gain * self._material.reversible(voltage)

    def _unbowed(self, voltage: float) -> float:
        self._relays.step(voltage)
        return self._sum(voltage)

    def _share_stroke(self) -> float:
        """Weight the relays for the wanted hysteresis; return the gain that gives the other part the rest."""
        wanted, nominal = self.parameters, self.parameters.nominal_voltage
        relays = measure_loop(self._relays.step, 0.0, nominal)
        share = wanted.hysteresis / relays.hysteresis
        if share > 1:
            raise UsageError(
                f"stage: hysteresis is {wanted.hysteresis}, but relays of width_scale {wanted.width_scale} V "
                f"give at most {relays.hysteresis:.3f}; lower it or raise width_scale"
            )
        self._relays.scale(share * wanted.stroke / relays.stroke)
        return (1 - share) * wanted.stroke / (self._material.reversible(nominal) - self._material.reversible(0.0))
