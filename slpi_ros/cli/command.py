"""What a command has to say, and how that is printed."""

import json
import math
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from slpi_ros.errors import LONGEST_SHOWN, shown

if TYPE_CHECKING:
    from slpi_ros.workflows.records import Findings


# Lines between the verdict and the next command, without -v.
MOST_LINES = 10


@dataclass(frozen=True)
class Result:
    """What a command has to say."""

    lines: Sequence[str]  # the most important first
    document: str | Mapping[str, Any]  # for ``--json``, SI: its text, or what becomes one
    next: str  # the command that follows, or what to do
    verdict: str = ""  # the first line; "": none
    details: Sequence[str] | None = None  # all lines, for ``-v``; default: `lines`
    passed: bool = True  # exit code 0, else 1

    def show(self, *, as_document: bool, verbose: bool) -> None:
        """Print the result."""
        if as_document:
            text = self.document if isinstance(self.document, str) else json.dumps(_finite(self.document), indent=2)
            say(*text.splitlines(), most=sys.maxsize)
            return
        everything = list(self.lines if self.details is None else self.details)
        lines = everything if verbose else list(self.lines)
        if not verbose and self.verdict:
            kept = lines if len(lines) <= MOST_LINES else lines[: MOST_LINES - 1]
            left_out = len(everything) - len(kept)
            if left_out > 0 and len(kept) < MOST_LINES:
                kept = [*kept, f"({left_out} more lines with -v)"]
            lines = kept
        say(*([self.verdict] if self.verdict else []), *lines, f"next: {self.next}")


def _finite(value: Any) -> Any:
    """Return a value of a document with null for every number that JSON does not have."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def command_line(*words: object) -> str:
    """Return a command that can be typed."""
    return shlex.join(str(word) for word in words)


def say(*lines: str, most: int = LONGEST_SHOWN) -> None:
    """Print lines of at most `most` characters; that a reader such as `head` has left is no error of the command."""
    try:
        print("\n".join(shown(line, most) for line in lines), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def finding_lines(found: "Findings", *, all_levels: bool = True) -> list[str]:
    """Return a line for each finding on a record; those of level "ok" are left out unless `all_levels`."""
    return [
        f"axis {axis}: {finding.level:4} {finding.text}"
        for axis, own in found.items()
        for finding in own
        if all_levels or finding.level != "ok"
    ]
