"""The exported inverse on simulated Cortex-M4F and M7: all vectors, code size, memory, instructions of a step.

Run by `make test-export-arm`; needs arm-none-eabi-gcc with newlib, and qemu-system-arm.
"""

import subprocess
import sys
import tempfile
from math import inf
from pathlib import Path

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


def tried(folder, label, board, machine, number):
    name, (qemu, cpu) = board, BOARDS[board]
    flags = ("-mthumb", "-mfloat-abi=hard", *cpu, "-O2", "-ffunction-sections", "-fdata-sections", *number)
    model = STAGES[label]()
    own = ("arm-none-eabi-gcc", *flags)
    said(folder, *own, *WARNINGS, "-c", "slpi_inverse.c")
    text, data, bss = said(folder, "arm-none-eabi-size", "slpi_inverse.o").splitlines()[1].split()[:3]
    link = ("-T", str(HERE / "mps2.ld"), "-nostartfiles", "--specs=rdimon.specs", "-Wl,--gc-sections", "-lm")
    run = (
        "qemu-system-arm",
        "-M",
        qemu,
        "-nographic",
        "-semihosting-config",
        "enable=on,target=native",
        "-icount",
        "shift=0",
    )
    spans = [axis.displacement_range for axis in model.axes.values()]
    given = [f"-D{key}={{{', '.join(repr(span[k]) for span in spans)}}}" for k, key in enumerate(("LOW", "HIGH"))]
    answers = []
    for program in ("slpi_test.c", str(HERE / "count.c")):
        said(
            folder, *own, *given, "-I.", "slpi_inverse.o", program, str(HERE / "startup.c"), *link, "-o", "program.elf"
        )
        answers.append(said(folder, *run, "-kernel", "program.elf").strip())
    kind = "float " if number else "double"
    sizes = f"code and tables {int(text):6} B, data {int(data) + int(bss)} B"
    print(f"{name:10} {kind} {label:16} {sizes}; {answers[0]}; {answers[1]}")


def main():
    for label, make in STAGES.items():
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            stage = ExportedStage.of(make(), Limits(-inf, inf))
            write(folder, stage)
            for name, text in program_files(stage, 600).items():
                (folder / name).write_text(text)
            for board, (machine, _) in BOARDS.items():
                for number in ((), ("-DSLPI_FLOAT",)):
                    tried(folder, label, board, machine, number)


if __name__ == "__main__":
    main()
