"""The configuration file, version 1, as frozen Structs (design: "The configuration file").

Owns the shape and the documentation of the file, from which the JSON Schema is made. Reading YAML and telling
what is wrong with it is `fmu_mesh.model.loading`; what the names in it mean is `fmu_mesh.model.system`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from fmu_mesh.model.types import PlainValue

__all__ = [
    "ActuatorConfig",
    "AnyInstanceConfig",
    "Config",
    "ConnectionConfig",
    "ControllerConfig",
    "EngineConfig",
    "FluidDynamicsConfig",
    "GazeboClassicConfig",
    "HostConfig",
    "InitializationConfig",
    "InstanceConfig",
    "LimitsConfig",
    "MujocoConfig",
    "PidConfig",
    "RecordConfig",
    "RosConfig",
    "RosTopicConfig",
    "SimulationConfig",
    "SolverConfig",
    "TimeoutsConfig",
    "ZenohConfig",
]

NAME_PATTERN = r"^[A-Za-z_][A-Za-z0-9_-]*$"
SHA256_PATTERN = r"^[0-9A-Fa-f]{64}$"
KEY_PREFIX_PATTERN = r"^[^/*$?#@\s]+(/[^/*$?#@\s]+)*$"
ENDPOINT_PATTERN = r"^[a-z0-9_-]+/\S+$"

Name = Annotated[
    str, Meta(pattern=NAME_PATTERN, title="a name of letters, digits, _ and - that starts with a letter or _")
]
Sha256 = Annotated[
    str,
    Meta(
        pattern=SHA256_PATTERN,
        title="a SHA-256 as 64 hexadecimal digits, as `sha256sum` or `fmu-mesh inspect` prints it",
    ),
]
Endpoint = Annotated[str, Meta(pattern=ENDPOINT_PATTERN, title="a Zenoh endpoint such as tcp/192.168.1.2:7447")]
RosTopicProfile = Literal["ros2dds", "rmw_zenoh"]
RosProfile = Literal["ros2dds", "rmw_zenoh", "rclpy"]
DeadlineSeconds = Annotated[float, Meta(gt=0)]

# What editors should know but `system.build` checks: these errors are shown together with those of the names.
_POSITIVE = {"exclusiveMinimum": 0}
_NOT_NEGATIVE = {"minimum": 0}


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Every section is frozen and refuses unknown fields; `kw_only` is repeated: it is not inherited."""


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
            extra_json_schema=_POSITIVE,
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
        Literal["auto"] | Annotated[int, Meta(ge=1)],
        Meta(description="How many points a node may run ahead of the slowest; 1 is strict lockstep."),
    ] = "auto"
    real_time_factor: Annotated[
        float,
        Meta(
            description="0: as fast as possible; 1: wall clock; 2: twice as fast as the wall clock.",
            extra_json_schema=_NOT_NEGATIVE,
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


class SolverConfig(Base, frozen=True, kw_only=True):
    """How the continuous states of a model-exchange FMU are solved."""

    name: Annotated[
        Literal["cvode", "euler"],
        Meta(description="cvode: variable step and order, finds events exactly; euler: fixed steps, for checks."),
    ] = "cvode"
    relative_tolerance: Annotated[
        float | None,
        Meta(
            description="Relative tolerance of cvode; default: that of the FMU's default experiment, or 1e-6.",
            extra_json_schema=_POSITIVE,
            examples=[1e-6],
        ),
    ] = None
    maximum_step_size: Annotated[
        float | None,
        Meta(
            description="Longest step of the solver in s; default: the instance's own step size.",
            extra_json_schema=_POSITIVE,
        ),
    ] = None


KIND = "@kind"
"""What tells the kinds of instances apart once a file is read; nobody writes it, the keys of a section say it."""

StartValues = Annotated[
    dict[str, PlainValue],
    Meta(
        description="Start values of parameters, inputs and initial values, by variable name. "
        "An Enumeration takes the item's name or its number, an array nested lists row by row, Binary base64."
    ),
]
StepSize = Annotated[
    float | None,
    Meta(
        description="Step size of this instance in s: a whole multiple of the base step size (default).",
        extra_json_schema=_POSITIVE,
    ),
]
Group = Annotated[Name | None, Meta(description="Instances of one group share one node (one process).")]
Host = Annotated[str | None, Meta(description="Host the node is meant to run on; `launch` starts those without.")]


class InstanceConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="fmu"):
    """One instance of an FMU."""

    fmu: Annotated[str, Meta(description="Path of the .fmu file, or of an unpacked one, relative to this file.")]
    kind: Annotated[
        Literal["auto", "co_simulation", "model_exchange"],
        Meta(description="Which kind of the FMU to use; auto: co-simulation if it has both."),
    ] = "auto"
    solver: Annotated[SolverConfig, Meta(description="The solver of a model-exchange FMU.")] = SolverConfig()
    retry_discarded_steps: Annotated[
        bool,
        Meta(
            description="Whether a step that an FMI 2.0 FMU discards is tried again in smaller ones; then its state is "
            "kept before every step. FMI 3.0 needs no such wish."
        ),
    ] = False
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    interpolation: Annotated[
        Literal["hold", "linear"] | None,
        Meta(
            description="How a value that is sent to an unconnected input with a time in its attachment is used: it "
            "holds from that time on, or Reals go to it linearly; null: the time is ignored, and it holds from the "
            "next point on."
        ),
    ] = None
    sha256: Annotated[
        Sha256 | None, Meta(description="SHA-256 that the .fmu file must have; any other is refused.")
    ] = None
    strict: Annotated[
        bool | None,
        Meta(description="Whether problems that a strict validation finds in the FMU are errors (default: top level)."),
    ] = None

    @property
    def path(self) -> str:
        """The file of the model, relative to the configuration."""
        return self.fmu


class CouplingConfig(Base, frozen=True, kw_only=True):
    """Another instance that reads and drives a part of a physics engine."""

    name: Annotated[str, Meta(description="Name of this coupling, for messages.")]
    instance: Annotated[Name, Meta(description="The instance that is coupled.")]
    enabled: Annotated[bool, Meta(description="false: as if it were not there.")] = True
    variable_names: Annotated[
        dict[str, str],
        Meta(description="The instance's own names of variables, by their default names."),
    ] = {}


class ControllerConfig(CouplingConfig, frozen=True, kw_only=True):
    """A controller of a joint: `position` and `velocity` to `effort`."""

    joint: Annotated[str, Meta(description="Name of the joint, revolute or prismatic.")]


class ActuatorConfig(CouplingConfig, frozen=True, kw_only=True):
    """An actuator of a joint: `actuatorInput`, `jointPosition`, `jointVelocity`, `jointAcceleration` to `jointTorque`.

    What a controller asks for goes to the actuator, and the joint gets the actuator's effort instead.
    """

    joint: Annotated[str, Meta(description="Name of the joint, revolute or prismatic.")]
    disable_velocity_effort_limits: Annotated[
        bool, Meta(description="true: the effort of the joint is not limited, whatever the model says.")
    ] = False


class FluidDynamicsConfig(CouplingConfig, frozen=True, kw_only=True):
    """Fluid dynamics of one body: `relativeVelocity_x/y/z` to `fluidDynamicForce_…` and `fluidDynamicMoment_…`."""

    link: Annotated[str, Meta(description="Name of the body.")]


class MujocoConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="mujoco"):
    """A world that the physics engine MuJoCo computes: its joints and bodies are variables."""

    mujoco: Annotated[str, Meta(description="Path of the model (MJCF or URDF), relative to this file.")]
    physics_steps: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(
            description="Steps of the engine per own step; default: as few as make none longer than the model's "
            "timestep.",
        ),
    ] = None
    keyframe: Annotated[str | None, Meta(description="The model's keyframe to start from.")] = None
    controllers: Annotated[list[ControllerConfig], Meta(description="Controllers of joints.")] = []
    actuators: Annotated[list[ActuatorConfig], Meta(description="Actuators of joints, as in gazebo-fmi.")] = []
    fluid_dynamics: Annotated[
        list[FluidDynamicsConfig], Meta(description="Fluid dynamics of single bodies, as in gazebo-fmi.")
    ] = []
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None

    @property
    def path(self) -> str:
        """The file of the model, relative to the configuration."""
        return self.mujoco


class GazeboClassicConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="gazebo_classic"):
    """A world that the simulator Gazebo classic 11 computes: its joints and links are variables."""

    gazebo_classic: Annotated[str, Meta(description="Path of the SDF world, relative to this file.")]
    physics_steps: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(
            description="Steps of the engine per own step; default: as few as make none longer than the world's "
            "max_step_size.",
        ),
    ] = None
    controllers: Annotated[list[ControllerConfig], Meta(description="Controllers of joints.")] = []
    actuators: Annotated[list[ActuatorConfig], Meta(description="Actuators of joints, as in gazebo-fmi.")] = []
    fluid_dynamics: Annotated[
        list[FluidDynamicsConfig], Meta(description="Fluid dynamics of single links, as in gazebo-fmi.")
    ] = []
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None

    @property
    def path(self) -> str:
        """The file of the world, relative to the configuration."""
        return self.gazebo_classic


class PidConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="controller"):
    """A controller that needs no FMU."""

    controller: Annotated[
        Literal["position_pid"],
        Meta(description="position_pid: gains p, i, d; inputs target, position, velocity; output effort."),
    ]
    start_values: StartValues = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None

    @property
    def path(self) -> str:
        """There is no file."""
        return ""


EngineConfig = MujocoConfig | GazeboClassicConfig
HostConfig = EngineConfig | PidConfig
AnyInstanceConfig = InstanceConfig | MujocoConfig | GazeboClassicConfig | PidConfig


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
        Meta(description="CSV file, relative to this file; {mesh} is the name of the mesh; null: no recording."),
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
        Meta(description="Endpoints where the master can be reached; default: a free loopback port."),
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


