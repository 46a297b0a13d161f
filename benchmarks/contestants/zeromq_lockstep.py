"""Hand-written ZeroMQ lockstep: a coordinator in the middle, one process per FMU, one packed message each way.

Every step the coordinator sends each node its input and waits for its output. The sockets are PAIR over Unix sockets,
the fastest that ZeroMQ has between processes.
"""

from __future__ import annotations

import struct
import tempfile
from multiprocessing.connection import Connection
from time import perf_counter

import zmq  # type: ignore[import-not-found] # of the peers

from benchmarks.contestants.entry import main, nodes, versions
from benchmarks.contestants.fmu import opened
from benchmarks.task import Outcome, Task

__all__: list[str] = []

_MESSAGE = struct.Struct("<qd")
_END = -1


def run(task: Task) -> Outcome:
    """Coordinate; timed is the coordinator's loop."""
    system = task.system
    context = zmq.Context()
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        addresses = [f"ipc://{folder}/{index}" for index in range(len(system.members))]
        sockets = [context.socket(zmq.PAIR) for _ in addresses]
        for socket, address in zip(sockets, addresses, strict=True):
            socket.bind(address)
        with nodes(_node, [(task, index, address) for index, address in enumerate(addresses)]):
            values = [_MESSAGE.unpack(socket.recv())[1] for socket in sockets]
            started = perf_counter()
            rows = _loop(task, sockets, values)
            seconds = perf_counter() - started
            for socket in sockets:
                socket.send(_MESSAGE.pack(_END, 0.0))
        context.destroy(linger=0)
    names = [member.column for member in system.members]
    return Outcome(seconds, dict(zip(names, rows[-1], strict=True)), versions("pyzmq", "fmpy"))


def _loop(task: Task, sockets: list[zmq.Socket[bytes]], values: list[float]) -> list[list[float]]:
    pack, unpack = _MESSAGE.pack, _MESSAGE.unpack
    stages = [
        [(index, task.system.source_of(index), sockets[index]) for index in stage] for stage in task.system.stages()
    ]
    rows = []
    for point in range(task.points):
        for stage in stages:
            for _, source, socket in stage:
                socket.send(pack(point, 0.0 if source is None else values[source]))
            for index, _, socket in stage:
                values[index] = unpack(socket.recv())[1]
        rows.append(list(values))
    return rows


def _node(_pipe: Connection, task: Task, index: int, address: str) -> None:
    pack, unpack = _MESSAGE.pack, _MESSAGE.unpack
    step_size, connected = task.system.step_size, task.system.source_of(index) is not None
    context = zmq.Context()
    socket = context.socket(zmq.PAIR)
    socket.connect(address)
    with opened(task, index) as instance:
        fmu, inputs, outputs = instance.fmu, instance.inputs, instance.outputs
        socket.send(pack(0, instance.get()))
        while True:
            point, value = unpack(socket.recv())
            if point == _END:
                break
            if connected:
                fmu.setReal(inputs, [value])
            fmu.doStep(currentCommunicationPoint=point * step_size, communicationStepSize=step_size)
            socket.send(pack(point + 1, fmu.getReal(outputs)[0]))
    context.destroy()


if __name__ == "__main__":
    main(run)
