"""The way of a `Run` into its mesh, and how it learns that the mesh has ended."""

from __future__ import annotations

import time
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import (
    CallRefused,
    DeadlineExceeded,
    FmuMeshError,
    Interrupted,
    KeyboardInterrupted,
    MeshLost,
    from_report,
)
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes

if TYPE_CHECKING:  # whoever attaches to a mesh needs nothing that starts one
    from .result import Result
    from .run_thread import RunThread

__all__ = ["TIMEOUT_S", "ended_by_keyboard", "follow", "reach"]

TIMEOUT_S = 5.0
"""Default deadline of a question in s."""

_LOOK_S = 0.2
_FOREVER_S = 1e9


def reach(own: RunThread, name: str, way: ExitStack) -> MeshClient:
    """The mesh of a run that this process has started, once it can be reached.

    Args:
        own: the run.
        name: the name of the mesh.
        way: closes what this opens.

    Raises:
        CallRefused: the run is in this process.
        DeadlineExceeded: it has not started in time.
        MeshLost: it has ended.
    """
    if own.in_process:
        hint = "Start it with processes=True, or step it by hand with `Mesh.open`."
        raise CallRefused(f"the run of mesh '{name}' is in this process, where nobody can reach it", hint=hint)
    timeout = own.plan.loaded.config.timeouts.start
    if not own.reached.wait(timeout):
        raise DeadlineExceeded(f"mesh '{name}' cannot be reached within {timeout:g} s")
    if not own.endpoints:
        raise MeshLost(f"the run of mesh '{name}' has ended")
    meshes = way.enter_context(Meshes(own.endpoints[:1], TIMEOUT_S))
    with meshes.changes() as wait:
        end = time.monotonic() + timeout
        while (client := meshes.appeared(name)) is None:
            if time.monotonic() > end or own.future.done():
                raise MeshLost(f"mesh '{name}' does not answer")
            wait(_LOOK_S)
            meshes.look()
    return client


def follow(client: MeshClient, future: Future[Result]) -> None:
    """Follow a mesh that somebody else has started to its end."""
    from .result import Result  # noqa: PLC0415  not for those who only look

    try:
        file, last = client.info().result_file, None
        with client.statuses(_FOREVER_S) as statuses:
            for status in statuses:
                last = status
        if last is not None and last.error is not None:
            future.set_exception(from_report(last.error))
        else:
            future.set_result(Result(client.keys.mesh, file=Path(file) if file is not None else None))
    except BaseException as error:  # noqa: BLE001 whoever waits gets it
        future.set_exception(error)


def ended_by_keyboard(own: RunThread) -> FmuMeshError:
    """End a run on Ctrl-C, and return its error; a second Ctrl-C does not wait for its processes."""
    while True:
        own.interrupt()
        try:
            result = own.future.result()
        except KeyboardInterrupt as error:
            if own.future.done() and own.future.exception() is error:
                return error if isinstance(error, FmuMeshError) else Interrupted("interrupted")
        except Interrupted as error:
            named = KeyboardInterrupted(error.message, point=error.point, time=error.time, hint=error.hint)
            return named.with_result(error.result)
        except FmuMeshError as error:
            return error
        else:
            return KeyboardInterrupted("interrupted").with_result(result)
