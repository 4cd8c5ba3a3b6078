"""All axes driven on their own: to a safe voltage, or to a known memory."""

from collections.abc import Collection, Sequence

from slpi_ros.compensator.axis import Axis
from slpi_ros.compensator.persistence import KNOWN, RESETTING, MemoryConfidence
from slpi_ros.compensator.ramps import Ramp
from slpi_ros.model.limits import decaying_turns


class Driving:
    """What moves axes on their own.

    Parameters
    ----------
    axes : sequence of Axis
        Each with a model before anything starts.

    Attributes
    ----------
    on : bool
        Whether something has been started and not been stopped.
    resetting : bool
        Whether that is a reset of the memory.
    """

    def __init__(self, axes: Sequence[Axis]) -> None:
        self._axes = axes
        self._spans: list[tuple[float, float]] = []
        self.on = self.resetting = False

    def reset(self, cycles: int, rate: float, finals: Sequence[float]) -> None:
        """Start the decaying oscillation that wipes the memory.

        Parameters
        ----------
        cycles : int
        rate : float, V/s
        finals : sequence of float, volts
            Where the axes end, or as near as their limits allow.
        """
        self.stop()
        for axis, final in zip(self._axes, finals, strict=True):
            limits = axis.stream.limits
            axis.start_drive(Ramp(decaying_turns(limits, limits.clip(final), cycles), rate))
            axis.trust = MemoryConfidence(RESETTING)
        self._spans = [(axis.stream.voltage,) * 2 for axis in self._axes]
        self.on = self.resetting = True

    def ramp(self, goals: Sequence[float], rate: float) -> None:
        """Start to go to the voltages `goals` (V), or as near as limits allow, at `rate` (V/s)."""
        self.stop()
        for axis, goal in zip(self._axes, goals, strict=True):
            axis.start_drive(Ramp([goal], rate))
        self.on = True

    def hold(self, but: Collection[Axis] = ()) -> None:
        """Let the axes `but` go, and leave the others where they are: at rest, or where they come to rest."""
        if self.resetting:
            self.stop()
        for axis in self._axes:
            if axis not in but and axis.in_motion:
                axis.brake()
                continue
            axis.stop_drive()
            if axis not in but:
                axis.rest()
        self.on = any(axis.on_ramp for axis in self._axes)

    def rest(self) -> None:
        """Know that the axes have been at rest for a while."""
        for axis in self._axes:
            axis.rest()

    def step(self, dt: float) -> bool:
        """Move all axes on, `dt` (s) later; return whether all have arrived."""
        arrived = [axis.drive(dt) for axis in self._axes]
        if self.resetting:
            reached = [axis.stream.voltage for axis in self._axes]
            self._spans = [(min(low, v), max(high, v)) for (low, high), v in zip(self._spans, reached, strict=True)]
        return all(arrived)

    def stop(self) -> None:
        """Take up desired displacements again, from where the axes are; without effect when off.

        A reset that has not come to its end, or has not spanned what the model was identified on, leaves the memory
        assumed.
        """
        if not self.on:
            return
        for axis in self._axes:
            axis.stop_drive()
        if self.resetting:
            for axis, span in zip(self._axes, self._spans, strict=True):
                axis.trust = MemoryConfidence(doubt="the reset was interrupted")
                if axis.arrived and axis.model:
                    axis.trust = MemoryConfidence(KNOWN, spanned=span).over(axis.model.voltage_range)
        self.on = self.resetting = False
