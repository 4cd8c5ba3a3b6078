"""The JSON Schemas of every document on a topic or on disk, and the check against them."""

import json
import textwrap
from functools import cache
from importlib.resources import files
from typing import Any

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from slpi_ros.errors import ModelError, UsageError


def load_schema(name: str) -> dict[str, Any]:
    """Read the schema ``msg_schemas/NAME.schema.json``.

    Parameters
    ----------
    name : str
        What the document is, for example ``"model"``.

    Returns
    -------
    dict
        The schema.

    Raises
    ------
    UsageError
        If there is no schema of that name.
    """
    # Here slpi_ros/msg_schemas is a link to the top-level folder, in an installation a copy of it.
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
        What ``json.loads`` returned.
    name : str
        The schema's name, for example ``"model"``.
    source : str
        Where the document came from, for the message.

    Raises
    ------
    ModelError
        If the document does not follow the schema; the message names the place and the value.
    """
    error = best_match(_validator(name).iter_errors(document))
    if error is not None:
        place = textwrap.shorten(error.json_path.replace("\\n", " "), width=200, placeholder=" ...")
        reason = textwrap.shorten(error.message, width=200, placeholder=" ...")
        raise ModelError(f"{source}: not a valid {name} document: at {place}: {reason}; write it anew")


@cache
def _validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(load_schema(name))
