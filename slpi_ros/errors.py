"""Exceptions of the package, all derived from `SlpiError`, and the form of text that is shown to people."""

# Characters of a line on a terminal, in a log or on a page; a hostile file may hold names of megabytes.
LONGEST_SHOWN = 2_000


def shown(text: object, most: int = LONGEST_SHOWN) -> str:
    """Return a text as one line for a terminal, a log or a page.

    Names of axes, stages, columns, topics and files come from strangers: control characters, which could command a
    terminal, are escaped, and a long text loses its middle, so that the remedy at the end of a message stays.
    """
    line = _cut(str(text), most)
    if line.isprintable():
        return line
    # Text that is not UTF-8 reaches Python as lone surrogates, which are not printable either.
    return _cut("".join(c if c.isprintable() or c == "\N{NO-BREAK SPACE}" else _escaped(c) for c in line), most)


def _cut(line: str, most: int) -> str:
    kept = most - len(" ... ")
    return line if len(line) <= most else f"{line[: kept * 2 // 3]} ... {line[kept * 2 // 3 - kept :]}"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


class SlpiError(Exception):
    """Base class: the data or a document do not allow the request; the message states cause, location and remedy.

    The message is one line that can be shown, see `shown`.
    """

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        super().__init__(shown(message))


class UsageError(SlpiError):
    """The call is invalid: an unknown option value, axis or kind."""

    exit_code = 2


class RecordError(SlpiError):
    """A record cannot be read or lacks required data."""


class ModelError(SlpiError):
    """A model document cannot be read, has an unsupported version or belongs to another stage."""


class IdentificationError(SlpiError):
    """A model cannot be identified from the given record."""


class UnreachableError(SlpiError):
    """A desired displacement lies far outside the identified displacement range."""
