"""The sections of instances in the configuration file: FMUs, worlds of physics engines, controllers.

Which kind a section is, its keys say: `fmu`, `mujoco`, `gazebo_classic` or `controller`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from fmu_mesh.config.base import POSITIVE, Base, Name, Sha256
from fmu_mesh.variables.value_types import PlainValue

__all__ = [
    "KIND",
    "ActuatorConfig",
    "AnyInstanceConfig",
    "ControllerConfig",
    "EngineConfig",
    "FluidDynamicsConfig",
    "GazeboClassicConfig",
    "HostConfig",
    "InstanceConfig",
    "MujocoConfig",
    "PidConfig",
    "SolverConfig",
]


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
            extra_json_schema=POSITIVE,
            examples=[1e-6],
        ),
    ] = None
    maximum_step_size: Annotated[
        float | None,
        Meta(
            description="Longest step of the solver in s; default: the instance's own step size.",
            extra_json_schema=POSITIVE,
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
        extra_json_schema=POSITIVE,
    ),
]
Group = Annotated[Name | None, Meta(description="Instances of one group share one node (one process).")]
Host = Annotated[str | None, Meta(description="Host the node is meant to run on; `launch` starts those without.")]


class InstanceConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="fmu"):
    """One instance of an FMU."""

    fmu: Annotated[
        str,
        Meta(
            title="the path of an FMU",
            description="Path of the .fmu file, or of an unpacked one, relative to this file.",
        ),
    ]
    kind: Annotated[
        Literal["auto", "co_simulation", "model_exchange"],
        Meta(description="Which kind of the FMU to use; auto: co-simulation if it has both."),
    ] = "auto"
    solver: Annotated[SolverConfig, Meta(description="The solver of a model-exchange FMU.")] = SolverConfig()
    tolerance: Annotated[
        float | None,
        Meta(
            description="Relative tolerance that a co-simulation FMU of FMI 2.0 or 3.0 is told for its own solver; "
            "default: that of its default experiment, if it has one. For model exchange: `solver.relative_tolerance`.",
            extra_json_schema=POSITIVE,
            examples=[1e-6],
        ),
    ] = None
    retry_discarded_steps: Annotated[
        bool,
        Meta(
            description="Whether a step that an FMI 2.0 FMU discards is tried again in smaller ones; then its state is "
            "kept before every step. FMI 1.0 and 3.0 need no such wish."
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
        Meta(description="Whether what FMI forbids is an error for this FMU (default: top level)."),
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


Controllers = Annotated[list[ControllerConfig], Meta(description="Controllers of joints.")]
Actuators = Annotated[list[ActuatorConfig], Meta(description="Actuators of joints, as in gazebo-fmi.")]
FluidDynamics = Annotated[
    list[FluidDynamicsConfig], Meta(description="Fluid dynamics of single bodies, as in gazebo-fmi.")
]


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
    controllers: Controllers = []
    actuators: Actuators = []
    fluid_dynamics: FluidDynamics = []
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
    controllers: Controllers = []
    actuators: Actuators = []
    fluid_dynamics: FluidDynamics = []
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
