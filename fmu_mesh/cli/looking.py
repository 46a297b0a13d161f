"""`ls`, `status`, `info`, `get`, `set` and `watch`: a running mesh.

Owns what these commands print. `fmu_mesh.wire.client.mesh_client` queries the mesh.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

import msgspec

from ..errors import ConfigurationError, FmuMeshError, Interrupted
from ..pictures.tables import table
from ..printing import page, printable
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.client.readings import Target
from ..wire.views import InstanceInfo, InstanceStatus, MeshInfo, MeshStatus, RosView
from .arguments import Runs, reach
from .output.json_output import print_json
from .output.pages import (
    cells,
    instance_info,
    instance_status,
    instances,
    mesh_info,
    mesh_status,
    progress,
    seconds,
    variables,
)

__all__ = ["RUNS"]

Run = Callable[[argparse.Namespace, Meshes], int]


def _with_meshes(run: Run, arguments: argparse.Namespace) -> int:
    with Meshes(**reach(arguments)) as meshes:
        code = run(arguments, meshes)
        for error in meshes.silent:  # others have answered
            print(f"fmu-mesh: {error}", file=sys.stderr)
            code = code or error.exit_code
        return code


# --- ls, status, info


def _ls(arguments: argparse.Namespace, meshes: Meshes) -> int:
    if arguments.name is None and (absence := meshes.absence) is not None:
        return _ls_nothing(absence, as_json=arguments.json)
    clients = [meshes.one(arguments.name)] if arguments.name is not None else meshes.all()
    instance = clients[0].instance_in(arguments.name) if arguments.name is not None else None
    if arguments.json:

        def everything(client: MeshClient) -> dict[str, Any]:
            infos = _infos(client, instance) if instance is not None or arguments.long else ()
            return {"mesh": client.info(), "status": client.status(), "instances": infos}

        for _, answer in meshes.answers(clients, everything):
            print_json(answer)
        return 0
    if instance is None:
        answers = meshes.answers(clients, MeshClient.status)
        clients = [client for client, _ in answers]
        rows = [
            [status.mesh, status.state, progress(status), seconds(status.time), ", ".join(client.endpoints)]
            for client, status in answers
        ]
        _print(table(rows, heading=["mesh", "state", "point", "time", "endpoint"]))
    if len(clients) == 1 and instance is None:
        print()
        _print(instances(_statuses(clients[0])))
    if instance is not None or arguments.long:
        for client, infos in meshes.answers(clients, partial(_infos, instance=instance)):
            for item in infos:
                print(
                    f"\n{client.keys.instance(item.instance)}" if instance is None else client.keys.instance(instance)
                )
                _print(variables(item))
    return 0


def _ls_nothing(absence: FmuMeshError, *, as_json: bool) -> int:
    """No mesh is not an error. The hint goes to standard error, apart from the output."""
    if as_json:
        print("[]")
    print(f"fmu-mesh: {absence}", file=sys.stderr)
    return 0


def _infos(client: MeshClient, instance: str | None) -> list[InstanceInfo]:
    names = [instance] if instance is not None else client.info().instances
    return [client.instance_info(name) for name in names]


def _statuses(client: MeshClient) -> list[InstanceStatus]:
    return [client.instance_status(name) for name in client.info().instances]


def _status(arguments: argparse.Namespace, meshes: Meshes) -> int:
    clients = [meshes.one(arguments.key)] if arguments.key is not None else meshes.all()
    instance = clients[0].instance_in(arguments.key) if arguments.key is not None else None

    def view_of(client: MeshClient) -> tuple[MeshStatus | InstanceStatus, list[InstanceStatus], list[RosView]]:
        if instance is not None:
            return client.instance_status(instance), [], []
        return client.status(), [] if arguments.json else _statuses(client), client.ros()

    for index, (_, (view, statuses, ros)) in enumerate(meshes.answers(clients, view_of)):
        if arguments.json:
            print_json({**msgspec.structs.asdict(view), "ros": ros} if isinstance(view, MeshStatus) else view)
            continue
        if index:
            print()
        _print(
            [*mesh_status(view, ros), "", *instances(statuses)]
            if isinstance(view, MeshStatus)
            else instance_status(view)
        )
    return 0


def _info(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.one(arguments.key)
    instance = client.instance_in(arguments.key)
    view = client.info() if instance is None else client.instance_info(instance)
    if arguments.json:
        print_json(view)
    else:
        _print(mesh_info(view) if isinstance(view, MeshInfo) else instance_info(view))
    return 0


# --- values


def _get(arguments: argparse.Namespace, meshes: Meshes) -> int:
    rows = []
    for client, targets in _selected(arguments.key, meshes):
        for reading in client.get(targets):
            if arguments.json:
                print_json(reading)
            rows.append(cells(reading))
    if not arguments.json:
        _print(table(rows))
    return 0


def _set(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.one(arguments.key)
    target = client.target(arguments.key, to_set=True)
    answer = client.set(target, _value(target, arguments.value), arguments.at)
    key = printable(answer.key)
    if arguments.json:
        print_json(answer)
    elif answer.late:
        past = f"t = {seconds(arguments.at)} was past"
        print(f"{key}: {past}; it holds from t = {seconds(answer.time)} (point {answer.point}) instead")
    else:
        print(f"{key} holds from point {answer.point} on (t = {seconds(answer.time)})")
    return 0


def _value(target: Target, text: str) -> object:
    """The value of a text: JSON, or the text itself, so that an item, a String or base64 needs no quotes."""
    try:
        value = msgspec.json.decode(text)
    except msgspec.DecodeError:
        return text
    is_text = target.variable.type in ("String", "Binary") and not isinstance(value, str | list)
    return text if value is None or is_text else value


def _watch(arguments: argparse.Namespace, meshes: Meshes) -> int:
    (client, targets), *others = _selected(arguments.key, meshes)
    if others:
        raise ConfigurationError("only variables of one mesh can be watched together.")
    with client.watch(targets) as readings:
        try:
            for reading in islice(readings, arguments.count):
                if arguments.json:
                    print_json(reading)
                else:
                    print(printable("  ".join(cell for cell in cells(reading) if cell)), flush=True)
        except KeyboardInterrupt:
            # At once: closing a session in order can take long, and the others notice that this process is gone.
            sys.stdout.flush()
            os._exit(Interrupted.exit_code)
    return 0


def _selected(references: list[str], meshes: Meshes) -> list[tuple[MeshClient, list[Target]]]:
    """The variables of the references by mesh, without duplicates."""
    found: dict[str, tuple[MeshClient, list[str]]] = {}
    for reference in references:
        client = meshes.one(reference)
        found.setdefault(client.keys.root, (client, []))[1].append(reference)
    return [(client, client.targets(*own)) for client, own in found.values()]


# --- text


def _print(lines: list[str]) -> None:
    print(page(lines))


RUNS: Runs = {
    name: partial(_with_meshes, run)
    for name, run in {"ls": _ls, "status": _status, "info": _info, "get": _get, "set": _set, "watch": _watch}.items()
}
