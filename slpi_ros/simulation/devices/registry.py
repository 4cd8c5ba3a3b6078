"""The simulated devices by name. A new one is its own file and an entry here."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from slpi_ros.errors import UsageError, dependencies_needed
from slpi_ros.simulation.devices.base import SimulatedDevice
from slpi_ros.simulation.stage import Stage

# Imported when they are used, as one may need a package that the others do not.
SIMULATORS = {
    "gcs": "gcs.GcsSimulator",
    "labjack": "labjack.LabjackSimulator",
    "nidaqmx": "nidaqmx.NidaqmxSimulator",
    "nv200": "serial.Nv200Simulator",
    "mdt69xb": "serial.MdtSimulator",
}


def make_simulator(
    kind: str,
    address: str,
    axes: Sequence[str],
    seed: int,
    noise_rms: float,
    voltage: float,
    answer_delay: float,
    **own: Any,
) -> SimulatedDevice:
    """Return a simulated device of that kind that does not serve yet; empty values are those of the kind.

    Parameters
    ----------
    kind : one of `SIMULATORS`
    address : where to serve, as the kind's drivers take it
    axes : the device's names of its axes
    seed, noise_rms : of the random stage, and of its sensor (m rms)
    voltage : at the outputs at the start, V
    answer_delay : time until an answer, s
    own : what only this kind takes

    Errors
    ------
    UsageError : there is no such kind, the address is none, or a voltage is outside the range
    """
    if kind not in SIMULATORS:
        raise UsageError(f"no simulated device '{kind}'; choose one of {', '.join(SIMULATORS)}")
    module, name = SIMULATORS[kind].split(".")
    with dependencies_needed():
        made: type[SimulatedDevice] = getattr(import_module(f"slpi_ros.simulation.devices.{module}"), name)
    names = list(axes) or list(made.usual_axes)
    simulator = made(
        names,
        Stage.random(names, seed, noise_rms),
        voltages=[voltage] * len(names),
        answer_delay=answer_delay,
        **made.placed(address),
        **own,
    )
    if not simulator.low <= voltage <= simulator.high:
        raise UsageError(f"voltage {voltage:g} V: give it within {simulator.low:g} to {simulator.high:g} V")
    return simulator
