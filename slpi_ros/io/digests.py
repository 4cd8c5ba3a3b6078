"""SHA-256 of files, by which a document names what it rests on, and of what a record holds."""

import hashlib
import os
from pathlib import Path

import numpy as np

from slpi_ros.errors import RecordError
from slpi_ros.io.input_limits import BAG_BYTES, open_input
from slpi_ros.io.record import BLOCK, Record, each_block
from slpi_ros.io.unfinished_bags import place_of

# Bytes that are read at once.
PART = 1 << 20


def digests(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the SHA-256 (64 hexadecimal digits) of a file, or of each file in a folder, by name; RecordError if not.

    Equal to what ``sha256sum`` prints.
    """
    place = place_of(Path(path))
    try:
        if not place.is_dir():
            return {place.name: _digest(place)}
        return {each.name: _digest(each) for each in sorted(place.iterdir()) if each.is_file()}
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise RecordError(f"{path}: cannot be read for its SHA-256: {reason}; check the file") from None


def record_digest(record: Record, axis: str) -> str:
    """Return the SHA-256 (64 hexadecimal digits) of the readings (m) of an axis, in whatever files they are."""
    # The same readings may be beside another voltage (commanded, measured) and at other times (another import).
    digest = hashlib.sha256()
    for (y,) in each_block(record.displacement[axis]):
        # Without the sample that two blocks share.
        y = y[:BLOCK]
        digest.update(y[np.isfinite(y)].astype("<f8").tobytes())
    return digest.hexdigest()


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open_input(path, BAG_BYTES) as file:
        while part := file.read(PART):
            digest.update(part)
    return digest.hexdigest()
