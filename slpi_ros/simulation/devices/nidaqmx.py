"""NI's gRPC server with one device, on the stubs of NI's own package, with an amplifier and a simulated stage behind.

Written independently of the driver. What is simulated: tasks on demand and with a sample clock, the internal channels
that read an output back, error codes. A device that is reset would set its outputs to 0 V: that is logged.
"""

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import grpc
from nidaqmx._stubs import nidaqmx_pb2 as types
from nidaqmx._stubs import nidaqmx_pb2_grpc as service

from slpi_ros.simulation.devices import base
from slpi_ros.simulation.devices.base import SimulatedDevice
from slpi_ros.simulation.stage import Stage

DEVICE = "Dev1"
# Sample clock: the stage follows the outputs at this period, as it takes long to compute.
STAGE_NS = 1_000_000
NAME, PRODUCT, SERIAL, RANGES = 0x1276, 0x631, 0x632, 0x299B
RESERVED, NO_CHANNEL, NO_SESSION, OUT_OF_RANGE = -50103, -200170, -1, -200077


@dataclass
class _Task:
    """One task on the server."""

    name: str
    outputs: list[str] = field(default_factory=list)
    inputs: list[str] = field(default_factory=list)
    rate: float = 0.0  # 0: on demand
    count: int = 0
    data: list[list[float]] = field(default_factory=list)  # V, of each output
    samples: list[list[float]] = field(default_factory=list)  # recorded, of each time
    begun_ns: int = 0
    next: int = 0
    running: bool = False


class NidaqmxSimulator(SimulatedDevice):
    """A simulated device Dev1, ±10 V, behind a gRPC server.

    Parameters
    ----------
    axes : OUTPUT:INPUT or OUTPUT:INPUT:INPUT, as the driver's channels: how the stage is wired
    stage : what moves; by default a random one
    internal : whether the device has the internal channels
    host, port : of the server; port 0 for a free one
    """

    usual_axes, usual_address = ("ao0:ai0",), "127.0.0.1:31763"
    question = "ReadAnalogF64"

    def __init__(
        self,
        axes: Sequence[str] = ("ao0:ai0",),
        stage: Stage | None = None,
        *,
        internal: bool = True,
        host: str = "127.0.0.1",
        port: int = 0,
        gain: float = 10.0,
        **named: Any,
    ) -> None:
        super().__init__(axes, stage, voltage_range=(-10.0, 10.0), gain=gain, **named)
        self.outputs, self.inputs = {}, {}
        for axis in self.axes:
            output, *inputs = axis.split(":")
            self.outputs[f"{DEVICE}/{output}"] = axis
            if internal:
                self.inputs[f"{DEVICE}/_{output}_vs_aognd"] = axis, False
            for name, sensor in zip(inputs, (True, False), strict=False):
                self.inputs[f"{DEVICE}/{name}"] = axis, sensor
        self.resets = 0
        self.refused_until = 0.0
        self._server = grpc.server(ThreadPoolExecutor(8))
        service.add_NiDAQmxServicer_to_server(_Service(self), self._server)
        self._port = self._server.add_insecure_port(f"{host}:{port}")
        if not self._port:
            raise OSError(f"cannot listen at {host}:{port}")
        self.address = f"{DEVICE}@{host}:{self._port}"

    def start(self) -> None:
        """Begin to serve."""
        self._server.start()

    def close(self) -> None:
        """End the server."""
        self._server.stop(grace=None).wait()

    def read(self, name: str, measured: dict[str, float]) -> float:
        """Return the voltage (V) at an input."""
        axis, sensor = self.inputs[name]
        return measured[axis] * base.VOLTS_PER_METRE if sensor else self.voltage(axis)


