"""The package's own model, SLPI, without and with the causes that its diagnosis of the fitted records finds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

import slpi_ros
from benchmarks.measured.methods.base import FloatArray, Series
from slpi_ros.errors import SlpiError
from slpi_ros.io.record import Record
from slpi_ros.model.axis_model import AxisModel

AXIS = "x"
# The package counts in metres, the tables in micrometres or in what stands for them.
UNIT = 1e-6


@dataclass(frozen=True)
class SlpiModel:
    """An identified model, and what was found."""

    model: AxisModel
    first: str
    said: str

    @property
    def rested(self) -> bool:
        """Whether the first fitted record begins where the stage had never moved."""
        return not self.model.start.history

    def simulate(self, name: str, t: FloatArray, v: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the displacement, shape (N,)."""
        return self._from(name, float(v[0]), history).simulate(t - t[0], v) / UNIT

    def invert(self, name: str, t: FloatArray, y: FloatArray, history: tuple[float, ...]) -> FloatArray:
        """Return the voltage, shape (N,), that the compensator would give, from the lowest voltage on."""
        model = self._from(name, self.model.voltage_range[0], history)
        reachable = np.clip(UNIT * y, *model.displacement_range)
        return model.compensate(t - t[0], reachable, start_memory="start")[0]

    def _from(self, name: str, v: float, history: tuple[float, ...]) -> AxisModel:
        """Return the model at the start of a record that begins at `v` (V)."""
        model = self.model
        if name == self.first and not history:
            # The state that the identification found for this record.
            return model
        start = model.after(np.array([*history, v]))
        return replace(model, start=replace(start, from_rest=False) if history else start)


def _record(one: Series) -> Record:
    stamps = np.round((one.t - one.t[0]) * 1e9).astype(np.int64)
    return Record(stamps, {AXIS: one.v}, {AXIS: UNIT * one.y}, source=one.name)


@dataclass(frozen=True)
class SlpiMethod:
    """Identification, and diagnosis if `causes`."""

    name: str
    causes: bool

    def fit(self, records: Sequence[Series]) -> SlpiModel:
        """Identify a model with the options that ``slpi identify`` has by default."""
        whole = [_record(one) for one in records]
        start = stop = None
        if len(records) == 1 and not records[0].fitted.all():
            times = records[0].t[records[0].fitted] - records[0].t[0]
            start, stop = float(times[0]), float(np.nextafter(times[-1], np.inf))
        model, said = slpi_ros.identify(whole, "slpi", start=start, stop=stop), ""
        if self.causes:
            try:
                diagnosis = slpi_ros.diagnose(whole, model, start=start, stop=stop)
            except SlpiError as error:
                said = f"no diagnosis: {error}"
            else:
                model, found = diagnosis.extended, diagnosis.axes[AXIS]
                kept = ", ".join(effect.name for effect in model.axes[AXIS].effects)
                said = f"{found.verdict}; in the model: {kept or 'nothing'}"
        return SlpiModel(model.axes[AXIS], records[0].name, said)


SLPI = SlpiMethod("SLPI", causes=False)
SLPI_CAUSES = SlpiMethod("SLPI, causes", causes=True)
