"""Meshes with Zenoh keys at ends of their connections, as files, and what makes them meet."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import yaml
import zenoh

from fmu_mesh.wire.session import matches
from tests.helpers import FMUS, Launched, Place, wait_until

__all__ = ["client", "endpoint_of", "key_lines", "put_values", "status_of", "stepped_router", "written"]

KeyLine = tuple[str, int, float | None, Any]


def written(
    place: Place,
    name: str,
    instances: Mapping[str, Mapping[str, Any]],
    connections: Sequence[str | Mapping[str, Any]],
    **sections: Any,  # noqa: ANN401  as the file has them
) -> Path:
    """Write ``<name>.yaml`` with the result ``<name>.csv``: 200 points of 10 ms, as fast as possible."""
    members = {own: dict(member) for own, member in instances.items()}
    for member in members.values():
        if "fmu" in member and not Path(member["fmu"]).is_absolute():
            member["fmu"] = str(FMUS / f"{member['fmu']}.fmu")
    content = {
        "mesh": name,
        "record": {"file": f"{name}.csv"},
        **sections,
        "simulation": {"stop_time": 2.0, "step_size": 0.01, "algorithm": "jacobi", **sections.get("simulation", {})},
        "instances": members,
        "connections": [one if isinstance(one, str) else dict(one) for one in connections],
    }
    path = place.folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


@contextmanager
def stepped_router(place: Place, listen: str = "tcp/127.0.0.1:0") -> Iterator[tuple[Launched, str]]:
    """A router and its endpoint, as long as the block."""
    launched = place.start("router", "--listen", listen)
    wait_until(lambda: "router at " in launched.output, "a router")
    yield launched, endpoint_of(launched)
    if launched.running:
        launched.signal(signal.SIGTERM)
        launched.wait()


def endpoint_of(router: Launched) -> str:
    """Where a router listens."""
    return router.output.split("router at ")[1].split()[0].rstrip(",")


@contextmanager
def client(*endpoints: str) -> Iterator[zenoh.Session]:
    """A session as any other program has it: a client at these endpoints."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps(list(endpoints)))
    with zenoh.open(config) as session:
        yield session


def put_values(
    session: zenoh.Session, key: str, values: Sequence[object], *, is_there: Callable[[], object] | None = None
) -> None:
    """Publish values under a key, each as JSON, once somebody subscribes to it."""
    publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    wait_until(lambda: matches(publisher), f"a subscriber of {key}")
    if is_there is not None:
        wait_until(is_there, f"who gets {key}")
    for value in values:
        publisher.put(value if isinstance(value, bytes) else msgspec.json.encode(value))
    publisher.undeclare()


def key_lines(result: Path) -> list[KeyLine]:
    """What has come by keys, as it is beside a result file; without a line that is being written."""
    lines, _, _ = result.with_name(f"{result.name}.keys.jsonl").read_bytes().rpartition(b"\n")
    return [msgspec.json.decode(line, type=tuple[str, int, float | None, Any]) for line in lines.splitlines()]


def status_of(session: zenoh.Session, mesh: str, instance: str) -> dict[str, Any]:
    """The status of an instance, as any client gets it; its keys are by key and variable."""
    for reply in session.get(f"fmu_mesh/{mesh}/{instance}/status", timeout=10.0):
        if reply.ok is not None:
            status: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
            return status
    return {}
