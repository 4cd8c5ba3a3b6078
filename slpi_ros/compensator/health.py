"""Whether the stage still is what was identified: measured displacements against what the model expects."""

from array import array
from dataclasses import dataclass
from math import sqrt

# Measurements that the health looks back on.
WINDOW = 500
# Fewer than these say nothing.
ENOUGH = 50


@dataclass(frozen=True)
class Drift:
    """What the health says.

    Parameters
    ----------
    rms : float, metres
        Of the residual, over the last `WINDOW` measurements.
    mean : float, metres
        Of what was measured minus what was expected.
    samples : int
        Measurements in the window.
    """

    rms: float
    mean: float
    samples: int


class ResidualWindow:
    """The residuals of the last `WINDOW` measurements.

    A stage answers a little later than it is told. So what counts is how far a measurement lies outside of what the
    model expected at the last two samples, and between them: at rest that is the whole residual.
    """

    __slots__ = ("_before", "_expected", "_next", "_residuals", "_samples")

    def __init__(self, expected: float) -> None:
        self._residuals = array("d", bytes(8 * WINDOW))
        self._samples = self._next = 0
        self._before = self._expected = expected

    def expect(self, displacement: float) -> None:
        """Note what the model gives (m) for the voltage that is applied from now on."""
        self._before, self._expected = self._expected, displacement

    def measure(self, displacement: float) -> None:
        """Note what was measured (m)."""
        low, high = self._before, self._expected
        if low > high:
            low, high = high, low
        outside = displacement - min(max(displacement, low), high)
        self._residuals[self._next] = outside
        self._next = (self._next + 1) % WINDOW
        self._samples = min(self._samples + 1, WINDOW)

    def forget(self, expected: float) -> None:
        """Start anew: another model, or another memory."""
        self._samples = self._next = 0
        self._before = self._expected = expected

    def drift(self) -> Drift | None:
        """Return what the window says; None when it holds too little."""
        if self._samples < ENOUGH:
            return None
        residuals = self._residuals[: self._samples]
        count = len(residuals)
        return Drift(sqrt(sum(r * r for r in residuals) / count), sum(residuals) / count, count)
