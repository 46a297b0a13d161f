"""The configuration file, version 1, as frozen Structs (design: "The configuration file").

Owns the shape and the documentation of the file, from which the JSON Schema is made. Reading YAML and telling
what is wrong with it is `fmu_mesh.config.loading`; what the names in it mean is `fmu_mesh.system.system`.
"""

from __future__ import annotations

from functools import cache, reduce
from operator import or_
from typing import Annotated, Any, Literal, cast

import msgspec
from msgspec import Meta

from fmu_mesh.config.base import (
    ENDPOINT_PATTERN,
    KEY_PREFIX_PATTERN,
    NAME_PATTERN,
    NOT_NEGATIVE,
    POSITIVE,
    SHA256_PATTERN,
    Base,
    DeadlineSeconds,
    Endpoint,
    Name,
)
from fmu_mesh.config.instance_sections import InstanceSection
from fmu_mesh.config.ros_section import RosConfig, RosProfile, RosTopicConfig

__all__ = [
    "ENDPOINT_PATTERN",
    "KEY_PREFIX_PATTERN",
    "MAX_WINDOW",
    "NAME_PATTERN",
    "SHA256_PATTERN",
    "Config",
    "ConnectionConfig",
    "InitializationConfig",
    "LimitsConfig",
    "RecordConfig",
    "RosConfig",
    "RosProfile",
    "RosTopicConfig",
    "SimulationConfig",
    "TimeoutsConfig",
    "ZenohConfig",
    "config_type",
]

MAX_WINDOW = 1_000_000
"""In points; rings hold as many rows."""


class SimulationConfig(Base, frozen=True, kw_only=True):
    """When the simulation starts and stops, and how instances are synchronized."""

    start_time: Annotated[float, Meta(description="Time of communication point 0 in s.")] = 0.0
    stop_time: Annotated[
        float | None,
        Meta(
            description="Time of the last communication point in s: start_time plus a multiple of step_size; "
            "null: it runs until it is stopped."
        ),
    ]
    step_size: Annotated[
        float,
        Meta(
            description="Base communication step size in s; greater than 0.",
            extra_json_schema=POSITIVE,
            examples=[0.002],
        ),
    ]
    algorithm: Annotated[
        Literal["jacobi", "gauss_seidel"],
        Meta(
            description="jacobi: every connection has a delay of one point. gauss_seidel: none, "
            "except on the connections that close a cycle."
        ),
    ] = "gauss_seidel"
    window: Annotated[
        Literal["auto"] | Annotated[int, Meta(ge=1, le=MAX_WINDOW)],
        Meta(
            description="How many points a node may run ahead of the slowest; 1 is strict lockstep; "
            "auto: up to 16384, where the instances are fast."
        ),
    ] = "auto"
    real_time_factor: Annotated[
        float,
        Meta(
            description="0: as fast as possible; 1: wall clock; 2: twice as fast as the wall clock.",
            extra_json_schema=NOT_NEGATIVE,
        ),
    ] = 0.0
    update_period: Annotated[
        float,
        Meta(
            ge=0,
            description="With a real_time_factor: wall-clock time in s after which the points that have become due are "
            "taken together; 0: each as it becomes due.",
        ),
    ] = 0.0
    catch_up: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(
            description="With a real_time_factor: how far in s a run may fall behind the wall clock before it gives up "
            "what it lost, which `status` counts as overruns; null: it catches up however long that takes."
        ),
    ] = None


class LimitsConfig(Base, frozen=True, kw_only=True):
    """How large an FMU may be before it is taken for an attack; no tool comes near the defaults."""

    unpacked_bytes: Annotated[int, Meta(ge=1, description="All files of an FMU together, unpacked, in bytes.")] = 2**32
    ratio: Annotated[
        float,
        Meta(
            gt=0, description="Size unpacked / size packed, of an FMU that is larger than 64 MiB when it is unpacked."
        ),
    ] = 200.0
    entries: Annotated[int, Meta(ge=1, description="Files and folders in an FMU.")] = 100_000
    description_bytes: Annotated[int, Meta(ge=1, description="A modelDescription.xml, in bytes.")] = 64 * 2**20


class ConnectionConfig(Base, frozen=True, kw_only=True):
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
    extrapolation: Annotated[
        Literal["hold", "linear"],
        Meta(
            description="hold: the input is constant during a step; linear: it changes with the slope between the last "
            "two values, for FMUs that take input derivatives."
        ),
    ] = "hold"


