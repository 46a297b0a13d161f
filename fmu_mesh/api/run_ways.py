"""The way of a `Run` into its mesh, and how it learns that the mesh has ended."""

from __future__ import annotations

from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import (
    CallRefused,
    ConfigurationError,
    DeadlineExceeded,
    FmuMeshError,
    Interrupted,
    KeyboardInterrupted,
    from_report,
)
from ..wire.client.mesh_client import MeshClient
from ..wire.keys import Keys
from ..wire.session import Wiring, close_session, open_session

if TYPE_CHECKING:  # whoever attaches to a mesh needs nothing that starts one
    from .result import Result
    from .run_thread import RunThread

__all__ = ["TIMEOUT_S", "ended_by_keyboard", "follow", "reach"]

TIMEOUT_S = 5.0
"""Default deadline of a question in s."""

_TRY_S = 0.25
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
    own.over()
    if own.in_process:
        hint = "Start it with processes=True, or step it by hand with `Mesh.open`."
        raise CallRefused(f"the run of mesh '{name}' is in this process, where nobody can reach it", hint=hint)
    config = own.plan.loaded.config
    if not own.reached.wait(config.timeouts.start):
        raise DeadlineExceeded(f"mesh '{name}' cannot be reached within {config.timeouts.start:g} s")
    patience_s = _TRY_S  # Zenoh tries for all of it, also if the mesh ends meanwhile
    while True:
        own.over()
        wiring = Wiring(mode="client", connect=own.endpoints[:1], patience_s=patience_s)
        try:
            session = open_session(wiring)
        except ConfigurationError as error:
            patience_s *= 2
            if patience_s > TIMEOUT_S:
                raise DeadlineExceeded(f"mesh '{name}' does not answer at {own.endpoints[0]}") from error
        else:
            way.callback(close_session, session)
            return MeshClient(session, Keys(config.zenoh.key_prefix, name), own.endpoints[:1], TIMEOUT_S, own.over)


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
