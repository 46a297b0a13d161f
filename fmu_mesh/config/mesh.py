"""The configuration file, version 1, as frozen Structs (design: "The configuration file").

Owns the keys of the file and their descriptions, from which the JSON Schema and the help of options are made. Reading a
file is `fmu_mesh.config.loading`; what the names in it mean is `fmu_mesh.system.system`.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, Literal, cast

import msgspec
from msgspec import Meta

from fmu_mesh.config.access_sections import RuntimeConfig, SecurityConfig, ZenohConfig
from fmu_mesh.config.base import Base, DeadlineSeconds, Name
from fmu_mesh.config.deploy_section import DeployConfig
from fmu_mesh.config.group_section import GroupedInstance
from fmu_mesh.config.instance_sections import (
    EXTRAPOLATIONS,
    KIND,
    Extrapolation,
    InstanceSection,
    PhysicsSection,
    ProcessConfig,
    placed,
)
from fmu_mesh.config.key_sections import KEY, KeyInputConfig, KeyOutputConfig
from fmu_mesh.config.ros_section import ConstantFile, Qos, RosConfig, RosProfile, RosTopicConfig
from fmu_mesh.config.scenario_section import ScenarioConfig
from fmu_mesh.config.simulation_section import MAX_WINDOW, SimulationConfig

__all__ = [
    "MAX_WINDOW",
    "Config",
    "ConnectionConfig",
    "ConstantFile",
    "InitializationConfig",
    "LimitsConfig",
    "Qos",
    "RecordConfig",
    "RosConfig",
    "RosProfile",
    "RosTopicConfig",
    "RuntimeConfig",
    "SecurityConfig",
    "SimulationConfig",
    "TimeoutsConfig",
    "ZenohConfig",
    "config_type",
    "sources_of",
]


class LimitsConfig(Base, frozen=True, kw_only=True):
    """The largest FMU that is accepted. The defaults are far above what tools export."""

    unpacked_bytes: Annotated[
        int, Meta(ge=1, description="Largest total size of the unpacked files of an FMU, in bytes.")
    ] = 2**32
    ratio: Annotated[
        float,
        Meta(
            gt=0, description="Largest ratio of unpacked to packed size of an FMU that is larger than 64 MiB unpacked."
        ),
    ] = 200.0
    entries: Annotated[int, Meta(ge=1, description="Largest number of files and folders in an FMU.")] = 100_000
    description_bytes: Annotated[int, Meta(ge=1, description="Largest modelDescription.xml, in bytes.")] = 64 * 2**20


class ConnectionConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="connection"):
    """One connection from an output to an input; the short form is `a.y -> b.u`."""

    source: Annotated[
        str,
        Meta(
            description="`instance.variable` of an output, or an element of an array as `a.y[1,2]`.",
            examples=["pendulum.a"],
        ),
    ] = msgspec.field(name="from")
    target: Annotated[
        str,
        Meta(
            description="`instance.variable` of an input, or an element of an array as `b.u[3]`.", examples=["delay.x"]
        ),
    ] = msgspec.field(name="to")
    factor: Annotated[
        float,
        Meta(description="The input is factor * output + offset, in the input's unit; Real inputs only."),
    ] = 1.0
    offset: Annotated[
        float,
        Meta(description="The input is factor * output + offset, in the input's unit; Real inputs only."),
    ] = 0.0
    delay: Annotated[
        Literal[0, 1] | None,
        Meta(description="0: value at the end of the target's step; 1: at its start. Default: see algorithm."),
    ] = None
    ignore_units: Annotated[bool, Meta(description="true: neither convert nor compare the units of the two ends.")] = (
        False
    )
    map: Annotated[
        dict[str, bool | int | str],
        Meta(
            description="Values of the output and what the input gets instead, such as {off: idle, on: running}; a "
            "value without an entry stays as it is. For Boolean, integer types and Enumeration (name or number).",
            examples=[{"0": 2, "1": 5}],
        ),
    ] = {}
    extrapolation: Annotated[
        Extrapolation | None,
        Meta(description=f"{EXTRAPOLATIONS} null: as the instance of the input says.", examples=["linear"]),
    ] = None


class InitializationConfig(Base, frozen=True, kw_only=True):
    """How algebraic loops in Initialization Mode are solved: by substitution, and where it is slow, by secant steps."""

    tolerance: Annotated[
        float,
        Meta(
            ge=0,
            description="A loop has converged when each of its inputs differs from its source by at most this, "
            "absolutely for values up to 1 and relatively above.",
        ),
    ] = 1e-9
    relaxation: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="Below 1: each iteration removes this fraction of the difference between an input and its "
            "source, and there are no secant steps. For a loop that does not converge with them.",
        ),
    ] = 1.0
    iterations: Annotated[int, Meta(ge=1, description="Largest number of iterations; beyond it, the run fails.")] = 1000


class RecordConfig(Base, frozen=True, kw_only=True):
    """One result file: where it is, which variables it holds, and at which points."""

    file: Annotated[
        str | None,
        Meta(description="CSV, or a bag if it ends in .mcap, relative to this file; {mesh}: the mesh; null: none."),
    ] = "results/{mesh}.csv"
    variables: Annotated[
        list[str] | None,
        Meta(
            description="`instance.variable` of any causality, or patterns: `*` any characters, `?` one, `re:` a "
            "regular expression. A pattern matches outputs; with `in:`, `local:` or `param:` before it, inputs, locals "
            "or parameters. Default: all outputs but those of type String and Binary; of an instance without outputs "
            "its continuous states, or else the first 100 locals that change.",
            examples=[["motor.*", "in:motor.*", "arm.angle"]],
        ),
    ] = None
    every: Annotated[
        int,
        Meta(ge=1, description="There is a row at every n-th communication point of the base step size."),
    ] = 1
    start: Annotated[
        float | None,
        Meta(description="Time in s from which on there are rows; null: from the first communication point on."),
    ] = msgspec.field(name="from", default=None)


class TimeoutsConfig(Base, frozen=True, kw_only=True):
    """The deadline of every kind of wait, in s. A missed deadline is an error that names what was missing."""

    start: Annotated[
        DeadlineSeconds,
        Meta(description="For starting all processes and instantiating all FMUs, in s."),
    ] = 60.0
    initialize: Annotated[
        DeadlineSeconds, Meta(description="From Initialization Mode to the first communication point, in s.")
    ] = 60.0
    step: Annotated[
        DeadlineSeconds, Meta(description="Without any progress of an instance while it may step, in s.")
    ] = 60.0
    call: Annotated[
        DeadlineSeconds,
        Meta(
            description="For each call into an FMU before the first communication point, such as fmi2Instantiate, "
            "in s. Keep it below start and initialize: then the error names the FMU."
        ),
    ] = 45.0
    link: Annotated[
        DeadlineSeconds,
        Meta(
            description="Between hosts, without any sign of life of the other end of a link, in s. On one host, a "
            "process counts as lost only when it has ended."
        ),
    ] = 30.0
    stop: Annotated[
        DeadlineSeconds,
        Meta(
            description="From the last communication point to the end of all processes, in s, "
            "without the time that FMUs take to terminate."
        ),
    ] = 10.0
    terminate: Annotated[
        DeadlineSeconds,
        Meta(description="For terminating and freeing an FMU, in s."),
    ] = 30.0
    router: Annotated[
        DeadlineSeconds,
        Meta(description="For a process that starts, until its router, or the socket of the master, is there, in s."),
    ] = 20.0
    write: Annotated[
        DeadlineSeconds,
        Meta(description="For each write to a result file, and for closing it, in s: a network disk may not answer."),
    ] = 60.0


class RecoveryConfig(Base, frozen=True, kw_only=True):
    """What happens when a process of a run is lost. `--restarts N` is `mode: restart` with `max_restarts: N`."""

    mode: Annotated[
        Literal["stop", "restart"],
        Meta(
            description="stop: the run ends; restart: all processes start again, and the result goes on with the rows "
            "that it has."
        ),
    ] = "stop"
    max_restarts: Annotated[
        int, Meta(ge=1, le=1000, description="How often at most; then the run ends as with stop.")
    ] = 3
    directory: Annotated[
        str | None,
        Meta(
            description="Folder, relative to this file, for what is needed to resume the run after a power cut, or "
            "after its launcher was killed; null: none."
        ),
    ] = None

    checkpoint_s: Annotated[
        Annotated[float, Meta(gt=0.0)] | None,
        Meta(
            description="Time between two checkpoints in s: a restart begins with the newest one. null: with the first "
            "point."
        ),
    ] = 0.2

    @property
    def restarts(self) -> int:
        """How often the run may start again."""
        return self.max_restarts if self.mode == "restart" else 0


_INSTANCES = Meta(min_length=1, description="The instances by name; `mesh` is reserved.")


class Config(Base, frozen=True, kw_only=True):
    """A mesh: its instances, connections, and how it runs (version 1)."""

    mesh: Annotated[Name, Meta(description="Name of the mesh; part of every key.")]
    simulation: SimulationConfig
    instances: Annotated[dict[Name, InstanceSection], _INSTANCES]
    group: Annotated[
        Literal["auto"] | None,
        Meta(
            description="auto: the instances of each cycle share one node, unless they have a group of their own; "
            "null: every instance without a group has a node of its own."
        ),
    ] = None
    connections: Annotated[
        list[ConnectionConfig | KeyInputConfig | KeyOutputConfig],
        Meta(description="From which output to which input values go; at one end there may be a Zenoh key."),
    ] = []
    initialization: InitializationConfig = InitializationConfig()
    record: Annotated[
        RecordConfig | list[RecordConfig],
        Meta(description="What is recorded: one result file, or a list of several; an empty list: nothing."),
    ] = RecordConfig()
    scenario: Annotated[
        ScenarioConfig | str | None,
        Meta(
            description="Values of inputs and tunable parameters over time; or a file with these keys, relative to "
            "this file."
        ),
    ] = None
    zenoh: ZenohConfig = ZenohConfig()
    security: Annotated[
        SecurityConfig | None,
        Meta(description="Certificates and roles for endpoints at a network; null: there are none."),
    ] = None
    runtime: RuntimeConfig = RuntimeConfig()
    deploy: DeployConfig = DeployConfig()
    timeouts: TimeoutsConfig = TimeoutsConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    limits: LimitsConfig = LimitsConfig()
    process: ProcessConfig = ProcessConfig()
    strict: Annotated[
        bool,
        Meta(
            description="true: what FMI forbids is an error instead of a warning, such as an invalid model description "
            "or a start value for a variable that may not have one."
        ),
    ] = False
    ros: Annotated[RosConfig | None, Meta(description="Topics for ROS 2; null: none.")] = None
    version: Annotated[Literal[1], Meta(description="Version of this file format.")] = 1

    @property
    def records(self) -> dict[str, RecordConfig]:
        """The sections of all result files, by their paths in the file: `record`, or `record[0]`, `record[1]`, ..."""
        if isinstance(self.record, RecordConfig):
            return {"record": self.record}
        return {f"record[{index}]": section for index, section in enumerate(self.record)}

    @property
    def recovery_problem(self) -> tuple[str, str, str] | None:
        """Why `recovery` cannot be as it says: the key, what was found, and what was expected; None if it can."""
        own, why = self.recovery, self.why_not_restarted
        boxed = [name for name, section in self.instances.items() if self.process_of(section).is_sandboxed]
        if own.restarts and why is not None:
            return "recovery.mode", f"restart, and {why}", "stop"
        if own.directory is not None and (why is not None or boxed):
            found = why or f"'{boxed[0]}' runs in a sandbox, from where nothing can be written there"
            return "recovery.directory", f"'{own.directory}', and {found}", "null"
        return None

    @property
    def why_not_restarted(self) -> str | None:
        """Why `recovery` cannot start this mesh again when a process is lost; None if it can."""
        for own in self.connections:
            if isinstance(own, KeyInputConfig) and own.wait:
                return f"the publisher of '{own.key}', for which the run waits (`wait: true`), does not start again"
            if isinstance(own, KeyOutputConfig) and own.congestion == "block":
                return f"who reads '{own.key}', for whom the run waits (`congestion: block`), does not start again"
        return None

    @property
    def row_streams(self) -> bool:
        """Whether processes that share no memory exchange rows through sockets of their own."""
        return self.zenoh.row_streams if self.zenoh.row_streams is not None else self.security is None

    @property
    def ends(self) -> tuple[str, ...]:
        """The keys of other programs at ends of connections."""
        keyed = (one.key for one in self.connections if isinstance(one, KeyInputConfig | KeyOutputConfig))
        return tuple(dict.fromkeys(keyed))

    @property
    def members(self) -> dict[str, GroupedInstance]:
        """What of each instance matters to its group, by name."""
        base = self.simulation.step_size
        return {
            name: GroupedInstance(own.group, own.step_size or base, own.on_failure != "stop")
            for name, own in self.instances.items()
        }

    @property
    def engines(self) -> dict[str, PhysicsSection]:
        """The sections of the physics engines by instance name."""
        return {name: section for name, section in self.instances.items() if isinstance(section, PhysicsSection)}

    def not_finite(self, section: InstanceSection) -> Literal["stop", "record"]:
        """What an output that is NaN or infinite means for an instance of this mesh."""
        return section.not_finite or self.simulation.not_finite

    def process_of(self, section: InstanceSection) -> ProcessConfig:
        """What the process of the node of an instance may take."""
        return (section.process or ProcessConfig()).over(self.process)

    def model_section(self, section: InstanceSection) -> InstanceSection:
        """A section without the common keys, but with the sandbox of an FMU: that decides what is loaded."""
        process = self.process_of(section)
        is_apart = section.follows_fmi and process.sandbox not in {None, "none"}
        return placed(section, process=process if is_apart else None)

    def is_strict(self, section: InstanceSection) -> bool:
        """Whether a violation of FMI is an error, and not a warning, for an instance of this mesh."""
        return section.follows_fmi and (self.strict if section.strict is None else section.strict)


@cache
def config_type(sections: tuple[type[InstanceSection], ...]) -> type[Config]:
    """The `Config` that a file is converted to, and that its JSON Schema is made from.

    `Config` itself knows no kind of instance, so msgspec needs a hook to decode it; this one needs none. The sections
    are those of the kinds that instances may have, the usual kind first.
    """
    union: Any = reduce(or_, sections)
    instances: Any = Annotated[dict[Name, union], _INSTANCES]
    made = msgspec.defstruct(
        "Config",
        [("instances", instances)],
        bases=(Config,),
        namespace={"__doc__": Config.__doc__},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )
    return cast("type[Config]", made)


def sources_of(connections: Iterable[ConnectionConfig | KeyInputConfig | KeyOutputConfig]) -> dict[str, str]:
    """By the name of each input with a connection, right or wrong: the source instance, or the key in words."""
    return {
        one.target: f"{KEY}{one.key}" if isinstance(one, KeyInputConfig) else one.source.partition(".")[0]
        for one in connections
        if not isinstance(one, KeyOutputConfig)
    }
