"""Stand-in for the interface of your amplifier and sensor: replace the body of the four methods."""

import time

from slpi_ros.simulation.stage import Stage


class Device:
    def __init__(self):
        """Open the amplifier and the sensor."""
        self._stage = Stage.random(["x"], seed=4, noise_rms=8e-9)
        self.write(0.0)

    def applied(self):
        """Return the voltage that the amplifier has, volts."""
        return self._voltage

    def write(self, voltage):
        """Apply a voltage, volts."""
        self._voltage = voltage
        self._displacement = self._stage.step(time.monotonic(), [voltage])

    def read(self):
        """Return the measured displacement, metres."""
        return self._stage.measure(self._displacement)[0]
