"""From a configuration file to a plan: everything is checked here, before anything is spawned."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

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
from .options import Options, with_options
from .results import check_results

__all__ = ["planned", "prepare"]


def prepare(
    path: Path,
    options: Options = Options(),  # noqa: B008 a frozen Struct
    tell: Callable[[str], None] = lambda _text: None,
) -> Plan:
    """Read, check and plan the configuration at ``path``.

    Args:
        path: the YAML file.
        options: what the command line changes.
        tell: called with what takes its time, such as compiling an FMU, before it begins.

    Raises:
        ConfigurationError: with everything that is wrong with it or its FMUs.
    """
    loaded, findings = examine(path, options.start_values)
    return planned(loaded, findings, options, tell)


def planned(
    loaded: LoadedConfig, findings: Findings, options: Options, tell: Callable[[str], None] = lambda _text: None
) -> Plan:
    """Check and plan a configuration whose structure was examined; ``findings`` are those of its structure.

    Raises:
        ConfigurationError: with everything that is wrong with it or its FMUs.
    """
    loaded = with_options(loaded, options, findings)
    descriptions, unreadable = _descriptions(loaded, tell)
    findings.merge(unreadable)
    resolve_ros(loaded, descriptions, findings)
    system = build(loaded, descriptions, tuple(findings))
    check_results(loaded, system)
    check_showing(system, options.showing)
    sections = loaded.config.instances
    contents = {name: content(Path(own.fmu), sections[name]) for name, own in system.instances.items()}
    return make_plan(system, file=str(loaded.file), contents=contents)


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
