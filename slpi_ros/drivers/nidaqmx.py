"""Analog outputs and inputs of National Instruments, by `nidaqmx`: with NI's driver, or NI's gRPC server elsewhere.

The present voltage of an output is read through the internal channel ``_ao0_vs_aognd`` before its task is made, and the
device is never reset, which would set its outputs to 0 V.
"""

import collections
import os
import re
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, Edge
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.stream_writers import AnalogMultiChannelWriter
from nidaqmx.system import Device as NiDevice

from slpi_ros.arrays import FloatArray
from slpi_ros.drivers.base import (
    TIMEOUT,
    AnswerError,
    Block,
    Channel,
    Device,
    Found,
    LinkError,
    Reading,
    Recording,
    RefusedError,
    UnsuitableError,
    host_and_port,
)
from slpi_ros.errors import UsageError, dependencies_needed, shown

PORT = 31_763  # of NI's gRPC server
SYNTAX = re.compile(r"(ao\d+):(ai\d+)(?::(ai\d+))?")
# Range that an input is asked for, and by how much of it a reading may be beyond, V.
INPUT_RANGE, BEYOND = 10.0, 1.1
# Errors after which the device is not there any more, or did not answer in time.
GONE = {-88705, -88710, -50405, -200220, -201003, -200284, -200474}
# A task does not exist any more: somebody has cleared it. On one server that is another driver at the same device.
CLEARED = -200088
# What a block is played and recorded at: the fastest that is asked for, and the most samples.
FASTEST, LONGEST = 1e-5, 1_000_000
# Samples that are read at once.
PIECE = 5000


