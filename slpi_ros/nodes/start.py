"""Executables of the nodes: signals are handled before ROS is imported, which takes most of the time of a start."""

# Few imports: until the handlers are set, SIGINT ends the process with a traceback.
import sys
import warnings
from importlib import import_module

from slpi_ros.nodes import stop

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable


def _executable(name: str, node: str) -> "Callable[[], int]":
    def main() -> int:
        stop.of_process = stop.listening()
        from slpi_ros.errors import DependencyError, dependencies_needed, shown

        # Like a line of the node's log, without the line of code that warns.
        warnings.formatwarning = lambda message, *_: f"[WARN] {shown(str(message))}\n"
        try:
            with dependencies_needed():
                from slpi_ros.nodes.common import run
                from slpi_ros.nodes.help import help_asked

                module = import_module(f"slpi_ros.nodes.{name}")
                program = getattr(module, node)
                return 0 if help_asked(name, program, module.DECLARATIONS) else run(program)
        except KeyboardInterrupt:
            return 0
        except DependencyError as error:
            print(f"{name}: {error}", file=sys.stderr, flush=True)
            return error.exit_code

    main.__doc__ = f"Run the node ``{name}``; return the exit code of the process."
    return main


calibrator = _executable("calibrator", "Calibrator")
compensator = _executable("compensator", "Compensator")
device_simulator = _executable("device_simulator", "DeviceSimulator")
driver = _executable("driver", "Driver")
exciter = _executable("exciter", "Exciter")
identify = _executable("identify", "Identify")
recorder = _executable("recorder", "Recorder")
stage_simulator = _executable("stage_simulator", "StageSimulator")

if __name__ == "__main__":
    sys.exit(globals()[sys.argv[1]]())
