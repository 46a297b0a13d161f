"""A running mesh in the hands of a program: look, set, steer, wait."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..errors import (
    CallRefused,
    ConfigurationError,
    DeadlineExceeded,
    FmuMeshError,
    Interrupted,
    KeyboardInterrupted,
    MeshLost,
    from_report,
)
from ..wire.client.mesh_client import MeshClient
from ..wire.client.reaching import Meshes
from ..wire.client.waiting import rest
from ..wire.views import (
    Command,
    CommandAnswer,
    InstanceInfo,
    InstanceStatus,
    MeshInfo,
    MeshStatus,
    SetAnswer,
    VariableView,
)
from .notebook_progress import NotebookProgress
from .result import Result
from .run_thread import RunThread
from .samples import Sample, Watch, sample_of, targets_of

__all__ = ["TIMEOUT_S", "Run"]

TIMEOUT_S = 5.0
"""Default deadline of a question in s."""

_LOOK_S = 0.2
_FOREVER_S = 1e9
_START_S = 120.0


class Run:
    """A running mesh: one that `Mesh.start` has started, or one that `attach` has found.

    All methods may be called from any thread. Each raises a `FmuMeshError` if the mesh refuses, does not answer in
    time, or has ended. As a context manager, a run that was started here is stopped at the end of the block, unless it
    has ended; one that was found is only let go.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=60.0, real_time_factor=1.0)
        >>> mesh.add("gain", fmu="fmus/Gain.fmu")
        >>> with mesh.start(paused=True, record="memory") as run:
        ...     answer = run.set("gain.u", 3.0)
        ...     run.step(10).point
        ...     run.get("gain.y")
        ...     run.stop()
        ...     float(run.wait()["gain.y"][-1])
        10
        3.0
        3.0
    """

    def __init__(self, name: str, *, own: RunThread | None = None, meshes: Meshes | None = None) -> None:
        self.name = name
        self._own = own
        self._meshes = meshes
        self._found = meshes.one(None) if meshes is not None else None
        self._opening = threading.RLock()
        self._closed = False
        self._begun = False
        self._ended: Future[Result] | None = own.future if own is not None else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._closed else "started here" if self._own is not None else "attached"
        return f"<Run of mesh '{self.name}' ({state})>"

    # --- looking

    @property
    def status(self) -> MeshStatus:
        """State, point, time and speed of the mesh right now; after the end, the last ones."""
        if self._own is not None and (self._own.future.done() or self._own.in_process):
            if self._own.status is None:
                raise MeshLost(f"mesh '{self.name}' has ended before it had a status")
            return self._own.status
        return self._client().status()

    def info(self) -> MeshInfo:
        """What the mesh is: its times, nodes, instances, result file and endpoints."""
        return self._client().info()

    def instance_info(self, instance: str) -> InstanceInfo:
        """What an instance is: model, variables, connections, process."""
        return self._client().instance_info(instance)

    def instance_status(self, instance: str) -> InstanceStatus:
        """How far an instance is, and what it is doing."""
        return self._client().instance_status(instance)

    @property
    def variables(self) -> dict[str, VariableView]:
        """All variables of the mesh by `instance.variable`."""
        client = self._running()
        return {f"{target.instance}.{target.variable.name}": target.variable for target in client.targets("*.*")}

    # --- values

    def get(self, name: str) -> Any:  # noqa: ANN401  the type follows from the variable
        """The current value of `instance.variable`.

        Returns:
            A number, truth value, text or bytes; an array as a numpy array, which belongs to the caller.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
        """
        return self.samples(name)[0].value

    def samples(self, *names: str) -> list[Sample]:
        """The current values of several variables, each with its point; `*` in a name stands for any characters."""
        client = self._running()
        targets = {target.key: target for name in names for target in targets_of(client, name)}
        return [sample_of(reading, targets[reading.key].variable) for reading in client.get(list(targets.values()))]

    def set(self, name: str, value: object, *, at: float | None = None) -> SetAnswer:
        """Give an unconnected input or a tunable parameter a value.

        Args:
            name: `instance.variable`.
            value: a Python or numpy value of its type; an Enumeration by name or number.
            at: simulation time in s from which on the value holds; None: from the next point on.

        Returns:
            The point, and its time in s, from which on the value holds.

        Raises:
            CallRefused: the variable cannot be set, or takes no such value; says why.
        """
        client = self._running()
        try:
            return client.set(targets_of(client, name)[0], value, at)
        except ConfigurationError as error:
            raise CallRefused(error.message, hint=error.hint) from error

    def watch(self, *names: str) -> Watch:
        """Every value of variables from now on, until the mesh ends; `*` in a name stands for any characters.

        A reader that falls far behind loses the newest values; the points tell which.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", stop_time=0.01, paused=True) as run:
            ...     samples = run.watch("delay.y")
            ...     answer = run.resume()
            ...     [sample.point for sample in samples][-1]
            5
        """
        client = self._running()
        targets = {target.key: target for name in names for target in targets_of(client, name)}
        return Watch(client, targets)

    # --- steering

    def pause(self) -> CommandAnswer:
        """Pause the mesh; returns when all instances have reached the point of the answer."""
        return rest(self._running(), Command("pause"))

    def step(self, points: int = 1) -> CommandAnswer:
        """Run some points and pause again; returns when the mesh has paused."""
        return rest(self._running(), Command("step", points))

    def resume(self) -> CommandAnswer:
        """Go on after a pause."""
        return self._running().command(Command("resume"))

    def stop(self) -> None:
        """End the run; what was recorded is kept. `wait` then returns the result of a run that was started here."""
        if self._own is None:
            self._client().command(Command("stop"))
        elif not self._own.future.done():
            self._own.expect_stop()
            try:
                self._client().command(Command("stop"))
            except FmuMeshError:
                self._own.stop()  # it has not begun, or runs in this process

    # --- the end

    def wait(self, timeout: float | None = None) -> Result:
        """Wait for the end of the run.

        Ctrl-C ends a run that was started here, and raises `KeyboardInterrupted`.

        Args:
            timeout: the longest time to wait in s; None: no limit.

        Raises:
            DeadlineExceeded: the run goes on after this time.
            FmuMeshError: the run ended early, and why; its `result` has what was recorded up to then.
        """
        future = self._end()
        try:
            return self._wait(future, timeout)
        except KeyboardInterrupt:
            if self._own is None:
                raise
            self._own.interrupt()
        error = self._ended_by_keyboard(future)
        raise error

    async def wait_async(self) -> Result:
        """As `wait`, without blocking the event loop of asyncio; a cancelled wait leaves the run as it is.

        Example:
            >>> import asyncio, fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> async def both():
            ...     with mesh.start(stop_time=1.0, output=None, record="memory") as run:
            ...         return await run.wait_async()
            >>> len(asyncio.run(both()).times)
            501
        """
        return await asyncio.shield(asyncio.wrap_future(self._end()))

    def close(self) -> None:
        """Let go of the mesh; a run that was started here is stopped. May be called twice."""
        with self._opening:
            if self._closed:
                return
            if self._own is not None and not self._own.future.done():
                self._own.stop()
                self._own.join()
            self._closed = True
            if self._meshes is not None:
                self._meshes.__exit__(None, None, None)

    def _wait(self, future: Future[Result], timeout: float | None) -> Result:
        end = time.monotonic() + timeout if timeout is not None else None
        with NotebookProgress.here(self.name) as progress:
            while True:
                left = _LOOK_S if end is None else min(_LOOK_S, end - time.monotonic())
                try:
                    return future.result(max(left, 0.0))
                except NotYet:
                    if future.done():
                        raise  # an error of the run that happens to be of this class
                    if end is not None and time.monotonic() >= end:
                        text = f"the run of '{self.name}' has not ended within {timeout:g} s"
                        raise DeadlineExceeded(text, hint="It goes on; wait again, or stop it.") from None
                if self._own is not None and self._own.status is not None:
                    progress.update(self._own.status)

    def _ended_by_keyboard(self, future: Future[Result]) -> FmuMeshError:
        """The error for a run that Ctrl-C has ended; a second Ctrl-C does not wait for its processes."""
        assert self._own is not None
        while True:
            try:
                future.result()
            except KeyboardInterrupt as error:
                if future.done() and future.exception() is error:
                    return error if isinstance(error, FmuMeshError) else Interrupted("interrupted")
                self._own.interrupt()
                continue
            except Interrupted as error:
                return _by_keyboard(error)
            except FmuMeshError as error:
                return error
            return KeyboardInterrupted("interrupted").with_result(future.result())

    def _end(self) -> Future[Result]:
        """The end of the run; that of a mesh that was found is followed on a thread."""
        with self._opening:
            if self._ended is None:
                self._ended = future = Future[Result]()
                client = self._client()
                threading.Thread(target=_follow, args=(client, future), name="end", daemon=True).start()
            return self._ended

    def _client(self) -> MeshClient:
        """The way into the mesh; opened when it is first needed.

        Raises:
            CallRefused: this handle is closed, or the run is in this process.
            MeshLost: the run has ended.
        """
        with self._opening:
            if self._closed:
                raise CallRefused(f"this handle of mesh '{self.name}' is closed")
            if self._found is None:
                self._found = self._reach()
            if self._own is not None and self._own.future.done():
                raise MeshLost(f"the run of mesh '{self.name}' has ended")
            return self._found

    def _running(self) -> MeshClient:
        """As `_client`, when the mesh has come to its first point.

        Raises:
            DeadlineExceeded: it has not, in time.
        """
        client = self._client()
        with self._opening:
            if not self._begun:
                _wait_until_it_runs(client)
                self._begun = True
        return client

    def _reach(self) -> MeshClient:
        own = self._own
        assert own is not None
        if own.in_process:
            hint = "Start it with processes=True, or step it by hand with `Mesh.open`."
            raise CallRefused(f"the run of mesh '{self.name}' is in this process, where nobody can reach it", hint=hint)
        timeout = own.plan.loaded.config.timeouts.start
        if not own.reached.wait(timeout):
            raise DeadlineExceeded(f"mesh '{self.name}' cannot be reached within {timeout:g} s")
        if not own.endpoints:
            raise MeshLost(f"the run of mesh '{self.name}' has ended")
        meshes = Meshes(own.endpoints[:1], TIMEOUT_S)
        self._meshes = meshes.__enter__()
        with meshes.changes() as wait:
            end = time.monotonic() + timeout
            while (client := meshes.appeared(self.name)) is None:
                if time.monotonic() > end or own.future.done():
                    raise MeshLost(f"mesh '{self.name}' does not answer")
                wait(_LOOK_S)
                meshes.look()
        return client


def _wait_until_it_runs(client: MeshClient) -> None:
    """Wait until the mesh is past its initialization.

    Raises:
        DeadlineExceeded: it is not, in time.
    """
    with client.statuses(_START_S) as statuses:
        for status in statuses:
            if status.state not in ("starting", "initializing"):
                return


def _by_keyboard(error: Interrupted) -> KeyboardInterrupted:
    named = KeyboardInterrupted(error.message, point=error.point, time=error.time, hint=error.hint)
    named.with_result(error.result)
    return named


def _follow(client: MeshClient, future: Future[Result]) -> None:
    """Follow a mesh that somebody else has started to its end."""
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
