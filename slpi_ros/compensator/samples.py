"""When the samples of an axis come: by their stamps, and between them by the steady clock."""

from itertools import pairwise

from slpi_ros.compensator.validation import DUPLICATE, TIME_BACKWARDS, RejectedError
from slpi_ros.io.messages import SECOND_NS

# A hold begins after this many intervals between samples, and after times between these.
HOLD_INTERVALS, SOONEST_HOLD_NS, LATEST_HOLD_NS = 3, SECOND_NS // 50, 3 * SECOND_NS


class Samples:
    """Time of an axis from step to step. The effects of the model take theirs from the stamps of the samples.

    A stamp that is older than the last one by at most `jump_ns` is late. If it is older by more than this, the clock
    was set back, and the elapsed time restarts. What is output between two samples moves the effects on by the steady
    clock; the next sample counts only what its stamp is ahead of that.
    """

    __slots__ = ("_arrivals", "_between", "_last_ns", "_point_ns", "_restarted", "given_ns", "jump_ns")

    def __init__(self) -> None:
        self.jump_ns = SECOND_NS
        self._last_ns: int | None = None  # the last stamp
        self._restarted = False  # whether the axis has moved without samples since the last stamp
        self.given_ns = 0  # steady clock, of the last step
        self._arrivals: tuple[int, ...] = ()
        self._between = 0.0  # s, of steps since the last sample
        self._point_ns: int | None = None  # deadline of the last trajectory point on its clock

    def check(self, stamp_ns: int) -> None:
        """Reject a stamp (ns) that is not newer than the last one, unless the clock was set back."""
        last = self._last_ns
        if last is None or stamp_ns > last or stamp_ns < last - self.jump_ns:
            return
        if stamp_ns == last:
            raise RejectedError(DUPLICATE, "the stamp equals the last accepted one; stamp each sample anew")
        back = f"{(last - stamp_ns) * 1e-9:.9g} s"
        raise RejectedError(TIME_BACKWARDS, f"time runs {back} backwards; send samples in order")

    def accept(self, stamp_ns: int) -> float | None:
        """Store a stamp (ns) accepted by `check`; return the time (s) since the last stamp."""
        # It is 0 for the first stamp, negative if the clock was set back, None for the first one after `restart`.
        last, self._last_ns = self._last_ns, stamp_ns
        if self._restarted:
            self._restarted = False
            return None
        return (stamp_ns - last) * 1e-9 if last is not None else 0.0

    def arrive(self, now_ns: int) -> float | None:
        """Accept a sample without stamp that arrived at `now_ns` (ns); return the time (s) since the last stamp."""
        last = self._last_ns
        if last is not None and last - self.jump_ns <= now_ns < last:
            now_ns = last
        return self.accept(now_ns)

    def sample(self, ahead: float | None, now_ns: int, period: float) -> float:
        """Return the time (s) since the last step for a sample that is `ahead` (s) of the last one by its stamp.

        None: by the steady clock. A sample that is not later counts as one output `period` (s) later.
        """
        if ahead is None:
            dt = max((now_ns - self.given_ns) * 1e-9, 0.0)
        else:
            dt = ahead - self._between
            if dt <= 0.0:
                dt = period if self._arrivals else 0.0
        self._between, self.given_ns = 0.0, now_ns
        self._arrivals = (*self._arrivals[-3:], now_ns)
        return dt

    def step(self, now_ns: int) -> float:
        """Return the time (s) since the last step for one without a sample."""
        dt = max((now_ns - self.given_ns) * 1e-9, 0.0)
        self.given_ns = now_ns
        self._between += dt
        return dt

    def point(self, deadline_ns: int) -> float | None:
        """Return by how much (s) a trajectory point is ahead of the one before; None if there was none."""
        before, self._point_ns = self._point_ns, deadline_ns
        return None if before is None else (deadline_ns - before) * 1e-9

    def restart(self) -> None:
        """Count the next sample by the steady clock, as the axis moves without samples; older stamps stay late."""
        self._restarted, self._point_ns = self._last_ns is not None, None

    @property
    def hold_ns(self) -> int:
        """Time on the steady clock from which the displacement is held: no sample has come for some intervals."""
        steps = sorted(later - earlier for earlier, later in pairwise(self._arrivals))
        usual_ns = steps[len(steps) // 2] if steps else 0
        return self._arrivals[-1] + min(max(HOLD_INTERVALS * usual_ns, SOONEST_HOLD_NS), LATEST_HOLD_NS)
