"""What an effect is: a part of the signal chain before or behind the hysteresis.

``v -> delay -> lag -> saturation -> HYSTERESIS -> rate_dependence -> creep -> resonance -> cross_coupling ->
thermal_drift -> sensor_periodic -> hum -> y``

A rate dependence that is a coercivity comes last before the hysteresis instead, and part of the voltage goes round it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from slpi_ros.effects.base import Form, Left

FloatArray = NDArray[np.float64]

Side = Literal["voltage", "displacement"]
# When an effect can be undone: sample by sample; where the whole path is known; on the record's clock only; never.
Removable = Literal["always", "path", "record", "never"]


@dataclass(frozen=True)
class Around:
    """What an effect may look at besides the signal it changes.

    Parameters
    ----------
    t : ndarray, shape (N,), seconds
        From the first stamp, not decreasing.
    u : ndarray, shape (N,), volts, optional
        Voltage that drives the hysteresis.
    middle : callable, optional
        Displacement (m) half-way between the two branches of the largest loop, at voltages (V).
    others : mapping of axis name to ndarray, shape (N,), metres
        Motion of the other axes from their start, before coupling.
    """

    t: FloatArray
    u: FloatArray | None = None
    middle: Callable[[FloatArray], FloatArray] | None = None
    others: Mapping[str, FloatArray] = field(default_factory=dict)


class Follower(Protocol):
    """An effect sample by sample; it remembers what it needs of the past."""

    def start(self, x: float) -> None:
        """Be at rest at the input `x` (V or m), as after a long time."""

    def forward(self, dt: float, x: float) -> float:
        """Move to the input `x`, `dt` (s) later; return the output."""

    def inverse(self, dt: float, wanted: float) -> float:
        """Return the input that gives the wanted output `dt` (s) from now, or as near as is stable; nothing moves."""

    def snapshot(self) -> Any:
        """Return the whole state, JSON-like: numbers and tuples of them."""

    def restore(self, state: Any) -> None:
        """Take over a state from `snapshot`."""


class DrivenFollower(Follower, Protocol):
    """A follower that also looks at the voltage that drives the hysteresis."""

    def attach(self, middle: Callable[[float], float]) -> None:
        """Tell where the middle of the largest loop is: displacement (m) at a voltage (V)."""

    def drive(self, dt: float, u: float) -> None:
        """Note the voltage `u` (V), `dt` (s) after the last one."""


class Effect(Protocol):
    """One effect: a frozen dataclass whose fields are its parameters, SI units, and their `uncertainty`."""

    name: ClassVar[str]
    removable: ClassVar[Removable]

    @property
    def side(self) -> Side:
        """What it acts on."""

    @property
    def uncertainty(self) -> Mapping[str, float]:
        """Standard deviation by parameter, in the parameter's unit."""

    def apply(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return what becomes of a signal, shape (N,), volts or metres; it begins at rest."""

    def invert(self, signal: FloatArray, around: Around) -> FloatArray:
        """Return the signal that becomes the given one, shape (N,), volts or metres; the whole path is known."""

    @classmethod
    def fit(cls, left: "Left") -> "Iterator[Form | Effect]":
        """Yield what it may be in a record: forms for a fit to judge, linear in their gains, or effects as they are."""

    def describe(self) -> str:
        """Say in one sentence what it is, with numbers."""

    def follower(self) -> Follower | None:
        """Return what follows it sample by sample; None: nothing can be done so."""
