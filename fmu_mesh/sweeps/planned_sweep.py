"""From what a user asks to a planned sweep: variants with their ids, what every worker gets, and the folder.

All that is wrong with the mesh, the parameters, or the columns is told here, before anything runs.
"""

import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from .. import __version__
from ..api.mesh_builder import Mesh, load
from ..api.mesh_check import together
from ..api.result import Result, types_of
from ..config.call_options import takes
from ..config.loading import PlainConfig
from ..config.mesh import Config
from ..errors import CallRefused, ConfigurationError, FmuError
from ..run.allowed_code import check_owner
from ..run.one_process import apart
from ..run.options import VariantOptions
from ..run.run_plan import RunPlan
from ..text import did_you_mean, listed, meant, nearest
from .reductions import check_reductions, read_reduction
from .sweep_folder import SweepFolder, Wanted, identity_of, is_sweep
from .sweep_options import Own, SweepOptions
from .variant_run import Common, OwnReductions, Row, SweepTask, curves_of, options_of_variant
from .variants import Parameters, variants_of

__all__ = ["Own", "PlannedSweep", "SweepOptions", "continued_sweep", "planned_sweep"]

log = logging.getLogger("fmu_mesh.run")

_OPTION = re.compile(r"`(start_values|config_values)=\{'([^']+)': ")

_DEPRECATED = (
    "the option that runs each variant in processes goes in two versions: leave it out; variants whose instances may "
    "not share a process get processes without it"
)

_OF_EACH_RUN = [name for name in VariantOptions.__struct_fields__ if name != "on_notice"]


class PlannedSweep(NamedTuple):
    """A sweep that can run."""

    wanted: Wanted  # what was asked
    folder: SweepFolder  # where everything goes
    plan: RunPlan  # the plan of a variant, for what all have in common
    columns: tuple[str, ...]  # what is calculated from the curves of each run
    functions: OwnReductions  # the columns that functions of the user calculate
    task: bytes  # what every worker gets
    at_once: int | None  # how many variants may be under way, because of `max_instances`; None: any number
    found: dict[str, Row]  # the rows that are in the folder already, by their id


@takes(SweepOptions)
def planned_sweep(
    mesh: Mesh | str | Path, vary: Mapping[str, Any] | Iterable[Mapping[str, Any]], options: SweepOptions
) -> PlannedSweep:
    """Plan a sweep; arguments and errors are those of `sweep`."""
    own = mesh if isinstance(mesh, Mesh) else load(mesh)
    variants = variants_of(vary, options.sampler, options.seed)
    _check_names(own, list(variants[0]))
    given = options.given()
    base = {name: given[name] for name in _OF_EACH_RUN if name in given}
    if options.replaced:
        base["replaced"] = [*options.replaced]
    if options.state is not None:
        base["state"] = str(Path(options.state).absolute())
    folder = SweepFolder(Path(options.folder).absolute() if options.folder is not None else _usual_folder(own, base))
    if options.resume and options.force:
        text = "`resume=True` keeps the runs of the folder, and `force=True` removes them"
        raise CallRefused(text, hint="Choose one of them.")
    errors = []
    if is_sweep(folder.path) and not (options.resume or options.force):
        hint = "Continue it with `resume=True`, replace it with `force=True`, or choose another folder."
        errors.append(ConfigurationError(f"there is a sweep in '{folder.path}' already", hint=hint))
    wanted = Wanted(
        version=__version__,
        mesh=own.name,
        file=str(own.configuration.file.absolute()),
        data=own.configuration.data,
        options=base,
        names=tuple(variants[0]),
        variants=tuple(tuple(variant.values()) for variant in variants),
        curves=options.curves,
        processes=options.processes,
        reset=options.reset,
        most_instances=dict(options.max_instances),
    )
    tell = options.on_notice or log.info
    if options.processes:
        tell(f"warning: {_DEPRECATED}")
    try:
        plan = _any_plan(own, base, wanted, tell)
    except ConfigurationError as error:
        raise together(str(own.configuration.file), [error, *errors]) from error
    if errors:
        raise errors[0]
    if not wanted.processes and (why := apart(plan.plan)):
        tell(f"each run of the sweep starts processes, because {why[0]}")
        wanted = replace(wanted, processes=True)
    recorded = types_of(plan.plan.system) or {}
    asked = options.reduce or [f"last({name})" for name in recorded]
    texts = [one for one in asked if isinstance(one, str)]
    check_reductions([read_reduction(text) for text in texts], recorded)
    wanted = replace(wanted, recorded=tuple(recorded), reductions=tuple(texts), units=_units(plan, wanted.names))
    functions = {_column(one): one for one in options.reduce if not isinstance(one, str)}
    if options.force:
        folder.clear()
    return _planned(own, plan, wanted, folder, functions)


