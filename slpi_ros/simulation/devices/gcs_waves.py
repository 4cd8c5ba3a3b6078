"""Wave generators and data recorder of the simulated PI controller: what is due by its clock is done when asked."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

CYCLE = 5e-5
WAVE_POINTS, RECORD_POINTS = 262_144, 32_768
# Longest command, bytes.
LONGEST = 8192
# The stage follows the outputs at this period, as it takes longer than a servo cycle to compute; between, its recorded
# position is interpolated.
STAGE_NS = 1_000_000


@dataclass
class _Generator:
    """One wave generator."""

    axis: str
    table: int = 0
    cycles: int = 0


@dataclass
class _Recorder:
    """The data recorder."""

    rate: int = 1  # servo cycles
    sources: dict[int, tuple[str, int]] = field(default_factory=dict)  # axis and option of each table
    rows: dict[int, list[float]] = field(default_factory=dict)
    told: dict[str, float] = field(default_factory=dict)  # positions at the last look


class SimulatedWaves:
    """Wave tables, generators and recorder of a controller; its clock is the steady one of this process."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self.tables: dict[int, list[float]] = {}
        self._generators = {number: _Generator(axis) for number, axis in enumerate(device.axes, 1)}
        self._rate = 1
        self._running: list[_Generator] = []  # all start together
        self._begun_ns, self._next = 0, 0
        self._recorder = _Recorder()
        self.handlers: dict[str, Callable[[list[str]], list[str]]] = {
            "WAV": self._wave,
            "WSL": lambda given: self._each(given, "table"),
            "WGC": lambda given: self._each(given, "cycles"),
            "WTR": self._set_rate,
            "WGO": self._run,
            "WGO?": lambda given: self._tell(given, lambda each: str(int(each in self._running))),
            "WGI?": lambda given: self._tell(given, lambda _: str(self._next)),
            "SPA?": self._parameter,
            "RTR": self._set_recording,
            "DRC": self._configure,
            "DRR?": self._read,
        }

    def moves(self, axis: str) -> bool:
        """Return whether a generator moves an axis."""
        return any(each.axis == axis for each in self._running)

    def advance(self, now_ns: int) -> None:
        """Play and record all samples that are due."""
        period_ns = round(self._rate * CYCLE * 1e9)
        while self._running:
            first, total = self._next, min(len(self.tables[each.table]) for each in self._running)
            most = max(STAGE_NS // period_ns, 1)
            count = min((now_ns - self._begun_ns) // period_ns + 1 - first, total - first, most)
            # So many at once that the stage follows each of its periods.
            if count < most and first + count < total:
                return
            times_ns = [self._begun_ns + (first + n) * period_ns for n in range(count)]
            before = {axis: self._device.voltage(axis) for axis in self._device.axes}
            for each in self._running:
                self._device.note(each.axis, self.tables[each.table][first : first + count], times_ns)
            self._next += count
            self._record(first, count, before, times_ns[-1])
            if self._next == total:
                self._running = []

    def _record(self, first: int, count: int, before: dict[str, float], time_ns: int) -> None:
        """Record samples, of which the last one is at a time (ns)."""
        recorder, told = self._recorder, self._device.measure(time_ns)
        playing = {each.axis: self.tables[each.table][first : first + count] for each in self._running}
        step = recorder.rate // self._rate or 1
        chosen = [n for n in range(count) if not (first + n) % step]
        for table, (axis, what) in recorder.sources.items():
            row = recorder.rows.setdefault(table, [])
            if what == 2:
                begin, end = (at[axis] / self._device.metres for at in ({**told, **recorder.told}, told))
                row += [begin + (end - begin) * (n + 1) / count for n in chosen]
            else:
                row += [playing[axis][n] if axis in playing else before[axis] for n in chosen]
            del row[RECORD_POINTS:]
        recorder.told = told

    def _wave(self, given: list[str]) -> list[str]:
        try:
            table, how, kind, first, count = int(given[0]), given[1], given[2], int(given[3]), int(given[4])
            values = [float(text) for text in given[5:]]
        except (ValueError, IndexError):
            return self._fail(1)
        if kind != "PNT" or first != 1 or how not in ("X", "&") or count != len(values):
            return self._fail(17)
        if sum(map(len, (" ".join(given), "WAV "))) > LONGEST:
            return self._fail(304)
        if not all(self._device.low <= v <= self._device.high for v in values):
            return self._fail(302)
        if any(each.table == table for each in self._running):
            return self._fail(73)
        self.tables[table] = values if how == "X" else self.tables.get(table, []) + values
        return [] if sum(map(len, self.tables.values())) <= WAVE_POINTS else self._fail(17)

    def _each(self, given: list[str], name: str) -> list[str]:
        for number, value in zip(given[::2], given[1::2], strict=True):
            setattr(self._generators[int(number)], name, int(value))
        return []

    def _set_rate(self, given: list[str]) -> list[str]:
        self._rate = int(given[1])
        return []

    def _set_recording(self, given: list[str]) -> list[str]:
        self._recorder.rate = int(given[0])
        return []

    def _configure(self, given: list[str]) -> list[str]:
        triples = zip(given[::3], given[1::3], given[2::3], strict=True)
        self._recorder.sources = {int(table): (axis, int(what)) for table, axis, what in triples}
        return []

    def _run(self, given: list[str]) -> list[str]:
        pairs = [(self._generators.get(int(a)), int(b)) for a, b in zip(given[::2], given[1::2], strict=True)]
        for each, mode in pairs:
            if each is None or (mode and (not self.tables.get(each.table) or self._device.servo[each.axis])):
                return self._fail(17)
        starting = [each for each, mode in pairs if each is not None and mode]
        if starting:
            self._begun_ns, self._next = time.monotonic_ns(), 0
            self._recorder.rows.clear()
            self._recorder.told = {}
        self._running = starting
        return []

    def _tell(self, given: list[str], value: Callable[[_Generator], str]) -> list[str]:
        return [f"{number}={value(self._generators[int(number)])}" for number in given or self._generators]

    def _parameter(self, given: list[str]) -> list[str]:
        known = {"0x0E000200": CYCLE, "0x13000004": WAVE_POINTS, "0x16000200": RECORD_POINTS}
        if len(given) != 2 or given[1] not in known:
            return self._fail(54)
        return [f"{given[0]} {given[1]}={known[given[1]]!r}"]

    def _read(self, given: list[str]) -> list[str]:
        first, count, *tables = map(int, given)
        part = slice(first - 1, first - 1 + count)
        rows = zip(*(self._recorder.rows.get(table, [])[part] for table in tables), strict=True)
        lines = [" ".join(f"{value:.8f}" for value in row) for row in rows]
        head = [
            "# TYPE = 1",
            f"# DIM = {len(tables)}",
            f"# SAMPLE_TIME = {self._recorder.rate * CYCLE!r}",
            "# END_HEADER",
        ]
        return [*head, *lines]

    def _fail(self, code: int) -> list[str]:
        result: list[str] = self._device.fail(code)
        return result
