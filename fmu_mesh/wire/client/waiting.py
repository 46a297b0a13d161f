"""Waits until a mesh has paused, is at a point, or is in a state."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from itertools import groupby
from typing import Final

from msgspec.structs import replace

from ...errors import CallRefused, ConfigurationError, DeadlineExceeded, FmuMeshError, MeshLost, from_report
from ..messages import SetValue
from ..views import Command, CommandAnswer, MeshState, MeshStatus
from .mesh_client import MeshClient
from .readings import Target

__all__ = ["begun_again", "go_on", "paused_at", "replay", "wait_for", "wait_for_start", "wait_until_at"]

_START_S: Final = 120.0

# A short step ends within a millisecond; a question costs the node about as much, so each wait is twice the last one.
_FIRST_ASK_S = 0.001
_LONGEST_ASK_S = 0.05

_RANKS: Final[dict[MeshState, int]] = {
    "starting": 0,
    "initializing": 1,
    "restarting": 1,
    "running": 2,
    "paused": 2,
    "stopping": 3,
    "done": 4,
    "failed": 4,
}
_BEFORE: Final = ("starting", "initializing", "restarting")
_GOES_AND_RESTS: Final = 2
"""Running and paused have the same rank: a mesh can change from each of them to the other."""
# How long an instance may stay at one point before it has come to the next value of a replay.
_NEXT_VALUE_S: Final = 60.0


def begun_again(client: MeshClient, command: Command) -> CommandAnswer:
    """Reset a mesh; return when it is at its first point again, with its state then.

    Raises:
        ConfigurationError: it refused, and nothing has changed.
        MeshLost: it ended meanwhile.
        DeadlineExceeded: it has not begun in time.
        FmuMeshError: it has failed meanwhile.
    """
    what = "begin again"
    with client.statuses(_START_S) as statuses:
        answer, last = client.command(command), None
        for last in statuses:
            if last.resets >= answer.resets and last.state not in _BEFORE:
                if last.state == "failed":
                    raise _ended(last, what)
                return replace(answer, state=last.state, point=last.point)
    raise _gone(client.keys.mesh, what) if last is None else _ended(last, what)


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


def wait_for_start(client: MeshClient) -> None:
    """Wait until a mesh is past its initialization.

    Raises:
        DeadlineExceeded: it is not, in time.
    """
    with client.statuses(_START_S) as statuses:
        for status in statuses:
            if status.state not in _BEFORE:
                return


def wait_for(client: MeshClient, state: MeshState, timeout_s: float) -> MeshStatus:
    """The first status in which a running mesh is in a state.

    Raises:
        DeadlineExceeded: it was not in this state in time.
        MeshLost: it has ended before.
        FmuMeshError: it has failed.
    """
    mesh, last = client.keys.mesh, None
    with client.statuses(timeout_s) as statuses:
        try:
            for last in statuses:
                if last.state == state:
                    return last
                before, then = _RANKS[last.state], _RANKS[state]
                if not (before < then or before == then == _GOES_AND_RESTS):
                    raise _ended(last, f"become {state}")
        except DeadlineExceeded:
            now = last.state if last is not None else "silent"
            text = f"mesh '{mesh}' is {now}, and was not {state} in time."
            raise DeadlineExceeded(text, hint="A larger `timeout=...` waits longer.") from None
    raise _gone(mesh, f"become {state}")


def _ended(status: MeshStatus, what: str) -> FmuMeshError:
    """The error for a mesh that ended before it was in the expected state."""
    if status.error is None:
        return MeshLost(f"mesh '{status.mesh}' is {status.state} at point {status.point}, and does not {what} any more")
    error = from_report(status.error)
    return error.saying(f"mesh '{status.mesh}' has failed and does not {what}: {error.message}")


def _gone(mesh: str, what: str) -> MeshLost:
    return MeshLost(f"mesh '{mesh}' is gone, and does not {what} any more")


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
            wait_until_at(client, value.instance, point, _NEXT_VALUE_S)
            try:
                client.set(targets[name], value.value, value.time)
            except ConfigurationError as error:
                raise CallRefused(
                    error.message, instance=value.instance, variable=value.variable, hint=error.hint
                ) from error
    if last_point is None:
        client.command(Command("resume"))
        return
    client.rest(Command("step", last_point - hold) if last_point > hold else Command("pause"), _NEXT_VALUE_S)
