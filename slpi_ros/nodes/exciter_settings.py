"""What the exciter is told by its parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from slpi_ros.errors import SlpiError, UsageError
from slpi_ros.excitation.drives import DRIVES, Drive, excite
from slpi_ros.nodes.parameters import Declaration, Values, choice, number, numbers, whole

# A driver may read back a voltage this share of the range outside the limits; it is taken to be at the limit.
READ_BACK = 0.01

VOLTAGE = (-10_000.0, 10_000.0)
SLEW = (0.0, 1e9)
DURATION = (0.1, 86_400.0)
RATE = (1.0, 10_000.0)
SETTLE = (0.0, 3600.0)
SEED = (0, 2**31 - 1)
LIVE, TRAJECTORY = OUTPUTS = ("live", "trajectory")

DECLARATIONS = (
    Declaration("axes", ["x"], "Names of the axes, in the order of voltage_command.", read_only=True),
    Declaration(
        "voltage_min", math.nan, "Lowest voltage ever given, volts; must be given. One value, or one for each axis.",
        number=True,
    ),
    Declaration(
        "voltage_max", math.nan, "Highest voltage ever given, volts; must be given. One value, or one for each axis.",
        number=True,
    ),
    Declaration(
        "slew_limit", 0.0, "Fastest change of a voltage, V/s; 0: none. One value, or one for each axis.",
        between=SLEW, number=True,
    ),
    Declaration(
        "start_voltage", math.nan,
        "Where the axes rest before and after the drive, volts; NaN: where stage_state says that they are, and without "
        "it at voltage_min. One value, or one for each axis.",
        number=True,
    ),
    Declaration("duration", 30.0, "Seconds, shared by the axes.", between=DURATION, number=True),
    Declaration("rate", 200.0, "Voltages per second.", between=RATE, number=True),
    Declaration(
        "settle", 3.0, "Seconds to wait for others to connect, once the voltages have a subscriber.",
        between=SETTLE, number=True,
    ),
    Declaration("drive", DRIVES[0], f"What to drive: {', '.join(DRIVES)}."),
    Declaration("seed", 0, "The same seed gives the same drive.", between=SEED),
    Declaration("repeat", False, "Whether to begin again at the end, until stopped."),
    Declaration(
        "output", LIVE,
        "live: one voltage_command after the other. trajectory: all at once on voltage_trajectory, for whoever keeps "
        "time itself.",
        read_only=True,
    ),
    Declaration(
        "autostart", True, "Whether to start at once, and end with the drive; else ~/start starts it.", read_only=True
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ExciterSettings:
    """What the node is told by its parameters; voltages in volts, in the order of `axes`.

    Parameters
    ----------
    axes : tuple of str
    limits : (list of float, list of float)
        Lowest and highest voltages.
    slew_limit : list of float, V/s
    start : list of float or None
        None: as ``stage_state`` says.
    duration : float, seconds
    rate : float, hertz
    settle : float, seconds
    drive : str
    seed : int
    repeat : bool
    output : str
    autostart : bool
    """

    axes: tuple[str, ...]
    limits: tuple[list[float], list[float]]
    slew_limit: list[float]
    start: list[float] | None
    duration: float
    rate: float
    settle: float
    drive: str
    seed: int
    repeat: bool
    output: str
    autostart: bool

    @classmethod
    def of(cls, values: Values) -> "ExciterSettings":
        """Make the settings of all parameters by name.

        Raises
        ------
        UsageError
            If a value makes no sense, or no drive can be made of them.
        """
        axes = tuple(values["axes"])
        start = values["start_voltage"]
        settings = cls(
            axes=axes,
            limits=(numbers(values, "voltage_min", axes, *VOLTAGE), numbers(values, "voltage_max", axes, *VOLTAGE)),
            slew_limit=numbers(values, "slew_limit", axes, *SLEW),
            start=None if start != start else numbers(values, "start_voltage", axes, *VOLTAGE),
            duration=number(values, "duration", *DURATION),
            rate=number(values, "rate", *RATE),
            settle=number(values, "settle", *SETTLE),
            drive=choice(values, "drive", DRIVES),
            seed=whole(values, "seed", *SEED),
            repeat=values["repeat"],
            output=choice(values, "output", OUTPUTS),
            autostart=values["autostart"],
        )
        if settings.repeat and settings.output != LIVE:
            raise UsageError(f"parameters repeat and output '{settings.output}' do not go together; set one of them")
        settings.drawn(None)
        return settings

    def drawn(self, heard: Sequence[float] | None) -> Drive:
        """Return the drive of a stage that was heard to be at some voltages (V), or not heard of.

        Raises
        ------
        UsageError
            If there is no such drive.
        SlpiError
            If the stage is outside its limits.
        """
        start = self._within_limits(heard) if self.start is None and heard else self.start
        return excite(
            self.axes,
            voltage_min=self.limits[0],
            voltage_max=self.limits[1],
            slew_limit=self.slew_limit,
            start=start,
            duration=self.duration,
            rate=self.rate,
            seed=self.seed,
            drive=self.drive,
        )

    def _within_limits(self, heard: Sequence[float]) -> list[float]:
        for axis, v, low, high in zip(self.axes, heard, *self.limits, strict=True):
            slack = READ_BACK * (high - low)
            if not low - slack <= v <= high + slack:
                raise SlpiError(
                    f"exciter: axis '{axis}' is at {v:g} V, outside {low:g} to {high:g} V; bring it there first"
                )
        return [min(max(v, low), high) for v, low, high in zip(heard, *self.limits, strict=True)]
