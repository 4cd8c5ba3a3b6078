"""What a file, message or document may hold, and the only way in which this package opens a file to read it.

Input comes from strangers: a link to a device never ends, a FIFO never answers, and a few kilobytes may unpack to
gigabytes. Each limit is far above what a piezo stage produces and far below what this process could not bear. A limit
is checked before reading, and again while reading where a size is only declared.
"""

import errno
import os
import stat
from io import BytesIO
from typing import BinaryIO
from zipfile import ZipFile

MIB = 2**20

# Axes of one stage. Interferometer heads and stacked stages have up to 12; the schemas of all documents say the same.
MOST_AXES = 100
# Characters of the name of an axis; the schemas say the same.
LONGEST_NAME = 100
# Columns of a table: an axis has two; laboratory tables have up to some hundred channels.
MOST_COLUMNS = 4_000
# Characters of the line of column names, and of each line near it: MOST_COLUMNS names of 60 characters.
LONGEST_HEADER = 250_000
# A table as text: ten million rows of five columns.
TABLE_BYTES = 1024 * MIB
# Unpacked arrays of a MATLAB file: ten million rows of thirteen columns.
ARRAY_BYTES = 1024 * MIB
# A bag file: a day at 10 kHz on four axes.
BAG_BYTES = 256 * 1024 * MIB
# metadata.yaml: a thousand topics; its parser reads some 100 kB/s.
METADATA_BYTES = 512 * 1024
# One chunk of an MCAP file; recorders write less than 10 MiB.
CHUNK_BYTES = 256 * MIB
# One message: a trajectory of a million points on two axes is 100 MB.
MESSAGE_BYTES = 256 * MIB
# Unpacked bytes for each packed one, beyond SMALL_BYTES: the stamps alone of recorded messages do not pack better.
MOST_UNPACKED_FOR_PACKED = 200
SMALL_BYTES = 64 * MIB
# A model document in a file: 50 axes of the finest model.
MODEL_BYTES = 16 * MIB
# Characters of a model document on a topic: its check takes processor time while commands are answered.
TOPIC_MODEL_CHARACTERS = 2_000_000
# A saved memory: some thousand bytes are usual.
MEMORY_BYTES = MIB
# Errors of a document that are looked at to tell the most relevant one; more may take minutes.
MOST_ERRORS = 100


class LimitError(OSError):
    """Input exceeds a limit, or is no regular file; `strerror` says which."""

    def __init__(self, reason: str) -> None:
        super().__init__(errno.EFBIG, reason)


def most_unpacked(packed: int) -> int:
    """Return the largest number of bytes that `packed` bytes may unpack to."""
    return SMALL_BYTES + MOST_UNPACKED_FOR_PACKED * packed


def open_input(path: str | os.PathLike[str], most: int) -> BinaryIO:
    """Open a regular file of at most `most` bytes, else LimitError; ValueError if no file has such a name."""
    # A device is not even opened; the second check is of what has been opened, should the name have changed hands.
    _require(os.stat(path), most)
    file = open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")  # noqa: SIM115
    try:
        _require(os.fstat(file.fileno()), most)
    except OSError:
        file.close()
        raise
    return file


def read_input(path: str | os.PathLike[str], most: int) -> bytes:
    """Return the content of a regular file of at most `most` bytes; errors as for `open_input`."""
    with open_input(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise LimitError(_size(most))
    return content


def require_count(count: int, most: int, what: str) -> None:
    """Raise LimitError if there are more than `most` of something, which `what` names."""
    if count > most:
        raise LimitError(f"{count} {what}, more than {most}")


def require_unpacked(packed: bytes) -> None:
    """Raise LimitError if the files in a ZIP archive are larger than `most_unpacked`; any exception if damaged."""
    with ZipFile(BytesIO(packed)) as archive:
        if sum(file.file_size for file in archive.infolist()) > min(ARRAY_BYTES, most_unpacked(len(packed))):
            raise LimitError("unpacks to more than any record")


def _require(found: os.stat_result, most: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(found.st_mode):
        raise LimitError("no regular file")
    if found.st_size > most:
        raise LimitError(_size(most))


def _size(most: int) -> str:
    return f"larger than {most / MIB:g} MiB"
