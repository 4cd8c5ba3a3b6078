"""The last readings of a device, by which a sensor that is slower than the cycle shows."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from slpi_ros.drivers.base import Reading

# Readings that are kept.
KEPT = 5_000


class RecentReadings:
    """Keeps the last readings; `rows` tells for how many cycles the sensor of a channel holds each of its own."""

    def __init__(self) -> None:
        self._readings: deque[Reading] = deque(maxlen=KEPT)
        self._rows: dict[int, float] = {}

    def note(self, reading: Reading) -> None:
        """Take a reading; by the thread of the device."""
        self._readings.append(reading)

    def rows(self) -> Sequence[float]:
        """Return the cycles for which readings are held, for each channel; 1: they are not, or it is unknown."""
        # It only shows while the stage moves, so that what was found is kept.
        from slpi_ros.identification.held_readings import held_readings

        readings = list(self._readings.copy())
        if not readings:
            return []
        positions, voltages = (np.array([getattr(one, name) for one in readings]) for name in ("positions", "voltages"))
        for channel in range(positions.shape[1]):
            y, v = positions[:, channel], voltages[:, channel]
            known = np.isfinite(y) & np.isfinite(v)
            found = held_readings(y[known], v[known])
            if found.found:
                self._rows[channel] = found.rows
        return [self._rows.get(channel, 1.0) for channel in range(positions.shape[1])]
