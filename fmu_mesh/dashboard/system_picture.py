"""The picture of instances and connections, where this version of the library can draw one."""

from __future__ import annotations

from typing import Any

from ..errors import FmuMeshError
from .mesh_follower import MeshFollower

__all__ = ["system_picture"]


def system_picture(follower: MeshFollower) -> str | None:
    """The SVG of the mesh with its present state; None if there is none, and the table of instances must do."""
    try:
        graph: Any = follower.ask(lambda mesh: getattr(mesh, "graph", lambda: None)())
    except FmuMeshError:
        return None
    return None if graph is None else str(graph.svg())
