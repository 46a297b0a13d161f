"""Run the node: `python -m fmu_mesh.ros.node`."""

import sys

from ...printing import guard_streams
from ...wire.last_exit import LastExit
from .entry import main

if __name__ == "__main__":
    guard_streams()
    last_exit = LastExit()
    sys.exit(last_exit.with_code(main()))
