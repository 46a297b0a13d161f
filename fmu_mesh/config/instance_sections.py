"""What the section of an instance in a configuration file may say, whatever its kind.

Each kind of instance has a Struct for its section, beside the kind itself (`fmu_mesh.instances.contract.Kind`). This
module has what all of them share: the common keys, what lower layers ask of any section, and the couplings of physics
engines. It knows no kind.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self, TypeVar, cast

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from fmu_mesh.config.base import POSITIVE, Base, Name
from fmu_mesh.config.findings import Findings
from fmu_mesh.config.group_section import Group, GroupConfig
from fmu_mesh.variables.model_description import ModelDescription
from fmu_mesh.variables.value_types import PlainValue

__all__ = [
    "EXTRAPOLATIONS",
    "KIND",
    "ActuatorConfig",
    "Actuators",
    "ControllerConfig",
    "Controllers",
    "Extrapolation",
    "ExtrapolationOfInputs",
    "Feedthrough",
    "FluidDynamics",
    "FluidDynamicsConfig",
    "Group",
    "Host",
    "InputConfig",
    "Inputs",
    "InstanceSection",
    "Kinds",
    "NotFinitePolicy",
    "OnFailure",
    "PhysicsSection",
    "Process",
    "ProcessConfig",
    "StartValues",
    "StepSize",
    "SubstitutesConfig",
    "key_of",
    "keys_of",
    "placed",
]

_SIZE = re.compile(r"^([0-9]+) ?([KMG])iB$")

KIND = "@kind"
"""The tag field of the sections. A file does not have it: there the kind of an instance follows from its keys."""

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
NotFinitePolicy = Annotated[
    Literal["stop", "record"] | None,
    Meta(
        description="stop: an output that is NaN or infinite ends the run at its point; record: it is recorded as it "
        "is, and may be set; null: as `simulation` says."
    ),
]


class SubstitutesConfig(Base, frozen=True, kw_only=True):
    """What the outputs of an instance are after it has failed."""

    disable: Annotated[
        dict[str, PlainValue],
        Meta(min_length=1, description="The value of each of these outputs from then on; all others hold their last."),
    ]


OnFailure = Annotated[
    Literal["stop", "hold"] | SubstitutesConfig,
    Meta(
        description="What follows if the instance itself fails in a step (an error, or an output that is not finite). "
        "stop: the run ends; hold: the run goes on with its last outputs; or `disable` with other values of outputs."
    ),
]
Extrapolation = Literal["hold", "linear", "midpoint", "auto"]
EXTRAPOLATIONS = (
    "hold: an input is constant during a step; linear: it changes with the slope between the last two values, for "
    "FMUs that take input derivatives; midpoint: it is constant, with the value of that line in the middle of the "
    "step; auto: linear where the FMU takes it, else midpoint, and hold for an input that is not continuous."
)
"""What the ways of `Extrapolation` are, for descriptions of keys."""
ExtrapolationOfInputs = Annotated[
    Extrapolation | None,
    Meta(description=f"How its connected inputs change within a step. {EXTRAPOLATIONS} null: as `simulation` says."),
]
Feedthrough = Annotated[
    dict[str, dict[str, float]] | None,
    Meta(
        description="For `loops: solved`: by how much an output changes with an input at the same point, by output and "
        "input, as {y: {u: -0.5}}; what is not listed is 0. null: it is measured in Initialization Mode."
    ),
]
Host = Annotated[
    str | None,
    Meta(description="The host of `deploy.hosts` on which its node runs; null: where `launch` runs."),
]


class ProcessConfig(Base, frozen=True, kw_only=True):
    """What the process of a node may take of its host. What is null is not limited."""

    memory: Annotated[
        Annotated[int, Meta(ge=1)] | Annotated[str, Meta(pattern=_SIZE.pattern, title="a size such as 512 MiB")] | None,
        Meta(
            description="Memory above what the node has before it loads its models, in bytes, or as 512 MiB; more is "
            "refused to the model (RLIMIT_DATA).",
            examples=["512 MiB"],
        ),
    ] = None
    cpu_time: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        Meta(description="Processor time from there on in s, rounded up to a second; then the process is ended."),
    ] = None
    open_files: Annotated[
        Annotated[int, Meta(ge=64)] | None,
        Meta(description="Files and sockets that are open at a time; a node has some thirty of its own."),
    ] = None
    working_folder: Annotated[
        Literal["shared", "private"] | None,
        Meta(
            description="shared: the node works in the folder where the mesh was started; private: in an empty one of "
            "its own, which is removed at the end, as always in a sandbox."
        ),
    ] = None
    sandbox: Annotated[
        Literal["none", "bubblewrap", "wasm"] | None,
        Meta(
            description="bubblewrap: without the network, other processes, and all files but the model and those of "
            "the system, which it can only read; wasm: sources of an FMU, compiled for WebAssembly, or its "
            "component run in wasmtime, without files and network, and with `memory`, or 1 GiB, of its own."
        ),
    ] = None

    @property
    def memory_bytes(self) -> int | None:
        """The limit of the memory in bytes."""
        if not isinstance(self.memory, str):
            return self.memory
        number, unit = cast("re.Match[str]", _SIZE.match(self.memory)).groups()
        return int(number) << {"K": 10, "M": 20, "G": 30}[unit]

    @property
    def is_private(self) -> bool:
        """Whether the node has a working folder of its own."""
        return self.working_folder == "private" or self.is_sandboxed

    @property
    def is_sandboxed(self) -> bool:
        """Whether the node runs in a sandbox."""
        return self.sandbox == "bubblewrap"

    @property
    def of_node(self) -> ProcessConfig:
        """What is for the process of the node: a sandbox of WebAssembly, and its memory, are within it."""
        if self.sandbox == "bubblewrap":
            return self
        return replace(self, sandbox=None, memory=None if self.sandbox == "wasm" else self.memory)

    def over(self, general: ProcessConfig) -> ProcessConfig:
        """This section, with what a more general one says where this one says nothing."""
        names = self.__struct_fields__
        return ProcessConfig(
            **{n: own if (own := getattr(self, n)) is not None else getattr(general, n) for n in names}
        )


Process = Annotated[
    ProcessConfig | None,
    Meta(description="What the process of its node may take; what it does not say is as in `process` of the mesh."),
]

Section = TypeVar("Section", bound="InstanceSection")


class TimeoutConfig(Base, frozen=True, kw_only=True):
    """What an input does for which no value comes."""

    after: Annotated[float, Meta(description="Simulation time in s without a value.", extra_json_schema=POSITIVE)]
    then: Annotated[
        PlainValue,
        Meta(description="hold; start: its start value; stop: the run ends with exit code 0; or a value of its type."),
    ]


class InputConfig(Base, frozen=True, kw_only=True):
    """An input that is not connected."""

    timeout: Annotated[TimeoutConfig | None, Meta(description="What it does without a value; null: it holds.")] = None


Inputs = Annotated[dict[str, InputConfig], Meta(description="Inputs that are not connected, by variable name.")]


class InstanceSection:
    """Base class of the sections of instances.

    A kind derives its section from `Base` and from this class. The field that has the same name as the kind is the path
    of the model, unless the section overrides `path` and `agreed`. The section has those of the ten common keys that
    make sense for its kind::

        class TableConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="table"):
            table: Annotated[str, Meta(description="Path of a CSV file, relative to this file.")]
            inputs: Inputs = {}
            step_size: StepSize = None
            group: Group = None
            host: Host = None
            not_finite: NotFinitePolicy = None
            on_failure: OnFailure = "stop"
            process: Process = None
            extrapolation: ExtrapolationOfInputs = None
            feedthrough: Feedthrough = None

    Attributes:
        start_values: by variable name, as written in the file.
        inputs: what inputs that are not connected do, by variable name.
        step_size: of the instance in s; None: the base step size.
        group: the group that shares one node, see `group_name`; None: none.
        host: the host on which the node runs, by its name in `deploy.hosts`; None: the one of `launch`.
        not_finite: what an output that is NaN or infinite means; None: what the simulation says.
        on_failure: what follows if the instance itself fails in a step.
        process: what the process of its node may take; None: what the mesh says.
        extrapolation: how its connected inputs change within a step; None: what the simulation says.
        feedthrough: the derivatives of its outputs by inputs at the same point; None: they are not known.
        interpolation: how a timed value for an unconnected input is used; None: its time is ignored.
        strict: whether what FMI forbids is an error for this instance; None: as the whole configuration says.
        follows_fmi: whether the rules of FMI apply to the model. If so, a start value that FMI forbids is a warning, or
            an error where the configuration is strict; otherwise it is always an error.
        names_code: whether it names code of the user, which whoever reads the configuration runs.
        waits_for_program: whether its steps wait for a program of the user, without a deadline.
        interpreter: the Python that has to run the instance; None: the one that runs fmu-mesh.
    """

    __slots__ = ()

    start_values: Mapping[str, PlainValue] = MappingProxyType({})
    inputs: Mapping[str, InputConfig] = MappingProxyType({})
    step_size: float | None = None
    group: str | GroupConfig | None = None
    host: str | None = None
    not_finite: Literal["stop", "record"] | None = None
    on_failure: Literal["stop", "hold"] | SubstitutesConfig = "stop"
    process: ProcessConfig | None = None
    extrapolation: Extrapolation | None = None
    feedthrough: Mapping[str, Mapping[str, float]] | None = None
    interpolation: Literal["hold", "linear"] | None = None
    strict: bool | None = None
    follows_fmi: ClassVar[bool] = False
    names_code: ClassVar[bool] = False
    waits_for_program: ClassVar[bool] = False
    interpreter: str | None = None

    @property
    def path(self) -> str:
        """The file of the model, relative to the configuration; empty for a kind without files."""
        return str(getattr(self, key_of(self)))

    @property
    def runs_code(self) -> bool:
        """Whether code runs that the section names: its own, or another Python."""
        return self.names_code or self.interpreter is not None

    @property
    def retries_steps(self) -> bool:
        """Whether a step that the model discards is repeated in smaller steps."""
        return False

    def agreed(self) -> Self:
        """The section without what may differ between hosts: the path of the model, and the interpreter.

        All processes of a mesh compare a hash of this; the content of the model is compared separately.
        """
        return _replaced(self, {"interpreter": None} | ({key_of(self): ""} if self.path else {}))

    def located(self, folder: Path) -> Self:
        """The section with absolute paths for all files but the model; ``folder`` is that of the configuration."""
        if self.interpreter is None:
            return self
        found = shutil.which(self.interpreter) if "/" not in self.interpreter else None
        # Not resolved: the Python of a virtual environment is a link, and where the link is says which environment.
        return _replaced(self, {"interpreter": found or str(folder / Path(self.interpreter).expanduser())})

    def check(self, place: str, description: ModelDescription, findings: Findings) -> None:
        """Add a finding for every key of this section that does not fit the model.

        Args:
            place: the path of this section in the file, as `instances.pendulum`.
            description: the model description.
            findings: where the findings go.
        """

    def summary(self, description: ModelDescription) -> str:
        """In a few words what computes the model, for the page of `fmu-mesh check`."""
        return description.generation_tool or key_of(self)

    def other_kind(self, description: ModelDescription) -> str | None:  # noqa: ARG002  for kinds with a choice
        """What else the model could be used as, as the end of a sentence; None without a choice, or once it is made."""
        return None

    def stateless(self, description: ModelDescription) -> str | None:
        """Why the state of an instance cannot outlive its process, as the end of a sentence; None if it can."""
        return None if description.can_serialize_state else f"`{key_of(self)}` has none that can be written"


def key_of(section: InstanceSection | type[InstanceSection]) -> str:
    """The key that says of which kind a section is: `fmu`, `mujoco`, ..."""
    return str(cast("msgspec.Struct", section).__struct_config__.tag)


def keys_of(section: type[InstanceSection]) -> tuple[str, ...]:
    """All keys of a section."""
    return cast("type[msgspec.Struct]", section).__struct_fields__


def placed(
    section: InstanceSection,
    not_finite: Literal["stop", "record"] | None = None,
    process: ProcessConfig | None = None,
) -> InstanceSection:
    """A section without the common keys, which a plan has in fields of its own, but with `on_failure` and these."""
    common: dict[str, Any] = {
        "start_values": {},
        "inputs": {},
        "step_size": None,
        "group": None,
        "host": None,
        "not_finite": not_finite,
        "process": process,
        "extrapolation": None,
        "feedthrough": None,
    }
    return _replaced(section, common)


def _replaced(section: Section, values: Mapping[str, Any]) -> Section:
    struct = cast("Any", section)
    changed = {key: value for key, value in values.items() if key in keys_of(type(section))}
    return cast("Section", replace(struct, **changed))


class Kinds(Protocol):
    """The kinds of instances that are installed, as far as reading a configuration needs them."""

    def own(self) -> dict[str, type[InstanceSection]]:
        """The sections of the kinds that are part of fmu_mesh by key; the usual kind is the first."""
        ...

    def names(self) -> list[str]:
        """The keys of all installed kinds, ours first."""
        ...

    def section(self, key: str) -> type[InstanceSection]:
        """The section of the kind with one of these `names`.

        Raises:
            ConfigurationError: its package cannot be imported, or two packages have this key.
        """
        ...


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


class PhysicsSection(InstanceSection):
    """Base class of the sections of physics engines: other instances can be coupled to their joints and bodies."""

    __slots__ = ()

    controllers: list[ControllerConfig]
    actuators: list[ActuatorConfig]
    fluid_dynamics: list[FluidDynamicsConfig]
