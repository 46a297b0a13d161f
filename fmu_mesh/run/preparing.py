"""From a configuration file to the plan of a run. Everything is checked here, before any process is started."""

from __future__ import annotations

import os
import pwd
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from types import MappingProxyType

import msgspec
from msgspec.structs import replace

from .. import files
from ..config.findings import Findings
from ..config.instance_sections import InstanceSection, key_of, placed
from ..config.loading import LoadedConfig, read_file
from ..errors import Finding, LoadFailed
from ..instances.configuration import examine_data
from ..instances.registry import check_showing, content, describe, expected_model
from ..ros.gateway.mapping import resolve as resolve_ros
from ..system.plan import Plan, make_plan
from ..system.system import build
from ..text import nearest_file
from ..variables.model_description import ModelDescription
from .options import Options, with_config_values, with_options
from .results import check_results
from .run_plan import RunPlan

__all__ = ["plan_run", "planned", "prepare"]


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
    loaded, findings = examine_data(with_config_values(read_file(path), options.config_values), options.start_values)
    return planned(loaded, findings, options, tell)


def planned(
    loaded: LoadedConfig,
    findings: Findings,
    options: Options,
    tell: Callable[[str], None] = lambda _text: None,
    known: Mapping[str, ModelDescription] = MappingProxyType({}),
) -> RunPlan:
    """Check and plan a configuration whose structure was examined.

    Args:
        loaded: the configuration.
        findings: those of its structure.
        options: what the command line changes.
        tell: called before something that takes long, such as compiling an FMU.
        known: model descriptions that were read before, by instance name.

    Raises:
        ConfigurationError: the configuration or an FMU is wrong; carries all findings.
    """
    loaded = _located(with_options(loaded, options, findings))
    if not options.allow_code:
        _check_owner(loaded, findings)
    if not len(findings):  # otherwise the world may be what is wrong
        check_showing(loaded.config.instances, options.showing)
    descriptions, unreadable = _descriptions(loaded, findings.places, tell, known)
    findings.merge(unreadable)
    resolve_ros(loaded, descriptions, findings)
    system = build(loaded, descriptions, tuple(findings))
    check_results(loaded, system)
    sections = loaded.config.instances
    contents = {name: content(Path(own.fmu), sections[name]) for name, own in system.instances.items()}
    plan = make_plan(system, file=str(loaded.file), contents=contents)
    return RunPlan(loaded, options, plan, contents)


def _descriptions(
    loaded: LoadedConfig,
    known_places: AbstractSet[str],
    tell: Callable[[str], None],
    known: Mapping[str, ModelDescription],
) -> tuple[dict[str, ModelDescription], Sequence[Finding]]:
    """The description of every instance whose model can be read, and a finding for every other.

    ``known_places`` are the places of earlier findings: an empty path stands for a section with one of them.
    """
    cache: dict[tuple[Path, bytes], ModelDescription | LoadFailed] = {}
    descriptions: dict[str, ModelDescription] = {}
    findings = []
    for name, section in loaded.config.instances.items():
        key = key_of(section)
        place = f"instances.{name}.{key}"
        if place in known_places:
            continue  # such as code that may not run
        if getattr(section, key) == "":
            if not any(f"{other}.".startswith(f"instances.{name}.") for other in known_places):
                findings.append(loaded.finding(place, "an empty path", expected_model(section)))
            continue
        path, own = loaded.resolve(section.path) if section.path else Path(), placed(section)
        model = (path, msgspec.json.encode(own))
        if model not in cache:
            try:
                cache[model] = known[name] if name in known else describe(path, own, loaded.config.limits, tell)
            except LoadFailed as error:
                cache[model] = error
        found = cache[model]
        if isinstance(found, LoadFailed):
            text = found.message.rstrip(".") + (f" ({found.hint.rstrip('.')})" if found.hint else "")
            findings.append(loaded.finding(place, text, _expected(section, path), _similar(path)))
            continue
        descriptions[name] = found
        if loaded.config.is_strict(section):
            expected = "an FMU without problems, or `strict: false`"
            findings += [loaded.finding(place, " ".join(text.split()), expected) for text in found.problems]
    return descriptions, findings


def _located(loaded: LoadedConfig) -> LoadedConfig:
    """The configuration with absolute paths where a section names other files than its model."""
    folder = loaded.file.absolute().parent
    sections = {name: section.located(folder) for name, section in loaded.config.instances.items()}
    return replace(loaded, config=replace(loaded.config, instances=sections))


def _check_owner(loaded: LoadedConfig, findings: Findings) -> None:
    """Check that the code in a configuration is named by this user, or by root: everybody else could run code as us."""
    try:
        owner = loaded.file.stat().st_uid
    except OSError:
        return  # there is no file: a program of this user has made the configuration
    if owner in {os.getuid(), 0}:
        return
    for name, section in loaded.config.instances.items():
        if section.names_code:
            found = f"Python code, in a file of the user {_user(owner)}"
            findings.add(f"instances.{name}.{key_of(section)}", found, "a file of your own, or `--allow-code`")


def _user(uid: int) -> str:
    try:
        return f"'{pwd.getpwuid(uid).pw_name}'"
    except KeyError:
        return str(uid)


def _expected(section: InstanceSection, path: Path) -> str:
    """In words, what the file of a model should be, where the one at ``path`` is not."""
    elsewhere = not files.exists(path) and files.exists(Path(section.path))
    return expected_model(section) + ("; paths are relative to the configuration file" if elsewhere else "")


def _similar(path: Path) -> str | None:
    """The nearest existing file name, if there is no such file."""
    return None if files.exists(path) else nearest_file(path)
