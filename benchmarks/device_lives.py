"""From an unknown stage to a verified scan through every driver and its simulated device, and without a driver.

Each is the same plain stage (seed, 8 nm of sensor noise), in real time: device_simulator, driver, calibrator to its
target; on the next day, compensator and a scan that no record holds, recorded, and `slpi verify`. The way without a
driver is the node `stage_simulator`: it answers each command, or is read as often as a device. A launch file starts the
same nodes: calibrate.launch.py and compensator.launch.py with driver_file and device_file.

The path is held between its samples. A state that answers a command never shows it on its way; one that is read at
other times does, with the step from sample to sample: speed * 10 ms, in the share of the readings that come before the
command. The figures tell that part by itself: late.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
CHECKOUT = Path(__file__).resolve().parents[1]
sys.path.append(str(CHECKOUT / "demo"))

import numpy as np  # noqa: E402
from driver import DEVICE_PRIORITY, PRIORITY, schedule  # noqa: E402
from graph import EXECUTABLES, executable, operator  # noqa: E402
from paths import scan_path  # noqa: E402

import slpi_ros  # noqa: E402

V_MIN, V_MAX, RATE, PATH_RATE, NOISE = 0.0, 90.0, 200.0, 100.0, 8e-9
PLAIN, READ = "no driver", "no driver, read"
# Simulated device: where it is served, the device of the driver, where the driver finds it, channel, V/V, m a unit.
DEVICES = {
    "gcs": ("127.0.0.1:{port}", "gcs", "127.0.0.1:{port}", "1", 1.0, 1e-6),
    "labjack": ("127.0.0.1:{port}", "labjack", "127.0.0.1:{port}", "DAC0:AIN0", 20.0, 1e-5),
    "nidaqmx": ("127.0.0.1:{port}", "nidaqmx", "Dev1@127.0.0.1:{port}", "ao0:ai0", 10.0, 1e-5),
    "nv200": ("{folder}/tty", "serial", "nv200:{folder}/tty", "1", 1.0, 1e-6),
}
PORT = 50_100
SETTLE, STATE_TIMEOUT = 2.0, 3.0


def stage(life, name, seed, folder):
    """Start the stage, with device and driver in between or without."""
    if name in (PLAIN, READ):
        answers = name == PLAIN
        life.enter_context(
            executable("stage_simulator", seed=seed, rate=RATE, noise_rms=NOISE, answer_commands=answers)
        )
        return
    served, kind, found, channel, gain, scale = DEVICES[name]
    place = {"port": PORT + list(DEVICES).index(name), "folder": folder}
    address = served.format(**place)
    simulated = executable("device_simulator", device=name, address=address, seed=seed, noise_rms=NOISE)
    process = life.enter_context(simulated)
    time.sleep(SETTLE)
    # A real device is not slowed by other programs here.
    with suppress(PermissionError):
        schedule(process.pid, os.SCHED_FIFO, DEVICE_PRIORITY)
    life.enter_context(
        executable(
            "driver", device=kind, address=found.format(**place), channels=f"['{channel}']", voltage_min=V_MIN,
            voltage_max=V_MAX, rate=RATE, amplifier_gain=gain, sensor_scale=scale, realtime_priority=PRIORITY,
        )
    )  # fmt: skip


def calibrated(name, seed, folder):
    """Let the calibrator calibrate; return its exit code and last line."""
    with ExitStack() as life:
        stage(life, name, seed, folder)
        given = {"voltage_min": V_MIN, "voltage_max": V_MAX, "rate": RATE, "output": folder / "calibration"}
        # On a busy machine states come late.
        given["state_timeout"] = STATE_TIMEOUT
        words = [word for key, value in given.items() for word in ("-p", f"{key}:={value}")]
        command = [EXECUTABLES / "calibrator", "--ros-args", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, (done.stderr.strip().splitlines() or [""])[-1]


def scanned(name, seed, folder):
    """Follow a scan with the model, and record it."""
    model = folder / "calibration" / "model.json"
    low, high = slpi_ros.load_model(model).axes["x"].displacement_range
    _, y = scan_path(low + 0.05 * (high - low), high - 0.05 * (high - low), duration=20.0, rate=PATH_RATE, seed=seed)
    with ExitStack() as life:
        stage(life, name, seed, folder)
        at = life.enter_context(operator())
        at.wait_until("states", lambda: len(at.state.position) > 0)
        given = {"model_file": model, "voltage_min": V_MIN, "voltage_max": V_MAX, "realtime_priority": PRIORITY}
        life.enter_context(executable("compensator", log="error", **given))
        at.await_compensator()
        at.call("/compensator/reset_memory")
        here = float(at.state.position[0])
        approach = here + (y[0] - here) * (1.0 - np.cos(np.linspace(0.0, np.pi, int(PATH_RATE)))) / 2.0
        topics = "[stage_state, desired_displacement]"
        with executable("recorder", output=folder / "scan", topics=topics):
            time.sleep(SETTLE)
            # Whoever sends the path is not measured; its samples are stamped as they are meant to be sent.
            with suppress(PermissionError):
                schedule("self", os.SCHED_FIFO, DEVICE_PRIORITY)
            at.follow([*approach.tolist(), *y.tolist()], PATH_RATE)
    with suppress(PermissionError):
        schedule("self", os.SCHED_OTHER, 0)
    return high - low


def verified(folder):
    """Return what `slpi verify` tells of the scan."""
    command = [EXECUTABLES / "slpi", "verify", folder / "scan", "--json"]
    command += ["--model", folder / "calibration" / "model.json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return json.loads(done.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", choices=(PLAIN, READ, *DEVICES), action="append", help="only these")
    parser.add_argument("--keep", type=Path, help="folder for the records")
    given = parser.parse_args()
    names = given.device or (PLAIN, READ, *DEVICES)
    if len(names) == 1:
        lived(names[0], given.seed, given.keep)
        return
    for name in names:
        # Of its own process, nothing is left on the graph.
        keep = ["--keep", given.keep] if given.keep else []
        subprocess.run([sys.executable, __file__, "--device", name, "--seed", str(given.seed), *keep], check=False)


def lived(name, seed, keep):
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as work:
        folder = (keep or Path(work)) / name
        folder.mkdir(parents=True, exist_ok=True)
        code, told = calibrated(name, seed, folder)
        print(f"{name}: calibrator, exit code {code}: {told}", flush=True)
        if (folder / "calibration" / "model.json").exists():
            stroke = scanned(name, seed, folder)
            (record,) = verified(folder)["axes"]["x"]["records"]
            path = record["tracking"]
            late = sum(max(path["shares"][cause], 0.0) for cause in ("command", "delay"))
            print(
                f"{name}: scan of {path['samples']} samples: {path['rms_m'] * 1e9:.2f} nm rms from the path "
                f"({path['rms_m'] / stroke:.3%} of {stroke * 1e6:.2f} um), maximum {path['maximum_m'] * 1e9:.0f} nm, "
                f"of it late {path['rms_m'] * late**0.5 * 1e9:.2f} nm, "
                f"else {path['rms_m'] * (1.0 - late) ** 0.5 * 1e9:.2f} nm; "
                f"verify: {record['verdict']}, {record['rms_m'] * 1e9:.2f} nm rms from the model, "
                f"repeatability {record['repeatability_rms_m'] * 1e9:.2f} nm",
                flush=True,
            )
    print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
