"""A drive, sample by sample, with a safe end at any time."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slpi_ros.excitation.calibration import PACE
from slpi_ros.excitation.drives import Drive
from slpi_ros.excitation.legs import FEWEST_STEPS, FloatArray, Path, Room


class Playback:
    """Gives one set of voltages after the other; all that it ever gives is within the limits of the drive.

    Parameters
    ----------
    drive : Drive
    repeat : bool
        Begin again at the end, until stopped.

    Attributes
    ----------
    drive : Drive
        As given.
    stopping : bool
        Whether the axes are on their way back to where they rest.
    """

    def __init__(self, drive: Drive, *, repeat: bool = False) -> None:
        self.drive, self.stopping = drive, False
        self._repeat = repeat
        self._samples = np.column_stack(list(drive.voltage.values()))
        self._next = 0

    @property
    def done(self) -> bool:
        """Whether the last voltages have been given."""
        return self._next == len(self._samples)

    @property
    def samples_left(self) -> FloatArray:
        """Voltages still to be given, shape (n, axes), volts."""
        return self._samples[self._next :]

    @property
    def seconds_left(self) -> float:
        """How long that takes, seconds."""
        return len(self.samples_left) / self.drive.rate

    def next(self) -> list[float]:
        """Return the voltages of the next sample, volts, in the order of the drive's axes; at the end the last ones."""
        sample: list[float] = self._samples[min(self._next, len(self._samples) - 1)].tolist()
        if not self.done:
            self._next += 1
        if self.done and self._repeat and not self.stopping:
            self._next = 0
        return sample

    def stop(self) -> bool:
        """Turn back to where the axes rest; return whether that is news."""
        if self.stopping:
            return False
        self.stopping = True
        self._samples, self._next = self._way_back(self._samples[max(self._next - 1, 0)]), 0
        return True

    def _way_back(self, present: FloatArray) -> FloatArray:
        """Return the voltages after the `present` ones, shape (n, axes), volts: all axes move at once."""
        ways = [
            _Way(room, (now - room.low) / room.span, (voltage[0] - room.low) / room.span)
            for room, now, voltage in zip(
                self.drive.rooms.values(), present.tolist(), self.drive.voltage.values(), strict=True
            )
        ]
        # A few steps more: seconds become whole steps.
        seconds = max(way.seconds for way in ways) + FEWEST_STEPS / self.drive.rate
        return np.column_stack([way.voltages(seconds)[1:] for way in ways])


class _Way(NamedTuple):
    room: Room
    present: float
    rest: float

    @property
    def seconds(self) -> float:
        span = abs(self.rest - self.present)
        return max(span / PACE, self.room.quickest(span))

    def voltages(self, seconds: float) -> FloatArray:
        path = Path(self.present)
        path.to(self.rest, seconds)
        return path.voltages(replace(self.room, duration=seconds))
