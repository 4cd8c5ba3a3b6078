"""Messages of one topic from an SQLite file, as rosbag2's storage ``sqlite3`` writes it."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from slpi_ros.io.message_blocks import BLOCK, MessageBlock

# In the order of writing: going through the index of times would jump about in the file.
_MESSAGES = """
SELECT timestamp, data FROM messages WHERE topic_id IN (SELECT id FROM topics WHERE name = ?) ORDER BY id
"""


def read_sqlite(path: Path, topic: str) -> Iterator[MessageBlock]:
    """Yield the messages of a topic, in the order in which they were written.

    Parameters
    ----------
    path : Path
        A complete file.
    topic : str
        Full name.

    Raises
    ------
    Exception
        Of any kind where the file is damaged.
    """
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as connection:
        rows = connection.execute(_MESSAGES, (topic,))
        while block := rows.fetchmany(BLOCK):
            yield MessageBlock.of([logged for logged, _ in block], [message for _, message in block])
