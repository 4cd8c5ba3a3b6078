"""All kinds of devices, each as a driver and its simulator, in volts at the stage."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slpi_ros.drivers.base import Channel
from slpi_ros.drivers.registry import make_device
from slpi_ros.simulation.devices.gcs import GcsSimulator
from slpi_ros.simulation.devices.labjack import LabjackSimulator
from slpi_ros.simulation.devices.nidaqmx import NidaqmxSimulator
from slpi_ros.simulation.devices.serial import MdtSimulator, Nv200Simulator


@dataclass(frozen=True)
class Kind:
    """How a device is simulated and reached."""

    device: str
    simulator: Callable[..., Any]
    axes: tuple[str, ...]  # names of its axes
    gain: float = 1.0  # of the amplifier behind it
    scale: float = 1e-6  # m for one unit of its position
    rounding: float = 2e-6  # V at the stage, of a voltage that it tells
    address: str = "{}"  # for the driver, with that of the simulator
    terminal: bool = False  # whether it is served at a pseudo terminal
    sensor: bool = True
    write: str = ""  # with what a write begins in what the simulator has received
    write_answered: bool = False  # whether it has an answer of its own

    def simulate(self, axes: int = 1, voltages=None, **settings: Any) -> Any:
        """Return a simulator of one or two axes at these voltages (V at the stage)."""
        own = [v / self.gain for v in voltages] if voltages else None
        if self.terminal:
            settings["path"] = str(Path(tempfile.mkdtemp(prefix="slpi_ros_")) / "tty")
        return self.simulator(self.axes[:axes], voltages=own, **settings)

    def channels(self, axes: int = 1) -> list[Channel]:
        return [Channel(axis, gain=self.gain, scale=self.scale) for axis in self.axes[:axes]]

    def make(self, simulator: Any) -> Any:
        """Return the driver of a simulated device."""
        return make_device(self.device, self.address.format(simulator.address), self.channels(len(simulator.axes)))

    def volts(self, simulator: Any) -> list[float]:
        """Return the voltages (V at the stage) of all axes."""
        return [self.gain * simulator.voltage(axis) for axis in simulator.axes]


KINDS = {
    "gcs": Kind("gcs", GcsSimulator, ("1", "2"), write="SVA "),
    "labjack": Kind(
        "labjack", LabjackSimulator, ("DAC0:AIN0", "DAC1:AIN1"), gain=20.0, scale=1e-5, rounding=2e-5, write="write",
        write_answered=True,
    ),
    "tick": Kind(
        "labjack", LabjackSimulator, ("TDAC0:AIN0:AIN2", "TDAC1:AIN1:AIN3"), gain=20.0, scale=1e-5, rounding=2e-5,
        write="write", write_answered=True,
    ),
    "nidaqmx": Kind(
        "nidaqmx", NidaqmxSimulator, ("ao0:ai0", "ao1:ai1"), gain=10.0, scale=1e-5, write="WriteAnalogF64",
        write_answered=True,
    ),
    "gcs at a serial port": Kind("gcs", GcsSimulator, ("1", "2"), terminal=True, write="SVA "),
    "nv200": Kind("serial", Nv200Simulator, ("1",), rounding=6e-4, address="nv200:{}", terminal=True, write="set,"),
    "mdt": Kind(
        "serial", MdtSimulator, ("x", "y"), rounding=0.051, address="mdt69xb:{}", terminal=True, sensor=False,
        write="xvoltage=",
    ),
}  # fmt: skip
