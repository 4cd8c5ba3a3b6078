# PYTHON_ARGCOMPLETE_OK
"""``python -m slpi_ros.cli``: the command line ``slpi``."""

import sys

from slpi_ros.cli import main

sys.exit(main())
