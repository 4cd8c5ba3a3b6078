"""Print the versions that matter in this environment: what the tests after it have run with."""

import platform
import re
from importlib.metadata import PackageNotFoundError, requires, version


def main() -> None:
    """Print Python and the package's dependencies with their versions, in one line."""
    names = sorted({re.match(r"[\w-]+", each)[0] for each in requires("slpi_ros") if "extra ==" not in each})
    found = [f"Python {platform.python_version()}"]
    for name in [*names, "rclpy"]:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} without version")
    print(", ".join(found), flush=True)


if __name__ == "__main__":
    main()
