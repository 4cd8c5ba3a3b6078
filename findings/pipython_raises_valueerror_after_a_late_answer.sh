#!/bin/sh
# Good guess: after an answer of a PI controller that came too late, the next commands work again, or raise GCSError, of
# which a program that moves a stage takes care.
# Really: the late answer is taken for that to "ERR?", and the error that should say so is formatted with a code that text
# does not have: ValueError ("Unknown format code 'r'") for some commands, by which "except GCSError" is passed.
# PIPython 2.11.0.6 (of the maker), pipython/pidevice/gcsmessages.py, lines 288 and 339: "{answer:r}".
# Met by: who moves a stage with a controller of PI by the maker's own library. The controller is played here: GCS lines
# over TCP, one answer 1 s late at a time-out of 0.5 s.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --no-compile --disable-pip-version-check PIPython==2.11.0.6 pyserial==3.5 pyusb==1.3.1
cd "$folder"
venv/bin/python - <<'PY'
import socket
import sys
import threading
import time
from importlib.metadata import version

from pipython import GCSError
from pipython.pidevice.gcscommands import GCSCommands
from pipython.pidevice.gcsmessages import GCSMessages
from pipython.pidevice.interfaces.pisocket import PISocket

late = []


def answer(line):
    command, *axes = line.split()
    if command == "POS?":
        if late:
            time.sleep(late.pop())
        return " \n".join(f"{axis}={float(axis):.6f}" for axis in axes or "12")
    known = {"*IDN?": "(c)2025 Physik Instrumente (PI) GmbH & Co. KG, E-727, 0120012345, 1.5", "ERR?": "0"}
    return known.get(command, "")


def serve(server):
    link, _ = server.accept()
    for line in link.makefile():
        if line.strip() and (text := answer(line)):
            link.sendall(f"{text}\n".encode())


server = socket.create_server(("127.0.0.1", 0))
threading.Thread(target=serve, args=(server,), daemon=True).start()
said = []
with PISocket("127.0.0.1", server.getsockname()[1]) as gateway:
    messages = GCSMessages(gateway)
    device = GCSCommands(messages)
    messages.timeout = 500
    assert dict(device.qPOS("1")) == {"1": 1.0}
    late.append(1.0)
    for axis in "1212":
        try:
            said.append(f"{dict(device.qPOS(axis))}")
        except GCSError as error:
            said.append(f"GCSError: {error}")
        except ValueError as error:
            said.append(f"ValueError: {error}")
print(f"PIPython {version('PIPython')}")
for line in said:
    print(line)
if not said[0].startswith("GCSError") or not any(each.startswith("ValueError: Unknown format") for each in said[1:]):
    sys.exit("the behaviour has changed")
PY
