"""From a configuration file to the plan of a run. Everything is checked here, before any process is started."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

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
from ..system.plan import Plan, make_plan
from ..system.point_loops import warn_of_point_loops
from ..system.process_sharing import Claims
from ..system.run_metadata import configuration_of
from ..system.scenario import Scenario
from ..system.solved_groups import blocks_of
from ..system.system import ResolvedSystem, build
from ..text import nearest_file
from ..variables.model_description import ModelDescription, Variable
from ..variables.value_conversion import ValueRefused, to_plain, to_value
from ..variables.value_types import PlainValue
from ..wire.runtime import why_not_shared
from .allowed_code import check_code
from .direct_dependence import with_feedthrough
from .options import PlanOptions
from .overriding import with_options
from .run_plan import RunPlan
from .sandbox import why_no_sandbox
from .state_file import StateFile

__all__ = ["KnownModels", "OtherStartValues", "check_reset", "planned", "planned_reset", "without_keys"]

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
                section = placed(config.instances[name])
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
    security = loaded.config.security
    if security is not None:
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
    sections = located

    def claimed(name: str) -> Claims:
        own = placed(sections[name])
        path = loaded.resolve(own.path) if own.path else Path()
        return known.claims(path, own, descriptions[name], loaded.config.limits)

    checked = partial(check_record, loaded)
    system = build(loaded, descriptions, findings, scenario, claimed, obstacles, checked, base_unit_of)
    for name, own in system.instances.items():
        check_messages(name, own.description, (*own.keys_in, *own.keys_out), obstacles)
    if options.keys_from is not None:
        system = _repeated(system, Path(options.keys_from))
    if loaded.config.simulation.loops == "solved" or blocks_of(loaded.config.members):
        system = with_feedthrough(system, sections, findings, warnings)
        findings.raise_any()
    _check_host(loaded.config, obstacles, warnings)
    contents = {name: content(Path(own.fmu), sections[name]) for name, own in system.instances.items()}
    plan = make_plan(system, findings=obstacles, contents=contents)
    warn_of_endings(loaded, system.records, warnings)
    warn_of_point_loops(plan, warnings)
    plan = replace(plan, system=replace(system, warnings=(*system.warnings, *warnings), topics=topics))
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
    return StateFile.read(Path(options.state)).begin(run) if options.state is not None else run


def _check_host(config: Config, obstacles: Findings, warnings: Findings) -> None:
    """Find what this host cannot do for a mesh, and say whom the mesh trusts here."""
    own = {name: section for name, section in config.instances.items() if config.process_of(section).is_sandboxed}
    elsewhere = {name: bool(section.host or section.interpreter) for name, section in own.items()}
    if elsewhere and (why := why_no_sandbox(config.zenoh, elsewhere)) is not None:
        obstacles.add("process.sandbox", *why)
    if (problem := config.recovery_problem) is not None:
        obstacles.add(*problem)
    if (group := config.runtime.share_with) is not None:
        trusted = f"the members of the group '{group}' are trusted as you are: they can read, set and end this mesh"
        warnings.add("runtime.share_with", trusted, "")
        if (why_not := why_not_shared(group)) is not None:
            obstacles.add("runtime.share_with", why_not, "a group of this host that you are a member of")


class OtherStartValues:
    """Decides whether start values of a further run, or of a reset, change nothing else of its plan.

    That is so if each is a value of a variable that is no structural parameter and has another start value in the plan,
    and if the plan uses start values for nothing else: no loop is iterated in Initialization Mode, there is no scenario
    and no state to begin with, and the instance has no input with a timeout or a key. The files of the models have to
    be as they were when the run was planned, unless nothing is loaded again.

    Args:
        run: the run.
        plan: plans it again for a reset, with these start values besides; None: from the configuration of the run.
        loads: whether models may be loaded again.

    Attributes:
        run: the run.
    """

    def __init__(
        self,
        run: RunPlan,
        plan: Callable[[Mapping[str, PlainValue]], RunPlan] | None = None,
        *,
        loads: bool = True,
    ) -> None:
        self.run, self._plan_again = run, plan or self._planned
        self._resets: dict[frozenset[str], OtherStartValues] = {}
        items = [item for node in run.plan.nodes.values() for item in node.instances]
        system = run.plan.system
        is_fixed = run.plan.initialization.loops or system.config.scenario is not None or run.begins_with is not None
        self._variables: dict[str, tuple[str, Variable, bool]] = {}
        for item in items if not (is_fixed or any(item.scenario for item in items)) else ():
            description, finite = system.instances[item.name].description, item.not_finite == "stop"
            for name in item.start_values if not (item.timeouts or item.keys_in) else ():
                variable = description.variable(name)
                if variable is not None and variable.causality != "structuralParameter":
                    self._variables[f"{item.name}.{name}"] = item.name, variable, finite
        loaded = items if loads else []
        self._models = [(Path(item.fmu), item.section, run.contents[item.name]) for item in loaded]
        self._archives = [path for path, _, _ in self._models if path.suffix == ".fmu" and path.is_file()]
        self._versions = [files.version_at(path) for path in self._archives]
        if not self._are_as_planned(self._models):
            self._variables.clear()
        self._models = [own for own in self._models if own[0] not in self._archives]

    def taken(self, start_values: Mapping[str, object]) -> dict[str, dict[str, PlainValue]] | None:
        """Those of one run, by `instance.variable`, as values by instance and variable.

        Returns:
            None: the run has to be planned, because a value changes more, or is wrong.
        """
        found = dict[str, dict[str, PlainValue]]()
        for path, value in start_values.items():
            if (known := self._variables.get(path)) is None:
                return None
            instance, variable, finite = known
            try:
                plain = to_plain(to_value(value, variable, finite=finite))
            except ValueRefused:
                return None
            found.setdefault(instance, {})[variable.name] = plain
        with suppress(OSError):
            if [files.version_at(path) for path in self._archives] == self._versions:
                return found if self._are_as_planned(self._models) else None
        return None

    def of_reset(self, start_values: Mapping[str, PlainValue]) -> tuple[Plan, Mapping[str, Mapping[str, PlainValue]]]:
        """The plan of a reset of the run to these start values, and those that the plan has not.

        It is planned once for the same variables, if that is enough.

        Raises:
            ConfigurationError: a start value is wrong, or changes the size of an array; carries all findings.
        """
        if not start_values:
            return self.run.plan, {}
        before = self._resets.get(names := frozenset(start_values))
        if before is not None and (values := before.taken(start_values)) is not None:
            return before.run.plan, values
        again = self._plan_again(start_values)
        check_reset(self.run, again)
        self._resets[names] = OtherStartValues(again, loads=False)
        return again.plan, {}

    def _planned(self, start_values: Mapping[str, PlainValue]) -> RunPlan:
        return planned_reset(self.run, start_values, 0, KnownModels.of(self.run))

    @staticmethod
    def _are_as_planned(models: Sequence[tuple[Path, InstanceSection, str]]) -> bool:
        try:
            return all(content(path, section) == known for path, section, known in models)
        except LoadFailed:
            return False


def planned_reset(run: RunPlan, start_values: Mapping[str, PlainValue], resets: int, known: KnownModels) -> RunPlan:
    """The plan of a run from its first point again, by the same processes, after so many resets.

    Args:
        run: the first run.
        start_values: the start values that differ from those of the first run, by `instance.variable`.
        resets: number of resets, this one included.
        known: its models.

    Raises:
        ConfigurationError: a start value is wrong, or more would change than values; carries all findings.
    """
    plain = PlainConfig(configuration_of(run.loaded), run.loaded.file)
    again = planned(plain, PlanOptions(start_values=dict(start_values), allow_code=True), known=known)
    check_reset(run, again)
    return replace(run, loaded=again.loaded, plan=again.plan).after_resets(resets)


def check_reset(run: RunPlan, again: RunPlan) -> None:
    """Check that a run can be reset to another plan of the same mesh.

    Raises:
        ConfigurationError: more would change than values.
    """
    if run.begins_with is not None or _without_start_values(again) != _without_start_values(run):
        why = "it would have other sizes, or a file of it has changed"
        text = f"mesh '{run.mesh}' cannot be reset: {why if run.begins_with is None else 'it has begun with a state'}"
        raise ConfigurationError(text, hint="Start it again.")


def _without_start_values(run: RunPlan) -> object:
    """What must stay as it is in a reset, because processes and their links have it."""
    plain: dict[str, Any] = {"start_values": {}, "timeouts": ()}
    return run.contents, {
        name: replace(node, digest="", records=(), instances=tuple(replace(own, **plain) for own in node.instances))
        for name, node in run.plan.nodes.items()
    }


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
        process = loaded.config.process_of(section)
        own = placed(section, process=process if section.follows_fmi and process.is_sandboxed else None)
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
