"""The plan of one run: made once by whoever starts the run, and the only thing that its other processes get.

Owns the file through which they get it. Each process decodes only the parts of that file that it needs.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from ..config.access_sections import SecurityConfig
from ..config.loading import LoadedConfig
from ..config.mesh import ZenohConfig
from ..errors import ConfigurationError, UnknownName
from ..instances.contract import LogMessage, Opening, Showing
from ..instances.registry import decode_section
from ..results.formats import goes_on
from ..results.played_rows import PLAYED_ROWS, PlayedRows
from ..rings.library import why_no_library
from ..simtime import ENDLESS
from ..system.attempt import Attempt
from ..system.layout import row_bytes
from ..system.placement import manual_hosts
from ..system.plan import RECORDER, NodePlan, Plan
from ..system.played_nodes import played_nodes
from ..system.start_values import why_not_settable
from ..system.states import BeginsWith
from ..text import counted, did_you_mean, listed, meant, nearest, shown
from ..variables.model_description import ModelDescription, Variable
from ..wire.journal import JOURNAL, JOURNALS
from ..wire.runtime import MeshNote, box_of, run_folder
from .limits import ring_problem

__all__ = [
    "MANUAL",
    "NodeRun",
    "PlannedModel",
    "RunPlan",
    "encoded",
    "in_parts",
    "numbered",
    "opening_in",
    "read_node",
    "read_run",
    "why_no_checkpoints",
]

MANUAL = "hand"
"""Name of a run whose processes are started manually."""

_FILE_NAME = "run.plan"
_LENGTH = struct.Struct("<Q")
_RUN = ""
"""The name of the part with all of the run; no node has it."""

T = TypeVar("T")


class PlannedModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The model of one instance as it was when the run was planned.

    Attributes:
        description: its model description.
        content: the SHA-256 of its files.
    """

    description: ModelDescription
    content: str


class NodeRun(msgspec.Struct, frozen=True):
    """The part of a run plan that one node needs.

    Attributes:
        config_file: the configuration file.
        run: name of the run.
        zenoh: the `zenoh` section.
        showing: whether and how a physics engine shows its world.
        plan: the plan of the node.
        models: the models of its instances, by instance name.
        security: the certificate of this host.
        launch: identifies the launch, on another host than that of the launcher; None: this is known.
        helper: the process id of the helper of the launcher there.
        begins_with: the states of its instances at the first point.
    """

    config_file: Path
    run: str
    zenoh: ZenohConfig
    showing: Showing
    plan: NodePlan
    models: Mapping[str, PlannedModel]
    security: SecurityConfig | None = None
    launch: str | None = None
    helper: int | None = None
    begins_with: BeginsWith | None = None


class RunPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that follows from a configuration and the options of one run.

    ```python
    run = fmu_mesh.load("configs/pendulum_delay.yaml").plan(window=64)
    file = run.write(folder)
    read_node(file, "pendulum").plan.window  # in another process
    ```

    Attributes:
        loaded: the configuration, options applied.
        plan: the plan of the mesh.
        contents: the SHA-256 of the model of each instance, by instance name.
        showing: whether and how a physics engine shows its world.
        paused: whether it stays paused at its first point.
        profile: whether it measures where the time goes.
        connect: Zenoh endpoints that an option gives.
        run: name of the run: that of the launcher (`run_name`), or `MANUAL`.
        restarts: how often the run was started before.
        begins_with: the states of its first point; None: it is that after Initialization Mode.
        max_restarts: how often it may be started again.
        rows: of each result file, how many rows it has from before.
        replays_to: the last point that was seen before: up to it, the run is as it was.
        plays_to: the point of ``begins_with`` where only some nodes have states: they play their rows up to it.
        directory: the folder for what `--resume` needs, absolute; empty: there is none.
    """

    loaded: LoadedConfig
    plan: Plan
    contents: dict[str, str]
    showing: Showing = Showing()
    paused: bool = False
    profile: bool = False
    connect: tuple[str, ...] = ()
    run: str = MANUAL
    restarts: int = 0
    begins_with: BeginsWith | None = None
    max_restarts: int = 0
    rows: tuple[int, ...] = ()
    replays_to: int = 0
    plays_to: int = 0
    directory: str = ""

    @property
    def checkpoint_s(self) -> float | None:
        """How often in s there is a checkpoint for a restart; None: never."""
        recovery = self.loaded.config.recovery
        is_wanted = recovery.mode == "restart" and self.restarts < self.max_restarts
        return recovery.checkpoint_s if (is_wanted or self.directory) and not why_no_checkpoints(self.plan) else None

    def played_rows(self) -> PlayedRows | None:
        """Open the file for the rows of the nodes that may have to play them; None: none has to."""
        plan = self.plan
        if not plan.played or self.checkpoint_s is None:
            return None
        rows = {
            item.name: (row_bytes(item.outputs), item.step_points)
            for name in plan.played
            for item in plan.nodes[name].instances
            if item.outputs.columns
        }
        return PlayedRows(self.kept_in / PLAYED_ROWS, rows)

    @property
    def config_file(self) -> Path:
        """The configuration file, absolute."""
        return self.loaded.file.absolute()

    @property
    def mesh(self) -> str:
        """Name of the mesh."""
        return self.loaded.config.mesh

    def __repr__(self) -> str:
        system, last = self.plan.system, self.plan.grid.last_point
        counts = f"{counted(len(system.instances), 'instance')}, {counted(len(system.connections), 'connection')}"
        return f"<RunPlan of {self.mesh}: {counts}, {counted(last, 'point') if last < ENDLESS else 'no end'}>"

    def zenoh(self, listen: Sequence[str] = ()) -> ZenohConfig:
        """The `zenoh` section for a process of this run that listens at ``listen``, besides its socket.

        Processes that are started manually may be on several hosts. A router forwards nothing between peers: it tells
        each where the others listen, and that is at sockets of their own host. So whoever only connects is a client.
        """
        own = self.loaded.config.zenoh
        return replace(own, mode="client") if self.run == MANUAL and own.connect and not listen else own

    def note(self, endpoints: tuple[str, ...]) -> MeshNote:
        """The note of this process about the mesh, for tools of this host."""
        config = self.loaded.config
        return MeshNote(
            config.mesh,
            config.zenoh.key_prefix,
            endpoints,
            os.getpid(),
            str(self.config_file),
            security=config.security.folder if config.security is not None else "",
            insecure=config.zenoh.insecure,
        )

    def check_memory(self) -> None:
        """Check that the rings between the processes of this run fit into the memory of this host.

        Raises:
            ConfigurationError: they do not; names the largest one.
        """
        places = (place for node in self.plan.nodes.values() for place in node.rings)
        last = self.plan.grid.last_point
        rings = {p.instance: (min(p.rows, last // p.step_points + 2), row_bytes(p.layout)) for p in places}
        if (problem := ring_problem(rings)) is not None:
            raise problem

    def node(self, name: str) -> NodeRun:
        """What the node ``name`` needs; a node with one instance and no group has the name of the instance.

        Raises:
            ConfigurationError: there is no such node.
        """
        plan = self.plan
        if name not in plan.nodes or name == RECORDER:
            raise _no_node(plan, name)
        return NodeRun(
            config_file=self.config_file,
            run=self.run,
            zenoh=self.zenoh(),
            showing=self.showing,
            plan=replace(plan.nodes[name], attempt=self.attempt_of(name)),
            models={
                item.name: PlannedModel(plan.system.instances[item.name].description, self.contents[item.name])
                for item in plan.nodes[name].instances
            },
            security=self.loaded.config.security,
            begins_with=self.begins_with and self.begins_with.only(item.name for item in plan.nodes[name].instances),
        )

    def attempt_of(self, participant: str) -> Attempt:
        """Which attempt this is, for a node or the master."""
        number, most, journal = self.restarts + 1, self.max_restarts + 1, ""
        if self.max_restarts or self.directory:
            folder = self.kept_in / JOURNALS if self.directory else self.kept_in
            box = box_of(folder, participant)
            journal = str((box if box.is_dir() else folder) / f"{box.name}{JOURNAL}")
        plays_to = self.plays_to if participant in self.plan.played else 0
        rows = str(self.kept_in / PLAYED_ROWS) if plays_to else ""
        return Attempt(number, most, self.replays_to, journal, plays_to, rows)

    @property
    def kept_in(self) -> Path:
        """Where the processes of this run keep what it needs to come back: `directory`, or else the folder of the run.

        The errors are those of `run_folder`.
        """
        return Path(self.directory) if self.directory else run_folder(self.mesh, self.run)

    def variable(self, name: str, *, elements: bool = False) -> tuple[str, Variable]:
        """The instance and the variable ``instance.variable``; with ``elements``, it may be an element of the variable.

        Raises:
            UnknownName: there is none; suggests the nearest one.
        """
        if not isinstance(name, str):
            raise UnknownName(f"{shown(name)} is no name of a variable.")
        instances = self.plan.system.instances
        instance, _, rest = name.partition(".")
        if instance not in instances:
            hint = did_you_mean(instance, instances, f"There are {listed(list(instances))}.")
            raise UnknownName(f"there is no instance '{instance}', which '{name}' names.", hint=hint)
        description = instances[instance].description
        variable = description.variable_of(rest) if elements else description.variable(rest)
        if variable is None or (rest != variable.name and rest not in variable.elements):
            sources = self.plan.nodes[self.plan.node_of(instance)].instance(instance).sources
            free = [one.name for one in description.variables if not why_not_settable(one, sources.get(one.name))]
            names = [one.name for one in description.variables] if elements else free
            if (clock := description.clock(rest)) is not None:
                raise UnknownName(f"{clock}.", instance=instance)
            near = nearest(rest, names)
            hint = meant(near and f"{instance}.{near}", f"There are {listed(names)}.")
            raise UnknownName(f"there is no variable '{rest}'.", instance=instance, hint=hint)
        return instance, variable

    def after_resets(self, resets: int) -> RunPlan:
        """The plan of the run after so many resets: `rows.csv` is followed by `rows-2.csv`."""
        system, nodes = self.plan.system, dict(self.plan.nodes)
        records = tuple(replace(record, file=str(numbered(Path(record.file), resets))) for record in system.records)
        if RECORDER in nodes:
            nodes[RECORDER] = replace(nodes[RECORDER], records=records)
        plan = replace(self.plan, system=replace(system, records=records), nodes=nodes)
        return replace(self, plan=plan)

    def with_earlier(self, files: Sequence[tuple[str, int]]) -> tuple[tuple[str, int], ...]:
        """Each result file and the number of rows in it, where an attempt may have ended before it had any."""
        found, names = dict(files), [record.file for record in self.plan.system.records]
        before = self.rows or [0] * len(names)
        return tuple((name, max(found.get(name, 0), rows)) for name, rows in zip(names, before, strict=True))

    def write(self, folder: Path) -> Path:
        """Write the plan into a private folder, for the other processes of the run; returns the file.

        The format is MessagePack: unlike JSON, it can hold any float and bytes.
        """
        nodes = {name: encoded(self.node(name)) for name in self.plan.nodes if name != RECORDER}
        file = folder / _FILE_NAME
        try:
            lean = replace(self, begins_with=self.begins_with and self.begins_with.only(()))
            file.write_bytes(in_parts({**nodes, _RUN: encoded(lean)}))
        except OSError as error:
            text = f"the runtime folder '{folder}' cannot be used: {error.strerror}"
            raise ConfigurationError(text, hint="Set FMU_MESH_RUNTIME_DIR to another folder.") from error
        return file


def why_no_checkpoints(plan: Plan) -> str:
    """Why a run of this plan has no checkpoints for a restart, in words; empty: it can have them."""
    for host in manual_hosts(plan):  # a state cannot get there
        return f"the nodes of host '{host}' are started by hand"
    for record in plan.system.records:
        if not goes_on(record.file):
            return f"the format of '{record.file}' cannot go on"
    played, library = played_nodes(plan.system, plan.outputs), why_no_library()
    return f"the library of C is {library}" if played.names and library is not None else played.refused


def numbered(file: Path, resets: int) -> Path:
    """The name of a file after so many resets; a device keeps its name.

    Example:
        >>> str(numbered(Path("rows.csv"), 1))
        'rows-2.csv'
    """
    if resets == 0 or (file.exists() and not file.is_file()):
        return file
    return file.with_name(f"{file.stem}-{resets + 1}{file.suffix}")


def opening_in(
    node: NodePlan, name: str, description: ModelDescription, folder: Path, log: Callable[[LogMessage], None]
) -> Opening[Any]:
    """What the kind of an instance gets to open it; its files go into ``folder``."""
    item = node.instance(name)
    return Opening(
        name=name,
        path=Path(item.fmu),
        section=item.section,
        description=description,
        folder=folder,
        limits=node.limits,
        timeouts=node.timeouts,
        linear_inputs=item.linear_inputs,
        midpoint_inputs=item.midpoint_inputs,
        group=next((group for group in node.groups if name in group.members), None),
        log=log,
    )


def in_parts(parts: Mapping[str, bytes]) -> bytes:
    """The content of a file with these parts, each `encoded`, by the names of nodes.

    It has the length of an index, the index, and the parts. So who needs one part reads no other one.
    """
    places, end = dict[str, tuple[int, int]](), 0
    for name, part in parts.items():
        places[name] = end, len(part)
        end += len(part)
    index = msgspec.msgpack.encode(places)
    return b"".join([_LENGTH.pack(len(index)), index, *parts.values()])


def read_node(file: Path, name: str) -> NodeRun:
    """Read what one node needs from the file of a run plan.

    Raises:
        ConfigurationError: it cannot be read, or is no run plan.
    """
    return _read(file, name, NodeRun)


def read_run(file: Path) -> RunPlan:
    """Read all of a run plan.

    Raises:
        ConfigurationError: it cannot be read, or is no run plan.
    """
    return _read(file, _RUN, RunPlan)


def _read(file: Path, name: str, type_: type[T]) -> T:
    """One part of a file, of which nothing else is read but the index."""
    try:
        with file.open("rb") as source:
            head = source.read(_LENGTH.size)
            most = os.fstat(source.fileno()).st_size
            length = _LENGTH.unpack(head)[0] if len(head) == _LENGTH.size else most
            if length > most - len(head):
                raise ConfigurationError(f"'{file}' is no run plan of this version of fmu_mesh: its index is cut.")
            places = _decoded(file, source.read(length), dict[str, tuple[int, int]])
            if name not in places:
                raise ConfigurationError(f"the run plan '{file}' has no node '{name}'.")
            begin, size = places[name]
            source.seek(len(head) + length + begin)
            data = source.read(min(size, most))
    except OSError as error:
        raise ConfigurationError(f"the run plan '{file}' cannot be read: {error.strerror}.") from error
    return _decoded(file, data, type_)


def encoded(value: object) -> bytes:
    """What a process of a run needs, as it is in the file."""
    return msgspec.msgpack.encode(value, enc_hook=os.fspath)


def _decoded(file: Path, data: bytes, type_: type[T]) -> T:
    def decoded_value(of_type: type[Any], value: object) -> object:
        return Path(value) if of_type is Path and isinstance(value, str) else decode_section(of_type, value)

    try:
        return msgspec.msgpack.decode(data, type=type_, dec_hook=decoded_value)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"'{file}' is no run plan of this version of fmu_mesh: {error}.") from error


def _no_node(plan: Plan, name: str) -> ConfigurationError:
    if name in plan.system.instances:
        group = plan.node_of(name)
        return ConfigurationError(f"instance '{name}' runs in the group '{group}'", hint=f"Start node '{group}'.")
    names = [node for node in plan.nodes if node != RECORDER]
    text = f"there is no node '{name}'; there are: {listed(names)}."
    return ConfigurationError(text, hint=did_you_mean(name, names))
