"""FMUs as a kind of instances: the section of a configuration, and how it is checked against the model description.

The code that reads, loads and calls FMUs is imported when it is used.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from msgspec import Meta
from msgspec.structs import replace

from ...config.base import POSITIVE, Base, Sha256
from ...config.findings import Findings
from ...config.instance_sections import (
    KIND,
    ExtrapolationOfInputs,
    Feedthrough,
    Group,
    Host,
    Inputs,
    InstanceSection,
    NotFinitePolicy,
    OnFailure,
    Process,
    StartValues,
    StepSize,
)
from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...rings.library import why_no_library
from ...system.process_sharing import Claims
from ...variables.model_description import ModelDescription
from ..contract import Instance, Kind, Opening
from .step_options import NO_STATE_OF_CVODE, SolverName, SolverSettings, StepOptions, Terms

__all__ = ["KIND_OF_FMUS", "FmuConfig", "SolverConfig"]

_DEFAULT_TOLERANCE = 1e-6
_GUEST_MEMORY = 1 << 30
"""How much memory an FMU in a sandbox of WebAssembly has without `memory`, in bytes."""


class SolverConfig(Base, frozen=True, kw_only=True):
    """How the continuous states of a model-exchange FMU are solved."""

    name: Annotated[
        SolverName,
        Meta(
            description="auto: dopri5, and cvode from where the model turns out to be stiff; dopri5: variable steps of "
            "order 5 in C, for models that are not stiff; cvode: variable step and order, also for stiff models; both "
            "find events exactly; euler: fixed steps, for checks."
        ),
    ] = "auto"
    relative_tolerance: Annotated[
        float | None,
        Meta(
            description="Relative tolerance of dopri5 and cvode; default: that of the default experiment of the FMU, "
            "or 1e-6.",
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


class FmuConfig(Base, InstanceSection, frozen=True, kw_only=True, tag_field=KIND, tag="fmu"):
    """One instance of an FMU."""

    follows_fmi: ClassVar[bool] = True

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
    inputs: Inputs = {}
    step_size: StepSize = None
    group: Group = None
    host: Host = None
    not_finite: NotFinitePolicy = None
    on_failure: OnFailure = "stop"
    process: Process = None
    extrapolation: ExtrapolationOfInputs = None
    feedthrough: Feedthrough = None
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
    deep_binding: Annotated[
        bool,
        Meta(
            description="Whether the library of the FMU finds its own functions and variables before those of the "
            "process (RTLD_DEEPBIND). false: for an FMU that replaces malloc, or runs under a preloaded allocator."
        ),
    ] = True

    @property
    def retries_steps(self) -> bool:
        """Whether a step that the FMU discards is repeated in smaller steps."""
        return self.retry_discarded_steps

    def agreed(self) -> Self:
        """The section without the path, without the expected SHA-256, and without what is only about findings."""
        return replace(self, fmu="", sha256=None, strict=None)

    def check(self, place: str, description: ModelDescription, findings: Findings) -> None:
        """Add a finding for every wish that the FMU cannot fulfil, by its capability flags."""
        settings = {
            "tolerance": self.tolerance,
            "solver.relative_tolerance": self.solver.relative_tolerance,
            "solver.maximum_step_size": self.solver.maximum_step_size,
        }
        for key, value in settings.items():
            if value is not None and not (math.isfinite(value) and value > 0.0):
                findings.add(f"{place}.{key}", f"{value:g}", "a number > 0")
        if description.kind == "co_simulation" and self.solver != SolverConfig():
            name = place.removeprefix("instances.")
            found = f"a solver for '{name}', which runs as co-simulation and has a solver of its own"
            findings.add(f"{place}.solver", found, "`kind: model_exchange`, or no solver")
        elif self.solver.name == "dopri5" and (why := why_no_library()) is not None:
            findings.add(f"{place}.solver.name", f"dopri5, whose steps the library of C takes; it is {why}", "`cvode`")
        if self.tolerance is not None and (refusal := _takes_no_tolerance(description)) is not None:
            why, expected = refusal
            findings.add(f"{place}.tolerance", f"{self.tolerance:g}, but {why}", expected)
        if self.retry_discarded_steps and (reason := _cannot_retry(description)) is not None:
            findings.add(f"{place}.retry_discarded_steps", f"true, but {reason}", "false")

    def summary(self, description: ModelDescription) -> str:
        """The version of FMI; the solver, or for co-simulation a tolerance that is set; what it runs in."""
        if description.kind == "co_simulation":
            solver = f", tolerance {self.tolerance:g}" if self.tolerance is not None else ""
        else:
            settings = self.solver_settings(description)
            tolerance = f" {settings.relative_tolerance:g}" if settings.name != "euler" else ""
            solver = f" model exchange, {settings.name}{tolerance}"
        return f"FMI {description.fmi_version}{solver}{_runs(description)}"

    def other_kind(self, description: ModelDescription) -> str | None:
        """See `InstanceSection`: `auto` uses the co-simulation of an FMU that has both."""
        if self.kind != "auto" or len(description.kinds) < 2:
            return None
        made = f"its co-simulation was made by {description.generation_tool or 'a tool that it does not name'}"
        tolerance = self.solver_settings(description).relative_tolerance
        return f"has both kinds; {made}; `kind: model_exchange` is solved by us with tolerance {tolerance:g}"

    def stateless(self, description: ModelDescription) -> str | None:
        """See `InstanceSection`: what the FMU says of itself, and whether the solver has a history."""
        if description.fmi_version.startswith("1."):
            return "FMI 1.0 has no states"
        if not description.can_serialize_state:
            able = "canSerialize" if description.can_get_and_set_state else "canGetAndSet"
            return f"its model description says so ({able}FMU{'s' if description.fmi_version[0] == '2' else 'S'}tate)"
        if description.kind == "model_exchange" and self.solver_settings(description).name == "cvode":
            return NO_STATE_OF_CVODE
        return None

    def solver_settings(self, description: ModelDescription) -> SolverSettings:
        """How the continuous states of a model-exchange FMU are solved; without the library of C, `auto` is `cvode`."""
        name = self.solver.name
        if name == "auto" and why_no_library() is not None:
            name = "cvode"
        tolerance = self.solver.relative_tolerance or description.default_experiment.tolerance or _DEFAULT_TOLERANCE
        return SolverSettings(name, tolerance, self.solver.maximum_step_size)


class FmuKind(Kind[FmuConfig]):
    """FMUs of FMI 1.0, 2.0 and 3.0, for co-simulation or model exchange."""

    section = FmuConfig
    expected = "an FMI 1.0, 2.0 or 3.0 FMU for this platform"

    def describe(
        self, path: Path, section: FmuConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """Read the model description; compile the FMU if it has no binary for this platform.

        What runs in a sandbox of bubblewrap is compiled there: a source can include any file that a compiler can read.
        """
        from .archive.reading import read_description  # noqa: PLC0415  FMPy is slow to import
        from .archive.sources import describe  # noqa: PLC0415  as above

        terms = Terms(limits, section.sha256)
        if section.process is not None and section.process.is_sandboxed:
            return read_description(path, terms, section.kind)
        return describe(path, terms, section.kind, tell, _guest_memory(section))

    def needs_compiler(self, path: Path, section: FmuConfig, limits: LimitsConfig) -> bool:
        """Whether it has neither a binary for this platform, nor one that was compiled before."""
        from .archive.sources import needs_compiler  # noqa: PLC0415  as above

        return needs_compiler(path, Terms(limits, section.sha256), section.kind, _guest_memory(section))

    def check_model(self, path: Path, description: ModelDescription, limits: LimitsConfig) -> None:
        """Look for the libraries of the system that the FMU needs."""
        from .archive.system_libraries import missing_libraries  # noqa: PLC0415  as above

        if description.library and (missing := missing_libraries(path, description.library, Terms(limits))):
            raise LoadFailed("; ".join(missing))

    def host_checks(self) -> Mapping[str, Callable[[], str]]:
        """Look for the compilers of sources."""
        from .archive.sources import find_compiler  # noqa: PLC0415  as above

        return {
            "C compiler": lambda: shlex.join(find_compiler(plus=False)),
            "C++ compiler": lambda: shlex.join(find_compiler(plus=True)),
        }

    def content(self, path: Path) -> str:
        """A SHA-256 of the archive, or of all files of an unpacked FMU."""
        from .archive.archive import content_of  # noqa: PLC0415  as above

        return content_of(path)

    def claims(self, path: Path, section: FmuConfig, description: ModelDescription, limits: LimitsConfig) -> Claims:
        """What its libraries have that a process has only once; nothing of what is compiled or another program runs."""
        from .archive.archive import opened  # noqa: PLC0415  as above
        from .archive.library_names import claims_of  # noqa: PLC0415  as above

        if description.library is None or description.runs != "native":
            return {}
        with opened(path, Terms(limits, section.sha256)) as fmu:
            return claims_of(fmu, description.library)

    def preload(self) -> None:
        """Import FMPy, and all that calls FMUs."""
        from . import opening  # noqa: F401, PLC0415  as above

    def prepare(self, opening: Opening[FmuConfig]) -> None:
        """Extract the FMU."""
        from .archive.sources import prepare  # noqa: PLC0415  as above

        terms = Terms(opening.limits, opening.section.sha256, opening.content)
        prepare(opening.path, opening.folder, terms, opening.description)

    def open(self, opening: Opening[FmuConfig]) -> Instance:
        """Extract, load and instantiate the FMU."""
        from .opening import open_instance, stepped  # noqa: PLC0415  as above

        section, description = opening.section, opening.description
        options = StepOptions(
            solver=section.solver_settings(description),
            tolerance=section.tolerance,
            retry_discarded_steps=section.retry_discarded_steps,
            linear_inputs=opening.linear_inputs,
            deep_binding=section.deep_binding,
            timeouts=opening.timeouts,
        )
        path, folder, terms = opening.path, opening.folder, Terms(opening.limits, section.sha256, opening.content)
        instance = open_instance(path, opening.name, description, folder, opening.log, terms, options, opening.kept)
        return stepped(instance, options) if opening.group is None else instance


KIND_OF_FMUS = FmuKind()  # what the entry point `fmu` names


def _guest_memory(section: FmuConfig) -> int | None:
    """The memory of its sandbox of WebAssembly in bytes; None if it has none."""
    own = section.process
    return (own.memory_bytes or _GUEST_MEMORY) if own is not None and own.sandbox == "wasm" else None


def _takes_no_tolerance(description: ModelDescription) -> tuple[str, str] | None:
    """Why an FMU cannot be told a tolerance, and what to write instead; None if it can."""
    if description.kind == "model_exchange":
        return "the FMU runs as model exchange, with a solver of ours", "`solver: {relative_tolerance: ...}`"
    if description.fmi_version.startswith("1."):
        return "co-simulation in FMI 1.0 cannot be told one (fmiInitializeSlave)", "no tolerance"
    return None


def _cannot_retry(description: ModelDescription) -> str | None:
    if description.kind == "model_exchange":
        return "a model-exchange FMU has no steps of its own to discard"
    if not description.can_handle_variable_step_size:
        return "the FMU does not handle a variable communication step size"
    if description.fmi_version.startswith("1.") and not description.can_reject_steps:
        return "the FMU cannot repeat a step (canRejectSteps)"
    if description.fmi_version.startswith("2.") and not description.can_get_and_set_state:
        return "the FMU cannot get and set its state, so it cannot go back to where the step began"
    return None


def _runs(description: ModelDescription) -> str:
    if description.runs == "wine":
        from .wine import wine_version  # noqa: PLC0415  what starts programs is slow to import

        return f", under {wine_version()}"
    return ", in WebAssembly" if description.runs == "wasm" else ""
