"""Controllers of Physik Instrumente (PI) that speak the General Command Set (GCS 2) over TCP or a serial port.

Commands and answers are lines of ASCII. Each line of an answer but the last one ends with a space before the line feed.
What a controller has not got is left out: it lists its commands on ``HLP?``. Syntax: user manual of E-727 (E727T0005,
page 178).
"""

import math
import re
import time
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from functools import partial

from slpi_ros.drivers.base import (
    AnswerError,
    Block,
    Channel,
    Device,
    Found,
    LinkError,
    Reading,
    Recording,
    RefusedError,
    UnsuitableError,
)
from slpi_ros.drivers.gcs_waves import GcsWaves
from slpi_ros.drivers.stream import SHOWN, stream_to
from slpi_ros.errors import shown

PORT = 50_000
NEEDED = ("POS?", "SVA")
# `SVA?` and `VOL?` of one axis may differ by this share of the device's own range, or where it tells none by this, V.
AGREEMENT, AGREEMENT_V = 0.01, 1.0
MEANINGS = {
    1: "syntax of a parameter",
    2: "unknown command",
    5: "servo off or axis not referenced",
    7: "position out of limits",
    10: "stopped by a command",
    15: "no such axis",
    17: "parameter out of range",
    302: "voltage out of limits",
    303: "open-loop motion while the servo is on",
    304: "command too long",
}


