"""Round trip of a two-axis command through the compensator at 1 kHz, a bare echo node beside it in the same run."""

import argparse

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from round_trip import Client, compensator, echo, identified_stage

ROUNDS = 3


def main(seconds: float = 10.0, rate: float = 1000.0) -> None:
    """Print the table."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    model = identified_stage()
    cases = {
        "echo, events executor": lambda: echo(),
        "compensator, events executor": lambda: compensator(model),
        "echo, default executor": lambda: echo("default"),
        "compensator, default executor": lambda: compensator(model, "default"),
    }
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    print(f"{ROUNDS} rounds of {seconds:g} s at {rate:g} Hz, two axes, reliable; median of the rounds")
    lost = dict.fromkeys(cases, 0)
    cpu = dict.fromkeys(cases, 0.0)
    for _ in range(ROUNDS):
        for name, start in cases.items():
            with start() as process:
                client = Client()
                trip = client.run(process, rate, seconds)
                client.close()
            found[name].append(trip.percentiles())
            lost[name] += trip.lost
            cpu[name] = max(cpu[name], trip.cpu)
    print(f"{'':<32} {'p50 us':>8} {'p99 us':>8} {'lost':>6} {'CPU':>6}")
    medians = {}
    for name, rounds in found.items():
        medians[name] = np.median(rounds, axis=0)
        p50, p99 = medians[name]
        print(f"{name:<32} {p50:8.0f} {p99:8.0f} {lost[name]:6d} {cpu[name]:6.0%}")
    for executor in ("events", "default"):
        p50, p99 = medians[f"compensator, {executor} executor"] / medians[f"echo, {executor} executor"]
        print(f"compensator over echo, {executor} executor: p50 {p50:.2f}, p99 {p99:.2f}")
    rclpy.try_shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    options = parser.parse_args()
    main(options.seconds, options.rate)
