#!/bin/sh
# Good guess: write_registers sends one request; where the device answers too late it fails, and the caller decides.
# Really: the client has three retries unless told otherwise, for writes too. A device that carries out the first request
# and answers late carries it out again, and the call returns a good response: who counts, steps or triggers by writing a
# register does so twice, and a voltage that another client has set in between is undone.
# pymodbus 3.16.1, pymodbus/client/tcp.py (retries: int = 3) and pymodbus/transaction/transaction.py (execute).
# Met by: who writes outputs of a LabJack or another device by Modbus; retries=0 is what a write needs.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check pymodbus==3.16.1
cd "$folder"
venv/bin/python - <<'PY'
import asyncio
import logging
import sys
import threading
from importlib.metadata import version

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
written, late, places, ready = [], [], [], threading.Event()


async def access(function, start, address, count, registers, values):
    if values is not None:
        written.append(list(values))
        if late:
            await asyncio.sleep(late.pop())


async def serve():
    device = SimDevice(1, [SimData(0, count=10, values=0, datatype=DataType.REGISTERS)], action=access)
    server = ModbusTcpServer(device, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    places.append(server.transport.sockets[0].getsockname()[1])
    ready.set()
    await asyncio.sleep(60.0)


threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
ready.wait()
found = {}
for name, settings in (("as it is", {}), ("retries=0", {"retries": 0})):
    client = ModbusTcpClient("127.0.0.1", port=places[0], timeout=1.0, **settings)
    client.connect()
    written.clear()
    late.append(1.5)
    try:
        said = "failed" if client.write_registers(0, [1, 2], device_id=1).isError() else "good"
    except ModbusException as error:
        said = type(error).__name__
    client.close()
    found[name] = len(written), said
print(f"pymodbus {version('pymodbus')}, an answer 1.5 s late at a time-out of 1 s")
for name, (count, said) in found.items():
    print(f"{name}: written {count} times; the call: {said}")
if found != {"as it is": (2, "good"), "retries=0": (1, "ModbusIOException")}:
    sys.exit("the behaviour has changed")
PY
