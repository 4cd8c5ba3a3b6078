"""A triangle of relays: the Preisach operator in its literal form, every relay with a state of its own."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slpi_ros.errors import UsageError

FloatArray = NDArray[np.float64]
Density = Callable[[FloatArray, FloatArray], FloatArray]


class RelayTriangle:
    """Relays that switch up at one threshold and down at a lower one, summed with weights.

    Row ``i`` and column ``j <= i`` of the state matrix hold a bundle of relays whose up-thresholds are spread
    evenly from ``low + i h`` to ``low + (i + 1) h`` and whose down-thresholds lie ``(i - j) h`` below them;
    the state is the share of the bundle that is up. Without the spread, the level spacing ``h`` would show as
    steps of tens of nanometres.

    Parameters
    ----------
    low, high : float, volts
        Range of the thresholds, and of the voltages the relays accept.
    levels : int
        Number of rows and of columns.
    density : callable
        ``density(bias, width)`` in arbitrary units: the weight of relays whose thresholds have the mean
        ``bias`` (V) and the distance ``width`` (V); called once with arrays of shape (levels, levels).

    Attributes
    ----------
    output : float
        Weighted sum of the states, in the unit of `density`.
    voltage : float, volts
        The voltage of the last step.

    References
    ----------
    I. D. Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, Eq. (1.1).
    """

    def __init__(self, low: float, high: float, levels: int, density: Density) -> None:
        self._low, self._high = low, high
        self._spacing = (high - low) / levels
        threshold = low + self._spacing * (np.arange(levels) + 0.5)
        up, down = threshold[:, None], threshold[None, :]
        self._weight: FloatArray = np.tril(density((up + down) / 2, np.maximum(up - down, 0.0)))
        self._state: FloatArray = np.zeros((levels, levels))
        self._index = np.arange(levels, dtype=np.float64)
        self.all_down()

    def all_down(self) -> None:
        """Switch every relay down, as the lowest voltage does."""
        self._state[:] = 0.0
        self._position = 0.0
        self.output = 0.0
        self.voltage = self._low

    def scale(self, factor: float) -> None:
        """Multiply every weight, and so the output, by `factor`."""
        self._weight *= factor
        self.output *= factor

    @property
    def state(self) -> FloatArray:
        """Share of relays up in each bundle, shape (levels, levels), 0 where there is none; a copy."""
        return np.tril(self._state)

    def check(self, voltage: float) -> None:
        """Refuse a voltage (V) that is not a number between the lowest and the highest threshold: UsageError."""
        if not self._low <= voltage <= self._high:
            raise UsageError(f"stage: {voltage} V is not within {self._low} to {self._high} V; clip it")

    def step(self, voltage: float) -> float:
        """Apply a voltage and switch the relays it passes.

        Parameters
        ----------
        voltage : float, volts
            Any value between the lowest and the highest threshold.

        Returns
        -------
        float
            The weighted sum of the states, in the unit of the density.

        Raises
        ------
        UsageError
            If the voltage is not a number between the lowest and the highest threshold.
        """
        self.check(voltage)
        position = (voltage - self._low) / self._spacing
        if position > self._position:
            self._rise(position)
        elif position < self._position:
            self._fall(position)
        self._position, self.voltage = position, voltage
        return self.output

    def _rise(self, position: float) -> None:
        # Rows below the old voltage are already up, rows above the new one are not reached.
        first, end = int(self._position), min(int(position) + 1, len(self._index))
        share = np.minimum(position - self._index[first:end, None], 1.0)
        block = (slice(first, end), slice(0, end))
        self._switch(block, np.maximum(self._state[block], share))

    def _fall(self, position: float) -> None:
        first, end = int(position), min(int(self._position) + 1, len(self._index))
        share = np.maximum(position - self._index[None, first:end], 0.0)
        block = (slice(first, None), slice(first, end))
        self._switch(block, np.minimum(self._state[block], share))

    def _switch(self, block: tuple[slice, slice], after: FloatArray) -> None:
        self.output += float(np.sum(self._weight[block] * (after - self._state[block])))
        self._state[block] = after
