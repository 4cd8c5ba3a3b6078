"""What a diagnosis leaves on disk: the document, the extended model, and the page."""

import json
from pathlib import Path

from slpi_ros.diagnosis.verdict import Diagnosis
from slpi_ros.errors import SlpiError
from slpi_ros.io.atomic_file import all_or_nothing, make_folder
from slpi_ros.io.schemas import validate
from slpi_ros.model.document import format_model
from slpi_ros.reports.diagnosis import write_diagnosis

DOCUMENT, EXTENDED_MODEL, PAGE = "diagnosis.json", "extended_model.json", "report.html"


def make_room(folder: Path) -> None:
    """Make the folder of a diagnosis; before long work, so that its end is not in vain.

    Raises
    ------
    SlpiError
        If the files cannot be written there.
    """
    make_folder(folder)
    for name in (DOCUMENT, EXTENDED_MODEL, PAGE):
        if (folder / name).is_dir():
            raise SlpiError(f"{folder / name}: cannot be written: a folder has that name; choose another place")


def write_files(folder: Path, diagnosis: Diagnosis) -> None:
    """Write ``diagnosis.json``, ``extended_model.json`` and ``report.html`` into `folder`, each whole or not at all.

    Parameters
    ----------
    folder : Path
        Made if need be.
    diagnosis : Diagnosis

    Raises
    ------
    SlpiError
        If a file cannot be written, or a figure is not finite.
    """
    make_room(folder)
    try:
        texts = {DOCUMENT: format_diagnosis(diagnosis), EXTENDED_MODEL: format_model(diagnosis.extended)}
    except ValueError as error:
        raise SlpiError(f"{diagnosis.source}: no sound diagnosis: {error}; record a longer drive") from None
    for name, text in texts.items():
        with all_or_nothing(folder / name) as file:
            file.write(text)
    write_diagnosis(folder, diagnosis)


def format_diagnosis(diagnosis: Diagnosis) -> str:
    """Return the text of a diagnosis document, ``msg_schemas/diagnosis.schema.json``.

    Raises
    ------
    ModelError
        If it does not follow the schema.
    ValueError
        If a figure is not finite.
    """
    document = diagnosis.to_document()
    validate(document, "diagnosis", "the new diagnosis")
    return json.dumps(document, allow_nan=False, indent=1)


def describe_diagnosis(diagnosis: Diagnosis) -> list[str]:
    """Return lines that say what a diagnosis found: per axis the verdict, the causes, and what to do next."""
    lines = []
    for name, found in diagnosis.axes.items():
        told = [f"verdict: {found.verdict.replace('_', ' ')}", found.summary]
        told += [f"{named.name}: {named.evidence}" for named in found.effects]
        told += [f"next: {found.next_experiment}"] if found.next_experiment else []
        lines += [f"axis {name}: {line}" for line in told]
    return lines
