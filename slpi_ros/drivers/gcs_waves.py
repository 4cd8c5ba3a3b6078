"""Wave tables and data recorder of PI controllers: a block is played and recorded by the controller's own clock.

A wave table holds the voltages of one axis; in the open loop the wave generator writes them as ``SVA`` does. Syntax:
user manual of E-727 (E727T0005), commands WAV, WSL, WGC, WTR, WGO, WGI?, RTR, DRC, DRR?, and parameters 0x0E000200
(time of a servo cycle), 0x13000004 (points of the wave tables), 0x16000200 (points of the recorder).
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np

from slpi_ros.arrays import FloatArray
from slpi_ros.drivers.base import AnswerError, Block, Channel, Recording

NEEDED = frozenset(("WAV", "WSL", "WGC", "WTR", "WGO", "WGO?", "WGI?", "SPA?"))
RECORDER = frozenset(("RTR", "DRC", "DRR?"))
CYCLE, WAVE_POINTS, RECORD_POINTS = "0x0E000200", "0x13000004", "0x16000200"
# Points of a wave in one command, and of a recording in one answer.
POINTS, RECORDED = 200, 500
# What the recorder records of an axis: its position, and its voltage in the open loop.
POSITION, VOLTAGE = 2, 7


class GcsWaves:
    """Wave generators of some axes; `ask`, `try_to_ask` (no lines if it has no answer) and `command` are its own."""

    def __init__(
        self,
        name: str,
        known: frozenset[str],
        axes: Sequence[str],
        every: Sequence[str],
        ask: Callable[[str], list[str]],
        try_to_ask: Callable[[str], list[str]],
        command: Callable[[str], None],
    ) -> None:
        self._name = name  # of the device, for messages
        self._axes, self._ask, self._try, self._command = list(axes), ask, try_to_ask, command
        self._generators = [every.index(axis) + 1 for axis in axes]
        self.period, self.longest = 0.0, 0
        self._count, self._played, self._block_period = 0, 0, 0.0
        if known >= NEEDED:
            self.period = self._parameter(CYCLE)
            self.longest = int(self._parameter(WAVE_POINTS)) // len(self._axes)
        if not self.longest:
            self.period = 0.0
        self._most = int(self._parameter(RECORD_POINTS)) if self.period and known >= RECORDER else 0
        self._records = self._most > 0

    @property
    def running(self) -> bool:
        """Whether a wave generator moves an axis."""
        return any(value != 0 for value in self._values("WGO?"))

    def load(self, block: Block, channels: Sequence[Channel]) -> Generator[None]:
        """Load the tables, connect them with the generators, and set up the recorder."""
        columns = [
            [repr(channel.device_volts(v)) for v in column]
            for channel, column in zip(channels, block.voltages.T.tolist(), strict=True)
        ]
        self._count, cycles = len(block.voltages), max(round(block.period / self.period), 1)
        self._block_period = cycles * self.period
        for generator, column in zip(self._generators, columns, strict=True):
            for first in range(0, len(column), POINTS):
                part = column[first : first + POINTS]
                how = "&" if first else "X"
                self._command(f"WAV {generator} {how} PNT 1 {len(part)} {' '.join(part)}")
                yield
        self._command("WSL " + self._pairs(*self._generators))
        self._command("WGC " + self._pairs(*([1] * len(self._generators))))
        yield
        self._command(f"WTR 0 {cycles} 0")
        if self._records:
            self._record_cycles = cycles * -(-self._count // self._most)
            self._command(f"RTR {self._record_cycles}")
            sources = [(axis, what) for axis in self._axes for what in (POSITION, VOLTAGE)]
            self._command("DRC " + " ".join(f"{n} {axis} {what}" for n, (axis, what) in enumerate(sources, 1)))

    def start(self) -> None:
        """Start all generators at the same time."""
        self._command("WGO " + self._pairs(*([1] * len(self._generators))))

    def played(self) -> int:
        """Return the number of samples that were played."""
        self._played = self._count if not self.running else self._index()
        return self._played

    def stop(self) -> int:
        """Stop all generators; return the number of samples that were played."""
        self._command("WGO " + self._pairs(*([0] * len(self._generators))))
        self._played = self._index()
        return self._played

    def _index(self) -> int:
        return int(min(max(min(self._values("WGI?")), 0), self._count))

    def recorded(self, channels: Sequence[Channel]) -> Generator[None, None, Recording | None]:
        """Read the recorder."""
        if not self._records or not self._played:
            return None
        share = self._record_cycles * self.period / self._block_period
        wanted, columns = int((self._played - 1) / share) + 1, 2 * len(self._axes)
        tables = " ".join(str(number) for number in range(1, columns + 1))
        rows: list[Any] = []
        for first in range(0, wanted, RECORDED):
            count = min(RECORDED, wanted - first)
            lines = [line for line in self._ask(f"DRR? {first + 1} {count} {tables}") if not line.startswith("#")]
            try:
                part = np.array([[float(text) for text in line.split()] for line in lines])
            except ValueError as error:
                raise AnswerError(f"{self._name}: DRR? answered something else than numbers: {error}") from error
            if part.shape != (count, columns) or not np.isfinite(part).all():
                raise AnswerError(
                    f"{self._name}: DRR? was asked for {count} rows of {columns} numbers and answered {part.shape}"
                )
            rows.append(part)
            yield
        data: FloatArray = np.concatenate(rows)
        return Recording(
            np.arange(len(data), dtype=float) * (self._record_cycles * self.period),
            _columns([channel.scale * data[:, 2 * n] + channel.offset for n, channel in enumerate(channels)]),
            _columns([channel.gain * data[:, 2 * n + 1] for n, channel in enumerate(channels)]),
        )

    def _pairs(self, *values: int) -> str:
        return " ".join(f"{generator} {value}" for generator, value in zip(self._generators, values, strict=True))

    def _values(self, question: str) -> list[float]:
        lines = self._ask(f"{question} {' '.join(map(str, self._generators))}")
        return [self._number(question, line, str(each)) for line, each in zip(lines, self._generators, strict=False)]

    def _parameter(self, which: str) -> float:
        """Return a parameter of the controller; 0 if it has none that is a number of that name."""
        lines = self._try(f"SPA? {self._axes[0]} {which}")
        name, equals, text = (lines or [""])[0].partition("=")
        found = name.split()
        try:
            # Written with or without leading zeros.
            known = equals and found[:1] == self._axes[:1] and int(found[-1], 16) == int(which, 16)
            return max(float(text), 0.0) if known else 0.0
        except ValueError:
            return 0.0

    def _number(self, question: str, line: str, name: str) -> float:
        found, equals, text = line.partition("=")
        try:
            if equals and found.strip() == name:
                return float(text)
        except ValueError:
            pass
        raise AnswerError(f"{self._name}: {question} answered '{line[:60]}', not a number of {name}")


def _columns(columns: list[FloatArray]) -> FloatArray:
    return np.stack(columns, axis=1)
