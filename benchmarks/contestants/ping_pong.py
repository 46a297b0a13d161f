"""The physical limit: 16 bytes there and back between two processes, in C or in Python.

One round trip is the least that one step of a coupled pair costs. Options: `transport` (`memory`, `unix` or `tcp`),
`language` (`c` or `python`; `memory` only in C), and `cores`: `one` keeps both processes on one core, where a message
wakes no sleeping core up. Option `spins`, in C: `trip` or `exchange` (both send at once, as in a Jacobi cycle) of so
many `bytes` over sockets, and who waits spins.
"""

from __future__ import annotations

import os
import platform
import socket
import subprocess
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter

from benchmarks.contestants.entry import compiled, main, nodes
from benchmarks.task import Outcome, Task

__all__ = ["run"]

_BYTES = 16
_SOURCE = Path(__file__).with_suffix(".c")


def run(task: Task) -> Outcome:
    """Timed are all round trips together; the C program times itself."""
    if task.options.get("cores") == "one":
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if task.options["language"] == "c":
        return _in_c(task)
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        listener = _listen(task.options["transport"], folder)
        with listener, nodes(_pong, [(task.options["transport"], listener.getsockname())]):
            connection, _ = listener.accept()
            with connection:
                _configure(connection, task.options["transport"])
                seconds = _ping(connection, task.points)
    return Outcome(seconds, versions={"python": platform.python_version()})


def _ping(connection: socket.socket, count: int) -> float:
    data = bytearray(_BYTES)
    send, receive = connection.sendall, connection.recv_into
    started = perf_counter()
    for _ in range(count):
        send(data)
        receive(data, _BYTES, socket.MSG_WAITALL)
    return perf_counter() - started


def _pong(_pipe: Connection, transport: str, address: str | tuple[str, int]) -> None:
    with socket.socket(socket.AF_UNIX if transport == "unix" else socket.AF_INET) as connection:
        connection.connect(address)
        _configure(connection, transport)
        data = bytearray(_BYTES)
        while connection.recv_into(data, _BYTES, socket.MSG_WAITALL):
            connection.sendall(data)


def _listen(transport: str, folder: str) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX if transport == "unix" else socket.AF_INET)
    listener.bind(f"{folder}/socket" if transport == "unix" else ("127.0.0.1", 0))
    listener.listen()
    return listener


def _configure(connection: socket.socket, transport: str) -> None:
    if transport == "tcp":
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _in_c(task: Task) -> Outcome:
    program, compiler = compiled(_SOURCE)
    command = [str(program), task.options["transport"], str(task.points)]
    if "spins" in task.options:
        command += [task.options["spins"], task.options["bytes"]]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
    return Outcome(float(output), versions=compiler)


if __name__ == "__main__":
    main(run)
