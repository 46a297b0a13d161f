"""The answers of the queryables as Structs: `info` and `status` of an instance and of the mesh (docs/key-space.md)."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec.structs import replace

from ..config.key_sections import KeyView
from ..config.ros_section import MeshTopic
from ..errors import ErrorReport
from ..simtime import ENDLESS
from ..system.defect import Defect
from ..text import counted
from ..variables.model_description import Clock, DefaultExperiment, PlainValue
from .runtime import this_host
from .solved_loop import SolvedLoop

__all__ = [
    "GOING_ON",
    "WAITING",
    "AuditEntry",
    "AuditView",
    "Command",
    "CommandAnswer",
    "ConnectionView",
    "InstanceInfo",
    "InstanceStatus",
    "KeyStatus",
    "LogLine",
    "MeshHello",
    "MeshInfo",
    "MeshState",
    "MeshStatus",
    "RosTopicView",
    "RosView",
    "SetAnswer",
    "VariableView",
    "Way",
]

MeshState = Literal["starting", "initializing", "restarting", "running", "paused", "stopping", "done", "failed"]

Way = Literal["ring", "stream", "zenoh"]
"""How rows go between two processes: by memory that both share, by a row stream, or in messages of Zenoh."""

GOING_ON: frozenset[MeshState] = frozenset(("starting", "initializing", "restarting", "running", "paused"))
"""The states of a mesh that has not ended."""


class VariableView(msgspec.Struct, frozen=True, omit_defaults=True):
    """One variable in `info`.

    Attributes:
        key: the key of its value, below that of the instance.
        minimum: the smallest value that its model description allows; None without one. So is ``maximum``.
        items: item names and values of an Enumeration.
        settable: whether it can be set while the mesh runs (`fmu_mesh.system.start_values`).
        timeout: what it does without a value, in words; None without a timeout.
    """

    name: str
    key: str
    type: str
    causality: str
    variability: str
    unit: str | None = None
    start: PlainValue | None = None
    description: str | None = None
    shape: tuple[int, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    items: tuple[tuple[str, int], ...] = ()
    settable: bool = False
    timeout: str | None = None


class ConnectionView(msgspec.Struct, frozen=True):
    """One connection in `info`.

    Attributes:
        map: what the input gets instead of a value, both as numbers.
        initial_only: whether it gives a parameter its value in the initialization, and has no part in the steps.
        way: how its values come from another process: `ring` (in shared memory), `stream` (a row stream) or `zenoh`;
            None within one process, and until all nodes are ready.
    """

    source: str = msgspec.field(name="from")
    target: str = msgspec.field(name="to")
    delay: int
    factor: float = 1.0
    offset: float = 0.0
    map: tuple[tuple[int, int], ...] = ()
    initial_only: bool = False
    way: Way | None = None

    @property
    def way_in_words(self) -> str:
        """Empty for the usual one, shared memory."""
        return {"stream": "row stream", "zenoh": "Zenoh"}.get(self.way or "", "")


class KeyStatus(KeyView, frozen=True):
    """What has come by a key, or gone to it, in `status`.

    Attributes:
        received: number of samples; for an output, of those that were published.
        replaced: those that a newer one replaced before the next point.
        refused: those that are no value for the variable.
        late: those that came after their time.
        disordered: those for an earlier time than the one before them.
        lost: those that were too many at once.
        rate: samples per second of wall-clock time.
        age: wall-clock time since the last one in s; None before the first.
    """

    received: int = 0
    replaced: int = 0
    refused: int = 0
    late: int = 0
    disordered: int = 0
    lost: int = 0
    rate: float = 0.0
    age: float | None = None

    @property
    def activity(self) -> str:
        """What came or went so far, in words."""
        if self.age is None:
            return "nothing so far"
        troubles = {name: getattr(self, name) for name in ("refused", "late", "disordered", "lost")}
        counts = (f"{count} {name}" for name, count in troubles.items() if count)
        silent = [f"silent for {self.age:.0f} s"] if self.age >= 1.0 else []
        return ", ".join([f"{self.rate:.3g}/s", *counts, *silent])


class InstanceInfo(msgspec.Struct, frozen=True):
    """Answer of `…/<instance>/info`.

    Attributes:
        host: the name that the system has; ``deploy_host``: the one in `deploy.hosts`, empty where `launch` runs.
        loops: how the algebraic loops with outputs of this instance were solved at the start.
    """

    instance: str
    model_name: str
    description: str | None
    fmi_version: str
    kind: str
    fmu: str
    generation_tool: str | None
    capabilities: dict[str, bool]
    default_experiment: DefaultExperiment
    step_size: float
    variables: tuple[VariableView, ...]
    connections: tuple[ConnectionView, ...]
    node: str
    pid: int
    host: str
    problems: tuple[str, ...]
    clocks: tuple[Clock, ...] = ()
    keys: tuple[KeyView, ...] = ()
    deploy_host: str = ""
    loops: tuple[SolvedLoop, ...] = ()

    def __repr__(self) -> str:
        counts = f"{counted(len(self.variables), 'variable')}, {counted(len(self.connections), 'connection')}"
        return f"<InstanceInfo of {self.instance}: {self.model_name}, {counts}>"


class InstanceStatus(msgspec.Struct, frozen=True):
    """Answer of `…/<instance>/status`, and what is published there about four times a second.

    Attributes:
        state: loading, waiting for the mesh, initializing, running, done or failed.
        activity: a text that says what the instance does at present, such as `in doStep at point 812 for 12.4 s`.
        time: simulation time in s.
        step_time: mean wall-clock time of a step in s.
        wait_time: wall-clock time spent waiting since the first point in s.
        running_time: wall-clock time since the first point in s.
        refused: messages that its process refused: malformed ones, and those of unknown senders.
        timed_out: the inputs without a value for longer than their timeout, and the points of their last values.
        keys: what has come by keys of connections, and gone to them.
        deploy_host: the host of `deploy.hosts` on which it runs; empty for that of `launch`.
        failed: since when its outputs are held, or have substitutes, and why; empty: it has not failed.
    """

    instance: str
    state: str
    activity: str
    point: int
    time: float
    step_time: float
    wait_time: float
    overruns: int = 0
    restarts: int = 0
    running_time: float = 0.0
    refused: int = 0
    timed_out: dict[str, int] = {}
    keys: tuple[KeyStatus, ...] = ()
    deploy_host: str = ""
    failed: str = ""

    def rates_since(self, before: InstanceStatus | None) -> tuple[float, float, float]:
        """Points per second, and the shares of the time in steps and waiting, since an earlier status.

        Without one, and after a restart, since the first point.
        """
        if before is None or before.running_time >= self.running_time or before.point > self.point:
            before = InstanceStatus(self.instance, "", "", 0, 0.0, 0.0, 0.0)
        wall_s = self.running_time - before.running_time
        if wall_s <= 0.0:
            return 0.0, 0.0, 0.0
        waiting = min(max(0.0, self.wait_time - before.wait_time) / wall_s, 1.0)
        steps_s = self.step_time * self.point - before.step_time * before.point
        return (self.point - before.point) / wall_s, min(max(0.0, steps_s) / wall_s, 1.0 - waiting), waiting


WAITING = "warning", "waiting"
"""Status and category of the line with which a node says once what an instance waits for."""


class LogLine(msgspec.Struct, frozen=True):
    """One line of `…/<instance>/log`, and of `…/mesh/log`, where ``number`` counts the lines of all from 1."""

    instance: str
    status: str
    category: str
    message: str
    point: int
    number: int = 0


class AuditEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of `…/mesh/audit`, and of `audit` in the metadata of results: who did something from outside.

    Attributes:
        what: `joined` a network; `set` a value; `commanded`; or was `refused`.
        who: the name of the certificate; without security, what the sender says of itself.
        time: the wall-clock time of the first time, in ISO 8601 (UTC).
        point: the communication point of the run then.
        key: the key at which it arrived; nothing for who joined.
        text: the command, the reason of a refusal, or the address of who joined.
        number: how often, for values and refusals at one key, and for a command that follows itself.
        last_time: when last; ``last_point``: at which point; both only if it was more than once.
    """

    what: Literal["joined", "set", "commanded", "refused"]
    who: str
    time: str
    point: int
    key: str = ""
    text: str = ""
    number: int = 1
    last_time: str = ""
    last_point: int = 0

    def and_again(self, new: AuditEntry) -> AuditEntry:
        """This entry after the same has happened again, as ``new`` says."""
        last_time, last_point = new.last_time or new.time, new.last_point or new.point
        return replace(self, number=self.number + new.number, last_time=last_time, last_point=last_point)

    def __str__(self) -> str:
        more = f" ({self.number} times, the last at point {self.last_point})" if self.last_time else ""
        return f"{self.who or 'somebody'} {self.what}: {self.text}{f' at {self.key}' if self.key else ''}{more}"


