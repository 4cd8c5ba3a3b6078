"""JSON Schemas of all documents that are published or stored in files, and validation against them."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match
from jsonschema.validators import extend

from slpi_ros.errors import ModelError, UsageError


def load_schema(name: str) -> dict[str, Any]:
    """Read the schema ``msg_schemas/NAME.schema.json``.

    Parameters
    ----------
    name : str
        Kind of document, for example ``"model"``.

    Returns
    -------
    dict
        The schema.

    Raises
    ------
    UsageError
        If there is no schema of that name.
    """
    # In the source tree slpi_ros/msg_schemas is a link to the top-level folder, in an installation a copy of it.
    folder = files("slpi_ros") / "msg_schemas"
    try:
        text = (folder / f"{name}.schema.json").read_text(encoding="utf-8")
    except FileNotFoundError:
        names = sorted(entry.name for entry in folder.iterdir())
        known = ", ".join(each.removesuffix(".schema.json") for each in names if each.endswith(".schema.json"))
        raise UsageError(f"there is no schema {name!r} in {folder}; use one of: {known}") from None
    schema: dict[str, Any] = json.loads(text)
    return schema


def validate(document: object, name: str, source: str) -> None:
    """Check a document against the schema of its kind.

    Parameters
    ----------
    document : object
        Parsed document, as returned by ``json.loads``.
    name : str
        Name of the schema, for example ``"model"``.
    source : str
        Origin of the document, for error messages.

    Raises
    ------
    ModelError
        If the document does not conform to the schema; the message names the location and the reason.
    """
    error = best_match(_validator(name).iter_errors(document))
    if error is not None:
        place = textwrap.shorten(error.json_path.replace("\\n", " "), width=200, placeholder=" ...")
        reason = textwrap.shorten(error.message, width=200, placeholder=" ...")
        raise ModelError(f"{source}: not a valid {name} document: at {place}: {reason}; write it anew")


def format_document(document: Mapping[str, Any], name: str) -> str:
    """Return the JSON text of a new document of the kind `name`.

    Raises
    ------
    ModelError
        If the document does not conform to its schema.
    ValueError
        If a value is not finite.
    """
    validate(document, name, f"the new {name}")
    return json.dumps(document, allow_nan=False, indent=1)


@cache
def _validator(name: str) -> Any:
    return _QuickValidator(load_schema(name))


def _items(validator: Any, schema: Any, values: Any, parent: Any) -> Iterator[Any]:
    """Check the items of an array; for an array of floats, check all only if the minimum or maximum is invalid."""
    check = Draft202012Validator.VALIDATORS["items"]
    floats = isinstance(values, list) and len(values) > 2 and all(type(value) is float for value in values)
    if not floats or any(True for _ in check(validator, schema, [min(values), max(values)], parent)):
        yield from check(validator, schema, values, parent)


_QuickValidator: Any = extend(Draft202012Validator, {"items": _items})  # type: ignore[no-untyped-call]
