"""``slpi fleet``: many bags of many stages."""

import os
import sys
from argparse import ArgumentParser, Namespace

from slpi_ros.cli import options as common
from slpi_ros.cli.command import Result
from slpi_ros.errors import UsageError

HELP = "identify, verify and follow many stages from many bags, on Dask"
EXAMPLE = "slpi fleet bags -o fleet --workers 4"

# Options that `slpi_ros.fleet.run` has under the same names.
_PASSED_ON = "scheduler", "workers", "models", "since", "diagnose", "watch", "topic"


def add_options(command: ArgumentParser) -> None:
    """Add the options of the command."""
    command.add_argument(
        "sources", metavar="SOURCE", nargs="+", help="bag, folder of bags (recursively), or CSV list of bag and stage"
    )
    common.add_output(
        command, "DIR", "folder of results.parquet, index.html and models; an interrupted run is continued there"
    )
    command.add_argument("--models", metavar="DIR", help="reference models; default: of the first bag of each stage")
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="of a Dask cluster whose workers see the bags and DIR at the same paths; default: a local cluster",
    )  # fmt: skip
    where.add_argument("--workers", metavar="N", type=int, help="processes of the local cluster; default: one per core")
    command.add_argument(
        "--since", metavar="DATE", help="only bags that begin at or after this date (UTC); default: all"
    )
    command.add_argument(
        "--no-diagnose", dest="diagnose", action="store_false", help="no search for causes of errors; default: search"
    )
    command.add_argument("--watch", action="store_true", help="go on with bags that are completed later; default: end")
    common.add_topic(command)
    common.add_with(command, "none; for a diagnosis every one that the bags hold")


def run(options: Namespace) -> Result:
    """Run the command."""
    from slpi_ros.fleet.pages import DOCUMENT, PAGE, report_fleet
    from slpi_ros.fleet.results import JOURNAL, TABLE
    from slpi_ros.io.outputs import allow_folder

    for source in [*options.sources, *filter(None, [options.models])]:
        if os.path.realpath(source) == os.path.realpath(options.output):
            raise UsageError(f"{options.output}: is also read from; give another output (-o)")
    options.remarks += allow_folder(options.output, PAGE, DOCUMENT, TABLE, JOURNAL, overwrite=options.overwrite)
    lines, usable = report_fleet(
        options.sources,
        options.output,
        as_document=options.json,
        told=lambda text: print(text, file=sys.stderr),
        surroundings=options.quantities,
        **{name: getattr(options, name) for name in _PASSED_ON},
    )
    text = "\n".join(lines)
    return Result(text.splitlines(), text, "slpi refit MODEL.json BAG... of a stage that has changed", passed=usable)