class InitializationConfig(Base, frozen=True, kw_only=True):
    """How the algebraic loops at the start are iterated: fixed point with under-relaxation."""

    tolerance: Annotated[
        float,
        Meta(
            ge=0,
            description="A loop is consistent when each of its inputs is off what feeds it by at most this, or by "
            "this times the value where that is above 1.",
        ),
    ] = 1e-9
    relaxation: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="How far an input goes towards what feeds it in one iteration; 1: all the way. Lower it for "
            "a loop that does not converge.",
        ),
    ] = 1.0
    iterations: Annotated[int, Meta(ge=1, description="After so many iterations the run ends with an error.")] = 1000


class RecordConfig(Base, frozen=True, kw_only=True):
    """Where results go and which variables they hold."""

    file: Annotated[
        str | None,
        Meta(description="CSV, or a bag if it ends in .mcap, relative to this file; {mesh}: the mesh; null: none."),
    ] = "results/{mesh}.csv"
    variables: Annotated[
        list[str] | None,
        Meta(description="`instance.variable` of outputs; default: all outputs but those of type String and Binary."),
    ] = None


class ZenohConfig(Base, frozen=True, kw_only=True):
    """How the processes of the mesh find each other."""

    key_prefix: Annotated[
        str,
        Meta(
            pattern=KEY_PREFIX_PATTERN,
            title="a key such as fmu_mesh or lab/fmu_mesh, without / * $ ? # @ in its parts",
            description="First part of every key of the mesh.",
        ),
    ] = "fmu_mesh"
    mode: Annotated[
        Literal["peer", "client"],
        Meta(
            description="peer: nodes link directly to each other; client: everything goes through the router "
            "in `connect`."
        ),
    ] = "peer"
    listen: Annotated[
        list[Endpoint],
        Meta(
            description="Endpoints where other hosts and users can reach the master, too; default: none, only the "
            "Unix socket in the runtime folder of its user."
        ),
    ] = []
    connect: Annotated[list[Endpoint], Meta(description="Endpoints of a router or of another host's mesh.")] = []
    shared_memory: Annotated[
        bool,
        Meta(
            description="Whether processes of one host exchange frames and grants through shared memory; false: "
            "through Zenoh, as those of different hosts do."
        ),
    ] = True
    config: Annotated[
        str | None,
        Meta(description="A Zenoh configuration file (JSON5), relative to this file, to start from."),
    ] = None


class TimeoutsConfig(Base, frozen=True, kw_only=True):
    """The deadline of every kind of wait, in s; meeting it is an error that says what was missing."""

    start: Annotated[
        DeadlineSeconds,
        Meta(description="Until all processes are there and all FMUs are instantiated, in s."),
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
            "in s; less than start and initialize, so that the FMU is named and not only who waits for it."
        ),
    ] = 45.0
    stop: Annotated[
        DeadlineSeconds,
        Meta(
            description="From the last communication point to the end of all processes, in s, "
            "besides what FMUs take to terminate."
        ),
    ] = 10.0
    terminate: Annotated[
        DeadlineSeconds,
        Meta(description="For terminating and freeing an FMU, in s."),
    ] = 30.0


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
        list[ConnectionConfig], Meta(description="What flows from which output to which input.")
    ] = []
    initialization: InitializationConfig = InitializationConfig()
    record: RecordConfig = RecordConfig()
    zenoh: ZenohConfig = ZenohConfig()
    timeouts: TimeoutsConfig = TimeoutsConfig()
    limits: LimitsConfig = LimitsConfig()
    strict: Annotated[
        bool,
        Meta(
            description="Whether what FMI forbids is an error instead of a warning: problems that a strict validation "
            "finds in an FMU, and start values of variables that have none."
        ),
    ] = False
    ros: Annotated[RosConfig | None, Meta(description="Topics for ROS 2; null: none.")] = None
    version: Annotated[Literal[1], Meta(description="Version of this file format.")] = 1

    def is_strict(self, section: InstanceSection) -> bool:
        """Whether what FMI forbids is an error for an instance of this mesh."""
        return section.follows_fmi and (self.strict if section.strict is None else section.strict)


@cache
def config_type(sections: tuple[type[InstanceSection], ...]) -> type[Config]:
    """The `Config` that a file is converted to, and that its JSON Schema is made from.

    `Config` itself knows no kind of instance, so msgspec needs a hook to decode it; this one needs none.

    Args:
        sections: the sections of the kinds that instances may have, the usual kind first.
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
