"""Round-trip latency of a two-axis command through the compensator at 1 kHz, compared with a minimal rclpy echo node.

All nodes run all the time and receive blocks of messages in turn, so that other load of the machine affects them alike.
The compensator receives and publishes serialised messages, which saves more time than the compensation takes; a second
echo node that does the same shows the time of the compensation itself.
"""

import argparse
import os
from contextlib import ExitStack

import kept
import rclpy
from rclpy.signals import SignalHandlerOptions
from round_trip import Client, Trip, compensator, echo, identified_stage

from slpi_ros.model.stage_model import StageModel

BLOCK_S = 0.25
# A rate limit would add voltages between the desired displacements, and answers must be one for each.
UNLIMITED = {"slew_limit": 0.0}
# Number of process starts: the latency depends on the memory and cores that a process happens to receive.
STARTS = 5


def measure(
    model: StageModel, executor: str, seconds: float, rate: float, beside: str = ""
) -> dict[str, dict[str, float]]:
    """Print the lines of the table for one executor, and return its figures by node; times in microseconds.

    `beside` is the Python of another environment, if any.
    """
    cases = {
        "echo": lambda name: echo(name, "echo", executor),
        "compensator": lambda name: compensator(name, model, executor, **UNLIMITED),
        "bytes_echo": lambda name: echo(name, "bytes", executor),
    }
    if beside:
        cases["echo_beside"] = lambda name: echo(name, "echo", executor, beside)
        cases["compensator_beside"] = lambda name: compensator(name, model, executor, python=beside, **UNLIMITED)
    trips = {name: Trip() for name in cases}
    for _ in range(STARTS):
        with ExitStack() as stack:
            processes = {name: stack.enter_context(start(name)) for name, start in cases.items()}
            client = Client(list(cases))
            client.wait_for_nodes()
            for _ in range(round(seconds / BLOCK_S)):
                for name, process in processes.items():
                    client.run(name, process, rate, BLOCK_S, trips[name])
            client.close()
    floor, figures = trips["echo"].percentiles(), {}
    for name, trip in trips.items():
        p50, p99 = trip.percentiles()
        ratio = f"{p50 / floor[0]:.2f} / {p99 / floor[1]:.2f}"
        print(
            f"{name + ', ' + executor:<32} {p50:8.0f} {p99:8.0f} {ratio:>12} {trip.lost:6d} {trip.cpu:6.0%}", flush=True
        )
        figures[name] = {"p50": round(p50), "p99": round(p99), "lost": trip.lost}
    return figures


def main(seconds: float = 8.0, rate: float = 1000.0, beside: str = "", keep: bool = False) -> None:
    """Print the table, with nodes of the Python `beside` too; `keep` writes it to the file of kept figures."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    print(f"{STARTS} starts of all nodes, {seconds:g} s at {rate:g} Hz each, in blocks of {BLOCK_S:g} s in turn")
    print(f"two axes, reliable, depth 100; load of the machine before: {os.getloadavg()[0]:.2f}")
    print(f"{'':<32} {'p50 us':>8} {'p99 us':>8} {'of echo':>12} {'lost':>6} {'CPU':>6}")
    model = identified_stage()
    figures = {executor: measure(model, executor, seconds, rate, beside) for executor in ("events", "default")}
    if keep:
        kept.write("latency", "make bench-latency", figures)
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--beside", default="", metavar="PYTHON", help="nodes of another environment in the same run")
    parser.add_argument("--keep", action="store_true", help="write the figures to kept_figures.json")
    options = parser.parse_args()
    main(options.seconds, options.rate, options.beside, options.keep)
