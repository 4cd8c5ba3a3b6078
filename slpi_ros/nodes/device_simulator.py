"""Node ``device_simulator``: the protocol of a device, with a simulated stage behind it."""

from functools import partial
from typing import Any

from rclpy.node import Node

from slpi_ros.errors import UsageError
from slpi_ros.nodes import parameters as declare
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, validated
from slpi_ros.simulation.devices.base import FAULTS, Fault, SimulatedDevice
from slpi_ros.simulation.devices.gcs import UNITS
from slpi_ros.simulation.devices.registry import SIMULATORS, make_simulator

NO_FAULT = "none"
WITH_SERVO = ("gcs", "nv200")
DECLARATIONS = (
    *declare.read_only(
        declare.text("device", "gcs", "Kind of the device.", *SIMULATORS),
        declare.text("address", "", "Where to serve, as for the driver; empty: where the kind usually is."),
        Declaration(
            "channels", [""], "The device's names of its axes, as for the driver; empty: the first one of the kind."
        ),
        declare.SEED,
        declare.scalar("noise_rms", 8e-9, "Sensor noise, metres rms.", (0.0, 1.0)),
        declare.scalar("voltage", 0.0, "Voltage at the outputs at the start, volts of the device.", declare.VOLTAGE),
        Declaration("servo", False, f"{', '.join(WITH_SERVO)}: whether the servo is on at the start."),
        declare.text("unit", "UM", "gcs: the unit of its positions, as PUN? reports it.", *UNITS),
        declare.scalar("answer_delay", 0.0003, "Time until an answer, seconds.", (0.0, 10.0)),
    ),
    declare.text(
        "fault", NO_FAULT, "What goes wrong with the next reading of the position, once each time it is set.",
        NO_FAULT, *FAULTS,
    ),
)  # fmt: skip


class DeviceSimulator(Node):
    """Simulate a device by its protocol, for a driver to connect to.

    The output of the simulated device moves a simulated stage, whose position it reports.
    It keeps its voltage when a client leaves, as a real one does. Setting the parameter ``fault`` makes the next
    reading fail. Parameters in `DECLARATIONS`.
    """

    def __init__(self) -> None:
        super().__init__("device_simulator")
        parameters = Parameters(self, DECLARATIONS, partial(validated, DECLARATIONS))
        values = parameters.settings
        self._simulator = _started(values)
        parameters.follow(self._set_fault)
        self.get_logger().info(
            f"{values['device']} at {self._simulator.address}, axes {', '.join(self._simulator.axes)}, own range "
            f"{self._simulator.low:g} to {self._simulator.high:g} V, amplifier {self._simulator.gain:g} V/V"
        )

    def destroy_node(self) -> None:
        """End the connection, then destroy the node."""
        self._simulator.close()
        super().destroy_node()

    def _set_fault(self, values: Values) -> None:
        kind = values["fault"]
        self._simulator.fault = None if kind == NO_FAULT else Fault(kind)


def _started(values: Values) -> SimulatedDevice:
    """Return the simulator, which serves; UsageError if that does not go."""
    own: dict[str, Any] = {"servo": True} if values["servo"] and values["device"] in WITH_SERVO else {}
    if values["device"] == "gcs":
        own["unit"] = values["unit"]
    channels = [name for name in values["channels"] or () if name]
    given = (values[name] for name in ("seed", "noise_rms", "voltage", "answer_delay"))
    try:
        simulator = make_simulator(values["device"], values["address"], channels, *given, **own)
        simulator.start()
    except OSError as error:
        raise UsageError(f"device_simulator: cannot serve at {values['address']}: {error.strerror or error}") from error
    return simulator
