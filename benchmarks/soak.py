"""The compensator under load for minutes: messages lost, memory, and the rate at which it can no longer follow."""

import argparse

import rclpy
from rclpy.signals import SignalHandlerOptions
from round_trip import Client, Trip, compensator, identified_stage


def described(trip: Trip, rate: float) -> str:
    """Return one line of the table."""
    p50, p99 = trip.percentiles()
    warm = trip.resident[min(10, trip.resident.size - 1) :]
    grown = (warm[-1] - warm[0]) / 1024
    reached = trip.sent / max(trip.resident.size, 1)
    return (
        f"{rate:8.0f} {reached:9.0f} {trip.sent:10d} {trip.lost:6d} {p50:8.0f} {p99:9.0f} {trip.cpu:6.0%} "
        f"{warm.max() / 2**20:9.1f} {grown:+11.0f}"
    )


def main(minutes: float = 10.0, ceiling: bool = True) -> None:
    """Print the table."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    model = identified_stage()
    runs = [(1000.0, 60.0 * minutes), (5000.0, min(60.0, 60.0 * minutes))]
    runs += [(rate, 10.0) for rate in (7000.0, 10000.0)] if ceiling else []
    print(" rate Hz  sent/s        sent   lost   p50 us    p99 us    CPU  mem MiB  growth KiB")
    for rate, seconds in runs:
        with compensator(model) as process:
            client = Client()
            print(described(client.run(process, rate, seconds), rate), flush=True)
            client.close()
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--no-ceiling", action="store_true")
    options = parser.parse_args()
    main(options.minutes, not options.no_ceiling)
