"""From a configuration file to the plan of a run. Everything is checked here, before any process is started."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from msgspec.structs import replace

from .. import files
from ..config.findings import Findings
from ..config.loading import LoadedConfig, examine
from ..config.mesh import AnyInstanceConfig, GazeboClassicConfig, InstanceConfig, MujocoConfig, PidConfig
from ..errors import Finding, LoadFailed
from ..instances.fmi import Terms
from ..instances.registry import check_showing, content, describe, expected_model
from ..ros.gateway.mapping import resolve as resolve_ros
from ..system.plan import Plan, make_plan
from ..system.system import build
from ..text import nearest_file
from ..variables.model_description import ModelDescription
from .options import Options
from .results import check_results
from .run_plan import RunPlan

__all__ = ["Options", "plan_run", "planned", "prepare"]


def prepare(
    path: Path,
    options: Options = Options(),  # noqa: B008 a frozen Struct
    tell: Callable[[str], None] = lambda _text: None,
) -> Plan:
    """As `plan_run`, for callers that need only the plan of the mesh."""
    return plan_run(path, options, tell).plan


def plan_run(
    path: Path,
    options: Options = Options(),  # noqa: B008 a frozen Struct
    tell: Callable[[str], None] = lambda _text: None,
) -> RunPlan:
    """Read, check and plan the configuration at ``path``.

    Args:
        path: the YAML file.
        options: what the command line changes.
        tell: called before something that takes long, such as compiling an FMU.

    Raises:
        ConfigurationError: the configuration or an FMU is wrong; carries all findings.
    """
    loaded, findings = examine(path, options.start_values)
    return planned(loaded, findings, options, tell)


def planned(
    loaded: LoadedConfig, findings: Findings, options: Options, tell: Callable[[str], None] = lambda _text: None
) -> RunPlan:
    """Check and plan a configuration whose structure was examined; ``findings`` are those of its structure.

    Raises:
        ConfigurationError: the configuration or an FMU is wrong; carries all findings.
    """
    loaded = _with_options(loaded, options)
    descriptions, unreadable = _descriptions(loaded, tell)
    findings.merge(unreadable)
    resolve_ros(loaded, descriptions, findings)
    system = build(loaded, descriptions, tuple(findings))
    check_results(loaded, system)
    check_showing(system, options.showing)
    sections = loaded.config.instances
    contents = {name: content(Path(own.fmu), sections[name]) for name, own in system.instances.items()}
    plan = make_plan(system, file=str(loaded.file), contents=contents)
    return RunPlan(loaded, options, plan, contents)


def _with_options(loaded: LoadedConfig, options: Options) -> LoadedConfig:
    section = loaded.config.zenoh
    zenoh = replace(
        section, connect=list(options.connect) or section.connect, listen=list(options.listen) or section.listen
    )
    config = replace(loaded.config, zenoh=zenoh)
    if options.window is not None:
        config = replace(config, simulation=replace(config.simulation, window=options.window))
    if (factor := options.real_time_factor) is not None:
        config = replace(config, simulation=replace(config.simulation, real_time_factor=factor))
        overrides = {"simulation.real_time_factor": f"--real-time-factor {factor:g}"}
        loaded = replace(loaded, overrides={**loaded.overrides, **overrides})
    if options.output is not None:
        config = replace(config, record=replace(config.record, file=str(options.output.absolute())))
        loaded = replace(loaded, overrides={**loaded.overrides, "record.file": f"--output {options.output}"})
    return replace(loaded, config=config)


def _descriptions(
    loaded: LoadedConfig, tell: Callable[[str], None]
) -> tuple[dict[str, ModelDescription], Sequence[Finding]]:
    """The description of every instance whose model can be read, and a finding for every other."""
    cache: dict[tuple[Path, Terms, str], ModelDescription | LoadFailed] = {}
    descriptions: dict[str, ModelDescription] = {}
    findings = []
    for name, instance in loaded.config.instances.items():
        if not instance.path and not isinstance(instance, PidConfig):
            continue  # what stands there instead is a finding already
        path, key = loaded.resolve(instance.path), None
        if isinstance(instance, InstanceConfig):
            terms = Terms(loaded.config.limits, instance.sha256)
            key = (path, terms, instance.kind)
        else:
            terms = Terms()
        found = cache.get(key) if key is not None else None
        if found is None:
            try:
                found = describe(path, instance, terms, tell)
            except LoadFailed as error:
                found = error
        if key is not None:
            cache[key] = found
        if isinstance(found, LoadFailed):
            text = found.message.rstrip(".") + (f" ({found.hint.rstrip('.')})" if found.hint else "")
            place = f"instances.{name}.{_key_of_path(instance)}"
            expected = expected_model(instance)
            if not files.exists(path) and files.exists(Path(instance.path)):
                expected += "; paths are relative to the configuration file"
            findings.append(loaded.finding(place, text, expected, _similar(path)))
        else:
            descriptions[name] = found
            findings += _strict_findings(loaded, name, instance, found)
    return descriptions, findings


def _strict_findings(
    loaded: LoadedConfig, name: str, instance: AnyInstanceConfig, description: ModelDescription
) -> Iterable[Finding]:
    """The problems of an FMU, where the configuration says that they are errors."""
    if not isinstance(instance, InstanceConfig):
        return
    for problem in description.problems if loaded.config.is_strict(instance) else ():
        text = " ".join(problem.split())
        yield loaded.finding(f"instances.{name}.fmu", text, "an FMU without problems, or `strict: false`")


def _key_of_path(instance: AnyInstanceConfig) -> str:
    """Where the file of an instance stands in its section."""
    match instance:
        case MujocoConfig():
            return "mujoco"
        case GazeboClassicConfig():
            return "gazebo_classic"
        case _:
            return "fmu"


def _similar(path: Path) -> str | None:
    """The nearest existing file name, if there is no such file."""
    return None if files.exists(path) else nearest_file(path)
