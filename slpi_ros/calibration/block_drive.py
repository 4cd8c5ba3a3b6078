"""A drive that a driver plays as one block: followed by what is told of it, stopped, and brought back to rest."""

from collections import deque
from collections.abc import Callable, Sequence
from statistics import median

from slpi_ros.arrays import FloatArray
from slpi_ros.calibration.drive_monitor import MOST_STEP_NS
from slpi_ros.compensator.amplifier import MOST_REPORTS, REPORTS, TOLERATED_SHARE
from slpi_ros.compensator.block import PATIENCE_NS
from slpi_ros.compensator.monitor import Silence
from slpi_ros.devices.block import BlockPhase, BlockState
from slpi_ros.excitation.drives import Playback
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.model.limits import Limits, volts

# Time to wait at the end for stage_state to report the last voltage, and what such a report must then last
# for a slow stage to have come all the way, seconds.
REPORT_PATIENCE, REPORT_LASTS = 3.0, 0.5


class SentBlock:
    """One block that was sent: voltages (V), shape (N, axes), for `seconds` (s), and how far the driver says it is.

    A driver that is `expected` to tell that answers within `PATIENCE_NS` and goes on telling; else the time decides.
    """

    def __init__(
        self, what: str, stamp_ns: int, voltages: FloatArray, seconds: float, now_ns: int, *, expected: bool
    ) -> None:
        self.voltages, self.expected = voltages, expected
        self.state: BlockState | None = None
        self._what, self._stamp_ns, self._end_ns = what, stamp_ns, now_ns + round(seconds * SECOND_NS)
        self._silence = Silence(now_ns, self._unheard)

    def hear(self, state: BlockState, now_ns: int) -> None:
        """Take what a driver tells of a block, which may be another one."""
        if state.stamp_ns == self._stamp_ns:
            self.state, self.expected = state, True
            self._silence.hear(now_ns)

    @property
    def phase(self) -> BlockPhase | None:
        """How far it is, None if nothing is told."""
        return self.state.phase if self.state else None

    def ended(self, now_ns: int) -> bool:
        """Return whether it was played to its end."""
        return self.phase is BlockPhase.ENDED if self.expected else now_ns >= self._end_ns

    def fault(self, now_ns: int) -> str:
        """Return why it is not played to its end, "" if it is as far as is known."""
        state = self.state
        if state is not None and state.phase is BlockPhase.REFUSED:
            return f"the driver refuses {self._what}: {state.reason}"
        if state is not None and state.phase is BlockPhase.STOPPED:
            return f"the driver stopped {self._what} at sample {state.sample} of {len(self.voltages)}: {state.reason}"
        over = not self.expected or self.ended(now_ns)
        return "" if over else self._silence.beyond(PATIENCE_NS / SECOND_NS, now_ns)

    def _unheard(self, _: float) -> str:
        if self.state is None:
            return f"no driver answers on voltage_trajectory_state whether it plays {self._what}"
        return (
            f"the driver no longer tells how far {self._what} is (last sample {self.state.sample} of "
            f"{len(self.voltages)})"
        )


class ReportedVoltages:
    """Voltages (V) that the stage reports, and whether they rest."""

    def __init__(self, limits: Sequence[Limits]) -> None:
        self.latest: Sequence[float] | None = None
        self._tolerated = [TOLERATED_SHARE * each.span for each in limits]
        self._recent: deque[Sequence[float]] = deque(maxlen=MOST_REPORTS)
        self._level: Sequence[float] = ()  # near which they are since a time
        self._since_ns = self._last_ns = 0

    def forget(self) -> None:
        """Let only those count for `resting` that come from now on."""
        self._recent.clear()

    def take(self, voltages: Sequence[float], now_ns: int) -> None:
        """Take reported voltages (V)."""
        if not (self._recent and self._near(voltages, self._level)):
            self._recent.clear()
            self._level, self._since_ns = voltages, now_ns
        self._recent.append(voltages)
        self.latest, self._last_ns = voltages, now_ns

    @property
    def resting(self) -> list[float] | None:
        """Voltages (V) that the last reports agree on for `REPORT_LASTS`, None if there are none."""
        lasted = self._last_ns - self._since_ns >= REPORT_LASTS * SECOND_NS
        if len(self._recent) < REPORTS or not lasted:
            return None
        return [median(column) for column in zip(*self._recent, strict=True)]

    @property
    def unrest(self) -> str:
        """What they are where they do not rest."""
        if not self._recent:
            return "stage_state no longer comes" if self.latest is not None else "nobody reports the voltage"
        return f"stage_state reports {volts(*self._recent[-1])} V, which does not rest"

    def rest_at(self, voltages: Sequence[float]) -> bool:
        """Return whether they rest at these voltages (V)."""
        return (there := self.resting) is not None and self._near(there, voltages)

    def _near(self, voltages: Sequence[float], others: Sequence[float]) -> bool:
        return all(abs(v - w) <= most for v, w, most in zip(voltages, others, self._tolerated, strict=True))


