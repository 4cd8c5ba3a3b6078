"""Faults of the sensor of an axis under feedback: silent, stuck, inverted or noisy."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.io.messages import SECOND_NS

# The model has to move by this share of the displacement range, and by this many times the noise of the sensor, before
# a reading that stays or moves the other way is a fault.
MOVED_SHARE, MOVED_NOISES = 0.02, 8.0
# A reading is stuck if it follows the model with less than this slope, inverted below this one. As the sensor may be
# late, the largest slope counts over shifts of the readings by up to this share of the time looked at.
STUCK_SLOPE, INVERTED_SLOPE = 0.1, -0.2
LATE_SHARE, SHIFTS = 0.1, 16
# The reading is noisy if it scatters by more than this share of the displacement range, rms, from sample to sample.
NOISY_SHARE = 0.03
# Fewest readings for a judgement.
FEWEST = 8
# Most readings that are kept.
KEPT = 4096


@dataclass(frozen=True)
class Fault:
    """Fault of a sensor: "silent", "stuck", "inverted" or "noisy", and what was seen, with numbers."""

    kind: str
    reason: str


class SensorWatch:
    """Hold the readings of a sensor against the model's displacement for the output voltages; m, steady clock in ns."""

    def __init__(self, span: float, noise: float = 0.0) -> None:
        self.span, self.noise = span, noise
        # Time (ns), displacement of the model (m), reading (m).
        self._readings: deque[tuple[int, float, float]] = deque(maxlen=KEPT)
        self._heard_ns: int | None = None
        self._suspect: tuple[str, int] | None = None

    def begin(self, now_ns: int) -> None:
        """Start to watch at `now_ns`; what was read before does not count."""
        self._readings.clear()
        self._heard_ns, self._suspect = now_ns, None

    def read(self, expected: float, reading: float, now_ns: int) -> None:
        """Take a reading (m), and the displacement of the model (m) at that time."""
        self._heard_ns = now_ns
        self._readings.append((now_ns, expected, reading))

    def judge(self, now_ns: int, fault_time: float) -> Fault | None:
        """Return the fault that has lasted for `fault_time` (s) at `now_ns`; None without one."""
        if self._heard_ns is None:
            return None
        silence = (now_ns - self._heard_ns) * 1e-9
        if silence > fault_time:
            return Fault("silent", f"no measured_displacement for {silence:.2g} s")
        found = self._look(now_ns, fault_time)
        if found is None:
            self._suspect = None
            return None
        if self._suspect is None or self._suspect[0] != found.kind:
            self._suspect = found.kind, now_ns
        # The readings that show it already span half of the time.
        return found if (now_ns - self._suspect[1]) * 1e-9 >= fault_time / 2 else None

    def _look(self, now_ns: int, fault_time: float) -> Fault | None:
        """Return the fault that the readings of the last `fault_time` (s) show."""
        oldest_ns = now_ns - int(fault_time * SECOND_NS)
        while self._readings and self._readings[0][0] < oldest_ns:
            self._readings.popleft()
        if len(self._readings) < FEWEST:
            return None
        _, expected, reading = np.array(self._readings, dtype=float).T
        model = float(np.ptp(expected))
        # Second differences remove what moves evenly.
        scatter = float(np.std(np.diff(reading, 2))) / 6.0**0.5
        smooth = float(np.std(np.diff(expected, 2))) / 6.0**0.5
        if scatter > NOISY_SHARE * self.span + 2.0 * smooth:
            return Fault("noisy", f"the reading scatters by {scatter * 1e9:.4g} nm rms")
        if model < max(MOVED_SHARE * self.span, MOVED_NOISES * self.noise):
            return None
        slope = _slope(expected, reading)
        if slope < INVERTED_SLOPE:
            return Fault(
                "inverted", f"the reading moves by {slope:.2g} m for each metre that the voltage moves; check its sign"
            )
        if slope < STUCK_SLOPE:
            moved = f"{np.ptp(reading) * 1e9:.3g} nm while the voltage moves it by {model * 1e9:.4g} nm"
            return Fault("stuck", f"the reading stays within {moved}")
        return None


def _slope(expected: FloatArray, reading: FloatArray) -> float:
    """Return the largest slope of the readings over the model, shape (N,) each, that a delay of the sensor allows."""
    latest = int(LATE_SHARE * expected.size)
    slopes = []
    for shift in sorted({round(share * latest) for share in np.linspace(0.0, 1.0, SHIFTS)}):
        early, late = expected[: expected.size - shift], reading[shift:]
        centred = early - early.mean()
        power = float(centred @ centred)
        if power > 0.0:
            slopes.append(float(centred @ (late - late.mean())) / power)
    return max(slopes, default=1.0)
