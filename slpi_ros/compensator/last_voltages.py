"""The voltages given last, in a file that outlives a crash of the process."""

import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path

from slpi_ros.errors import ModelError

# What a record begins with: a mark of what it belongs to, and its number.
HEAD = struct.Struct("<IQ")
VOLTAGE_BYTES, CHECKSUM_BYTES = 8, 4


class LastVoltages:
    """Notes every command in two microseconds.

    Two records are written in turn, each with a checksum: whenever the process dies, one of them is whole. The system
    keeps what has been written, so nothing waits for the disk; only when the machine itself fails may it be lost.

    Parameters
    ----------
    path : path-like
        A file of that name is emptied.
    mark : int
        Of what the records belong to, 32 bits; it may be changed at any time.

    Raises
    ------
    ModelError
        If the file cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], mark: int) -> None:
        self._path, self.mark, self._number = path, mark, 0
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except (OSError, ValueError) as error:
            raise ModelError(f"{path}: cannot be written: {error}; choose another place") from None

    def note(self, voltages: bytes) -> None:
        """Note the voltages (V) of all axes, each 8 bytes as the machine has them.

        Raises
        ------
        ModelError
            If the file cannot be written.
        """
        self._number = number = self._number + 1
        record = HEAD.pack(self.mark, number) + voltages
        try:
            os.pwrite(self._file, record + zlib.crc32(record).to_bytes(4, "little"), (number & 1) * (len(record) + 4))
        except OSError as error:
            raise ModelError(f"{self._path}: cannot be written: {error.strerror}; make room") from None

    def discard(self) -> None:
        """Remove the file: nothing will be given any more."""
        os.close(self._file)
        with suppress(OSError):
            os.unlink(self._path)


def read_last_voltages(path: str | os.PathLike[str], mark: int, axes: int) -> tuple[float, ...] | None:
    """Return the voltages (V) noted last for so many axes; None where no whole record bears the mark."""
    size = HEAD.size + VOLTAGE_BYTES * axes + CHECKSUM_BYTES
    try:
        with Path(path).open("rb") as file:
            data = file.read(2 * size)
    except (OSError, ValueError):
        return None
    found = []
    for record in (data[:size], data[size:]):
        body, checksum = record[:-CHECKSUM_BYTES], record[-CHECKSUM_BYTES:]
        if len(record) == size and zlib.crc32(body) == int.from_bytes(checksum, "little"):
            belongs_to, number = HEAD.unpack_from(body)
            if belongs_to == mark:
                found.append((number, struct.unpack_from(f"{axes}d", body, HEAD.size)))
    return max(found)[1] if found else None