class NidaqmxDevice(Device):
    """Outputs and inputs of one device: each cycle is one write and one read, without a clock of the device."""

    block_period, longest_block = FASTEST, LONGEST

    def __init__(self, address: str, channels: Sequence[Channel]) -> None:
        super().__init__("nidaqmx", address, channels)
        self._device, _, place = address.partition("@")
        if not self._device:
            raise UsageError(f"address '{address}' of a nidaqmx device; give such as Dev1, or Dev1@192.0.2.1:{PORT}")
        self._place = host_and_port("nidaqmx", place, PORT) if place else None
        found = [SYNTAX.fullmatch(channel.name) for channel in channels]
        if None in found:
            raise UsageError(
                f"channel '{channels[found.index(None)].name}' of a nidaqmx device; give OUTPUT:INPUT of the sensor, "
                "such as ao0:ai0, or OUTPUT:INPUT:INPUT with the one that the output is wired to"
            )
        wires = [each.groups() for each in found if each]
        self._outputs = [f"{self._device}/{output}" for output, _, _ in wires]
        told = [f"{self._device}/{wired or f'_{output}_vs_aognd'}" for output, _, wired in wires]
        self._inputs = [*(f"{self._device}/{sensor}" for _, sensor, _ in wires), *told]
        self._tasks: dict[str, Any] = {}
        self._link: Any = None  # to the gRPC server
        self._displaced = False  # whether another program has cleared the tasks
        self._range = (-INPUT_RANGE, INPUT_RANGE)
        self._reader: Any = None
        self._writer: Any = None
        self._values = np.empty((len(self._inputs), 1))
        # Of a block: voltages (V of the device), what was recorded so far, the last reading.
        self._block: Block | None = None
        self._pieces: list[FloatArray] = []
        self._last: Reading | None = None

    def open(self) -> Found:
        """Connect, then only read."""
        self.close()
        with self._told("opening"):
            if self._place:
                self._link = _link_to(self.name, *self._place)
                if not self._displaced:
                    # Else two drivers would clear each other's tasks, and move the stage by turns.
                    self._clear_tasks_of_the_past()
            device = NiDevice(self._device, grpc_options=self._options(""))
            identity = f"{device.product_type}, serial number {device.serial_num}"
            ranges = list(device.ao_voltage_rngs)
            if len(ranges) < 2:
                raise UnsuitableError(f"{self.name}: {shown(identity)} has no analog voltage outputs")
            self._range = min(ranges[::2]), max(ranges[1::2])
            self._read_on_demand()
        reading = self.read()
        self._displaced = False
        count = len(self.channels)
        return Found(identity, reading, reading.voltages, *self.range_of([self._range] * count), (False,) * count)

    def release_servo(self) -> Found:
        """Return what the device says: it has no servo."""
        return self.open()

    def exchange(self, voltages: Sequence[float] | None) -> Reading:
        """Write the outputs if voltages are given, then read all inputs at once."""
        if self._reader is None:
            raise LinkError(f"{self.name}: it is not open")
        if voltages is not None:
            with self._told("writing"):
                if self._writer is None:
                    self._writer = self._make_writer()
                values = [each.device_volts(v) for each, v in zip(self.channels, voltages, strict=True)]
                self._writer.write_one_sample(np.array(values), TIMEOUT)
        if self._block is not None:
            return self._latest()
        # What an answer leaves out is not taken for one.
        self._values.fill(np.nan)
        sent_ns = time.monotonic_ns()
        with self._told("reading"):
            count = self._reader.read_many_sample(self._values, 1, TIMEOUT)
        received_ns = time.monotonic_ns()
        if count != 1:
            raise AnswerError(f"{self.name}: one sample was asked for and {count} came")
        return self._reading(self._values[:, 0], (sent_ns + received_ns) // 2)

    def close(self) -> None:
        """Clear the tasks; the outputs stay."""
        if self._displaced:
            # By their names they may be those of the other program.
            self._tasks.clear()
        for name in list(self._tasks):
            self._clear(name)
        self._reader = self._writer = self._block = None
        if self._link is not None:
            with suppress(Exception):
                self._link.close()
        self._link = None

    # Blocks, by the sample clock of the outputs

    def load(self, block: Block) -> Generator[None]:
        """Write a block into the buffer of the outputs; the inputs sample with their clock."""
        count, rate = len(block.voltages), 1.0 / block.period
        with self._told("loading a block"):
            self._clear("output")
            self._writer = None
            output = self._output_task()
            output.timing.cfg_samp_clk_timing(
                rate, active_edge=Edge.RISING, sample_mode=AcquisitionType.FINITE, samps_per_chan=count
            )
            writer = AnalogMultiChannelWriter(output.out_stream, auto_start=False)
            writer.verify_array_shape = False
            gains = np.array([each.device_volts(1.0) for each in self.channels])
            writer.write_many_sample(np.ascontiguousarray(block.voltages.T * gains[:, None]), TIMEOUT)
        yield
        with self._told("loading a block"):
            # Until here, the inputs are read on demand.
            self._last = self.exchange(None)
            self._clear("input")
            inputs = self._input_task()
            inputs.timing.cfg_samp_clk_timing(
                rate, source=f"/{self._device}/ao/SampleClock", sample_mode=AcquisitionType.FINITE, samps_per_chan=count
            )
            self._reader = self._make_reader(inputs)
            inputs.start()
        self._block, self._pieces = block, []

    def play(self) -> None:
        """Start the sample clock."""
        with self._told("playing a block"):
            self._tasks["output"].start()

    def played(self) -> int:
        """Return the number of samples that were generated."""
        assert self._block is not None
        output, count = self._tasks["output"], len(self._block.voltages)
        with self._told("playing a block"):
            if output.is_task_done():
                self._take_all()
                self._end()
                return count
            return min(int(output.out_stream.total_samp_per_chan_generated), count - 1)

    def halt(self) -> int:
        """Stop the sample clock; the outputs stay."""
        with self._told("stopping a block"):
            self._tasks["output"].stop()
            self._take_all()
            self._end()
        # The inputs sample with the clock of the outputs, so that they count its samples.
        return sum(piece.shape[1] for piece in self._pieces)

    def recorded(self) -> Generator[None, None, Recording | None]:
        """Return what the inputs sampled meanwhile."""
        if not self._pieces:
            return None
        data, places = np.concatenate(self._pieces, 1), len(self.channels)
        period = self._period
        positions = [each.scale * data[n] + each.offset for n, each in enumerate(self.channels)]
        voltages = [each.gain * data[places + n] for n, each in enumerate(self.channels)]
        return Recording(
            np.arange(data.shape[1], dtype=np.float64) * period, np.stack(positions, 1), np.stack(voltages, 1)
        )
        yield

    def _latest(self) -> Reading:
        """Take what has been sampled of a block; return its last sample, or the last reading before."""
        assert self._last is not None
        if len(values := self._take()):
            self._last = self._reading(values[:, -1], time.monotonic_ns())
        return self._last

    def _take(self) -> FloatArray:
        """Take the samples of a block that are there, shape (inputs, n)."""
        with self._told("reading a block"):
            count = min(int(self._tasks["input"].in_stream.avail_samp_per_chan), PIECE)
            values = np.full((len(self._inputs), count), np.nan)
            if not count:
                return np.empty((0, 0))
            if self._reader.read_many_sample(values, count, TIMEOUT) != count:
                raise AnswerError(f"{self.name}: fewer than the {count} samples came that were there")
        self._require_volts(values)
        self._pieces.append(values)
        return values

    def _take_all(self) -> None:
        while len(self._take()):
            pass

    def _end(self) -> None:
        """Read on demand again."""
        assert self._block is not None
        self._period, self._block = self._block.period, None
        self._clear("output")
        self._writer = None
        self._read_on_demand()

    # Tasks

    def _read_on_demand(self) -> None:
        self._clear("input")
        inputs = self._input_task()
        self._reader = self._make_reader(inputs)
        inputs.start()

    def _input_task(self) -> Any:
        task = self._task("input")
        for name in self._inputs:
            task.ai_channels.add_ai_voltage_chan(name, min_val=-INPUT_RANGE, max_val=INPUT_RANGE)
        return task

    def _output_task(self) -> Any:
        task = self._task("output")
        for name in self._outputs:
            task.ao_channels.add_ao_voltage_chan(name, min_val=self._range[0], max_val=self._range[1])
        return task

    def _make_writer(self) -> Any:
        writer = AnalogMultiChannelWriter(self._output_task().out_stream, auto_start=True)
        # It asks the device for its channels in every cycle.
        writer.verify_array_shape = False
        return writer

    def _make_reader(self, task: Any) -> Any:
        reader = AnalogMultiChannelReader(task.in_stream)
        reader.verify_array_shape = False
        return reader

    def _name_of(self, what: str) -> str:
        return f"slpi_ros_{self._device}_{what}"

    def _task(self, what: str) -> Any:
        # That of a block which was stopped before it began.
        self._clear(what)
        name = self._name_of(what) if self._link else ""
        self._tasks[what] = nidaqmx.Task(name, grpc_options=self._options(name))
        return self._tasks[what]

    def _clear(self, what: str) -> None:
        if (task := self._tasks.pop(what, None)) is not None:
            with suppress(Exception):
                task.close()

    def _clear_tasks_of_the_past(self) -> None:
        """Clear the tasks that a process which was killed has left on the server; the outputs stay."""
        for what in ("input", "output"):
            with suppress(nidaqmx.errors.Error):
                name = self._name_of(what)
                nidaqmx.Task(name, grpc_options=self._options(name, attach=True)).close()

    def _options(self, name: str, *, attach: bool = False) -> Any:
        if self._link is None:
            return None
        behavior = nidaqmx.grpc_session_options.SessionInitializationBehavior
        return nidaqmx.GrpcSessionOptions(
            self._link,
            name,
            initialization_behavior=behavior.ATTACH_TO_SERVER_SESSION if attach else behavior.INITIALIZE_SERVER_SESSION,
        )

    # Answers

    def _reading(self, values: FloatArray, read_ns: int) -> Reading:
        self._require_volts(values)
        told, places = values.tolist(), len(self.channels)
        return self.reading(read_ns, told[places:], told[:places])

    def _require_volts(self, values: FloatArray) -> None:
        if not np.isfinite(values).all() or np.abs(values).max() > BEYOND * max(INPUT_RANGE, *map(abs, self._range)):
            last = values.reshape(len(self._inputs), -1)[:, -1].tolist()
            raise AnswerError(f"{self.name}: it reads {last}, no voltages of an input")

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Raise the errors of the library as those of a device."""
        try:
            yield
        except nidaqmx.errors.DaqNotFoundError as error:
            raise UnsuitableError(
                f"{self.name}: NI's driver is not installed; install NI-DAQmx, or give {self._device}@HOST of a "
                "computer with NI's gRPC server"
            ) from error
        except nidaqmx.errors.Error as error:
            code = getattr(error, "error_code", 0)
            self._displaced |= code == CLEARED
            if self._displaced:
                raise LinkError(
                    f"{self.name}: its tasks are gone ({_first_line(error)}): another program has taken the device "
                    "over, or its server was started again; end the other one, or start this driver again to take it "
                    "back"
                ) from error
            if not isinstance(error, nidaqmx.errors.DaqError):
                raise LinkError(f"{self.name}: no answer to {what}: {_first_line(error)}") from error
            kind = LinkError if code in GONE else RefusedError
            raise kind(f"{self.name}: error {code} at {what}: {_first_line(error)}") from error
        except (AssertionError, ValueError) as error:
            raise AnswerError(f"{self.name}: {what} was answered by other samples than were asked for") from error


DEVICE = NidaqmxDevice


def _first_line(error: Exception) -> str:
    return shown(str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__, 160)


def _link_to(name: str, host: str, port: int) -> Any:
    """Return a channel to a gRPC server, on which no call waits longer than `TIMEOUT`."""
    # It writes what it does to standard error; the errors say what matters.
    os.environ.setdefault("GRPC_VERBOSITY", "NONE")
    with dependencies_needed():
        import grpc

    details = collections.namedtuple(
        "details", ("method", "timeout", "metadata", "credentials", "wait_for_ready", "compression")
    )

    class Deadline(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]
        """Give every call a deadline."""

        def intercept_unary_unary(self, continuation: Any, given: Any, request: Any) -> Any:
            mine = details(given.method, TIMEOUT, given.metadata, given.credentials, None, None)
            return continuation(mine, request)

    channel = grpc.insecure_channel(f"{host}:{port}")
    try:
        grpc.channel_ready_future(channel).result(timeout=TIMEOUT)
    except grpc.FutureTimeoutError as error:
        channel.close()
        raise LinkError(
            f"{name}: no connection; check that NI's gRPC server runs there, its address and its port"
        ) from error
    return grpc.intercept_channel(channel, Deadline())
