"""``slpi experiments``: the tables and figures of the two papers."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result
from slpi_ros.errors import UsageError

HELP = "reproduce the tables and figures of the two papers"
EXAMPLE = "slpi experiments -o experiments"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    common.add_output(command, "DIR", "folder of index.html")
    command.add_argument(
        "--data", metavar="DIR", help="folder of measured records to include in the comparison; default: none"
    )


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.io.outputs import allow_folder
    from slpi_ros.papers.page import COLUMNS, PAGE, TABLE, write_experiments

    data = Path(options.data) if options.data else None
    if data and not data.is_dir():
        raise UsageError(f"{data}: no such folder; give the folder of the measured records, or leave --data out")
    options.remarks += allow_folder(options.output, PAGE, tables={TABLE: COLUMNS}, overwrite=options.overwrite)
    page = write_experiments(Path(options.output), data)
    return Result([f"{page}: the tables and figures"], {"page": str(page)}, f"open {page} in a browser")
