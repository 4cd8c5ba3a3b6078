"""The interface of a device: an amplifier together with the sensor of the stage, and what goes wrong with it."""

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from math import isnan, log10, nan

from slpi_ros.arrays import FloatArray
from slpi_ros.errors import SlpiError, UsageError, shown

# Longest time that a device may take to accept a connection or to answer, seconds.
TIMEOUT = 0.2
# Metres for one unit of a position where neither device nor user says it.
USUAL_SCALE = 1e-6
# Metres of the units of length, by what devices call them in any case.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "\N{GREEK SMALL LETTER MU}m": 1e-6, "micron": 1e-6,
         "nm": 1e-9, "pm": 1e-12}  # fmt: skip


class DeviceError(SlpiError):
    """Something is wrong with a device; the message begins with its kind and address."""


class LinkError(DeviceError):
    """A device cannot be reached, does not answer in time or has closed the connection."""


class AnswerError(DeviceError):
    """A device answers something else than what was asked."""


class RefusedError(DeviceError):
    """A device reports an error."""


class UnsuitableError(DeviceError):
    """A device cannot be used as it is, or not with this configuration; the message says what to change."""


@dataclass(frozen=True)
class Channel:
    """One axis at a device, and the units of it."""

    name: str  # the device's name of the axis
    gain: float = 1.0  # V/V of an amplifier behind the device: volts at the stage for one volt of the device
    scale: float = nan  # m for one unit of the position that the device reports; NaN: of the unit that it tells
    offset: float = 0.0  # m, added to it

    def stage_volts(self, voltage: float) -> float:
        """Return the voltage (V) at the stage for a voltage (V) of the device."""
        return self.gain * voltage

    def device_volts(self, voltage: float) -> float:
        """Return the voltage (V) of the device for a voltage (V) at the stage."""
        return voltage / self.gain

    def metres(self, position: float) -> float:
        """Return the displacement (m) for a position in units of the device."""
        return self.scale * position + self.offset


@dataclass(frozen=True)
class Reading:
    """What a device says, one value for each channel."""

    read_ns: int  # when the positions were read, by the steady clock of the process
    voltages: tuple[float, ...]  # V at the stage, that the device says it has
    positions: tuple[float, ...]  # m


@dataclass(frozen=True)
class Found:
    """What a device says of itself when it is opened, one value for each channel."""

    identity: str  # maker, model, serial number
    reading: Reading
    setpoints: tuple[float, ...]  # V at the stage: writing these changes nothing
    lowest: tuple[float, ...]  # V at the stage, own range; -inf: not told
    highest: tuple[float, ...]  # V; inf: not told
    servo: tuple[bool, ...]  # whether the device's own position control is on, so that it moves the voltage
    notes: tuple[str, ...] = ()  # what the user should know
    units: tuple[str, ...] = ()  # of the positions, as the device calls them; () or "": not told
    travel: tuple[float, ...] = ()  # m from end to end, as the device tells; () or NaN: not told


@dataclass(frozen=True)
class Block:
    """Voltages that a device plays by its own clock, one sample each `period`."""

    period: float  # s, a multiple of the device's `block_period`
    voltages: FloatArray  # V at the stage, (N, channels)


@dataclass(frozen=True)
class Recording:
    """What a device recorded while it played a block."""

    times: FloatArray  # s since the first sample, (M,)
    positions: FloatArray  # m, (M, channels)
    voltages: FloatArray  # V at the stage, (M, channels)


