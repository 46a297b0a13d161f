"""Sets recorded values in a running mesh, each at the point at which it was set before."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from ..errors import CallRefused, ConfigurationError, MeshLost
from ..variables.value_types import PlainValue
from ..wire.client.mesh_client import MeshClient
from ..wire.client.pausing import go_on, paused_at, wait_until_at
from ..wire.client.readings import Target
from ..wire.client.waiting import rest
from ..wire.messages import SetValue
from ..wire.views import Command

__all__ = ["replay"]

_STEP_S = 60.0
"""How long in s an instance may stay at one point before it has come to the next value."""


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
            _set(client, targets[name], value)
    if last_point is None:
        client.command(Command("resume"))
        return
    rest(client, Command("step", last_point - hold) if last_point > hold else Command("pause"))


def _set(client: MeshClient, target: Target, value: SetValue) -> None:
    plain: PlainValue = value.value
    try:
        client.set(target, plain, value.time)
    except ConfigurationError as error:
        raise CallRefused(error.message, instance=value.instance, variable=value.variable, hint=error.hint) from error
