"""The session of a calibration: its records, between which nothing else has moved the stage."""

from dataclasses import replace
from math import inf

from slpi_ros.calibration.drives import LONGEST_PAUSE
from slpi_ros.io.messages import SECOND_NS
from slpi_ros.io.record import Record


class Session:
    """Gives each record those before it, as far back as nothing else can have moved the stage.

    Between two runs of the calibrator anybody can, and so between kept records more than `LONGEST_PAUSE` apart.
    """

    def __init__(self) -> None:
        self._records: list[Record] = []
        self._kept = True  # the last record was kept from an earlier run

    def following(self, record: Record, *, kept: bool) -> Record:
        """Return a record, just made or `kept` from an earlier run, with those of its session before it."""
        pause = int(record.time_ns[0] - self._records[-1].time_ns[-1]) if self._records else 0
        longest = LONGEST_PAUSE * SECOND_NS if kept else inf
        if kept is not self._kept or not 0 <= pause <= longest:
            self._records.clear()
        self._kept = kept
        self._records.append(record)
        return replace(record, before=tuple(self._records[:-1]))