class _Service(service.NiDAQmxServicer):  # type: ignore[misc]
    """What of the service a driver needs."""

    def __init__(self, device: NidaqmxSimulator) -> None:
        self._device = device
        self._tasks: dict[str, _Task] = {}
        self._guard = threading.RLock()
        self._number = 0

    # What a call meets

    def _arrived(self, name: str, context: Any) -> str:
        """Note a call; return the kind of the fault that spoils its answer."""
        device = self._device
        device.received.append(name)
        if time.monotonic() < device.refused_until:
            context.abort(grpc.StatusCode.UNAVAILABLE, "the link was lost")
        if device.answer_delay:
            time.sleep(device.answer_delay)
        with self._guard:
            self._advance(time.monotonic_ns())
        fault = device.due(name)
        if fault is None:
            return ""
        if fault.kind == base.LOST:
            device.refused_until = time.monotonic() + fault.seconds
            context.abort(grpc.StatusCode.UNAVAILABLE, "the link was lost")
        if fault.kind in (base.LATE, base.SILENT):
            time.sleep(fault.seconds if fault.kind == base.LATE else 0.6)
            if fault.kind == base.SILENT:
                context.abort(grpc.StatusCode.CANCELLED, "nobody waits any more")
        if fault.kind == base.ERROR:
            self._fail(context, -200361, "The device has failed.")
        return fault.kind

    def _fail(self, context: Any, code: int, text: str) -> None:
        context.set_trailing_metadata((("ni-error", str(code)),))
        context.abort(grpc.StatusCode.UNKNOWN, text)

    def _task_of(self, request: Any, context: Any) -> _Task:
        task = self._tasks.get(request.task.name)
        if task is None:
            self._fail(context, -200088, "Task specified is invalid or does not exist.")
        assert task is not None
        return task

    # The system and the device

    def GetSystemInfoAttributeUInt32(self, request: Any, context: Any) -> Any:
        return types.GetSystemInfoAttributeUInt32Response(value=23)

    def GetDeviceAttributeString(self, request: Any, context: Any) -> Any:
        self._arrived("GetDeviceAttributeString", context)
        if request.device_name != DEVICE:
            self._fail(context, -200220, "Device identifier is invalid.")
        return types.GetDeviceAttributeStringResponse(value="USB-6363 (SIMULATED)")

    def GetDeviceAttributeUInt32(self, request: Any, context: Any) -> Any:
        return types.GetDeviceAttributeUInt32Response(value=0x1D9A3C5)

    def GetDeviceAttributeDoubleArray(self, request: Any, context: Any) -> Any:
        return types.GetDeviceAttributeDoubleArrayResponse(value=[-5.0, 5.0, self._device.low, self._device.high])

    def ResetDevice(self, request: Any, context: Any) -> Any:
        self._device.resets += 1
        for axis in self._device.axes:
            self._device.output(axis, 0.0)
        return types.ResetDeviceResponse()

    # Tasks

    def CreateTask(self, request: Any, context: Any) -> Any:
        self._arrived("CreateTask", context)
        with self._guard:
            name = request.session_name
            if request.initialization_behavior == 2 and name not in self._tasks:
                self._fail(context, NO_SESSION, "Cannot attach to a session that does not exist.")
            if request.initialization_behavior == 1 and name in self._tasks:
                self._fail(context, -200089, "Task name conflicts with an existing task name.")
            new = name not in self._tasks
            if not name:
                self._number += 1
                name = f"_unnamedTask<{self._number}>"
            if new:
                self._tasks[name] = _Task(name)
            response = types.CreateTaskResponse(new_session_initialized=new)
            response.task.name = name
            return response

    def ClearTask(self, request: Any, context: Any) -> Any:
        self._arrived("ClearTask", context)
        with self._guard:
            self._tasks.pop(request.task.name, None)
        return types.ClearTaskResponse()

    def GetTaskAttributeString(self, request: Any, context: Any) -> Any:
        return types.GetTaskAttributeStringResponse(value=request.task.name)

    def CreateAIVoltageChan(self, request: Any, context: Any) -> Any:
        task = self._task_of(request, context)
        if request.physical_channel not in self._device.inputs:
            self._fail(context, NO_CHANNEL, f"Physical channel {request.physical_channel} does not exist.")
        task.inputs.append(request.physical_channel)
        return types.CreateAIVoltageChanResponse()

    def CreateAOVoltageChan(self, request: Any, context: Any) -> Any:
        task = self._task_of(request, context)
        if request.physical_channel not in self._device.outputs:
            self._fail(context, NO_CHANNEL, f"Physical channel {request.physical_channel} does not exist.")
        others = [each for each in self._tasks.values() if each is not task]
        if any(request.physical_channel in each.outputs for each in others):
            self._fail(context, RESERVED, "The specified resource is reserved.")
        task.outputs.append(request.physical_channel)
        return types.CreateAOVoltageChanResponse()

    def CfgSampClkTiming(self, request: Any, context: Any) -> Any:
        task = self._task_of(request, context)
        task.rate, task.count = request.rate, request.samps_per_chan
        return types.CfgSampClkTimingResponse()

    def StartTask(self, request: Any, context: Any) -> Any:
        self._arrived("StartTask", context)
        with self._guard:
            task = self._task_of(request, context)
            task.running, task.begun_ns, task.next = True, time.monotonic_ns(), 0
        return types.StartTaskResponse()

    def StopTask(self, request: Any, context: Any) -> Any:
        self._arrived("StopTask", context)
        with self._guard:
            self._task_of(request, context).running = False
        return types.StopTaskResponse()

    def IsTaskDone(self, request: Any, context: Any) -> Any:
        self._arrived("IsTaskDone", context)
        return types.IsTaskDoneResponse(is_task_done=not self._task_of(request, context).running)

    def GetWriteAttributeUInt64(self, request: Any, context: Any) -> Any:
        self._arrived("GetWriteAttributeUInt64", context)
        return types.GetWriteAttributeUInt64Response(value=self._task_of(request, context).next)

    def GetReadAttributeUInt32(self, request: Any, context: Any) -> Any:
        self._arrived("GetReadAttributeUInt32", context)
        task = self._task_of(request, context)
        return types.GetReadAttributeUInt32Response(value=len(task.samples))

    # Samples

    def WriteAnalogF64(self, request: Any, context: Any) -> Any:
        self._arrived("WriteAnalogF64", context)
        device, task, values = self._device, self._task_of(request, context), list(request.write_array)
        if not all(device.low <= v <= device.high for v in values):
            self._fail(context, OUT_OF_RANGE, "Requested value is not a supported value for this property.")
        count = request.num_samps_per_chan
        columns = [values[n * count : (n + 1) * count] for n in range(len(task.outputs))]
        with self._guard:
            if task.rate:
                task.data = columns
            else:
                for name, column in zip(task.outputs, columns, strict=True):
                    device.output(device.outputs[name], column[-1])
        return types.WriteAnalogF64Response(samps_per_chan_written=count)

    def ReadAnalogF64(self, request: Any, context: Any) -> Any:
        kind = self._arrived("ReadAnalogF64", context)
        device, task, count = self._device, self._task_of(request, context), request.num_samps_per_chan
        with self._guard:
            if task.rate:
                rows, task.samples = task.samples[:count], task.samples[count:]
            else:
                device.cycles += 1
                measured = device.measure()
                rows = [[device.read(name, measured) for name in task.inputs]]
        values = [row[n] for n in range(len(task.inputs)) for row in rows]
        values = {
            base.HALF: values[: len(values) // 2],
            base.WRONG_AXIS: [*values, 1.0],
            base.TWICE: values + values,
            base.NONSENSE: [1e300] * len(values),
            base.NOT_FINITE: [float("nan")] * len(values),
        }.get(kind, values)
        return types.ReadAnalogF64Response(read_array=values, samps_per_chan_read=len(rows))

    def _advance(self, now_ns: int) -> None:
        """Generate and sample what is due by the sample clock."""
        device = self._device
        task = next((each for each in self._tasks.values() if each.outputs and each.rate and each.running), None)
        if task is None:
            return
        inputs = next((each for each in self._tasks.values() if each.inputs and each.rate and each.running), None)
        period_ns = round(1e9 / task.rate)
        most = max(STAGE_NS // period_ns, 1)
        while task.running:
            first = task.next
            count = min((now_ns - task.begun_ns) // period_ns + 1 - first, task.count - first, most)
            if count < most and first + count < task.count:
                return
            times_ns = [task.begun_ns + (first + n) * period_ns for n in range(count)]
            for name, column in zip(task.outputs, task.data, strict=True):
                device.note(device.outputs[name], column[first : first + count], times_ns)
            measured = device.measure(times_ns[-1])
            if inputs is not None:
                told = dict(zip(task.outputs, task.data, strict=True))
                axes = {device.outputs[name]: column for name, column in told.items()}
                for n in range(first, first + count):
                    inputs.samples.append(
                        [
                            device.read(name, measured)
                            if device.inputs[name][1] or device.inputs[name][0] not in axes
                            else axes[device.inputs[name][0]][n]
                            for name in inputs.inputs
                        ]
                    )
            task.next += count
            task.running = task.next < task.count
