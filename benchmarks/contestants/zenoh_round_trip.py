"""The limit of what goes by Zenoh from Python: 40 bytes there and back between two processes, read by `recv` of a FIFO.

The link and the publishers are those of `zenoh_lockstep`, and no FMU is stepped.
"""

from __future__ import annotations

import tempfile
from multiprocessing.connection import Connection
from time import perf_counter

from zenoh.handlers import FifoChannel

from benchmarks.contestants.entry import main, nodes, versions
from benchmarks.contestants.zenoh_lockstep import hello, publisher, session_of
from benchmarks.task import Outcome, Task

__all__: list[str] = []

_BYTES = 40


def run(task: Task) -> Outcome:
    """Timed are all round trips together."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder, session_of(folder, "there", []) as session:
        answers = session.declare_subscriber("bench/back", FifoChannel(64))
        asking = publisher(session, "bench/forth")
        here = session.declare_queryable("bench/hello/there", FifoChannel(64))
        with nodes(_back, [(folder,)]):
            with here.recv() as query:
                query.reply(query.key_expr, b"")
            put, recv, data = asking.put, answers.handler.recv, bytes(_BYTES)
            started = perf_counter()
            for _ in range(task.points):
                put(data)
                recv().payload.to_bytes()
            seconds = perf_counter() - started
            put(b"")
    return Outcome(seconds, versions=versions("eclipse-zenoh"))


def _back(_pipe: Connection, folder: str) -> None:
    with session_of(folder, "back", ["there"]) as session:
        asked = session.declare_subscriber("bench/forth", FifoChannel(64))
        answering = publisher(session, "bench/back")
        hello(session, "there")
        put, recv = answering.put, asked.handler.recv
        while data := recv().payload.to_bytes():
            put(data)


if __name__ == "__main__":
    main(run)
