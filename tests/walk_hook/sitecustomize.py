"""Python runs this when it starts, in each process of a walk: its folder is on PYTHONPATH there (`tests.walks`)."""

import os

if "FMU_MESH_WALK" in os.environ:
    from tests.walks import follow

    follow(os.environ["FMU_MESH_WALK"])
