"""The answers of a mesh as lines of text for a person."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from ...pictures.tables import pairs, table
from ...simtime import ENDLESS
from ...text import listed, short_number
from ...wire.client.readings import Reading
from ...wire.views import ConnectionView, InstanceInfo, InstanceStatus, MeshInfo, MeshStatus, RosView, VariableView

__all__ = [
    "cells",
    "instance_info",
    "instance_status",
    "instances",
    "keys",
    "mesh_info",
    "mesh_status",
    "progress",
    "seconds",
    "variables",
    "with_hosts",
]


def variables(info: InstanceInfo) -> list[str]:
    """One line for each variable of an instance."""
    rows = [
        [
            v.key,
            _type(v),
            v.variability,
            "yes" if v.settable else "",
            v.unit or "",
            "" if v.start is None else _text(v.start),
            v.description or "",
        ]
        for v in info.variables
    ]
    heading = ["variable", "type", "variability", "settable", "unit", "start", "description"]
    return table(rows, heading=heading, indent=2)


def instances(statuses: Iterable[InstanceStatus]) -> list[str]:
    """One line for each instance of a mesh, and for each Zenoh key at an end of its connections."""
    statuses = list(statuses)
    rows = [
        [s.instance, s.state, str(s.point), seconds(s.time), f"{1e6 * s.step_time:.3g} us", s.activity]
        for s in statuses
    ]
    heading = ["instance", "state", "point", "time", "step time", "activity"]
    return [*table(with_hosts(statuses, rows, heading), heading=heading), *keys(statuses)]


def with_hosts(statuses: Iterable[InstanceStatus], rows: list[list[str]], heading: list[str]) -> list[list[str]]:
    """The rows of instances, and into the heading, with their hosts, if not all of them are on that of `launch`."""
    hosts = [status.deploy_host for status in statuses]
    if not any(hosts):
        return rows
    heading.insert(1, "host")
    return [[row[0], host, *row[1:]] for row, host in zip(rows, hosts, strict=True)]


def keys(statuses: Iterable[InstanceStatus]) -> list[str]:
    """One line for each Zenoh key at an end of a connection, below an empty one; nothing without keys."""
    rows = [own.cells for status in statuses for own in status.keys]
    return ["", *table(rows, heading=["key", "encoding", "rule", "activity"])] if rows else []


def mesh_status(status: MeshStatus, ros: Sequence[RosView] = ()) -> list[str]:
    """The status of a mesh, and of its gateways to ROS."""
    return pairs(
        [
            ("mesh", status.mesh),
            ("state", f"restarting, {status.restarting}" if status.restarting else status.state),
            ("point", progress(status)),
            ("time", seconds(status.time)),
            ("speed", f"{status.points_per_second:.0f} points/s, real-time factor {status.real_time_factor:.3g}"),
            ("missing", ", ".join(map(_part, status.missing))),
            ("overruns", str(status.overruns or "")),
            ("resets", str(status.resets or "")),
            *(("cut", f"the master waits for node '{name}' for {cut_s:.0f} s") for name, cut_s in status.cut.items()),
            *(("ROS", view.activity) for view in ros),
            *(("ROS", f"{other} publishes /clock, too") for view in ros for other in view.other_clocks),
            *(
                ("ROS", f"{count} elements on {topic} were ignored: no variable has their keys")
                for view in ros
                for topic, count in view.ignored.items()
            ),
            *(
                ("ROS", f"{words} {listed(names)}")
                for view in ros
                for words, which in _MATCHED.items()
                if view.connected
                and (names := [own.topic for own in view.topics if (own.direction, own.matched) == which])
            ),
            *(("ROS", f"the deadline of {topic} was missed {n} times") for v in ros for topic, n in v.missed.items()),
            ("error", status.error.message if status.error is not None else ""),
        ]
    )


_MATCHED = {
    "somebody subscribes to": ("out", True),
    "nobody subscribes to": ("out", False),
    "somebody publishes": ("in", True),
    "nobody publishes": ("in", False),
}


def instance_status(status: InstanceStatus) -> list[str]:
    """The status of an instance."""
    return pairs(
        [
            ("instance", status.instance),
            ("state", status.state),
            ("activity", status.activity),
            ("point", str(status.point)),
            ("time", seconds(status.time)),
            ("step time", f"{1e6 * status.step_time:.3g} us"),
            ("wait time", f"{status.wait_time:.3g} s"),
            ("overruns", str(status.overruns or "")),
            ("restarts", str(status.restarts or "")),
            *(("key", "  ".join(own.cells)) for own in status.keys),
        ]
    )


_PARTS = {"@record": "the recorder", "@mesh": "the master"}


def _part(name: str) -> str:
    return _PARTS.get(name, name)


def _on(deploy_host: str) -> str:
    return f" on host '{deploy_host}'" if deploy_host else ""


def mesh_info(info: MeshInfo) -> list[str]:
    """The information about a mesh."""
    end = seconds(info.stop_time) if info.stop_time is not None else "an open end"
    return pairs(
        [
            ("mesh", info.mesh),
            ("configuration", info.config),
            ("simulation", f"{seconds(info.start_time)} to {end} in steps of {seconds(info.step_size)}"),
            ("algorithm", info.algorithm),
            ("window", f"{info.window} points"),
            ("real-time factor", f"{info.real_time_factor:g}" if info.real_time_factor else "as fast as possible"),
            ("instances", ", ".join(info.instances)),
            ("nodes", ", ".join(name + _on(info.deploy_hosts.get(name, "")) for name in info.nodes)),
            ("result files" if len(info.result_files) > 1 else "result file", ", ".join(info.result_files) or "none"),
            ("endpoints", ", ".join(info.endpoints)),
            ("shared memory", ", ".join(map(_part, info.shared_memory)) or "not used"),
            ("row streams", ", ".join(f"{_part(one)} with {_part(other)}" for one, other in info.row_streams)),
            *(("ROS", "  ".join(own.cells)) for own in info.topics),
            ("master", f"process {info.pid} on {info.host}, fmu_mesh {info.version}"),
        ]
    )


def instance_info(info: InstanceInfo) -> list[str]:
    """The information about an instance, and its variables."""
    fmi = f"FMI {info.fmi_version}, " if info.fmi_version else ""
    can = (name.removeprefix("can_").replace("_", " ") for name, own in info.capabilities.items() if own)
    facts = pairs(
        [
            ("instance", info.instance),
            ("model", f"{info.model_name} ({fmi}{info.kind})"),
            ("description", info.description or ""),
            ("made by", info.generation_tool or ""),
            ("FMU" if fmi else "file", info.fmu),
            ("step size", seconds(info.step_size)),
            ("can", ", ".join(can)),
            ("node", f"{info.node}{_on(info.deploy_host)}, process {info.pid} on {info.host}"),
            ("fed by", ", ".join(map(_connection, info.connections))),
            *(("key", "  ".join(own.cells)) for own in info.keys),
            *(("loop", str(own)) for own in info.loops),
            ("timeouts", ", ".join(f"{v.name}: {v.timeout}" for v in info.variables if v.timeout)),
            ("clocks", ", ".join(map(str, info.clocks))),
            ("problems", "; ".join(info.problems)),
        ]
    )
    return [*facts, "", *variables(info)]


def _connection(view: ConnectionView) -> str:
    about = ", ".join(filter(None, ("map" if view.map else "", view.way_in_words)))
    return f"{view.source} -> {view.target}{f' ({about})' if about else ''}"


def cells(reading: Reading) -> list[str]:
    """The cells of a value: key, value, unit, and point with time."""
    where = f"(point {reading.point}, t = {seconds(reading.time)})"
    return [reading.key, _text(reading.value), reading.unit or "", where]


def progress(status: MeshStatus) -> str:
    """The point of a mesh, and the last one if there is one."""
    return f"{status.point} of {status.last_point}" if status.last_point < ENDLESS else str(status.point)


def seconds(time: float) -> str:
    """A time in s."""
    return f"{short_number(time)} s"


def _type(view: VariableView) -> str:
    """The type, with the sizes of an array's dimensions."""
    return f"{view.type}[{','.join(map(str, view.shape))}]" if view.shape else view.type


def _text(value: object) -> str:
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
