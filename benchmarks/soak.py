"""The compensator under load for minutes: lost messages, memory use, and the message rate that it cannot sustain."""

import argparse
import os

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from round_trip import Client, Trip, compensator, identified_stage

# At 5 kHz the usual queue depth of 100 covers 20 ms; on a machine with two cores, other processes may run longer.
DEEP = {
    f"qos_overrides./soak/{topic}.{side}.depth": 20_000
    for topic, side in (("desired_displacement", "subscription"), ("voltage_command", "publisher"))
}
# Warm-up time, seconds, after which growth of the memory is measured.
WARM = 30


def described(trip: Trip, rate: float) -> str:
    """Return the line of the table for one rate (Hz)."""
    p50, p99 = trip.percentiles()
    resident = np.array(trip.resident[min(WARM, len(trip.resident) // 2) :])
    grown = (resident[-1] - resident[0]) / 1024
    reached, load = trip.sent / trip.took, os.getloadavg()[0]
    return (
        f"{rate:8.0f} {reached:9.0f} {trip.sent:10d} {trip.lost:6d} {p50:8.0f} {p99:9.0f} {trip.cpu:6.0%} "
        f"{resident.max() / 2**20:9.1f} {grown:+11.0f} {load:6.2f}"
    )


def main(minutes: float = 10.0, ceiling: bool = True) -> None:
    """Print the table."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    model = identified_stage()
    runs = [(1000.0, 60.0 * minutes), (5000.0, min(60.0, 60.0 * minutes))]
    runs += [(rate, 10.0) for rate in (7000.0, 10000.0)] if ceiling else []
    print(" rate Hz  sent/s        sent   lost   p50 us    p99 us    CPU  mem MiB  growth KiB   load")
    for rate, seconds in runs:
        with compensator("soak", model, **(DEEP if rate > 1000.0 else {})) as process:
            client, trip = Client(["soak"]), Trip()
            client.wait_for_nodes()
            client.run("soak", process, rate, seconds, trip)
            print(described(trip, rate), flush=True)
            client.close()
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--no-ceiling", action="store_true")
    options = parser.parse_args()
    main(options.minutes, not options.no_ceiling)
