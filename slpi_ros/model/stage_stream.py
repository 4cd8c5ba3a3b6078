"""Compensation sample by sample of all axes of a stage, which may move along with each other."""

from collections.abc import Mapping

from slpi_ros.effects.coupling import Coupling
from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.model.stream import AxisStream, StreamState


class StageStream:
    """Causal compensation of several axes: ``{axis: v} = step(t, {axis: y})``.

    Parameters
    ----------
    streams : mapping of axis name to AxisStream
        Owned by the stage from here on.
    coupling : Coupling
    origins : mapping of axis name to float, metres
        From there the motion of an axis counts for the others.

    Attributes
    ----------
    streams : dict of axis name to AxisStream
    """

    def __init__(self, streams: Mapping[str, AxisStream], coupling: Coupling, origins: Mapping[str, float]) -> None:
        self.streams = dict(streams)
        self._coupling, self._origins = coupling, origins

    def step(self, t: float, y: Mapping[str, float]) -> dict[str, float]:
        """Return the voltages (V) for desired displacements `y` (m) at time `t` (s); other axes keep theirs.

        Raises
        ------
        SlpiError
            As `AxisStream.check`, or if there is no such axis; nothing has moved then.
        """
        for name, wish in y.items():
            if name not in self.streams:
                raise UsageError(f"no axis '{name}'; there are {', '.join(self.streams)}")
            try:
                self.streams[name].check(t, wish)
            except SlpiError as error:
                raise type(error)(f"axis '{name}': {error}") from None
        self.decouple(y)
        return {name: self.streams[name].step(t, wish) for name, wish in y.items()}

    __call__ = step

    def decouple(self, y: Mapping[str, float]) -> None:
        """Tell every axis what the others will add once the named ones are at `y` (m)."""
        if not self._coupling.on:
            return
        streams, origins = self.streams, self._origins
        seen = {name: streams[name].unseen(wish) - origins[name] for name, wish in y.items()}
        resting = {name: each.own - origins[name] for name, each in streams.items() if name not in seen}
        motions = self._coupling.apart(seen, resting)
        motions.update(resting)
        for name, stream in streams.items():
            stream.coupled = float(self._coupling.part(name, motions))

    def snapshot(self) -> dict[str, StreamState]:
        """Return the whole state, to be given back to `restore`."""
        return {name: stream.snapshot() for name, stream in self.streams.items()}

    def restore(self, state: Mapping[str, StreamState]) -> None:
        """Take over a state from `snapshot`."""
        for name, stream in self.streams.items():
            stream.restore(state[name])
