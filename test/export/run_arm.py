"""The exported inverse on simulated Cortex-M4F and M7: all vectors, code size, memory, instructions of a step.

Run by `make test-export-arm`; needs arm-none-eabi-gcc with newlib, and qemu-system-arm. With `--steps 1000000` a path
of that length instead, beside this computer; two minutes.
"""

import argparse
import subprocess
import sys
import tempfile
from math import inf
from pathlib import Path

import numpy as np
from export.built import WARNINGS, write
from export.stages import EVERY, one_axis, two_axes

from slpi_ros.export.stage import ExportedStage
from slpi_ros.export.vectors import program_files
from slpi_ros.model.limits import Limits

HERE = Path(__file__).with_name("arm")
BOARDS = {
    "Cortex-M4F": ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16")),
    "Cortex-M7": ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16")),
}
NUMBERS = ((), ("-DSLPI_FLOAT",))
STAGES = {
    "no effects": lambda: one_axis("slpi"),
    "pi": lambda: one_axis("pi"),
    "mpi": lambda: one_axis("mpi"),
    "all effects": lambda: one_axis("slpi", EVERY),
    "two coupled axes": two_axes,
}


def said(folder, *command):
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def ranges(model):
    """Return the displacements of the axes as definitions for a program."""
    spans = [axis.displacement_range for axis in model.axes.values()]
    return [f"-D{key}={{{', '.join(repr(span[k]) for span in spans)}}}" for k, key in enumerate(("LOW", "HIGH"))]


def compiler(board, number):
    flags = ("-mthumb", "-mfloat-abi=hard", *BOARDS[board][1], "-O2", "-ffunction-sections", "-fdata-sections", *number)
    return ("arm-none-eabi-gcc", *flags)


def on_board(folder, board, own, *parts):
    """Return what a program says on a board."""
    link = ("-T", str(HERE / "mps2.ld"), "-nostartfiles", "--specs=rdimon.specs", "-Wl,--gc-sections", "-lm")
    run = ("-nographic", "-semihosting-config", "enable=on,target=native", "-icount", "shift=0")
    said(folder, *own, "-I.", *parts, str(HERE / "startup.c"), *link, "-o", "program.elf")
    return said(folder, "qemu-system-arm", "-M", BOARDS[board][0], *run, "-kernel", "program.elf")


def tried(folder, label, board, number):
    own, model = compiler(board, number), STAGES[label]()
    said(folder, *own, *WARNINGS, "-c", "slpi_inverse.c")
    text, data, bss = said(folder, "arm-none-eabi-size", "slpi_inverse.o").splitlines()[1].split()[:3]
    answers = [
        on_board(folder, board, own, *ranges(model), "slpi_inverse.o", program).strip()
        for program in ("slpi_test.c", str(HERE / "count.c"))
    ]
    kind = "float " if number else "double"
    sizes = f"code and tables {int(text):6} B, data {int(data) + int(bss)} B"
    print(f"{board:10} {kind} {label:16} {sizes}; {answers[0]}; {answers[1]}")


def followed(folder, label, steps, span):
    """Print by how much the voltages on a long path differ from those of this computer."""
    parts = [*ranges(STAGES[label]()), f"-DSTEPS={steps}", "slpi_inverse.c", str(HERE / "long.c")]

    def numbers(text):
        return np.array(list(map(float, text.split()))) / span

    host = {}
    for number in NUMBERS:
        said(folder, "gcc", "-std=c11", "-O2", *number, "-I.", *parts, "-o", "host", "-lm")
        host[number] = numbers(said(folder, "./host"))
        for board in BOARDS:
            if (board, number) == ("Cortex-M4F", ()) and label == "all effects":
                # Without a unit for double that is ten times as long as all others.
                continue
            found = numbers(on_board(folder, board, compiler(board, number), *parts))
            kind = "float " if number else "double"
            same, exact = (np.abs(found - host[each]).max() for each in (number, ()))
            print(f"{board:10} {kind} {label:16} {steps} steps: {same:.1e} of the range beside the same, {exact:.1e} "
                  "beside double", flush=True)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, help="a path of this length instead")
    options = parser.parse_args()
    for label, make in STAGES.items():
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            stage = ExportedStage.of(make(), Limits(-inf, inf))
            write(folder, stage)
            for name, text in program_files(stage, 600).items():
                (folder / name).write_text(text)
            if options.steps:
                if label in ("no effects", "all effects"):
                    followed(folder, label, options.steps, stage.axes[0].allowed.upper - stage.axes[0].allowed.lower)
                continue
            for board in BOARDS:
                for number in NUMBERS:
                    tried(folder, label, board, number)


if __name__ == "__main__":
    main()
