"""A running mesh in the hands of a program: look, set, steer, wait."""

# Threads: a `Run` may be used from any. `_opening` is held while the way into the mesh is opened or closed; it can be
# taken again, because whoever asks for the end may be the first who needs the way. The end of a mesh that somebody else
# started is followed on a thread "end"; that of an own run comes from its `RunThread`.

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from msgspec.structs import replace

from ..config.call_options import checked, takes
from ..config.plain_values import plain
from ..errors import CallRefused, ConfigurationError, FmuMeshError, MeshLost
from ..installing import importing
from ..pictures.notebook_progress import ShownProgress, awaited, progress_of
from ..ros.bags.play_options import PlayOptions
from ..run.options import ResetOptions, StartOptions
from ..text import shown
from ..wire.client.mesh_client import MeshClient
from ..wire.client.readings import Target
from ..wire.client.waiting import begun_again, replay, wait_for, wait_for_start
from ..wire.views import (
    AuditView,
    Command,
    CommandAnswer,
    InstanceInfo,
    InstanceStatus,
    LogLine,
    MeshInfo,
    MeshState,
    MeshStatus,
    SetAnswer,
    VariableView,
)
from .samples import Sample, Watch, follow_to_end, sample_of, target_of, targets_of

if TYPE_CHECKING:  # whoever attaches to a mesh needs nothing that plans or starts one
    from ..pictures.system_graph import SystemGraph
    from ..ros.bags.bag import Bag
    from ..ros.bags.playing import Played
    from ..run.run_plan import RunPlan
    from ..wire.messages import SetValue
    from .live_view import LiveView
    from .result import Result
    from .run_thread import RunThread

__all__ = ["TIMEOUT_S", "Run"]

TIMEOUT_S = 5.0
"""Default deadline of a question in s."""

