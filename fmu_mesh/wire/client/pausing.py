"""Brings a mesh to a point and pauses it there, for those who set values at exact points."""

from __future__ import annotations

import threading
import time

from ...errors import ConfigurationError, DeadlineExceeded, MeshLost
from ..views import Command
from .mesh_client import MeshClient

__all__ = ["go_on", "paused_at", "wait_until_at"]

# A short step ends within a millisecond; a question costs the node about as much, so each wait is twice the last one.
_FIRST_ASK_S = 0.001
_LONGEST_ASK_S = 0.05


def paused_at(client: MeshClient, command: Command) -> int:
    """Give a command that pauses the mesh; returns the point at which it will be paused.

    Raises:
        ConfigurationError: the mesh refuses, or does not say it.
    """
    hold = client.command(command).hold
    if hold is None:
        raise ConfigurationError("the mesh does not say where it pauses.", hint="Is it another version of fmu_mesh?")
    return hold


def go_on(client: MeshClient, hold: int, point: int) -> int:
    """Let the mesh run from the point at which it is or will be paused to a later one; returns that point.

    Raises:
        ConfigurationError: the mesh refuses.
        MeshLost: another program controls the mesh too.
    """
    if point > hold and paused_at(client, Command("step", point - hold)) != point:
        raise MeshLost(f"the mesh runs to another point than {point}: another program controls it too.")
    return max(point, hold)


def wait_until_at(client: MeshClient, instance: str, point: int, timeout_s: float) -> None:
    """Wait until an instance is paused at ``point``, one of its own.

    Raises:
        DeadlineExceeded: it stays at another point for ``timeout_s`` seconds.
    """
    never = threading.Event()
    look, reached, moved = _FIRST_ASK_S, -1, time.monotonic()
    while (status := client.instance_status(instance)).point != point:
        now = time.monotonic()
        if status.point != reached:
            look, reached, moved = _FIRST_ASK_S, status.point, now
        if now - moved > timeout_s:
            raise DeadlineExceeded(
                f"it does not reach point {point}: {status.activity}.", instance=instance, point=reached
            )
        never.wait(look)
        look = min(2 * look, _LONGEST_ASK_S)
