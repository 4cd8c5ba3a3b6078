"""PI's own client library at a controller: python driver_pipython.py ADDRESS RATE SECONDS, started by driver.py.

Runs where `pipython` is installed, and nothing of this package has to be. Prints, once as it comes (it asks ``ERR?``
after each command) and once without that, cycles, seconds, seconds of the processor, and latenesses (s): median, 99th
percentile, maximum.
"""

import math
import sys
import time

from pipython.pidevice.gcscommands import GCSCommands
from pipython.pidevice.gcsmessages import GCSMessages
from pipython.pidevice.interfaces.pisocket import PISocket

AXES = ("1", "2")


def main():
    host, _, port = sys.argv[1].rpartition(":")
    rate, seconds = map(float, sys.argv[2:])
    with PISocket(host=host, port=int(port)) as link:
        device = GCSCommands(GCSMessages(link))
        for checked in (True, False):
            device.errcheck = checked
            turns(device, rate, seconds)


def turns(device, rate, seconds):
    period = 1.0 / rate
    begun, used = time.perf_counter(), time.process_time()
    due, lateness = begun, []
    while (now := time.perf_counter()) - begun < seconds:
        if now < due:
            time.sleep(due - now)
        lateness.append(time.perf_counter() - due)
        device.SVA(AXES, [45.0 + 40.0 * math.sin(6.0 * (now - begun))] * len(AXES))
        device.qPOS(AXES)
        due += period
        # As in the driver, no burst makes up for a cycle that took long.
        due += max((time.perf_counter() - due) // period, 0.0) * period
    elapsed, used = time.perf_counter() - begun, time.process_time() - used
    lateness.sort()
    median, p99, most = (lateness[min(int(share * len(lateness)), len(lateness) - 1)] for share in (0.5, 0.99, 1.0))
    print(len(lateness), elapsed, used, median, p99, most, flush=True)


if __name__ == "__main__":
    main()