_WAIT_S = 60.0


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
        ...     answer = run.stop()
        ...     float(run.wait()["gain.y"][-1])
        10
        3.0
        3.0
    """

    def __init__(
        self, name: str, *, own: RunThread | None = None, attached: tuple[MeshClient, ExitStack] | None = None
    ) -> None:
        self.name = name
        self._own = own
        self._found: MeshClient | None
        self._found, self._way = attached if attached is not None else (None, ExitStack())
        self._opening = threading.RLock()
        self._closed = False
        self._begun = False
        self._targets: dict[str, list[Target]] = {}  # what a mesh has does not change, so a name is looked up once
        self._ended: Future[Result] | None = own.future if own is not None else None

    @classmethod
    @takes(StartOptions)
    def start(cls, plan: RunPlan, options: StartOptions) -> Self:
        """Start a run that `Mesh.plan` has planned; `Mesh.start` does both.

        Args:
            plan: the plan of the run.
            options: see `StartOptions`.

        Raises:
            CallRefused: its results do not fit into memory.
        """
        from ..run.run_plan import RunPlan  # noqa: PLC0415  not for those who attach to a mesh
        from .run_thread import RunThread  # noqa: PLC0415  as above

        if not isinstance(plan, RunPlan):
            raise CallRefused(f"`plan` is {shown(plan)}; expected what `Mesh.plan` returns")
        return cls(plan.mesh, own=RunThread(plan, options))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._closed else "started here" if self._own is not None else "attached"
        now = self._progress()
        return f"<Run of mesh {now.text if now is not None else self.name} ({state})>"

    def _repr_html_(self) -> str | None:
        now = self._progress()
        return now.html if now is not None else None

    def _progress(self) -> ShownProgress | None:
        """How far a run is that was started here; nobody is asked."""
        status = self._own.status if self._own is not None else None
        return progress_of(self.name, status) if status is not None else None

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

    @checked
    def instance_info(self, instance: str) -> InstanceInfo:
        """What an instance is: model, variables, connections, process."""
        return self._client().instance_info(instance)

    @checked
    def instance_status(self, instance: str) -> InstanceStatus:
        """How far an instance is, and what it is doing."""
        return self._client().instance_status(instance)

    def all_status(self) -> tuple[MeshStatus, dict[str, InstanceStatus]]:
        """The status of the mesh and of its instances, with one question; instances that do not answer are left out.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run:
            ...     point = run.wait_for("paused").point
            ...     status, instances = run.all_status()
            ...     status.state, sorted(instances)
            ('paused', ['delay', 'pendulum'])
        """
        return self._client().all_status()

    def graph(self) -> SystemGraph:
        """The graph of the mesh, with the state and the speed of each instance, and defects, while it runs.

        `SystemGraph.with_status` renews these without another question for what does not change.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run:
            ...     point = run.wait_for("paused").point
            ...     print([(node.instance, node.state) for node in run.graph().nodes])
            [('pendulum', 'running'), ('delay', 'running')]
        """
        from ..pictures.system_graph import graph_of_infos, graph_of_plan  # noqa: PLC0415  only this needs it

        if self._own is None:
            mesh = self._client().info()
            infos = [*map(self._client().instance_info, mesh.instances)]
            graph = replace(graph_of_infos(self.name, infos), topics=mesh.topics)
        else:
            graph = graph_of_plan(self._own.plan.plan)
            if self._own.in_process or self._own.future.done():
                return graph
        status, instances = self._client().all_status()
        return graph.with_status(instances, defects=status.defects)

    @property
    def variables(self) -> dict[str, VariableView]:
        """All variables of the mesh by `instance.variable`."""
        client = self._running()
        return {target.name: target.variable for target in client.targets("*")}

    # --- values

    @checked
    def get(self, name: str) -> Any:  # noqa: ANN401  the type follows from the variable
        """The current value of `instance.variable`.

        Returns:
            A number, truth value, text or bytes; an array as a numpy array, which belongs to the caller.

        Raises:
            UnknownName: there is no such variable (suggests the nearest one), or a pattern means several.
        """
        if len(self._targets.get(name, ())) != 1:
            self._targets[name] = [target_of(self._running(), name)]
        return self.samples(name)[0].value

    @checked
    def samples(self, *names: str) -> list[Sample]:
        """The current values of several variables, each with its point; patterns mean all that they match."""
        client = self._running()
        for name in names:
            self._targets[name] = self._targets.get(name) or targets_of(client, name)
        targets = {target.key: target for name in names for target in self._targets[name]}
        return [sample_of(reading, targets[reading.key].variable) for reading in client.get(list(targets.values()))]

    @checked
    def set(self, name: str, value: object, *, at: float | None = None) -> SetAnswer:
        """Give an unconnected input or a tunable parameter a value.

        Args:
            name: `instance.variable`.
            value: a Python or numpy value of its type; an Enumeration by name or number.
            at: simulation time in s from which on the value holds, before the end of the simulation and, without a stop
                time, at most 1e6 s ahead; None: from the next point on.

        Returns:
            The point, and its time in s, from which on the value holds; `late` says that the time asked for was past.

        Raises:
            CallRefused: the variable cannot be set, or takes no such value; says why.
        """
        client = self._running()
        try:
            return client.set(target_of(client, name, to_set=True), value, at)
        except ConfigurationError as error:
            raise CallRefused(error.message, hint=error.hint) from error

    @checked
    def watch(self, *names: str) -> Watch:
        """Every value of variables from now on, until the mesh ends; patterns mean all that they match.

        A reader that falls far behind loses the newest values; the points tell which.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", stop_time=0.01, paused=True) as run:
            ...     samples = run.watch("delay.y")
            ...     answer = run.resume()
            ...     [sample.point for sample in samples][-1]
            5
        """
        client = self._running()
        return Watch(client, targets_of(client, *names))

    @checked
    def view(self, *names: str) -> LiveView:
        """A live cell in a notebook, which draws numbers over time until the mesh ends.

        Of a long run, a curve has the least and the largest value of each of 400 sections of time. Where values were
        lost, because the mesh is faster than this program can follow, there is no line.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", stop_time=0.1, paused=True) as run:
            ...     view = run.view("delay.y", "pendulum.a")
            ...     answer, result = run.resume(), run.wait()
            >>> view
            <LiveView of pendulum_delay: delay.y, pendulum.a, ended>

        Args:
            names: at most 10 variables, or patterns; none: the first 10 outputs.

        Raises:
            UnknownName: there is no such variable.
            CallRefused: too many of them, or none of them, are numbers.
            LibraryMissing: anywidget is not installed.
        """
        with importing("anywidget"):
            from .live_view import live_view  # noqa: PLC0415  anywidget is an extra
        view = live_view(self._running(), names)
        with self._opening:
            self._way.callback(view.stop)
        return view

    def logs(self, *, follow: bool = False) -> Iterator[LogLine]:
        """The log messages of FMUs that the mesh has kept, the oldest first.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run:
            ...     [line.message for line in run.logs()]
            []

        Args:
            follow: whether all new ones follow, until the mesh ends.
        """
        with self._client().logs(follow=follow) as lines:
            yield from lines

    def audit(self) -> AuditView:
        """Who has joined the mesh at a network, set a value, commanded, or was refused, the oldest first."""
        return self._client().audit()

    @takes(PlayOptions)
    def play(self, bag: str | Path | Bag, options: PlayOptions) -> Played:
        """Send the messages of a recorded bag to inputs of the mesh, each at the point of its stamp.

        The mesh is paused at each of these points, so the result depends on the bag alone.

        Args:
            bag: an MCAP file, or the folder of a `ros2 bag`; or a bag that is open.
            options: see `PlayOptions`.

        Returns:
            How many values were set, and from which point to which.

        Raises:
            ConfigurationError: the bag has no message of these topics, or an input takes no such value.
            DeadlineExceeded: the mesh does not come to the next message.
        """
        from ..ros.bags.bag import Bag  # noqa: PLC0415  not for those who only look
        from ..ros.bags.playing import play_bag  # noqa: PLC0415  as above

        loaded = self._own.plan.loaded if self._own is not None else None
        if not isinstance(bag, str | Path | Bag):
            raise CallRefused(f"`bag` is {shown(bag)}; expected the path of a bag, or a `Bag`")
        with nullcontext(bag) if isinstance(bag, Bag) else Bag(Path(bag)) as opened:
            return play_bag(self._running(), opened, loaded, options)

    def replay(self, values: Sequence[SetValue], last_point: int | None = None) -> None:
        """Set values at exact points, as the metadata of a result have them (`rerun`).

        The mesh is paused at each of these points until its value is set, and then goes on.

        Args:
            values: what to set; each at its own `point`, which is not past.
            last_point: the point at which the mesh is stopped; None: it runs to its end.

        Raises:
            CallRefused: a variable cannot be set, or takes no such value.
            MeshLost: the mesh has ended, or another program controls it too.
        """
        replay(self._running(), values, last_point)
        if last_point is not None:
            self.stop()

    # --- steering

    @checked
    def pause(self, *, timeout: float | None = None) -> CommandAnswer:
        """Pause the mesh; returns when all instances have reached the point of the answer.

        Raises:
            DeadlineExceeded: they have not in ``timeout`` s, by default that of every question; the mesh pauses later.
            MeshLost: the mesh has ended, or another program has let it run on or pause elsewhere.
        """
        return self._steered().rest(Command("pause"), timeout)

    @checked
    def step(self, points: int = 1, *, timeout: float | None = None) -> CommandAnswer:
        """Run some points and pause again; returns when the mesh has paused. For ``timeout`` and errors see `pause`."""
        return self._steered().rest(Command("step", points), timeout)

    @checked
    def checkpoint(self, file: str | Path, *, timeout: float | None = None) -> int:
        """Write the states of all instances at one point into a file, while the mesh goes on.

        A run, a sweep and `Mesh.open` begin with it: ``state=file``. It replaces a file of this name.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", stop_time=0.1, paused=True) as run:
            ...     run.step(10).point, run.checkpoint("ten.state")
            (10, 10)
            >>> len(mesh.run(record="memory", stop_time=0.1, state="ten.state").times)
            41

        Returns:
            The point of the states.

        Raises:
            ConfigurationError: an instance has no state, there is none in ``timeout`` s (by default that of every
                question), or for another reason; or the file cannot be written.
        """
        from ..run.state_file import StateFile, write_state  # noqa: PLC0415  only this needs it

        write_state(Path(file), self._steered().checkpoint(timeout))
        return StateFile.read(Path(file)).head.point

    def resume(self) -> CommandAnswer:
        """Go on after a pause."""
        return self._steered().command(Command("resume"))

    @takes(ResetOptions)
    def reset(self, options: ResetOptions) -> CommandAnswer:
        """Begin again at point 0, in the same processes; returns when the mesh is there.

        The run so far ends: its result is complete, is one of `results`, and the next one has its name with a number,
        such as `rows-2.csv`. The instances are made anew, with the start values of the configuration and those that are
        given here. Values that were `set` are gone, and so is the progress of the scenario. A mesh that was paused, or
        was in a `step`, is paused at point 0; one that was running goes on.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", stop_time=0.1, paused=True) as run:
            ...     answer = run.step(10)
            ...     run.reset(start_values={"pendulum.a": 0.5}).point
            ...     answer, last = run.resume(), run.wait()
            0
            >>> [len(result.times) for result in run.results], len(last.times), float(last["pendulum.a"][0])
            ([11], 51, 0.5)

        Args:
            options: see `ResetOptions`.

        Raises:
            ConfigurationError: a start value is wrong, or changes the size of an array. Nothing has changed.
            DeadlineExceeded: the mesh does not begin in time.
            FmuMeshError: an instance could not be made anew, and the run has failed.
        """
        return begun_again(self._steered(), Command("reset", start_values=plain(dict(options.start_values or {}))))

    @property
    def results(self) -> tuple[Result, ...]:
        """The results of the runs that a `reset` has ended, in order; `wait` returns that of the last one."""
        return tuple(self._own.results) if self._own is not None else ()

    def interrupt(self) -> None:
        """End a run that was started here, so that `wait` raises `Interrupted`; a second call waits for no process.

        It may be called in a signal handler.

        Raises:
            CallRefused: the run was started by somebody else.
        """
        if self._own is None:
            raise CallRefused(f"mesh '{self.name}' was started by somebody else", hint="`stop` ends it.")
        self._own.interrupt()

    def stop(self) -> CommandAnswer | None:
        """End the run; what was recorded is kept. `wait` then returns the result of a run that was started here.

        Returns:
            The answer of the mesh; None if it has ended, has not begun, or runs in this process.
        """
        if self._own is None:
            return self._client().command(Command("stop"))
        if self._own.future.done():
            return None
        self._own.expect_stop()
        try:
            return self._client().command(Command("stop"))
        except FmuMeshError:
            self._own.stop()  # it has not begun, or runs in this process
            return None

    @checked
    def wait_for(self, state: MeshState, timeout: float = _WAIT_S) -> MeshStatus:
        """Wait until the mesh is in a state, such as "paused".

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run:
            ...     run.wait_for("paused").point
            0

        Args:
            state: "starting", "initializing", "restarting", "running", "paused", "stopping", "done" or "failed".
            timeout: the longest time to wait in s.

        Raises:
            DeadlineExceeded: it was not in this state in time.
            MeshLost: it has ended before.
            FmuMeshError: it has failed before.
        """
        if self._own is not None and self._own.future.done() and self.status.state == state:
            return self.status
        return wait_for(self._client(), state, timeout)

    # --- the end

    @contextmanager
    def until_end(self, tell: Callable[[], None] = lambda: None) -> Iterator[threading.Event]:
        """An event that is set when the mesh ends or is gone; then ``tell`` is called, on another thread.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run, run.until_end() as ended:
            ...     answer = run.stop()
            ...     ended.wait(10.0)
            True
        """
        with self._client().until_end(tell) as ended:
            yield ended

    @checked
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
            return awaited(future, timeout, f"the run of '{self.name}'", self._progress)
        except KeyboardInterrupt:
            if self._own is None:
                raise
            raise self._own.end_by_keyboard() from None

    async def wait_async(self) -> Result:
        """As `wait`, without blocking the event loop of asyncio; a cancelled wait leaves the run as it is.

        Example:
            >>> import asyncio
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> async def both():
            ...     with mesh.start(stop_time=1.0, output=None, record="memory") as run:
            ...         return await run.wait_async()
            >>> len(asyncio.run(both()).times)
            501
        """
        import asyncio  # noqa: PLC0415  slow to import for a command

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
            self._way.close()

    def _end(self) -> Future[Result]:
        """The end of the run; that of a mesh that was found is followed on a thread."""
        with self._opening:
            if self._ended is None:
                future: Future[Result] = Future()
                self._ended, client = future, self._client()
                threading.Thread(target=follow_to_end, args=(client, future), name="end", daemon=True).start()
            return self._ended

    def _client(self) -> MeshClient:
        """The way into the mesh; opened when it is first needed.

        Raises:
            CallRefused: this handle is closed, or the run is in this process.
            MeshLost: the run has ended.
        """
        with self._opening:
            if self._closed:
                hint = "The values of its run are in `run.wait()`." if self._own is not None else None
                raise CallRefused(f"this handle of mesh '{self.name}' is closed", hint=hint)
            if self._own is not None:
                self._own.over()
            if self._found is None:
                assert self._own is not None  # otherwise it was found by whoever made this
                self._found = self._own.reach(self._way, TIMEOUT_S)
            return self._found

    def _running(self) -> MeshClient:
        """As `_client`, when the mesh has come to its first point.

        Raises:
            DeadlineExceeded: it has not, in time.
        """
        client = self._client()
        with self._opening:
            if not self._begun:
                wait_for_start(client)
                self._begun = True
        return client

    def _steered(self) -> MeshClient:
        """As `_running` for a run that was started here; a mesh that was found takes commands when it takes them."""
        return self._client() if self._own is None else self._running()
