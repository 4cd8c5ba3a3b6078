"""The standard uncertainty of where an axis is, followed sample by sample while somebody asks for it."""

from collections.abc import Mapping
from dataclasses import replace

from slpi_ros.compensator.model_swap import voltage_history
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.streaming import StreamingInverse
from slpi_ros.model.uncertainty import AxisUncertainty

# Without samples, the age counts on from this time (s) after the last one.
IDLE = 0.1


class UncertaintyWatch:
    """Standard uncertainty of one axis, from the present state of its `stream` on; ModelError if it is not known."""

    # The range that the voltage has gone over counts from here on, and `age` (s) is that of the zero now. Times are
    # those of the stamps, by which the rate of the voltage is known, and between samples those of the steady clock.
    def __init__(
        self, model: AxisModel, stream: StreamingInverse, known: bool, age: float, surroundings: Mapping[str, float]
    ) -> None:
        *turns, present = voltage_history(stream)
        here = Start(present, stream.memory.displacement, tuple(turns))
        self._streaming = AxisUncertainty(replace(model, end=here), "end", known).stream(age)
        self._streaming.surround(surroundings)
        self._t = self._waited = 0.0
        self._streaming.note(0.0, stream.uncoupled_displacement + stream.coupled, stream.voltage)
        self._note = self._streaming.note

    @property
    def present(self) -> float:
        """Standard uncertainty of where the axis is now, metres."""
        return self._streaming.present

    def surround(self, key: str, value: float) -> None:
        """Take a value of a quantity that the stage follows."""
        self._streaming.surround({key: value})

    def sample(self, dt: float, y: float, v: float) -> None:
        """Follow a displacement (m) and its voltage (V), `dt` (s) after the last sample."""
        if self._waited:
            dt, self._waited = max(dt - self._waited, 0.0), 0.0
        self._t += dt
        self._note(self._t, y, v)

    def wait(self, dt: float, y: float, v: float) -> None:
        """Let the age count on: the last sample, of a displacement (m) and its voltage (V), was `dt` (s) ago."""
        if dt - self._waited > IDLE:
            self._t += dt - self._waited
            self._waited = dt
            self._note(self._t, y, v)
