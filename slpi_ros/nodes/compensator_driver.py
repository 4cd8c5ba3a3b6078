"""What moves the compensator's axes on its own: resets of the memory and ramps to safe voltages, from a timer."""

import time
from collections.abc import Callable, Sequence

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from slpi_ros.nodes.compensation import Compensation

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
    """

    def __init__(self, node: Node, compensation: Compensation, publish: Callable[[], None]) -> None:
        self._node, self._compensation, self._publish = node, compensation, publish
        self._last = 0.0
        self._on_end: Callable[[bool], None] = _nothing
        # A simulated clock may stand still; the amplifier's slew is real.
        self._timer = node.create_timer(PERIOD, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def start(self, on_end: Callable[[bool], None] | None = None) -> None:
        """Move on what `compensation.driving` has been told, and tell `on_end` whether that came to its end."""
        self._on_end = on_end or _nothing
        self._last = time.monotonic()
        self._timer.reset()

    def stop(self) -> None:
        """Leave the axes where they are."""
        self._end(arrived=False)

    def ramp_now(self, voltages: Sequence[float], rate: float) -> None:
        """Go to voltages (V) at a rate (V/s), and return when there."""
        self.stop()
        self._compensation.driving.ramp(voltages, rate)
        self._last, arrived = time.monotonic(), False
        while not arrived and self._node.context.ok():
            time.sleep(PERIOD)
            arrived = self._step()
        self._compensation.driving.stop()

    def _on_tick(self) -> None:
        # A command ends a ramp.
        if not self._compensation.driving.on:
            self._timer.cancel()
        elif self._step():
            self._end(arrived=True)

    def _step(self) -> bool:
        now = time.monotonic()
        arrived = self._compensation.drive(now - self._last)
        self._last = now
        self._publish()
        return arrived

    def _end(self, arrived: bool) -> None:
        self._timer.cancel()
        self._compensation.driving.stop()
        on_end, self._on_end = self._on_end, _nothing
        on_end(arrived)


def _nothing(arrived: bool) -> None:
    pass
