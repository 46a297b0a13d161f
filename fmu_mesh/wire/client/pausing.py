"""Brings a mesh to a point and pauses it there, for those who set values at exact points; sets those of a first run."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from itertools import groupby

from ...errors import CallRefused, ConfigurationError, DeadlineExceeded, MeshLost
from ..messages import SetValue
from ..views import Command
from .mesh_client import MeshClient
from .readings import Target
from .waiting import rest

__all__ = ["go_on", "paused_at", "replay", "wait_until_at"]

_LOOK_S = 0.001
_LONGEST_LOOK_S = 0.05
_STEP_S = 60.0
"""How long in s an instance may stay at one point before it has come to the next value of a replay."""


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
    look, reached, moved = _LOOK_S, -1, time.monotonic()
    while (status := client.instance_status(instance)).point != point:
        now = time.monotonic()
        if status.point != reached:
            look, reached, moved = _LOOK_S, status.point, now
        if now - moved > timeout_s:
            raise DeadlineExceeded(
                f"it does not reach point {point}: {status.activity}.", instance=instance, point=reached
            )
        never.wait(look)
        look = min(2 * look, _LONGEST_LOOK_S)


def replay(client: MeshClient, values: Sequence[SetValue], last_point: int | None) -> None:
    """Set all values, and let the mesh run on, or to ``last_point``, where it pauses.

    Raises:
        CallRefused: a value was refused.
        MeshLost: the mesh has ended, or another program controls it too.
        DeadlineExceeded: an instance does not come to the point of a value.
    """
    hold = paused_at(client, Command("pause"))
    targets: dict[str, Target] = {}
    for point, together in groupby(sorted(values, key=lambda value: value.point), key=lambda value: value.point):
        hold = go_on(client, hold, point)
        for value in together:
            name = f"{value.instance}.{value.variable}"
            if hold != point:
                raise MeshLost(f"the mesh is at point {hold}, and '{name}' was set at point {point}.")
            if name not in targets:
                targets[name] = client.target(name)
            wait_until_at(client, value.instance, point, _STEP_S)
            try:
                client.set(targets[name], value.value, value.time)
            except ConfigurationError as error:
                raise CallRefused(
                    error.message, instance=value.instance, variable=value.variable, hint=error.hint
                ) from error
    if last_point is None:
        client.command(Command("resume"))
        return
    rest(client, Command("step", last_point - hold) if last_point > hold else Command("pause"))