def continued_sweep(
    folder: Path, *, allow_code: bool = False, on_notice: Callable[[str], None] = log.info
) -> PlannedSweep:
    """Plan what is missing of the sweep in a folder; ``allow_code`` also runs it if another user owns it.

    Raises:
        ConfigurationError: there is no sweep in the folder, another user has made it, or its mesh cannot run any more.
    """
    own = SweepFolder(folder.absolute())
    wanted = own.wanted()
    source = f"the sweep in '{own.path}'"
    if not allow_code:
        check_owner(own.wanted_file, source)
    wanted = replace(wanted, options={**wanted.options, "allow_code": allow_code})  # a file cannot allow its own code
    mesh = Mesh.from_configuration(PlainConfig(wanted.data, Path(wanted.file), foreign=source))
    return _planned(mesh, _any_plan(mesh, wanted.options, wanted, on_notice), wanted, own, {})


def _planned(mesh: Mesh, plan: RunPlan, wanted: Wanted, folder: SweepFolder, functions: OwnReductions) -> PlannedSweep:
    wanted = replace(wanted, identities=_identities(mesh, plan, wanted))
    columns = (*wanted.reductions, *functions)
    common = {name: getattr(wanted, name) for name in Common.__struct_fields__}
    curves = folder.curves if wanted.curves else None
    task = SweepTask(**common, folder=curves, foreign=mesh.configuration.foreign)

    def is_kept(row: Row) -> bool:
        """What failed may be right now, unless an FMU failed: that would fail again."""
        has_curves = not wanted.curves or curves_of(folder.curves, row.id).is_file()
        is_whole = row.exit_code == 0 and has_curves and set(columns) <= {*row.values}
        return is_whole or row.exit_code == FmuError.exit_code

    return PlannedSweep(
        wanted=wanted,
        folder=folder,
        plan=plan,
        columns=columns,
        functions=functions,
        task=msgspec.msgpack.encode(task, enc_hook=str),
        at_once=_at_once(plan, wanted.most_instances),
        found={identity: row for identity, row in folder.rows().items() if is_kept(row)},
    )


def _check_names(mesh: Mesh, names: Sequence[str]) -> None:
    sections = [field.encode_name for field in msgspec.structs.fields(Config)]
    for name in names:
        first, dot, rest = name.partition(".")
        if first in mesh.instances and dot and rest:
            continue
        if first not in sections:
            found = f"'{name}' is neither a variable of an instance nor a key of the configuration."
            near = nearest(first, [*mesh.instances, *sections])
            there = f"There are the instances {listed(mesh.instances)}."
            raise ConfigurationError(found, hint=meant(near and f"{near}{dot}{rest}", there))


