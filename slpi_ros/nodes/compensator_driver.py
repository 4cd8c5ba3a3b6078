"""What moves the compensator's axes on its own: resets of the memory and ramps to safe voltages, from a timer."""

import time
from collections.abc import Callable, Sequence

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from slpi_ros.compensator.controller import Compensation
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import MAX_DT

# Seconds from one voltage to the next.
PERIOD = 0.004


class Driver:
    """Moves the axes on and publishes their voltages while something drives them.

    Parameters
    ----------
    node : Node
    compensation : Compensation
    publish : callable
        Publishes the present voltages.
    commanded_ns : callable
        Returns when voltages were last given by a command, nanoseconds on ``time.monotonic_ns``.
    """

    def __init__(
        self,
        node: Node,
        compensation: Compensation,
        publish: Callable[[], None],
        commanded_ns: Callable[[], int],
    ) -> None:
        self._node, self._compensation, self._publish = node, compensation, publish
        self._commanded_ns, self._last_ns = commanded_ns, 0
        self._on_end: Callable[[bool], None] = _nothing
        # A simulated clock may stand still; the amplifier's slew is real.
        self._timer = node.create_timer(PERIOD, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    @property
    def given_ns(self) -> int:
        """When voltages were last given, whatever for, nanoseconds on ``time.monotonic_ns``."""
        return max(self._last_ns, self._commanded_ns())

    def start(self, on_end: Callable[[bool], None] | None = None) -> None:
        """Move on what `compensation.driving` has been told, and tell `on_end` whether that came to its end."""
        self._on_end = on_end or _nothing
        self._begin()
        self._timer.reset()

    def go_on(self) -> None:
        """Move on what still moves, if anything does."""
        if self._compensation.driving.on and self._timer.is_canceled():
            self.start()

    def stop(self) -> None:
        """Leave the axes where they are, or come to rest."""
        self._rest_after_pause()
        self._compensation.hold()
        on_end, self._on_end = self._on_end, _nothing
        on_end(False)
        self.go_on()

    def stop_now(self) -> None:
        """Leave the axes where they are, or come to rest before this returns."""
        self.stop()
        self._finish()

    def ramp_now(self, voltages: Sequence[float], rate: float) -> None:
        """Go to voltages (V) at a rate (V/s), and return when there."""
        self.stop()
        self._compensation.driving.ramp(voltages, rate)
        self._finish()

    def _finish(self) -> None:
        """Do what is to be done at once."""
        self._timer.cancel()
        self._begin()
        arrived = not self._compensation.driving.on
        while not arrived and self._node.context.ok():
            time.sleep(PERIOD)
            arrived = self._step()
        self._compensation.driving.stop()

    def _begin(self) -> None:
        """Count time from now on, or, where an axis is in motion, from the last voltage on."""
        self._rest_after_pause()
        moving = any(axis.in_motion for axis in self._compensation.axes)
        self._last_ns = self.given_ns if moving else time.monotonic_ns()

    def _rest_after_pause(self) -> None:
        if time.monotonic_ns() - self.given_ns > MAX_DT * SECOND_NS:
            self._compensation.driving.rest()

    def _on_tick(self) -> None:
        # A command ends a ramp.
        if not self._compensation.driving.on:
            self._timer.cancel()
        elif self._step():
            self._timer.cancel()
            self._compensation.driving.stop()
            on_end, self._on_end = self._on_end, _nothing
            on_end(True)

    def _step(self) -> bool:
        now_ns = time.monotonic_ns()
        arrived = self._compensation.drive((now_ns - self._last_ns) * 1e-9)
        self._last_ns = now_ns
        self._publish()
        return arrived


def _nothing(arrived: bool) -> None:
    pass