class AuditView(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/audit`: the newest entries in their order, and how many others are ``left_out``."""

    entries: tuple[AuditEntry, ...]
    left_out: int = 0


class SetAnswer(msgspec.Struct, frozen=True):
    """Answer to a query that sets an input or a parameter: the point from which on the value holds, and its time in s.

    It is ``late`` if the time that the query asked for was past.
    """

    key: str
    point: int
    time: float
    late: bool = False


class MeshInfo(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/info`.

    Attributes:
        run: the id of the run, which its internal keys contain; after a reset, of the first run.
        result_file: the first result file; None if nothing is recorded.
        shared_memory: the processes that exchange values, grants and progress through the memory of the master's host.
            Empty until all nodes are ready.
        row_streams: the pairs of processes that do it by a row stream; all others do it through Zenoh.
        topics: those in ROS.
        host_id: of the master's host; ``host`` is a name, which two hosts can have.
        deploy_hosts: the hosts of `deploy.hosts` by the nodes that run there.
    """

    mesh: str
    version: str
    run: str
    config: str
    start_time: float
    stop_time: float | None
    step_size: float
    algorithm: str
    window: int
    real_time_factor: float
    instances: tuple[str, ...]
    nodes: tuple[str, ...]
    result_file: str | None
    endpoints: tuple[str, ...]
    pid: int
    host: str
    shared_memory: tuple[str, ...] = ()
    row_streams: tuple[tuple[str, str], ...] = ()
    result_files: tuple[str, ...] = ()
    host_id: str = ""
    topics: tuple[MeshTopic, ...] = ()
    deploy_hosts: dict[str, str] = {}

    @property
    def is_here(self) -> bool:
        """Whether the master runs on this host, so that its paths are those of this process."""
        return self.host_id == this_host()


class MeshHello(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/hello` and `…/mesh/role/<role>`, in a mesh with `security`.

    Attributes:
        table: number of the table of roles that its master has.
    """

    mesh: str
    table: int


class MeshStatus(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/status`.

    Attributes:
        point: the last point that every instance has reached; ``time`` is its time in s.
        points_per_second: since the first point, or since the last pause.
        real_time_factor: simulated over wall-clock time since the first point.
        overruns: points by which the run fell behind the wall clock beyond `catch_up`.
        refused: messages that the master refused: malformed ones, and those of unknown senders.
        resets: how often the mesh was reset.
        cut: the nodes whose row streams to the master are cut, and for how long in s. Who is cut from another node says
            so in the `activity` of its instances.
        missing: while it starts, the nodes that are not ready.
        restarts: how often all processes were started again, because one was lost.
        restarting: while it comes back, such as `attempt 2 of 3, from point 812`.
        may_restart: whether it starts again if a process is lost.
        defects: with `simulation.defects`, by connection, in the rows of about a second ago; the 64 that are largest
            relative to the range of their inputs, the largest first. Empty in a run in one process.
    """

    mesh: str
    state: MeshState
    point: int
    last_point: int
    time: float
    points_per_second: float
    real_time_factor: float
    progress: dict[str, int]
    error: ErrorReport | None = None
    overruns: int = 0
    refused: int = 0
    cut: dict[str, float] = {}
    resets: int = 0
    missing: tuple[str, ...] = ()
    restarts: int = 0
    restarting: str = ""
    may_restart: bool = False
    defects: dict[str, Defect] = {}


class RosTopicView(msgspec.Struct, frozen=True):
    """A topic that a gateway publishes (out) or subscribes to (in), and whether a subscriber or publisher is there."""

    topic: str
    direction: Literal["in", "out"]
    matched: bool


class RosView(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/ros/<id>`: the link of a gateway to ROS.

    Attributes:
        endpoints: where it connects to, and where it listens.
        connected: whether a bridge or router answers.
        activity: the same as text, such as `nobody answers at tcp/127.0.0.1:7447`.
        other_clocks: other publishers of `/clock`, as text.
        topics: all of them; what is published reaches a subscriber if it is matched.
        ignored: by topic, how many elements of messages had keys that no variable has.
        missed: by topic, how often its deadline was missed.
    """

    profile: str
    endpoints: tuple[str, ...]
    connected: bool
    activity: str
    other_clocks: tuple[str, ...] = ()
    topics: tuple[RosTopicView, ...] = ()
    ignored: dict[str, int] = {}
    missed: dict[str, int] = {}


class Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A query to `…/mesh/command`.

    Attributes:
        points: for `step` only.
        paced: for `step` and `resume`: whether the real-time factor limits what follows.
        wait: for how long in s the answer to `pause` or `step` may wait until the mesh rests, and that to `checkpoint`
            until it has its file.
        start_values: for `reset` only; by `instance.variable`, as in a configuration file.
    """

    command: Literal["pause", "resume", "step", "stop", "reset", "checkpoint"]
    points: Annotated[int, msgspec.Meta(le=ENDLESS)] = 1
    paced: bool = True
    wait: Annotated[float, msgspec.Meta(ge=0.0)] = 0.0
    start_values: dict[str, PlainValue] = {}


class CommandAnswer(msgspec.Struct, frozen=True):
    """Answer of `…/mesh/command`.

    Attributes:
        point: the last point that every instance has reached.
        hold: the point at which all of them will pause; None if the mesh continues to run.
        resets: how often the mesh was reset, once it has done what it was told.
        error: why an answer that has waited comes before they have.
    """

    command: str
    state: MeshState
    point: int
    hold: int | None = None
    resets: int = 0
    error: ErrorReport | None = None
