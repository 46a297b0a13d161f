"""From a configuration file to the plan of a run. Everything is checked here, before any process is started."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

import msgspec
from msgspec.structs import replace

from .. import files
from ..config.findings import Findings
from ..config.instance_sections import InstanceSection, key_of, placed
from ..config.loading import LoadedConfig, PlainConfig, read_scenario
from ..config.mesh import Config, LimitsConfig
from ..config.ros_section import MeshTopic
from ..errors import ConfigurationError, Finding, LoadFailed
from ..instances.configuration import examine_data
from ..instances.contract import Showing
from ..instances.python.unit_names import base_unit_of
from ..instances.registry import check_showing, claims, content, describe, expected_model, needs_compiler
from ..results.formats import check_record, warn_of_endings
from ..results.keys_file import KEYS_ENDING, keys_beside, recorded_keys
from ..ros_wire.key_messages import check_messages
from ..system.initialization_plan import warn_of_start_values
from ..system.plan import make_plan
from ..system.point_loops import warn_of_point_loops
from ..system.process_sharing import Claims
from ..system.scenario import Scenario
from ..system.system import ResolvedSystem, build
from ..text import nearest_file
from ..variables.model_description import ModelDescription
from ..wire.runtime import why_not_shared
from .allowed_code import check_code
from .direct_dependence import with_feedthrough
from .options import PlanOptions
from .overriding import with_options
from .run_plan import RunPlan
from .sandbox import why_no_sandbox
from .state_file import StateFile

__all__ = ["KnownModels", "planned", "without_keys"]

_MOST_KNOWN = 256
T = TypeVar("T")


class KnownModels:
    """Model descriptions that were read before, for plans of the same models: a model is read again if it has changed.

    Example:
        >>> from fmu_mesh.config.mesh import LimitsConfig
        >>> from fmu_mesh.instances.registry import KINDS
        >>> section = KINDS.section("fmu")(fmu="fmus/Gain.fmu")
        >>> known = KnownModels()
        >>> first = known.describe(Path("fmus/Gain.fmu"), section, LimitsConfig())
        >>> known.describe(Path("fmus/Gain.fmu"), section, LimitsConfig()) is first
        True

    Args:
        keeps_code: whether components are known, too: right where the code of a process stays as it was imported. The
            content of a component does not cover what it imports, so otherwise it is described anew for each plan.
    """

    def __init__(self, *, keeps_code: bool = False) -> None:
        self._keeps_code = keeps_code
        self._models: dict[tuple[str, str, bytes], tuple[str, object]] = {}

    @classmethod
    def of(cls, run: RunPlan) -> KnownModels:
        """Those of a run: none of its models is read again as long as its files stay as they are.

        But those whose instances may have other sizes than their model are.
        """
        known, config = cls(keeps_code=True), run.loaded.config
        for name, own in run.plan.system.instances.items():
            if not own.description.with_causality("structuralParameter"):
                section = config.model_section(config.instances[name])
                path = run.loaded.resolve(section.path) if section.path else Path()
                model = "description", os.path.realpath(path), msgspec.json.encode((section, config.limits))
                known._models[model] = run.contents[name], own.description
        return known

    def describe(
        self,
        path: Path,
        section: InstanceSection,
        limits: LimitsConfig,
        tell: Callable[[str], None] = lambda _text: None,
    ) -> ModelDescription:
        """The model description of an instance; see `fmu_mesh.instances.registry.describe`.

        Raises:
            LoadFailed: the model cannot be read.
        """
        if section.names_code and not self._keeps_code:
            return describe(path, section, limits, tell)
        return self._known("description", path, section, limits, lambda: describe(path, section, limits, tell))

    def needs_compiler(self, path: Path, section: InstanceSection, limits: LimitsConfig) -> bool:
        """Whether to describe a model compiles it."""
        return self._known("compiling", path, section, limits, lambda: needs_compiler(path, section, limits))

    def claims(
        self, path: Path, section: InstanceSection, description: ModelDescription, limits: LimitsConfig
    ) -> Claims:
        """What an instance claims of its process; see `fmu_mesh.instances.registry.claims`.

        Raises:
            LoadFailed: the model cannot be read.
        """
        return self._known("claims", path, section, limits, lambda: claims(path, section, description, limits))

    def _known(self, what: str, path: Path, section: InstanceSection, limits: LimitsConfig, read: Callable[[], T]) -> T:
        model = what, os.path.realpath(path), msgspec.json.encode((section, limits))
        if model in self._models:
            version, known = self._models[model]
            with suppress(LoadFailed):  # `read` says why
                if content(path, section) == version:
                    return cast("T", known)
        found = read()
        with suppress(LoadFailed):  # whoever needs its content says why
            self._models[model] = content(path, section), found
        if len(self._models) > _MOST_KNOWN:
            del self._models[next(iter(self._models))]
        return found


def planned(
    values: PlainConfig,
    options: PlanOptions,
    tell: Callable[[str], None] = lambda _text: None,
    known: KnownModels | None = None,
) -> RunPlan:
    """Check and plan a configuration.

    Args:
        values: the values of the configuration.
        options: what replaces some of them.
        tell: called before something that takes long, such as compiling an FMU.
        known: model descriptions that were read before; those that are read now are added. None: all are read.

    Raises:
        ConfigurationError: the configuration or an FMU is wrong; carries all findings.
    """
    loaded, findings = examine_data(with_options(values, options), dict(options.start_values or {}))
    folder = loaded.file.absolute().parent  # paths become absolute where a section names other files than its model
    located = {name: section.located(folder) for name, section in loaded.config.instances.items()}
    if (security := loaded.config.security) is not None:
        security = replace(security, folder=str(folder / security.folder))
    loaded = replace(loaded, config=replace(loaded.config, instances=located, security=security))
    showing = Showing(view=options.view, video=Path(options.video).absolute() if options.video else None)
    known = known or KnownModels()
    allowed = "because of `allow_code=True`" if options.allow_code else ""
    check_code(loaded, findings, tell, allowed, known.needs_compiler)
    obstacles = loaded.findings()
    if not len(findings):  # otherwise the world may be what is wrong
        try:
            check_showing(loaded.config.instances, showing)
        except ConfigurationError as error:
            obstacles.add("`view=True`" if options.view else f"`video={options.video}`", str(error), "")
    descriptions, unreadable = _descriptions(loaded, findings.places, tell, known)
    findings.merge(unreadable)
    warnings, topics = loaded.findings(), tuple[MeshTopic, ...]()
    if loaded.config.ros is not None:
        from ..ros.gateway.mapping import resolve  # noqa: PLC0415 most configurations have no such section

        ros = resolve(loaded, descriptions, findings, warnings)
        topics = ros.listed if ros is not None else ()
    scenario = _scenario(loaded, descriptions, findings)

    def claimed(name: str) -> Claims:
        own = placed(located[name])
        path = loaded.resolve(own.path) if own.path else Path()
        return known.claims(path, own, descriptions[name], loaded.config.limits)

    checked = partial(check_record, loaded)
    system = build(loaded, descriptions, findings, scenario, claimed, obstacles, checked, base_unit_of)
    for name, own in system.instances.items():
        check_messages(name, own.description, (*own.keys_in, *own.keys_out), obstacles)
    if options.keys_from is not None:
        system = _repeated(system, Path(options.keys_from))
    system = with_feedthrough(system, located, loaded.findings(), warnings)
    _check_host(loaded.config, descriptions, obstacles, warnings)
    contents = {name: content(Path(own.fmu), located[name]) for name, own in system.instances.items()}
    plan = make_plan(system, findings=obstacles, contents=contents)
    warn_of_endings(loaded, system.records, warnings)
    warn_of_start_values(system, plan.initialization.loops, warnings)
    warn_of_point_loops(plan, warnings)
    plan = replace(plan, system=replace(plan.system, warnings=(*system.warnings, *warnings), topics=topics))
    run = RunPlan(
        loaded,
        plan,
        contents,
        showing=showing,
        paused=options.paused,
        profile=options.profile is not False,
        connect=tuple(options.connect or ()),
    )
    obstacles.raise_any(run)
    state = StateFile.of(options)
    return state.begin(run, options.replaced) if state is not None else run


def _check_host(
    config: Config, descriptions: Mapping[str, ModelDescription], obstacles: Findings, warnings: Findings
) -> None:
    """Find what this host cannot do for a mesh, and say whom the mesh trusts here."""
    own = {name: section for name, section in config.instances.items() if config.process_of(section).is_sandboxed}
    elsewhere = {name: bool(section.host or section.interpreter) for name, section in own.items()}
    if elsewhere and (why := why_no_sandbox(config.zenoh, elsewhere)) is not None:
        obstacles.add("process.sandbox", *why)
    for name, section in config.instances.items():
        if config.process_of(section).sandbox == "wasm" and not section.follows_fmi:
            found = f"wasm for '{name}', which is no FMU and has no sources for a compiler of C"
            obstacles.add(f"instances.{name}.process.sandbox", found, "`sandbox: none` for this instance")
    for name in own:
        if name in descriptions and descriptions[name].runs == "wine":
            obstacles.add("process.sandbox", f"a sandbox for '{name}', which runs under Wine", "`sandbox: none`")
    if (problem := config.recovery_problem) is not None:
        obstacles.add(*problem)
    if (group := config.runtime.share_with) is not None:
        trusted = f"the members of the group '{group}' are trusted as you are: they can read, set and end this mesh"
        warnings.add("runtime.share_with", trusted, "")
        if (why_not := why_not_shared(group)) is not None:
            obstacles.add("runtime.share_with", why_not, "a group of this host that you are a member of")


def _repeated(system: ResolvedSystem, result: Path) -> ResolvedSystem:
    """The system with the values of keys of an earlier run, and without keys of its own."""
    known = result.name.endswith(KEYS_ENDING) or not result.is_file() or str(result) == os.devnull
    recorded = recorded_keys(result if known else keys_beside(result))
    if system.result_file is not None and recorded.path == str(keys_beside(Path(system.result_file)).absolute()):
        text = f"'{system.result_file}' is the result whose values of keys this run takes, and would be replaced"
        raise ConfigurationError(text, hint="Write this one to another file with `output=...`.")
    alone = {name: replace(own, keys_out=()) for name, own in system.instances.items()}
    return replace(system, instances=alone, recorded_keys=recorded)


def without_keys(run: RunPlan) -> RunPlan:
    """The plan without keys at ends of connections, for a program that sets inputs itself: they are free."""
    system = run.plan.system
    free = {name: replace(own, keys_in=(), keys_out=()) for name, own in system.instances.items()}
    if free == system.instances:
        return run
    return replace(run, plan=make_plan(replace(system, instances=free), contents=run.contents))


def _scenario(
    loaded: LoadedConfig, descriptions: Mapping[str, ModelDescription], findings: Findings
) -> Scenario | None:
    """The scenario with the values of its bags; None if there is none, or after a finding."""
    try:
        source = read_scenario(loaded, findings)
    except ConfigurationError as error:
        findings.merge(error.findings)
        return None
    if source is None:
        return None
    from ..ros.bags.bag import bag_values  # noqa: PLC0415 as above

    own = findings if source.prefix else source.findings()
    bags = bag_values(source, loaded, descriptions, own)
    if own is not findings:
        findings.merge(own)
    return Scenario(source, bags, base_unit_of)


def _descriptions(
    loaded: LoadedConfig,
    known_places: AbstractSet[str],
    tell: Callable[[str], None],
    known: KnownModels,
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
        own = loaded.config.model_section(section)
        path = loaded.resolve(section.path) if section.path else Path()
        model = (path, msgspec.json.encode(own))
        if model not in cache:
            try:
                cache[model] = known.describe(path, own, loaded.config.limits, tell)
            except LoadFailed as error:
                cache[model] = error
        found = cache[model]
        if isinstance(found, LoadFailed):
            text = found.message.rstrip(".") + (f" ({found.hint.rstrip('.')})" if found.hint else "")
            expected = expected_model(section)
            if not _leads_somewhere(path) and _leads_somewhere(Path(section.path)):
                expected += "; paths are relative to the configuration file"
            near = None if files.exists(path) else nearest_file(path)
            findings.append(loaded.finding(place, text, expected, near))
            continue
        descriptions[name] = found
        if loaded.config.is_strict(section):
            expected = "an FMU without problems, or `strict: false`"
            findings += [loaded.finding(place, " ".join(text.split()), expected) for text in found.problems]
    return descriptions, findings


def _leads_somewhere(path: Path) -> bool:
    """Whether there is something at the path, or an archive that it leads into."""
    return files.exists(path) or files.archive_on_the_way(path) is not None
