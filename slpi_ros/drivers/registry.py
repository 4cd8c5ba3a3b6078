"""The devices by name. A new one is its own file, which names its class in `DEVICE`, and an entry here."""

from collections.abc import Sequence
from importlib import import_module

from slpi_ros.drivers.base import Channel, Device
from slpi_ros.errors import UsageError, dependencies_needed

# Imported when they are used, as one may need a package that the others do not.
MODULES = {
    "gcs": "slpi_ros.drivers.gcs",
    "labjack": "slpi_ros.drivers.labjack",
    "nidaqmx": "slpi_ros.drivers.nidaqmx",
    "serial": "slpi_ros.drivers.serial",
}
# What the first axis is called, by kind or dialect, where nobody says a name.
FIRST_CHANNEL = {"gcs": "1", "labjack": "DAC0:AIN0", "nidaqmx": "ao0:ai0", "nv200": "1", "mdt69xb": "x"}


def make_device(kind: str, address: str, channels: Sequence[Channel]) -> Device:
    """Return the device of that kind and address, not yet open; UsageError if there is none or the address is none."""
    if kind not in MODULES:
        raise UsageError(f"no device '{kind}'; choose one of {', '.join(MODULES)}")
    with dependencies_needed():
        module = import_module(MODULES[kind])
    device: Device = module.DEVICE(address, channels)
    return device
