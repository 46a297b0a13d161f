"""`ls`, `status`, `info`, `get`, `set`, `watch`, `wait`, `pause`, `resume`, `step` and `stop`: a running mesh.

Owns what these commands print. `fmu_mesh.wire.client.mesh_client` queries the mesh.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any, get_args

import msgspec

from ..errors import ConfigurationError, FmuMeshError, Interrupted
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.client.readings import Target
from ..wire.client.waiting import rest, wait_for
from ..wire.views import Command, InstanceInfo, InstanceStatus, MeshInfo, MeshState, MeshStatus, RosView
from .arguments import add_command, count, endpoint, positive_seconds
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
from .output.tables import table

__all__ = ["add_commands", "reaching"]

_TIMEOUT_S = 5.0
_WAIT_S = 60.0
_REFERENCE = "`instance.variable` (with `*` for any characters), or a key (with the wildcards of Zenoh)"

Run = Callable[[argparse.Namespace, Meshes], int]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the commands of this module."""

    def add(name: str, run: Run, text: str) -> argparse.ArgumentParser:
        parser = add_command(commands, name, text, [common, reaching()])
        parser.add_argument("--json", action="store_true", help="JSON, one object per line")
        parser.set_defaults(run_command=lambda arguments: _with_meshes(arguments, run))
        return parser

    ls = add("ls", _ls, "list meshes, instances and variables")
    ls.add_argument("name", nargs="?", metavar="NAME", help="a mesh, or an instance, whose variables are listed")
    ls.add_argument("-l", "--long", action="store_true", help="also list the variables of every instance")
    status = add("status", _status, "show the state and progress of a mesh or an instance")
    status.add_argument(
        "key", nargs="?", metavar="KEY", help="a mesh or an instance, by name or key; default: every mesh"
    )
    info = add("info", _info, "show information about a mesh or an instance")
    info.add_argument("key", metavar="KEY", help="a mesh or an instance, by name or key")
    get = add("get", _get, "show current values")
    get.add_argument("key", nargs="+", metavar="KEY", help=_REFERENCE)
    set_ = add("set", _set, "set an unconnected input or a tunable parameter")
    set_.add_argument("key", metavar="KEY", help="`instance.variable`, or a key")
    set_.add_argument("value", metavar="VALUE", help="a number, true, false, text, or [a, list] for an array")
    watch = add("watch", _watch, "show every value of variables until the mesh ends")
    watch.add_argument("key", nargs="+", metavar="KEY", help=_REFERENCE)
    watch.add_argument("--count", type=count, metavar="N", help="end after N values")
    wait = add_command(
        commands, "wait", "wait until a mesh is running, or in another state", [common, reaching(_WAIT_S)]
    )
    wait.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh; default: the only one")
    wait.add_argument(
        "--state",
        choices=get_args(MeshState),
        default="running",
        metavar="STATE",
        help=f"{', '.join(get_args(MeshState))} (running)",
    )
    wait.add_argument("--json", action="store_true", help="JSON, as `status` prints it")
    wait.set_defaults(run_command=_wait)
    for name, text in (
        ("pause", "pause a mesh at a point"),
        ("resume", "resume a paused mesh"),
        ("step", "run a mesh for some points and pause it again"),
        ("stop", "end the run of a mesh"),
    ):
        parser = add(name, _command, text)
        parser.add_argument("mesh", metavar="MESH", help="name or key of the mesh")
        if name == "step":
            parser.add_argument("points", nargs="?", type=count, default=1, metavar="N", help="points (1)")


def reaching(timeout_s: float = _TIMEOUT_S) -> argparse.ArgumentParser:
    """The options of all commands for running meshes; ``timeout_s`` is the default deadline of a query in s."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "--connect",
        type=endpoint,
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="Zenoh endpoint of a mesh or a router; repeatable; default: the meshes of this user on this host",
    )
    options.add_argument(
        "--timeout",
        type=positive_seconds,
        default=timeout_s,
        metavar="S",
        help=f"deadline of every query in s ({timeout_s:g})",
    )
    return options


def _with_meshes(arguments: argparse.Namespace, run: Run) -> int:
    with Meshes(arguments.connect, arguments.timeout) as meshes:
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
            _print_json(answer)
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

    for number, (_, (view, statuses, ros)) in enumerate(meshes.answers(clients, view_of)):
        if arguments.json:
            _print_json({**msgspec.structs.asdict(view), "ros": ros} if isinstance(view, MeshStatus) else view)
            continue
        if number:
            print()
        match view:
            case MeshStatus():
                _print(mesh_status(view, ros))
                _print(["", *instances(statuses)])
            case InstanceStatus():
                _print(instance_status(view))
    return 0


def _info(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.one(arguments.key)
    instance = client.instance_in(arguments.key)
    view = client.info() if instance is None else client.instance_info(instance)
    if arguments.json:
        _print_json(view)
        return 0
    match view:
        case MeshInfo():
            _print(mesh_info(view))
        case InstanceInfo():
            _print(instance_info(view))
    return 0


# --- values


def _get(arguments: argparse.Namespace, meshes: Meshes) -> int:
    rows = []
    for client, targets in _selected(arguments.key, meshes):
        for reading in client.get(targets):
            if arguments.json:
                _print_json(reading)
            rows.append(cells(reading))
    if not arguments.json:
        _print(table(rows))
    return 0


def _set(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.one(arguments.key)
    target = client.target(arguments.key)
    answer = client.set(target, _value(target, arguments.value))
    if arguments.json:
        _print_json(answer)
    else:
        print(f"{answer.key} holds from point {answer.point} on (t = {seconds(answer.time)})")
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
                    _print_json(reading)
                else:
                    print("  ".join(cell for cell in cells(reading) if cell), flush=True)
        except KeyboardInterrupt:
            # At once: closing a session in order can take long, and the others notice that this process is gone.
            sys.stdout.flush()
            os._exit(Interrupted.exit_code)
    return 0


def _selected(references: list[str], meshes: Meshes) -> list[tuple[MeshClient, list[Target]]]:
    """The variables of the references by mesh, without duplicates."""
    found: dict[str, tuple[MeshClient, dict[str, Target]]] = {}
    for reference in references:
        client = meshes.one(reference)
        _, targets = found.setdefault(client.keys.root, (client, {}))
        targets.update({target.key: target for target in client.targets(reference)})
    return [(client, list(targets.values())) for client, targets in found.values()]


# --- commands


def _command(arguments: argparse.Namespace, meshes: Meshes) -> int:
    client = meshes.named(arguments.mesh)
    command = Command(arguments.command, getattr(arguments, "points", 1))
    answer = rest(client, command) if command.command in ("pause", "step") else client.command(command)
    if arguments.json:
        _print_json(answer)
        return 0
    what = "is told to end, and was" if answer.command == "stop" else f"is {answer.state}"
    print(f"mesh '{client.keys.mesh}' {what} at point {answer.point}")
    return 0


def _wait(arguments: argparse.Namespace) -> int:
    # A mesh with a note is running or about to end; an endpoint may appear later.
    patience_s = arguments.timeout if arguments.connect else min(arguments.timeout, _TIMEOUT_S)
    with Meshes(arguments.connect, patience_s) as meshes:
        status = wait_for(meshes, arguments.mesh, arguments.state, arguments.timeout)
    if arguments.json:
        _print_json(status)
    else:
        print(f"mesh '{status.mesh}' is {status.state} at point {status.point}")
    return 0


# --- text


def _print(lines: list[str]) -> None:
    print("\n".join(lines))


def _print_json(view: object) -> None:
    print(msgspec.json.encode(view).decode(), flush=True)