def _any_plan(mesh: Mesh, base: Mapping[str, Any], wanted: Wanted, tell: Callable[[str], None] = log.info) -> RunPlan:
    """The plan of the first variant, or of the last one: one of them may have values that are refused."""
    first: ConfigurationError | None = None
    for number in (0, len(wanted.variants) - 1):
        options = options_of_variant(base, mesh.instances, wanted.parameters(number))
        options["record"], options["on_notice"] = "memory", tell
        try:
            plan = mesh.plan(**options)
        except ConfigurationError as error:
            first = first or error
        else:
            for warning in plan.plan.system.warnings:
                tell(f"warning: {warning}")
            return plan
    assert first is not None
    raise _as_asked(first, wanted.names)


def _as_asked(error: ConfigurationError, names: Sequence[str]) -> ConfigurationError:
    """The error of a variant as one about what varies: that is not what the program has given for other options."""

    def asked(text: str) -> str:
        return _OPTION.sub(lambda found: found[0].replace(found[1], "vary", 1) if found[2] in names else found[0], text)

    findings = tuple(replace(finding, path=asked(finding.path)) for finding in error.findings)
    return ConfigurationError(asked(error.message), findings=findings, hint=error.hint)


def _identities(mesh: Mesh, plan: RunPlan, wanted: Wanted) -> tuple[str, ...]:
    """The id of each variant; where a parameter changes which models there are, their files are looked at, too."""
    contents: dict[tuple[Any, ...], Mapping[str, str]] = {}
    identities = []
    of_models = [name for name in wanted.names if name.startswith("instances.") and "instances" not in mesh.instances]
    for number in range(len(wanted.variants)):
        parameters = wanted.parameters(number)
        models = tuple(str(parameters[name]) for name in of_models)
        if models not in contents:
            contents[models] = _contents(mesh, wanted, parameters) if models else plan.contents
        identities.append(identity_of(wanted, parameters, contents[models]))
    return tuple(identities)


def _contents(mesh: Mesh, wanted: Wanted, parameters: Parameters) -> Mapping[str, str]:
    try:
        return mesh.plan(**options_of_variant(wanted.options, mesh.instances, parameters)).contents
    except ConfigurationError:
        return {}  # its row will say so


def _at_once(plan: RunPlan, most_instances: Mapping[str, int]) -> int | None:
    """How many variants may be under way; refuses a limit for no model, or one that a single variant exceeds."""
    limits = []
    models = [Path(own.fmu).name for own in plan.plan.system.instances.values() if own.fmu]
    for name, most in most_instances.items():
        needed = models.count(name)
        if not needed:
            hint = did_you_mean(name, models, f"There are {listed(sorted({*models}))}.")
            raise ConfigurationError(f"no instance has the model '{name}'", hint=hint)
        if most < needed:
            text = f"one run needs {needed} instances of '{name}', and {most} may exist at a time"
            raise ConfigurationError(text, hint=f"Allow {needed} or more.")
        limits.append(most // needed)
    return min(limits, default=None)


def _usual_folder(mesh: Mesh, base: Mapping[str, Any]) -> Path:
    """`<mesh>_sweep` beside the result file of the configuration; without one in the current folder."""
    options = options_of_variant(base, mesh.instances, {})
    try:
        file = mesh.plan(**options).plan.system.result_file
    except ConfigurationError:  # it can run with the parameters of its variants only
        file = None
    return (Path(file).parent if file is not None else Path.cwd()) / f"{mesh.name}_sweep"


def _units(plan: RunPlan, names: Sequence[str]) -> dict[str, str | None]:
    units = Result(plan.mesh, system=plan.plan.system).units
    for name in names:
        instance, _, variable = name.partition(".")
        own = plan.plan.system.instances.get(instance)
        found = own.description.variable_of(variable) if own is not None else None
        units[name] = found.unit if found is not None else None
    return units


def _column(function: Own) -> str:
    """The name of the column of a function of the user, which workers can import."""
    name = getattr(function, "__qualname__", "")
    if not name or "<" in name:
        found = f"the reduction '{name or type(function).__name__}' cannot be imported by the workers"
        raise ConfigurationError(found, hint="Write it as a function of a module.")
    return str(name)
