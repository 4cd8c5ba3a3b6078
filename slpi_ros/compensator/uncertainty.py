"""The standard uncertainty of where an axis is, followed sample by sample while somebody asks for it."""

from collections.abc import Mapping
from dataclasses import replace

from slpi_ros.compensator.model_swap import voltage_history
from slpi_ros.compensator.persistence import KNOWN, RESTORED, Zero
from slpi_ros.model.axis_model import AxisModel, Start
from slpi_ros.model.streaming import StreamingInverse
from slpi_ros.model.uncertainty import AxisUncertainty, StreamingUncertainty

# Without samples, the age counts on from this time (s) after the last one.
IDLE = 0.1


class Uncertainty:
    """Standard uncertainty of where an axis is by its model alone, from the first question (`follow`) on.

    The range that the voltage has gone over counts from there on, for the model, the state of its memory and the zero
    of that time. Times are those of the stamps, by which the rate of the voltage is known, and between samples those
    of the steady clock.
    """

    def __init__(self) -> None:
        self._streaming: StreamingUncertainty | None = None
        self._of: tuple[AxisModel, str, Zero] | None = None
        self._t = self._waited = 0.0

    @property
    def on(self) -> bool:
        """Whether somebody asks for it."""
        return self._streaming is not None

    @property
    def present(self) -> float | None:
        """Standard uncertainty of where the axis is now, metres; None if nobody asks for it."""
        return self._streaming.present if self._streaming else None

    def follow(
        self,
        of: tuple[AxisModel, str, Zero],
        stream: StreamingInverse,
        surroundings: Mapping[str, float],
        age: float,
    ) -> None:
        """Follow an axis from the state of its `stream` on; ModelError if the uncertainty is not known.

        `of`: its model, the state of its memory and its zero, of which the `age` in seconds is given; as long as they
        are the same, it is followed on.
        """
        if self._of is not None and all(now is then for now, then in zip(of, self._of, strict=True)):
            return
        self.end()
        model, memory, _ = of
        *turns, present = voltage_history(stream)
        here = Start(present, stream.memory.displacement, tuple(turns))
        known = memory in (KNOWN, RESTORED)
        streaming = AxisUncertainty(replace(model, end=here), "end", known, model.felt_range).stream(age)
        streaming.surround(surroundings)
        self._t = self._waited = 0.0
        streaming.note(0.0, stream.uncoupled_displacement + stream.coupled, stream.voltage)
        self._streaming, self._of = streaming, of

    def end(self) -> None:
        """Follow it no longer."""
        self._streaming = self._of = None

    def surround(self, values: Mapping[str, float]) -> None:
        """Take values of quantities that the stage follows."""
        if self._streaming:
            self._streaming.surround(values)

    def sample(self, dt: float, y: float, v: float) -> None:
        """Follow a displacement (m) and its voltage (V), `dt` (s) after the last sample."""
        if self._streaming is None:
            return
        self._t += max(dt - self._waited, 0.0)
        self._waited = 0.0
        self._streaming.note(self._t, y, v)

    def wait(self, dt: float, y: float, v: float) -> None:
        """Let the age count on: the last sample, of a displacement (m) and its voltage (V), was `dt` (s) ago."""
        if self._streaming and dt - self._waited > IDLE:
            self._t += dt - self._waited
            self._waited = dt
            self._streaming.note(self._t, y, v)
