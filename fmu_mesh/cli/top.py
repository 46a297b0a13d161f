"""`top`: a live table of all instances of a mesh.

Owns what changes from one look to the next: rates and shares are those of the time between two looks, and those since
the first point where there was only one.
"""

from __future__ import annotations

import argparse
from typing import Any

import msgspec
from rich.console import Console
from rich.live import Live
from rich.text import Text

from ..errors import DeadlineExceeded, Interrupted
from ..wire.client import MeshClient
from ..wire.reaching import Meshes
from ..wire.views import InstanceStatus, MeshStatus
from .arguments import add_command, positive_seconds
from .looking import reaching
from .pages import progress, seconds
from .tables import table

__all__ = ["add_commands", "page"]

_INTERVAL_S = 1.0
_HEADING = ["instance", "state", "point", "time", "step time", "wait", "points/s", "factor", "restarts", "activity"]

Look = tuple[MeshStatus, dict[str, InstanceStatus]]


def add_commands(commands: argparse._SubParsersAction[Any], common: argparse.ArgumentParser) -> None:
    """Add the command of this module."""
    top = add_command(commands, "top", "show a live table of all instances of a mesh", [common, reaching()])
    top.add_argument("mesh", nargs="?", metavar="MESH", help="name or key of the mesh, if there are several")
    top.add_argument("--once", action="store_true", help="show it once, and end")
    top.add_argument(
        "--interval", type=positive_seconds, default=_INTERVAL_S, metavar="S", help="time between two looks in s (1)"
    )
    top.add_argument("--json", action="store_true", help="JSON, one object per look")
    top.set_defaults(run_command=_top)


def _top(arguments: argparse.Namespace) -> int:
    with Meshes(arguments.connect, arguments.timeout) as meshes:
        client = meshes.named(arguments.mesh) if arguments.mesh is not None else meshes.one(None)
        if arguments.once:
            _show_once(client.all_status(), as_json=arguments.json)
            return 0
        try:
            _follow(client, arguments.interval, as_json=arguments.json)
        except KeyboardInterrupt:
            return Interrupted.exit_code
    return 0


def _show_once(look: Look, *, as_json: bool) -> None:
    if as_json:
        print(msgspec.json.encode({"mesh": look[0], "instances": list(look[1].values())}).decode(), flush=True)
    else:
        print("\n".join(page(look)), flush=True)


def _follow(client: MeshClient, interval_s: float, *, as_json: bool) -> None:
    """Look again and again until the mesh ends; where there is no terminal, one table after the other."""
    console = Console()
    live = Live(console=console, auto_refresh=False, screen=False) if console.is_terminal and not as_json else None
    before: Look | None = None
    with client.until_end() as ended:
        if live is not None:
            live.start()
        try:
            while not ended.is_set():
                try:
                    look = client.all_status()
                except DeadlineExceeded:
                    if ended.is_set():
                        break
                    raise
                if live is not None:
                    live.update(Text("\n".join(page(look, before)), no_wrap=True, overflow="ellipsis"), refresh=True)
                else:
                    _show_once(look, as_json=as_json)
                before = look
                ended.wait(interval_s)
        finally:
            if live is not None:
                live.stop()
    if not as_json:
        print(f"mesh '{client.keys.mesh}' has ended")


def page(look: Look, before: Look | None = None) -> list[str]:
    """The lines of one look; with the one before it, what happened since then."""
    status, instances = look
    step_size = status.real_time_factor / status.points_per_second if status.points_per_second else 0.0
    rate, factor = f"{status.points_per_second:.0f} points/s", f"real-time factor {status.real_time_factor:.3g}"
    overruns = f", {status.overruns} overruns" if status.overruns else ""
    head = (
        f"{status.mesh}: {status.state}, point {progress(status)}, {seconds(status.time)}, {rate}, {factor}{overruns}"
    )
    rows = [
        _row(own, before[1].get(own.instance) if before is not None else None, step_size)
        for _, own in sorted(instances.items())
    ]
    return [head, "", *table(rows, heading=_HEADING)]


def _row(own: InstanceStatus, before: InstanceStatus | None, step_size: float) -> list[str]:
    if before is None or before.running_time >= own.running_time or before.point > own.point:  # it was restarted
        before = InstanceStatus(own.instance, "", "", 0, 0.0, 0.0, 0.0)
    wall_s = own.running_time - before.running_time
    rate = (own.point - before.point) / wall_s if wall_s > 0.0 else 0.0
    waited = (own.wait_time - before.wait_time) / wall_s if wall_s > 0.0 else 0.0
    return [
        own.instance,
        own.state,
        str(own.point),
        seconds(own.time),
        f"{1e6 * own.step_time:.3g} us",
        f"{100.0 * min(waited, 1.0):.0f} %",
        f"{rate:.0f}",
        f"{rate * step_size:.3g}",
        str(own.restarts),
        own.activity,
    ]
