"""One axis of a simulated piezo stage: amplifier, Preisach relays, a reversible curve, creep, a flexure, a sensor."""

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError
from slpi_ros.simulation.density import material
from slpi_ros.simulation.dynamics import Dynamics
from slpi_ros.simulation.figures import measure_loop
from slpi_ros.simulation.parameters import StageParameters
from slpi_ros.simulation.relays import RelayTriangle
from slpi_ros.simulation.sensor import Sensor

__all__ = ["PreisachStage", "StageParameters"]

FloatArray = NDArray[np.float64]


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
