"""Run the node: `python -m fmu_mesh.ros.node`."""

import sys

from .entry import main

if __name__ == "__main__":
    sys.exit(main())
