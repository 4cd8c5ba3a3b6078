"""Oscillations that feedback itself sustains: they end while the correction is held; hum and vibration go on."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slpi_ros.arrays import FloatArray
from slpi_ros.compensator.loop_margin import LEAST_MARGIN
from slpi_ros.compensator.monitor import Finding, Rule
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.axis_model import RESOLUTION

IntArray = NDArray[np.int64]

# What counts as an oscillation, in noises; by when it has to be found, in seconds and in periods.
NOISES, SECONDS, PERIODS = 4.0, 2.0, 4.0
# Of that time, the share in which an oscillation has to show, and the one in which the correction is held then.
SHOWN, HELD = 0.25, 0.35
# Fewest periods that show an oscillation, and fewest readings; longest time looked at, s.
SHOWING, FEWEST, LONGEST = 2, 8, 16.0
# Readings for long times are means over this time, ns.
MEAN_NS = SECOND_NS // 32
# The signal of one oscillation is within this ratio of its frequency, and within this many lines of the spectrum.
NEAR, LINES = 2.0**0.25, 2


class Signals:
    """Errors of the readings, setpoints, and what the correction is expected to move, of some last time (ns); m."""

    def __init__(self, kept: float) -> None:  # s
        self._kept_ns = int(kept * SECOND_NS)
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._times, self._values = array("q"), (array("d"), array("d"), array("d"))

    def append(self, now_ns: int, *values: float) -> None:
        """Take an error, a setpoint and a motion (m)."""
        self._times.append(now_ns)
        for each, value in zip(self._values, values, strict=True):
            each.append(value)

    def last(self, seconds: float, now_ns: int) -> tuple[FloatArray, ...]:
        """Return times (s, from now), errors, setpoints and motions (m) of the last `seconds`, shape (N,) each."""
        times = np.array(self._times)
        old = int(np.searchsorted(times, now_ns - self._kept_ns))
        if old > times.size // 2:
            for each in (self._times, *self._values):
                del each[:old]
            times = times[old:]
        k = int(np.searchsorted(times, now_ns - int(seconds * SECOND_NS)))
        return (times[k:] - now_ns) * 1e-9, *(np.array(each)[k:] for each in self._values)


@lru_cache(maxsize=32)
def _window(n: int) -> FloatArray:
    """Return the window of n values."""
    return np.hanning(n + 1)[:n]


@dataclass(frozen=True)
class Spectrum:
    """Amplitudes of what oscillates near each frequency: of sines there, their root sum square (m)."""

    frequencies: FloatArray  # Hz, (K,)
    lines: FloatArray  # m, (K,), of each line
    near: FloatArray  # m, (K,), of the lines near it
    bands: tuple[IntArray, IntArray]  # first and last of these, (K,) each

    @classmethod
    def of(cls, t: FloatArray, error: FloatArray) -> "Spectrum":
        """Return the spectrum of errors (m) at times (s), shape (N,) each."""
        n = t.size
        even = np.interp(np.linspace(t[0], t[-1], n), t, error)
        window = _window(n)
        power = np.abs(np.fft.rfft((even - even.mean()) * window)) ** 2 * (4.0 / (n * float(window @ window)))
        if n % 2 == 0:
            power[-1] /= 2.0
        k = np.arange(power.size)
        low = np.minimum(np.ceil(k / NEAR), k - LINES).clip(1).astype(int)
        high = np.maximum(np.floor(k * NEAR), k + LINES).clip(max=power.size - 1).astype(int)
        total = np.append(0.0, np.cumsum(power))
        step = (n - 1) / n / (t[-1] - t[0])
        return cls(k * step, np.sqrt(power), np.sqrt(np.maximum(total[high + 1] - total[low], 0.0)), (low, high))

    def amplitude(self, of: "Oscillation") -> float:
        """Return the amplitude (m) of what counts as an oscillation: what is near it, or all from the lowest one on."""
        if not of.erratic:
            return float(np.interp(of.frequency, self.frequencies, self.near))
        k = int(np.searchsorted(self.frequencies, of.erratic, "right")) - 1
        return float(np.linalg.norm(self.lines[k:]))

    def erratic(self) -> "Oscillation":
        """Return all that oscillates as one, with its mean frequency."""
        power = self.lines[SHOWING:] ** 2
        mean = float(np.average(self.frequencies[SHOWING:], weights=power)) if power.any() else 0.0
        return Oscillation(mean, float(power.sum() ** 0.5), float(self.frequencies[SHOWING]))

    def frequency(self, k: int) -> float:
        """Return the frequency (Hz) of what shows in line k and those beside it."""
        beside = slice(max(k - 1, 0), k + 2)
        return float(np.average(self.frequencies[beside], weights=self.lines[beside] ** 2))

    def peaks(self) -> Iterator[int]:
        """Yield the strongest line, the strongest one that is not near it, and so on, but what may come from others."""
        lines = self.lines.copy()
        lines[0] = 0.0
        while lines.any():
            k = int(np.argmax(lines))
            yield k
            # Beside a line, and over a trend, the window leaves less than this.
            lines[lines * (np.arange(lines.size) - k) ** 2 <= self.lines[k]] = 0.0
            lines[self.bands[0][k] : self.bands[1][k] + 1] = 0.0


@dataclass(frozen=True)
class Oscillation:
    """An oscillation that shows: frequency (Hz) and amplitude (m); lowest frequency (Hz) of one without a period."""

    frequency: float
    amplitude: float
    erratic: float = 0.0

    @property
    def slowest(self) -> float:
        """Longest period (s)."""
        return 1.0 / (self.erratic or self.frequency)

    @property
    def time(self) -> float:
        """Time (s) in which it has to be found."""
        return max(SECONDS, PERIODS * self.slowest)


class OscillationRule(Rule):
    """Feedback sustains no oscillation; m, steady clock in ns.

    With the return ratio L, a vibration d shows as ``d / (1 + L)``, and as d while the correction is held: as
    `LEAST_MARGIN` of it or more in a loop that may be used. What feedback sustains dies away instead. So, where an
    oscillation of more than `NOISES` times the noise shows and does not fall by itself, the rule wants the correction
    to be `held`. If less than that share is left then, feedback has sustained it. Else what is there without feedback
    is kept as long as anything shows, and what is at most ``1 / LEAST_MARGIN`` times as large is let alone. Setpoints
    that move by more than that share of it within a period tell nothing. `noise` is that of the sensor, `span` the
    displacement range.

    On a busy computer the delay of the loop varies, and an oscillation has no period: all that moves counts as one
    then, if the correction moves nearly as much. (``|1 + L|`` below `LEAST_MARGIN` means ``|L|`` above
    ``1 - LEAST_MARGIN``, the ratio of what the correction moves to the error.)
    """

    def __init__(self, span: float, noise: float = 0.0, axis: str = "") -> None:
        self.span, self.noise, self.axis = span, noise, axis
        self.held = False  # whether the correction has to be held, to listen
        self.noticed = False  # whether most of the error oscillates, and is still to be judged
        self._on = False
        self._fast, self._slow = Signals(SECONDS), Signals(LONGEST)
        self.begin(0)

    def begin(self, now_ns: int) -> None:
        """Start to watch at `now_ns`; what was read before does not count."""
        self._fast.forget()
        self._slow.forget()
        self._begun_ns = self._mean_ns = now_ns
        self._sum, self._count = 0.0, 0
        self._shown: Oscillation | None = None  # for which the correction is held
        self._alone: Spectrum | None = None  # without feedback
        self._found: Finding | None = None
        self.held = self.noticed = False

    def watch(self, on: bool, now_ns: int) -> None:
        """Watch while feedback corrects, begin anew with it."""
        if on and not self._on:
            self.begin(now_ns)
        self._on, self.held, self.noticed = on, on and self.held, on and self.noticed

    def take(self, error: float, setpoint: float, moved: float, now_ns: int) -> None:
        """Take error, setpoint and what the correction `moved` by the model, of a reading; m."""
        if not self._on:
            return
        self._fast.append(now_ns, error, setpoint, moved)
        self._sum += error
        self._count += 1
        if now_ns - self._mean_ns >= MEAN_NS:
            self._slow.append(now_ns, self._sum / self._count, setpoint, moved)
            self._sum, self._count, self._mean_ns = 0.0, 0, now_ns

    def check(self, now_ns: int) -> Finding | None:
        """Return the oscillation that feedback sustains, if one has been found."""
        if not self._on or self._found:
            return self._found
        if self._shown is None:
            self._shown = self._look(now_ns)
            self.held = self._shown is not None
            if self.held:
                self._begun_ns = now_ns
        else:
            self._listen(self._shown, now_ns)
        return self._found

    @property
    def _least(self) -> float:
        """Smallest amplitude (m) that counts."""
        return NOISES * (self.noise or RESOLUTION * self.span)

    def _look(self, now_ns: int) -> Oscillation | None:
        """Return an oscillation that shows, is not there without feedback, and does not fall by itself."""
        elapsed, seconds = (now_ns - self._begun_ns) * 1e-9, SECONDS * SHOWN
        # A short time first; a longer one only where something moves in the longest.
        signals, fast, loud, self.noticed = self._fast.last(seconds, now_ns), True, False, False
        while fast or seconds <= min(LONGEST, elapsed):
            t, error, setpoint, moved = (each[signals[0] >= -seconds] for each in signals)
            # A sine of that amplitude has at least this spread.
            if t.size >= FEWEST and float(error.std()) * 2.0**0.5 > self._least:
                loud = True
                spectrum = Spectrum.of(t, error)
                found = self._strongest(spectrum, fast)
                if found and self._is_slow(t, setpoint, found):
                    self.noticed = self.noticed or found.amplitude > float(error.std())
                    if elapsed >= seconds and self._lasts(t, error, found):
                        return found
                if (
                    fast
                    and elapsed >= seconds
                    and self._stands_out(every := spectrum.erratic())
                    and self._is_slow(t, setpoint, every)
                    and self._lasts(t, error, every)
                    and Spectrum.of(t, moved).amplitude(every) >= (1.0 - LEAST_MARGIN) * every.amplitude
                ):
                    return every
            if fast:
                signals, fast = self._slow.last(LONGEST, now_ns), False
                if not signals[1].size or float(np.ptp(signals[1])) <= self._least:
                    break
            seconds *= 2.0**0.5
        if not loud and elapsed >= SECONDS * SHOWN:
            self._alone = None
        return None

    def _strongest(self, spectrum: Spectrum, fast: bool) -> Oscillation | None:
        """Return the strongest oscillation that is not there without feedback; a long time shows only slow ones."""
        for k in spectrum.peaks():
            found = Oscillation(spectrum.frequency(k), float(spectrum.near[k]))
            if found.amplitude <= self._least:
                break
            if not self._stands_out(found):
                continue
            if k == SHOWING or (fast and k > SHOWING):
                return found
            if not fast:
                break
        return None

    def _stands_out(self, found: Oscillation) -> bool:
        """Return whether an oscillation counts, and is not there without feedback."""
        alone = self._alone.amplitude(found) if self._alone else 0.0
        return found.amplitude > max(self._least, alone / LEAST_MARGIN)

    def _is_slow(self, t: FloatArray, setpoint: FloatArray, of: Oscillation) -> bool:
        """Return whether setpoints (m, (N,)) move so little within a period that they cannot explain the judgement."""
        later = np.searchsorted(t, t + of.slowest).clip(max=t.size - 1)
        return bool(np.max(np.abs(setpoint[later] - setpoint), initial=0.0) < LEAST_MARGIN * of.amplitude)

    def _lasts(self, t: FloatArray, error: FloatArray, of: Oscillation) -> bool:
        """Return whether it has begun long enough ago, and is not gone by itself after the time for it, as it falls."""
        half = t.size // 2
        first, second = (Spectrum.of(t[part], error[part]).amplitude(of) for part in (slice(half), slice(half, None)))
        share = LEAST_MARGIN * of.amplitude
        ahead = of.time / max(float(t[-1] - t[half]), 1e-9)
        return first > share and second * min(second / first, 1.0) ** ahead > max(self._least, share)

    def _listen(self, shown: Oscillation, now_ns: int) -> None:
        """Judge what is left of an oscillation while the correction is held."""
        since = (now_ns - self._begun_ns) * 1e-9
        if since < HELD * shown.time:
            return
        fast = shown.time <= SECONDS
        t, error, setpoint, _ = self._fast.last(min(since, SECONDS), now_ns) if fast else self._slow.last(since, now_ns)
        if t.size < FEWEST or not self._is_slow(t, setpoint, shown):
            self._end(now_ns, self._alone)
            return
        # What rings down is before the last half, or the last period.
        last = t >= -max(0.5 * since, shown.slowest)
        alone = Spectrum.of(t[last], error[last])
        if alone.amplitude(shown) < LEAST_MARGIN * shown.amplitude:
            about = "about " if shown.erratic else ""
            reason = (
                f"it oscillated at {about}{shown.frequency:.3g} Hz by {shown.amplitude * 1e9:.3g} nm, and no more "
                "while the correction was held"
            )
            self._found = Finding("oscillation", "oscillating", reason, self.axis)
        elif self._lasts(t, error, shown):
            self._end(now_ns, alone)

    def _end(self, now_ns: int, alone: Spectrum | None) -> None:
        """Let feedback go on."""
        self.begin(now_ns)
        self._alone = alone