class RosTopicConfig(Base, frozen=True, kw_only=True):
    """One ROS topic; outputs are published, unconnected inputs subscribed. The short form is `instance.variable`."""

    topic: Annotated[
        str | None,
        Meta(description="Name of the topic; default: <instance>/<variable>, with _ for what ROS does not allow."),
    ] = None
    variable: Annotated[
        str | None,
        Meta(description="`instance.variable`, or `instance` for all of its outputs and unconnected inputs."),
    ] = None
    type: Annotated[
        str | None,
        Meta(
            description="Message type; default: the one of std_msgs for the type of the variable.",
            examples=["std_msgs/msg/Float64"],
        ),
    ] = None
    fields: Annotated[
        dict[str, str],
        Meta(
            description="Several variables in one message: `instance.variable` by the field that it goes into.",
            examples=[{"twist.linear.x": "path_filter.v"}],
        ),
    ] = {}
    profile: Annotated[RosTopicProfile | None, Meta(description="Another profile than that of the mesh.")] = None
    frame_id: Annotated[str, Meta(description="frame_id of the header, where the message has one.")] = ""
    reliability: Annotated[
        Literal["reliable", "best_effort"],
        Meta(description="Reliability in ROS; a best-effort publisher needs a best-effort subscription here."),
    ] = "reliable"


class RosConfig(Base, frozen=True, kw_only=True):
    """What ROS 2 sees of the mesh, without ROS on this side."""

    profile: Annotated[
        RosProfile,
        Meta(
            description="ros2dds: as zenoh-bridge-ros2dds expects it, for ROS on DDS; rmw_zenoh: as ROS nodes on "
            "rmw_zenoh expect it; rclpy: as topics of a ROS node, `python -m fmu_mesh.ros.node` with this file."
        ),
    ] = "ros2dds"
    topics: Annotated[
        list[str | RosTopicConfig] | None,
        Meta(description="The topics; default: all outputs and all unconnected inputs of all instances."),
    ] = None
    connect: Annotated[list[Endpoint], Meta(description="Where the bridge or the router of rmw_zenoh is.")] = (
        msgspec.field(default_factory=lambda: ["tcp/127.0.0.1:7447"])
    )
    listen: Annotated[
        list[Endpoint], Meta(description="Endpoints where a bridge can connect to, instead of or beside `connect`.")
    ] = []
    node: Annotated[str | None, Meta(description="Name of the node in ROS; default: the name of the mesh.")] = None
    namespace: Annotated[str, Meta(description="Namespace of the node and of its topics.")] = "/"
    domain: Annotated[int, Meta(ge=0, le=232, description="ROS_DOMAIN_ID; used by rmw_zenoh.")] = 0
    distribution: Annotated[
        Literal["humble", "jazzy", "kilted", "lyrical"],
        Meta(description="The ROS 2 distribution whose message definitions and hashes hold."),
    ] = "jazzy"
    clock_rate: Annotated[
        float | None,
        Meta(
            description="/clock messages per second of simulation time, at most one per point; null: no /clock.",
            extra_json_schema=_POSITIVE,
        ),
    ] = 100.0
    messages: Annotated[
        dict[str, str],
        Meta(
            description="Custom message types: the path of the .msg file, relative to this file, by the full name.",
            examples=[{"lab_msgs/msg/Wheel": "msg/Wheel.msg"}],
        ),
    ] = {}


class Config(Base, frozen=True, kw_only=True):
    """A mesh: its instances, connections, and how it runs (version 1)."""

    mesh: Annotated[Name, Meta(description="Name of the mesh; part of every key.")]
    simulation: SimulationConfig
    instances: Annotated[
        dict[Name, AnyInstanceConfig],
        Meta(min_length=1, description="The instances by name; `mesh` is reserved."),
    ]
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
        Meta(description="Whether problems that a strict validation finds in an FMU are errors instead of warnings."),
    ] = False
    ros: Annotated[RosConfig | None, Meta(description="Topics for ROS 2; null: none.")] = None
    version: Annotated[Literal[1], Meta(description="Version of this file format.")] = 1
