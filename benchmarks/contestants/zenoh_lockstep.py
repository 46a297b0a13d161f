"""Hand-written zenoh lockstep: the coordinator grants a point, the nodes step, publish to each other and to it.

Publishers are best effort and express, receivers are FIFO channels read by `recv`. The links are Unix sockets between
peers, as in fmu_mesh.
"""

from __future__ import annotations

import json
import struct
import tempfile
import threading
from multiprocessing.connection import Connection
from time import perf_counter

import zenoh
from zenoh.handlers import FifoChannel

from benchmarks.contestants.entry import main, nodes, versions
from benchmarks.contestants.fmu import opened
from benchmarks.task import Outcome, Task

__all__ = ["hello", "publisher", "session_of"]

_GRANT = struct.Struct("<q")
_OUTPUT = struct.Struct("<qqd")
_COORDINATOR = "coordinator"


def run(task: Task) -> Outcome:
    """Coordinate; timed is the coordinator's loop."""
    members = task.system.members
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, session_of(folder, _COORDINATOR, []) as session:
        outputs = session.declare_subscriber("bench/out/*", FifoChannel(64))
        grant = publisher(session, "bench/grant")
        answers = session.declare_queryable(f"bench/hello/{_COORDINATOR}", FifoChannel(64))
        with nodes(_node, [(task, index, folder) for index in range(len(members))]):
            waiting = [answers.recv() for _ in members]
            for query in waiting:
                query.reply(query.key_expr, b"")
                query.drop()
            started = perf_counter()
            rows = _loop(task.points, len(members), grant, outputs)
            seconds = perf_counter() - started
            grant.put(_GRANT.pack(-1))
    last = {member.column: rows[-1][index] for index, member in enumerate(members)}
    return Outcome(seconds, last, versions("eclipse-zenoh", "fmpy"))


def _loop(
    points: int, count: int, grant: zenoh.Publisher, outputs: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]
) -> list[list[float]]:
    put, pack, unpack = grant.put, _GRANT.pack, _OUTPUT.unpack
    recv = outputs.handler.recv
    rows = []
    for point in range(points):
        put(pack(point))
        values = [0.0] * count
        for _ in range(count):
            index, reached, value = unpack(recv().payload.to_bytes())
            if reached != point + 1:
                msg = f"a value of point {reached} at point {point + 1}"
                raise RuntimeError(msg)
            values[index] = value
        rows.append(values)
    return rows


def _node(_pipe: Connection, task: Task, index: int, folder: str) -> None:
    system = task.system
    source = system.source_of(index)
    with session_of(folder, str(index), [_COORDINATOR, *map(str, range(index))]) as session, opened(task, index) as own:
        grants = session.declare_subscriber("bench/grant", FifoChannel(64))
        values = None if source is None else session.declare_subscriber(f"bench/out/{source}", FifoChannel(64))
        output = publisher(session, f"bench/out/{index}")
        with session.declare_queryable(f"bench/hello/{index}", lambda query: query.reply(query.key_expr, b"")):
            if source is not None:
                hello(session, str(source))
            hello(session, _COORDINATOR)
            put, pack, unpack = output.put, _OUTPUT.pack, _OUTPUT.unpack
            next_grant = grants.handler.recv
            next_value = None if values is None else values.handler.recv
            fmu, inputs, outputs, step_size = own.fmu, own.inputs, own.outputs, system.step_size
            newest = task.initial_inputs[index]
            jacobi = system.algorithm == "jacobi"
            while (point := _GRANT.unpack(next_grant().payload.to_bytes())[0]) >= 0:
                if next_value is not None:
                    if not (jacobi and point == 0):
                        newest = unpack(next_value().payload.to_bytes())[2]
                    fmu.setReal(inputs, [newest])
                fmu.doStep(currentCommunicationPoint=point * step_size, communicationStepSize=step_size)
                put(pack(index, point + 1, fmu.getReal(outputs)[0]))


def publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """What sends each message at once."""
    return session.declare_publisher(key, express=True, reliability=zenoh.Reliability.BEST_EFFORT)


def hello(session: zenoh.Session, name: str) -> None:
    """Ask until ``name`` answers: then the link works both ways and knows our subscribers."""
    pause = threading.Event()
    while not any(reply.ok for reply in session.get(f"bench/hello/{name}", timeout=20.0)):
        pause.wait(0.02)


def session_of(folder: str, name: str, peers: list[str]) -> zenoh.Session:
    """A session that listens at a Unix socket of its name, and connects to those of others."""
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [f"unixsock-stream/{folder}/{name}"],
        "connect/endpoints": [f"unixsock-stream/{folder}/{peer}" for peer in peers],
        "connect/exit_on_failure": False,
        "connect/timeout_ms": -1,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 250, "period_increase_factor": 1.5},
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


if __name__ == "__main__":
    main(run)