class BlockDrive:
    """A drive as one block for a driver, begun at `now_ns` (steady clock), from rest and back to it.

    `send` publishes voltages (V), shape (N, axes), as a block, none to stop the one that is played, and returns its
    stamp (ns). The driver is `expected` to tell how far the block is; else the time decides. `look` is called again and
    again, until the drive is `over`; then `failure` says what went wrong, "" if nothing did. Of the time between two
    calls only so much counts as a process that was held up may have missed.
    """

    def __init__(
        self,
        playback: Playback,
        limits: Sequence[Limits],
        send: Callable[[FloatArray], int],
        now_ns: int,
        *,
        expected: bool,
    ) -> None:
        self.over = self.stopped = False
        self.failure = ""
        self.reports = ReportedVoltages(limits)
        self._playback, self._send = playback, send
        self._rest = [float(v[0]) for v in playback.drive.voltage.values()]
        self._now_ns, self._last_ns, self._since_ns = 0, now_ns, 0
        self._sent = self._sent_now("the drive", expected=expected)
        self._turn = self._follow

    @property
    def told(self) -> bool:
        """Whether a driver has told anything of the block."""
        return self._sent.state is not None

    def hear(self, state: BlockState) -> None:
        """Take what a driver tells of a block."""
        before = self._sent.phase
        self._sent.hear(state, self._now_ns)
        if self._sent.phase is not before and self._sent.phase is BlockPhase.STOPPED:
            # Where it holds is what is reported from now on.
            self._begin_waiting()

    def report(self, voltages: Sequence[float]) -> None:
        """Take voltages (V) that the stage reports."""
        self.reports.take(voltages, self._now_ns)

    def stop(self) -> None:
        """Stop the block where it is, and return to rest from there."""
        if self.over or self.stopped:
            return
        self.stopped = True
        self._send(self._sent.voltages[:0])
        self._begin_waiting()
        self._turn = self._return_when_held

    def look(self, now_ns: int) -> None:
        """Go on with what has come until `now_ns`."""
        self._now_ns += min(max(now_ns - self._last_ns, 0), MOST_STEP_NS)
        self._last_ns = now_ns
        if not self.over:
            self._turn()

    def _sent_now(self, what: str, *, expected: bool) -> SentBlock:
        """Send what is left of the playback."""
        voltages, seconds = self._playback.samples_left, self._playback.seconds_left
        return SentBlock(what, self._send(voltages), voltages, seconds, self._now_ns, expected=expected)

    def _begin_waiting(self) -> None:
        self._since_ns = self._now_ns
        self.reports.forget()

    def _waited(self, seconds: float) -> bool:
        return self._now_ns - self._since_ns >= seconds * SECOND_NS

    def _finish(self, failure: str = "") -> None:
        self.failure, self.over = "; ".join(filter(None, [self.failure, failure])), True

    def _follow(self) -> None:
        """Let the driver play the drive."""
        sent, fault = self._sent, self._sent.fault(self._now_ns)
        if sent.phase in (BlockPhase.REFUSED, BlockPhase.STOPPED):
            # Whoever has stopped it wants the stage to stay where it is.
            self._finish(fault)
        elif fault:
            self.failure = fault
            self.stop()
        elif sent.ended(self._now_ns):
            self._finish()

    def _return_when_held(self) -> None:
        """Return to rest, once it is known that the block has stopped, and where."""
        sent = self._sent
        if sent.phase in (BlockPhase.REFUSED, BlockPhase.ENDED):
            self._finish(sent.fault(self._now_ns))
        elif sent.expected and sent.phase is not BlockPhase.STOPPED:
            if self._waited(PATIENCE_NS / SECOND_NS):
                self._finish("the stop is not confirmed: the driver does not tell that the drive has stopped")
        elif (there := self._there()) is not None:
            self._playback.stop(there)
            self._sent = self._sent_now("the way back to rest", expected=sent.expected)
            self._turn = self._follow_back
        elif self._waited(REPORT_PATIENCE):
            self._finish(f"the stop is not confirmed: {self.reports.unrest}")

    def _there(self) -> Sequence[float] | None:
        """Return the voltages (V) at which the driver holds, None if they are not known."""
        state = self._sent.state
        if self.reports.latest is not None or state is None:
            return self.reports.resting
        # Nobody reports the voltage.
        there: list[float] = self._sent.voltages[max(min(state.sample, len(self._sent.voltages)) - 1, 0)].tolist()
        return there

    def _follow_back(self) -> None:
        """Let the driver play the way back."""
        if fault := self._sent.fault(self._now_ns):
            self._finish(fault)
        elif not self._sent.ended(self._now_ns):
            self._since_ns = self._now_ns
        elif self.reports.latest is None or self.reports.rest_at(self._rest):
            self._finish()
        elif self._waited(REPORT_PATIENCE):
            self._finish(f"the return is not confirmed: stage_state reports {volts(*self.reports.latest)} V last")
