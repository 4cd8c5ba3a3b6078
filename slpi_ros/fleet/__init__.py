"""Calibration records of many stages, processed on a Dask cluster, whose packages ``pip install .[fleet]`` installs."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slpi_ros.fleet.cluster import run

__all__ = ["run"]


def __getattr__(name: str) -> Any:
    if name != "run":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from slpi_ros.fleet.cluster import run

    return run
