"""What the compensator does, and says, when commands stop: decided here only."""

from collections.abc import Callable
from time import monotonic_ns

from slpi_ros.compensator.controller import Compensation
from slpi_ros.nodes.compensator_driver import Driver
from slpi_ros.nodes.compensator_parameters import CompensatorSettings


class Silence:
    """Holds the voltages, or brings the axes to the safe ones, once no command has come for `command_timeout`.

    A trajectory under way is a command, however long it takes to its next point.

    Parameters
    ----------
    compensation : Compensation
    driver : Driver
    settings : callable
        Returns the present ones.

    Attributes
    ----------
    given_ns : int, nanoseconds
        When voltages were last given to all axes, on ``time.monotonic_ns``; to be set with every command.
    """

    def __init__(self, compensation: Compensation, driver: Driver, settings: Callable[[], CompensatorSettings]) -> None:
        self._compensation, self._driver, self._settings = compensation, driver, settings
        self.begin()

    def begin(self) -> None:
        """Start anew: nothing has been commanded yet."""
        self._commanded = self._on = False
        # The voltages to go to, and the command after which.
        self._goal: tuple[tuple[float, ...], int] | None = None
        self.given_ns = self._own_ns = self._listening_ns = monotonic_ns()

    def after_reset(self) -> None:
        """Count from now, when a reset of the memory has ended: it was no command."""
        self._notice_commands()
        self.given_ns = self._own_ns = self._listening_ns = monotonic_ns()

    def after_trajectory(self) -> None:
        """Count from now, when a trajectory has been accepted or cancelled."""
        self._listening_ns = monotonic_ns()

    def watch(self) -> bool:
        """Do what is to be done by now; return whether there is news."""
        self._notice_commands()
        before, self._on = (self._on, self._goal), self._too_long
        safety = self._settings().safety
        # Nothing moves before it has been told to.
        moves = self._on and self._commanded and safety.ramps_on_timeout
        self._goal = (safety.voltages, self.given_ns) if moves else None
        if self._on and self._goal != before[1]:
            if self._goal:
                self._compensation.driving.ramp(safety.voltages, safety.rate)
                self._driver.start()
            else:
                self._driver.stop()
        return self._on and (self._on, self._goal) != before

    @property
    def said(self) -> str:
        """What has been done, in one line; "" while commands come."""
        if not (self._on and self._too_long):
            return ""
        does = "are held"
        if self._goal:
            does = "go to the safe ones" if self._compensation.driving.on else "are the safe ones"
        yet = "" if self._commanded else " yet"
        return f"no command{yet} for {self._seconds:.3g} s; voltages {does}"

    @property
    def _seconds(self) -> float:
        return (monotonic_ns() - max(self.given_ns, self._listening_ns)) * 1e-9

    @property
    def _too_long(self) -> bool:
        compensation, timeout = self._compensation, self._settings().safety.command_timeout
        busy = compensation.following.on or compensation.driving.resetting
        return compensation.active and not busy and 0.0 < timeout < self._seconds

    def _notice_commands(self) -> None:
        self._commanded = self._commanded or self.given_ns != self._own_ns
