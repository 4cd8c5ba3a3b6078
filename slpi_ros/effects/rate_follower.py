"""Rate dependence sample by sample."""

from collections.abc import Callable
from math import copysign, exp

# Share of the latest rate in the smoothed one.
SMOOTHING = 0.5
# Time over which rates of voltage and displacement are compared, seconds.
COMPARISON = 0.02

RateState = tuple[float | None, float, float, float | None, float, float, float]


class RateFollower:
    """Rate dependence sample by sample; it looks at the voltage too.

    The voltage that a wish asks for depends on its own rate: taken from the voltages, that would run away. The inverse
    therefore takes the rate from the wishes, and only slowly learns how the two compare.

    Parameters
    ----------
    widening, backlash, exponent, reference_rate, transition : float
        As in `RateDependence`.
    """

    def __init__(
        self, widening: float, backlash: float, exponent: float, reference_rate: float, transition: float
    ) -> None:
        self._widening, self._backlash = widening, backlash
        self._exponent, self._reference_rate, self._transition = exponent, reference_rate, transition
        self._middle: Callable[[float], float] = float
        self.start(0.0)

    def attach(self, middle: Callable[[float], float]) -> None:
        """Tell where the middle of the largest loop is: displacement (m) at a voltage (V)."""
        self._middle = middle

    def start(self, x: float) -> None:
        """Be at rest at `x` (m); the next voltage is the one it rests at."""
        self._u: float | None = None
        self._rate = self._direction = self._wish_rate = self._volts = self._metres = 0.0
        self._wish: float | None = x
        self._asked: float | None = None

    def drive(self, dt: float, u: float) -> None:
        """Note the voltage `u` (V), `dt` (s) after the last one."""
        way = 0.0 if self._u is None else u - self._u
        if dt > 0.0:
            self._rate += SMOOTHING * (way / dt - self._rate)
            self._compare(dt, way)
        if self._asked is not None or dt > 0.0:
            self._wish, self._asked = self._asked, None
        self._direction = self._turned(way)
        self._u = u

    def forward(self, dt: float, x: float) -> float:
        """Return the displacement (m) of the wider loops for one of the loops at rest (m)."""
        if self._u is None or not self._rate:
            return x
        behind = self._backlash * self._direction
        return x + self._speed(self._rate) * (self._widening * (x - self._middle(self._u)) - behind)

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the displacement (m) of the loops at rest for one of the wider loops (m)."""
        self._asked = wanted
        if self._u is None or self._wish is None or dt <= 0.0:
            return wanted
        rate = (self._wish_rate + SMOOTHING * ((wanted - self._wish) / dt - self._wish_rate)) * self._volts_per_metre()
        speed, middle = self._speed(rate), self._middle(self._u + rate * dt)
        back = wanted + speed * (self._widening * middle + self._backlash * self._turned(rate * dt))
        return back / (1 + speed * self._widening)

    def snapshot(self) -> RateState:
        """Return voltage, rate, direction, and what is known of the wishes."""
        return self._u, self._rate, self._direction, self._wish, self._wish_rate, self._volts, self._metres

    def restore(self, state: RateState) -> None:
        """Take over a state from `snapshot`."""
        self._u, self._rate, self._direction, self._wish, self._wish_rate, self._volts, self._metres = state
        self._asked = None

    def _turned(self, way: float) -> float:
        """Return the direction after a way (V)."""
        if not way:
            return self._direction
        toward = copysign(1.0, way)
        return toward + (self._direction - toward) * exp(-abs(way) / self._transition)

    def _speed(self, rate: float) -> float:
        return float((abs(rate) / self._reference_rate) ** self._exponent)

    def _compare(self, dt: float, way: float) -> None:
        """Note the last wish, and how its rate compares with that of the voltage."""
        if self._asked is None or self._wish is None:
            self._wish_rate = 0.0
            return
        went = self._asked - self._wish
        self._wish_rate += SMOOTHING * (went / dt - self._wish_rate)
        kept = exp(-dt / COMPARISON)
        self._volts = kept * self._volts + abs(way)
        self._metres = kept * self._metres + abs(went)

    def _volts_per_metre(self) -> float:
        """Return by how many volts the voltage goes on for each metre: as in the middle of the loop, and as of late."""
        u = self._u or 0.0
        slope = 1 / max((self._middle(u + 1.0) - self._middle(u - 1.0)) / 2, 1e-15)
        seen = self._volts / self._metres if self._metres > 0.0 else slope
        return min(max(seen, slope / 3), 3 * slope)
