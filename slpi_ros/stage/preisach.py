"""One axis of a simulated piezo stage: Preisach relays, a reversible curve, a flexure and a sensor."""

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.stage.figures import measure_loop
from slpi_ros.stage.parameters import StageParameters
from slpi_ros.stage.relays import RelayTriangle
from slpi_ros.stage.sensor import Sensor

__all__ = ["PreisachStage", "StageParameters"]

FloatArray = NDArray[np.float64]


class PreisachStage:
    """A stage whose displacement is a relay sum plus a reversible curve of the voltage, behind a flexure.

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
        self._centre, self._half_range = (low + high) / 2, (high - low) / 2
        self._sensor = Sensor(parameters.noise_rms, parameters.quantisation, seed)
        self._relays = RelayTriangle(low, high, parameters.levels, self._density)
        self._reversible_gain = self._share_stroke()
        self._zero = 0.0
        self._bottom = measure_loop(self._unbowed, 0.0, parameters.nominal_voltage).bottom
        self.rest()
        self._zero = self._displacement() - parameters.offset

    def rest(self) -> None:
        """Forget the past: all relays down at the lowest voltage, then 0 V."""
        self._relays.all_down()
        self._relays.step(0.0)

    def step(self, t: float, v: float) -> float:
        """Apply one voltage.

        Parameters
        ----------
        t : float, seconds
            When. The stage is rate independent; dynamics added to it will need the time.
        v : float, volts
            Within the threshold range.

        Returns
        -------
        float, metres
            The displacement, without sensor errors.

        Raises
        ------
        UsageError
            If `v` is not a number within the threshold range.
        """
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
            If the lengths differ or a voltage is not a number within the threshold range.
        """
        if t.shape != v.shape:
            raise UsageError(f"stage: {t.shape} times for {v.shape} voltages; give one time for each voltage")
        samples = zip(t.tolist(), v.tolist(), strict=True)
        y_true = np.array([self.step(*sample) for sample in samples], dtype=np.float64)
        return y_true, self._sensor.read(y_true)

    def _displacement(self) -> float:
        force = self._sum() - self._bottom
        bow = 4.0 * self.parameters.stiffening * force * (1.0 - force / self.parameters.stroke)
        return self._bottom + force + bow - self._zero

    def _sum(self) -> float:
        return self._relays.output + self._reversible_gain * self._reversible(self._relays.voltage)

    def _unbowed(self, voltage: float) -> float:
        self._relays.step(voltage)
        return self._sum()

    def _density(self, bias: FloatArray, width: FloatArray) -> FloatArray:
        # The fall with width changes with bias too: a mere product of the two would be too easy a stage.
        b = (bias - self._centre) / self._half_range
        scale = self.parameters.width_scale * (1 + self.parameters.width_growth * b)
        density = np.exp(self.parameters.bias_slope * b + self.parameters.bias_bow * b**2 - width / scale)
        return np.asarray(density, dtype=np.float64)

    def _reversible(self, voltage: float) -> float:
        x = (voltage - self._centre) / self._half_range
        return x + self.parameters.curvature * x**3

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
        return (1 - share) * wanted.stroke / (self._reversible(nominal) - self._reversible(0.0))
