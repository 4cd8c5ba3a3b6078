"""Node ``device_simulator``: the protocol of a device, with a simulated stage behind it."""

from functools import partial

from rclpy.node import Node

from slpi_ros.errors import UsageError
from slpi_ros.nodes.parameters import Declaration, Parameters, Values, validated
from slpi_ros.simulation.devices.gcs import FAULTS, Fault, GcsSimulator
from slpi_ros.simulation.stage import Stage

VOLTAGE = (-10_000.0, 10_000.0)
NO_FAULT = "none"
DECLARATIONS = (
    Declaration("device", "gcs", "Kind of the device.", read_only=True, choices=("gcs",)),
    Declaration("address", "127.0.0.1:50000", "Where to listen: host:port.", read_only=True),
    Declaration("axes", ["1"], "The device's names of its axes: the channels of the driver.", read_only=True),
    Declaration("seed", 0, "Seed of the random stage and of the noise.", read_only=True, between=(0, 2**53)),
    Declaration(
        "noise_rms", 8e-9, "Sensor noise, metres rms.", read_only=True, between=(0.0, 1.0), number=True
    ),
    Declaration(
        "voltage_min", -20.0, "Lower end of the device's own range, volts.", read_only=True, between=VOLTAGE,
        number=True,
    ),
    Declaration(
        "voltage_max", 120.0, "Upper end of the device's own range, volts.", read_only=True, between=VOLTAGE,
        number=True,
    ),
    Declaration(
        "voltage", 0.0, "Voltage at the outputs at the start, volts. One value, or one for each axis.",
        read_only=True, between=VOLTAGE, number=True, each_axis=True,
    ),
    Declaration("servo", False, "Whether the servo is on at the start.", read_only=True),
    Declaration(
        "answer_delay", 0.0003, "Time until an answer, seconds.", read_only=True, between=(0.0, 10.0), number=True
    ),
    Declaration(
        "fault", NO_FAULT, "What goes wrong with the next reading of the position, once each time it is set.",
        choices=(NO_FAULT, *FAULTS),
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
        self._simulator = _make_simulator(values)
        parameters.follow(self._set_fault)
        self._simulator.start()
        self.get_logger().info(
            f"{values['device']} at {self._simulator.address}, axes {', '.join(values['axes'])}, own range "
            f"{values['voltage_min']:g} to {values['voltage_max']:g} V"
        )

    def destroy_node(self) -> None:
        """End the connection, then destroy the node."""
        self._simulator.close()
        super().destroy_node()

    def _set_fault(self, values: Values) -> None:
        kind = values["fault"]
        self._simulator.fault = None if kind == NO_FAULT else Fault(kind)


def _make_simulator(values: Values) -> GcsSimulator:
    axes, low, high = list(values["axes"]), values["voltage_min"], values["voltage_max"]
    host, _, port = values["address"].rpartition(":")
    if not host or not port.isdigit() or int(port) > 65_535:
        raise UsageError(f"parameter address is '{values['address']}'; give HOST:PORT, such as 127.0.0.1:50000")
    if not low < high:
        raise UsageError(f"voltage_min is {low:g} V and voltage_max {high:g} V; give the lower one first")
    voltages = values["voltage"]
    if not all(low <= v <= high for v in voltages):
        raise UsageError(f"parameter voltage is {voltages}; give it within {low:g} to {high:g} V")
    try:
        return GcsSimulator(
            axes,
            Stage.random(axes, values["seed"], values["noise_rms"]),
            voltage_range=(low, high),
            voltages=voltages,
            servo=values["servo"],
            answer_delay=values["answer_delay"],
            host=host,
            port=int(port),
        )
    except OSError as error:
        raise UsageError(f"device_simulator: cannot listen at {values['address']}: {error.strerror}") from error