class Device(ABC):
    """A device with one or more channels; all voltages are those at the stage (V), all positions displacements (m).

    Every method raises a DeviceError; no single wait is longer than twice `TIMEOUT`. After an error only `open` and
    `close` may be called. A device is used by one thread. `channels` hold the scales in use, without NaN.
    """

    def __init__(self, kind: str, address: str, channels: Sequence[Channel]) -> None:
        self.name = f"{kind} {address}"
        self._given = tuple(channels)
        self.channels = tuple(replace(each, scale=_scale_or(each, USUAL_SCALE)) for each in channels)

    def take_units(self, units: Sequence[str]) -> tuple[str, ...]:
        """Take the scales of the channels from what the device calls the units of their positions, "": it does not say.

        Return notes for the user; UnsuitableError where a unit is no length, or a given scale is of another one.
        """
        notes, channels = [], []
        for channel, unit in zip(self._given, units, strict=True):
            metres = UNITS.get(unit.strip().casefold())
            what = f"{self.name}: axis '{channel.name}' counts in {shown(unit)}"
            if unit and metres is None and isnan(channel.scale):
                raise UnsuitableError(f"{what}, which is no known length; give sensor_scale, metres for one of it")
            # Units of length are powers of ten apart; what is nearer to 1 is a correction of the sensor.
            if metres and round(log10(abs(_scale_or(channel, metres)) / metres)):
                raise UnsuitableError(
                    f"{what}, {metres:g} m, but sensor_scale is {channel.scale:g}; leave sensor_scale out, or change "
                    "the unit at the device"
                )
            channels.append(replace(channel, scale=_scale_or(channel, metres or USUAL_SCALE)))
            if unit:
                notes.append(f"axis '{channel.name}' counts in {shown(unit)}: sensor_scale {channels[-1].scale:g} m")
        self.channels = tuple(channels)
        return tuple(notes)

    def reading(self, read_ns: int, voltages: Sequence[float], positions: Sequence[float]) -> Reading:
        """Return what was read at a time (ns), given in the units of the device, one value for each channel."""
        return Reading(
            read_ns,
            tuple(each.stage_volts(v) for each, v in zip(self.channels, voltages, strict=True)),
            tuple(each.metres(p) for each, p in zip(self.channels, positions, strict=True)),
        )

    def range_of(self, ends: Iterable[Sequence[float]]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return lowest and highest voltages at the stage from the ends (V of the device) of each channel."""
        pairs = [sorted(map(each.stage_volts, own)) for each, own in zip(self.channels, ends, strict=True)]
        return tuple(low for low, _ in pairs), tuple(high for _, high in pairs)

    @abstractmethod
    def open(self) -> Found:
        """Connect anew and ask the device what it is and where it is; changes no output and no setting."""

    @abstractmethod
    def release_servo(self) -> Found:
        """Switch the device's own position control off; return what the device says afterwards."""

    @abstractmethod
    def exchange(self, voltages: Sequence[float] | None) -> Reading:
        """Write voltages (V), none if None, and read."""

    @abstractmethod
    def close(self) -> None:
        """End the connection; changes no output. Never raises."""

    # Blocks, where the device has a clock and a memory of its own: `load`, `play`, then `played` until it is the number
    # of samples, then `recorded`. `block_period` and `longest_block` are known once the device is open.

    block_period = 0.0  # s, shortest time between two samples; 0: it plays no blocks
    longest_block = 0  # samples

    def load(self, block: Block) -> Generator[None]:
        """Load a block in pieces of one wait each; nothing moves."""
        raise UnsuitableError(f"{self.name}: it plays no blocks")

    def play(self) -> None:
        """Begin to play what was loaded."""
        raise UnsuitableError(f"{self.name}: it plays no blocks")

    def played(self) -> int:
        """Return the number of samples that were played; all of them, once it has ended."""
        raise UnsuitableError(f"{self.name}: it plays no blocks")

    def halt(self) -> int:
        """Stop where it is; return the number of samples that were played."""
        raise UnsuitableError(f"{self.name}: it plays no blocks")

    def recorded(self) -> Generator[None, None, Recording | None]:
        """Return, in pieces of one wait each, what was recorded of the last block; None if nothing was."""
        return None
        yield

    def read(self) -> Reading:
        """Read without writing."""
        return self.exchange(None)

    def write(self, voltages: Sequence[float]) -> Reading:
        """Write voltages (V); return what is read after them."""
        return self.exchange(voltages)


def _scale_or(channel: Channel, scale: float) -> float:
    """Return the scale (m) of a channel, another one where none was given."""
    return scale if isnan(channel.scale) else channel.scale


def host_and_port(kind: str, address: str, default: int) -> tuple[str, int]:
    """Return host and port of an address, by default this port; UsageError if it is none."""
    host, colon, port = address.rpartition(":")
    if not colon:
        host, port = address, str(default)
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise UsageError(f"address '{address}' of a {kind} device; give HOST or HOST:PORT, such as 192.0.2.1:{default}")
    return host.strip("[]"), int(port)