class GcsDevice(Device):
    """A PI controller; one that has been opened is moved by ``SVA`` alone."""

    def __init__(self, address: str, channels: Sequence[Channel]) -> None:
        super().__init__("gcs", address, channels)
        self._stream = stream_to("gcs", address, PORT)
        self._axes = [channel.name for channel in channels]
        self._known: frozenset[str] = frozenset()
        self._outputs: list[str] = []  # output channel of each axis; [] if the controller does not tell voltages
        self._poll = b""
        self._waves: GcsWaves | None = None

    def open(self) -> Found:
        """Connect, then only ask."""
        self._stream.open()
        try:
            identity = " ".join(self._ask("*IDN?"))
        except LinkError as error:
            raise LinkError(
                f"{error}; check that it is a controller that speaks GCS, and that no other program is connected to it"
            ) from error
        self._known = frozenset(line.split()[0].upper() for line in self._ask("HLP?") if line.split())
        if lacking := [command for command in NEEDED if command not in self._known]:
            raise UnsuitableError(
                f"{self.name}: {shown(identity, SHOWN)} has no {' and no '.join(lacking)} in its list of commands "
                "(HLP?), so this driver cannot use it"
            )
        if not {"VOL?", "SVA?"} & self._known:
            raise UnsuitableError(
                f"{self.name}: neither VOL? nor SVA? is in its list of commands (HLP?); without the present voltage "
                "the first one would be a jump"
            )
        axes = self._ask("SAI?") if "SAI?" in self._known else self._axes
        if strangers := [axis for axis in self._axes if axis not in axes]:
            raise UnsuitableError(
                f"{self.name}: it has no axis '{strangers[0]}'; give channels out of {', '.join(axes)}"
            )
        self._outputs = self._outputs_of(axes)
        ids = " ".join(self._axes)
        volts = f"VOL? {' '.join(self._outputs)}" if self._outputs else f"SVA? {ids}"
        self._poll = f"POS? {ids}\n{volts}\nERR?\n".encode()
        found = self._found(identity)
        # After `_found`, which reads an error of the past.
        self._waves = GcsWaves(self.name, self._known, self._axes, axes, self._ask, self._try, self._command)
        self.block_period, self.longest_block = self._waves.period, self._waves.longest
        if self.block_period and self._waves.running:
            raise UnsuitableError(
                f"{self.name}: its wave generator is running and moves the voltage itself; wait for its end, or stop "
                "it at the controller"
            )
        return found

    def release_servo(self) -> Found:
        """Switch the servo of all axes off; UnsuitableError if the voltage then is not that of ``SVA?``."""
        before = self.read().voltages
        self._stream.send("".join(f"SVO {axis} 0\n" for axis in self._axes).encode())
        after = self.read().voltages
        found = self._found(" ".join(self._ask("*IDN?")))
        moves = ", ".join(
            f"{axis} from {v:.3f} to {w:.3f} V" for axis, v, w in zip(self._axes, before, after, strict=True)
        )
        note = f"the servo was switched off: {moves}"
        return replace(found, notes=(note, *found.notes))

    def exchange(self, voltages: Sequence[float] | None) -> Reading:
        """Send ``SVA`` and all questions at once, so that there is one wait."""
        command = ""
        if voltages is not None:
            pairs = zip(self.channels, voltages, strict=True)
            command = "SVA " + " ".join(f"{each.name} {each.device_volts(v):.6f}" for each, v in pairs)
        sent_ns = time.monotonic_ns()
        self._stream.send(f"{command}\n".encode() + self._poll if command else self._poll)
        count = len(self._axes)
        lines = self._lines(2 * count + 1, command or "POS?")
        received_ns = time.monotonic_ns()
        self._stream.require_end()
        positions = self._values("POS?", lines[:count], self._axes)
        told = self._values("VOL?" if self._outputs else "SVA?", lines[count:-1], self._outputs or self._axes)
        if code := self._error(lines[-1]):
            raise RefusedError(f"{self.name}: error {_meaning(code)} after '{command or 'questions only'}'")
        return self.reading((sent_ns + received_ns) // 2, told, positions)

    def close(self) -> None:
        """End the connection; the controller keeps its voltages."""
        self._stream.close()

    # Blocks

    def load(self, block: Block) -> Generator[None]:
        """Load a block into the wave tables."""
        yield from self._generators.load(block, self.channels)

    def play(self) -> None:
        """Start the wave generators."""
        self._generators.start()

    def played(self) -> int:
        """Return the number of samples that the wave generators have played."""
        return self._generators.played()

    def halt(self) -> int:
        """Stop the wave generators; the voltage stays."""
        return self._generators.stop()

    def recorded(self) -> Generator[None, None, Recording | None]:
        """Read the data recorder."""
        return (yield from self._generators.recorded(self.channels))

    @property
    def _generators(self) -> GcsWaves:
        if self._waves is None or not self._waves.period:
            raise UnsuitableError(f"{self.name}: it plays no blocks")
        return self._waves

    def _command(self, text: str) -> None:
        """Send a command that has no answer; RefusedError if the controller reports an error."""
        self._stream.send(f"{text}\nERR?\n".encode())
        code = self._error(" ".join(self._lines(0, "ERR?")))
        self._stream.require_end()
        if code:
            raise RefusedError(f"{self.name}: error {_meaning(code)} after '{shown(text, SHOWN)}'")

    # What the controller says of itself

    def _outputs_of(self, axes: Sequence[str]) -> list[str]:
        """Return the output channel of each axis: of the same name, else at the same place among all."""
        if "VOL?" not in self._known:
            return []
        outputs = list(self._table("VOL?"))
        found = []
        for axis in self._axes:
            place = axes.index(axis)
            if axis not in outputs and place >= len(outputs):
                raise UnsuitableError(
                    f"{self.name}: VOL? tells the voltages of {', '.join(outputs)}, none of them of axis '{axis}'"
                )
            found.append(axis if axis in outputs else outputs[place])
        return found

    def _found(self, identity: str) -> Found:
        """Ask for everything but what never changes."""
        notes = []
        # An error of the past is read here, else it would be taken for one of the first command.
        if old := self._error(" ".join(self._ask("ERR?"))):
            notes.append(f"it told the old error {_meaning(old)}")
        servo = self._switches("SVO?", self._axes, default=False)
        online = self._switches("ONL?", self._outputs or self._axes, default=True)
        if not all(online):
            off = self._axes[online.index(False)]
            raise UnsuitableError(
                f"{self.name}: axis '{off}' is not controlled by commands (ONL? tells 0), so an analog input decides "
                "its voltage; switch it over at the controller, knowing that this may move the stage"
            )
        units = self._units()
        notes += self.take_units(units)
        lowest = self._optional("VMI?", self._outputs, -math.inf)
        highest = self._optional("VMA?", self._outputs, math.inf)
        travel: tuple[float, ...] = ()
        if "TMN?" in self._known and "TMX?" in self._known:
            ends = [self._named(command, self._axes) for command in ("TMN?", "TMX?")]
            notes += [
                f"travel of {axis}: {low:g} to {high:g} in units of the device"
                for axis, low, high in zip(self._axes, *ends, strict=True)
            ]
            travel = tuple(abs(each.scale * (high - low)) for each, low, high in zip(self.channels, *ends, strict=True))
        reading = self.read()
        told = [each.device_volts(v) for each, v in zip(self.channels, reading.voltages, strict=True)]
        setpoints = self._named("SVA?", self._axes) if "SVA?" in self._known else told
        if "VOL?" not in self._known:
            notes.append("it has no VOL?: the voltage is what SVA? says, which cannot be checked to be in volts")
        if not any(servo):
            self._require_agreement(setpoints, told, lowest, highest)
        return Found(
            identity,
            reading,
            tuple(each.stage_volts(v) for each, v in zip(self.channels, setpoints, strict=True)),
            *self.range_of(zip(lowest, highest, strict=True)),
            tuple(servo),
            tuple(notes),
            tuple(units),
            travel,
        )

    def _units(self) -> list[str]:
        """Return the unit of the position of each axis, "" where the controller does not tell it."""
        lines = self._try(f"PUN? {' '.join(self._axes)}") if "PUN?" in self._known else []
        if not lines:
            return [""] * len(self._axes)
        pairs = [line.partition("=") for line in lines]
        if [name.strip() for name, _, _ in pairs] != self._axes:
            raise AnswerError(
                f"{self.name}: PUN? was asked for {', '.join(self._axes)} and answered "
                f"'{shown(' '.join(lines), SHOWN)}'"
            )
        return [unit.strip() for _, _, unit in pairs]

    def _require_agreement(
        self, setpoints: Sequence[float], told: Sequence[float], lowest: Sequence[float], highest: Sequence[float]
    ) -> None:
        """Raise UnsuitableError where ``SVA?`` and ``VOL?`` disagree: SVA is not in volts, or of another output."""
        for axis, setpoint, v, low, high in zip(self._axes, setpoints, told, lowest, highest, strict=True):
            tolerated = AGREEMENT * (high - low) if math.isfinite(high - low) else AGREEMENT_V
            if abs(setpoint - v) > tolerated:
                raise UnsuitableError(
                    f"{self.name}: axis '{axis}': SVA? tells {setpoint:g}, VOL? {v:g} V; so SVA is not in volts on "
                    "this controller, or belongs to another output, or something else adds to it: this driver cannot "
                    "use it as it is"
                )

    def _optional(self, command: str, outputs: Sequence[str], absent: float) -> list[float]:
        """Return a number for each output, or `absent` if the controller does not tell them."""
        if command in self._known and outputs:
            return self._named(command, outputs)
        return [absent] * len(self._axes)

    def _switches(self, command: str, names: Sequence[str], *, default: bool) -> list[bool]:
        """Return a switch for each name, or the default if the controller has none."""
        return [value != 0.0 for value in self._named(command, names)] if command in self._known else (
            [default] * len(names)
        )  # fmt: skip

    # Lines

    def _lines(self, count: int, what: str) -> list[str]:
        """Return the next lines; `count` 0: those of one answer, however many it has."""
        data = self._stream.until(partial(_end_of_lines, count) if count else _end_of_answer, what)
        return [line.decode("latin-1").strip() for line in data.split(b"\n")[:-1]]

    def _ask(self, question: str) -> list[str]:
        """Return the lines of the answer to a question."""
        self._stream.send(f"{question}\n".encode())
        lines = self._lines(0, question)
        self._stream.require_end()
        return lines

    def _try(self, question: str) -> list[str]:
        """Return the lines of the answer to a question, none if the controller has no answer but an error."""
        self._stream.send(f"{question}\nERR?\n".encode())
        *lines, error = self._stream.until(_end_with_error, question).decode("latin-1").splitlines()
        self._stream.require_end()
        return [] if self._error(error.strip()) else [line.strip() for line in lines]

    def _named(self, command: str, names: Sequence[str]) -> list[float]:
        """Return the numbers that a question gives for these names."""
        return self._values(command, self._ask(f"{command} {' '.join(names)}"), names)

    def _table(self, command: str) -> Mapping[str, float]:
        """Return all numbers that a question gives, by name."""
        return dict(self._pair(command, line) for line in self._ask(command))

    def _values(self, command: str, lines: Sequence[str], names: Sequence[str]) -> list[float]:
        pairs = [self._pair(command, line) for line in lines]
        if [name for name, _ in pairs] != list(names):
            raise AnswerError(
                f"{self.name}: {command} was asked for {', '.join(names)} and answered for "
                f"{shown(', '.join(name for name, _ in pairs), SHOWN)}"
            )
        return [value for _, value in pairs]

    def _pair(self, command: str, line: str) -> tuple[str, float]:
        name, equals, text = line.partition("=")
        try:
            value = float(text) if equals else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise AnswerError(f"{self.name}: {command} answered '{shown(line, SHOWN)}', not a name and a number")
        return name.strip(), value

    def _error(self, answer: str) -> int:
        """Return the error code of an answer to ``ERR?``; 0: none."""
        if not answer.removeprefix("-").isdecimal():
            raise AnswerError(f"{self.name}: ERR? answered '{shown(answer, SHOWN)}', not a number")
        return int(answer)


DEVICE = GcsDevice


def _meaning(code: int) -> str:
    return f"{code} ({MEANINGS.get(code, 'see its manual')})"


def _end_of_lines(count: int, data: bytes) -> int:
    at = -1
    for _ in range(count):
        at = data.find(b"\n", at + 1)
        if at < 0:
            return 0
    return at + 1


def _end_of_answer(data: bytes) -> int:
    return len(data) if data.endswith(b"\n") and not data.endswith(b" \n") else 0


def _end_with_error(data: bytes) -> int:
    """Return the length of an answer that ends with that to ``ERR?``, a number without a name."""
    return len(data) if re.search(rb"(?:^|\n)-?\d+ *\r?\n$", data) else 0
