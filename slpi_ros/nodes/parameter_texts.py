"""Parameters as they are written, on the command line and in files, where ROS reads something else than is meant.

ROS reads YAML 1.1: a leading 0 makes a number octal, and y, n, yes, no, on, off are truth values. Of the blocks that
fit a node the one counts whose name comes last, in whatever file it comes first, and ``-p`` is one more block ``/**``.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

_OCTAL = re.compile(r"[-+]?0[0-7]+")
_TRUTH = re.compile(r"(?<![\w'\"])(?:y|n|yes|no|on|off)(?![\w'\"])", re.IGNORECASE)
_LINE = re.compile(r"\s*(?:-\s+)?([\w.]+)\s*:\s+(.*?)\s*(?:#.*)?")
_BLOCK = "ros__parameters"

Texts = Iterator[tuple[str, str, str]]


def _options(arguments: Sequence[str], *names: str) -> Iterator[str]:
    """Yield the values of the options for ROS of these names."""
    of_ros = False
    for option, value in zip(arguments, arguments[1:], strict=False):
        of_ros = option == "--ros-args" or (of_ros and option != "--")
        if of_ros and option in names:
            yield value


def _files(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each parameter file that can be read."""
    for name in _options(arguments, "--params-file"):
        with suppress(OSError, UnicodeError):
            yield name, Path(name).read_text(encoding="utf-8")


def _written(arguments: Sequence[str]) -> Texts:
    """Yield where each parameter is given, with its name and its text."""
    for rule in _options(arguments, "-p", "--param"):
        name, _, text = rule.partition(":=")
        yield f"-p {rule}", name.rpartition(":")[2], text.strip()
    for file, content in _files(arguments):
        for number, line in enumerate(content.splitlines(), start=1):
            if found := _LINE.fullmatch(line):
                yield f"{file}, line {number}", found[1], found[2]


def leading_zeros(arguments: Sequence[str]) -> Iterator[str]:
    """Yield a remark for each number that is octal as it begins with 0."""
    for where, name, text in _written(arguments):
        if _OCTAL.fullmatch(text):
            meant = text.lstrip("+-0") or "0"
            found = f"{name} is {int(text, 8)}, as a leading 0 makes it octal"
            yield f"{where}: {found}; write {meant}, or '{text}' for a text"


def remedy(arguments: Sequence[str], error: str) -> str:
    """Return what to do about an `error` of ROS that parameters were given; "" if that is not known."""
    if split := _split_list(arguments):
        name, values = split
        quoted = re.sub(r"(?<![\w.])[A-Za-z_]\w*", r"'\g<0>'", values)
        return f'the shell split {name}:={values} at its spaces; quote it: -p {name}:="{quoted}"'
    kinds = error.upper()
    for where, name, text in _written(arguments):
        if "BOOL" in kinds and (word := _TRUTH.search(text)):
            quoted = re.sub(r"[\w.]+", r"'\g<0>'", text)
            return f'{where}: YAML reads {word[0]} as a truth value; quote it: -p {name}:="{quoted}"'
        if "STRING" in kinds and name in error and _OCTAL.fullmatch(text):
            return f"{where}: a leading 0 makes it an octal number; quote it: -p {name}:=\"'{text}'\""
    return ""


def _split_list(arguments: Sequence[str]) -> tuple[str, str] | None:
    """Return name and text of a list that was given in several words; None without one."""
    for k, word in enumerate(arguments):
        name, _, text = word.partition(":=")
        if text.startswith("[") and "]" not in text:
            for end, last in enumerate(arguments[k:]):
                if last.endswith("]"):
                    return name, " ".join([text, *arguments[k + 1 : k + end + 1]])
    return None


def overridden(arguments: Sequence[str], node: Any) -> Iterator[str]:
    """Yield a remark for each parameter of a node that has not the value which is meant.

    That is the one of ``-p``, else that of the last file, and there that of a block without wildcards.
    """
    full_name, used = node.get_fully_qualified_name(), getattr(node, "_parameter_overrides", {})
    blocks = [
        (f"the block {name} of {file}", values)
        for file, text in _files(arguments)
        for name, values in sorted(_blocks(_read(text)), key=lambda block: "*" not in block[0])
        if _fits(name, full_name)
    ]
    meant = {key: (block, value) for block, values in blocks for key, value in values.items()}
    for rule in _options(arguments, "-p", "--param"):
        key, _, text = rule.partition(":=")
        if key.rpartition(":")[0] in ("", node.get_name(), full_name):
            meant[key.rpartition(":")[2]] = f"-p {rule}", _read(text)
    for key, (where, wanted) in meant.items():
        value = getattr(used.get(key), "value", wanted)
        others = [block for block, values in blocks if key in values and _same(values[key], value)]
        if others and not _same(value, wanted):
            yield (
                f"{key} is {value}, of {others[-1]}, and not {wanted} of {where}: ROS takes the last block, "
                "also before -p; put /** first, and give each parameter once"
            )


def _read(text: str) -> Any:
    with suppress(yaml.YAMLError):
        return yaml.safe_load(text)
    return None


def _blocks(document: Any, before: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the full name of each block of a parameter file, which may have wildcards, and its parameters."""
    for key, value in document.items() if isinstance(document, Mapping) else ():
        if isinstance(value, Mapping):
            name = f"{before}/{str(key).strip('/')}"
            values = value.get(_BLOCK)
            yield from [(name, values)] if isinstance(values, Mapping) else _blocks(value, name)


def _fits(block: str, full_name: str) -> bool:
    """Return whether a block is one of a node."""
    pattern = re.escape(block).replace(r"/\*\*", "(?:/.*)?").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, full_name) is not None


def _same(one: Any, other: Any) -> bool:
    """Return whether two values are equal, arrays number by number."""
    arrays = [hasattr(each, "__len__") and not isinstance(each, str) for each in (one, other)]
    return list(one) == list(other) if all(arrays) else not any(arrays) and bool(one == other)
