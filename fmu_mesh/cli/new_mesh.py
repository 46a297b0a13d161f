"""`new`: writes a commented configuration for FMUs, with suggested connections, and its schema for editors.

Owns the suggestions. What is suggested was checked in the same way as a configuration that a person wrote.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

import msgspec

from .. import files
from ..config.findings import Findings
from ..config.instance_sections import KIND
from ..config.loading import read_text
from ..config.mesh import ConnectionConfig, LimitsConfig
from ..config.structure import SCHEMA_ID, schema_text
from ..config.yaml_text import read
from ..errors import ConfigurationError, LoadFailed
from ..instances.configuration import installed_config
from ..instances.registry import KINDS, describe, needs_compiler
from ..run.options import PlanOptions
from ..run.preparing import planned
from ..simtime import steps_between
from ..ssp.configuration_files import names_package
from ..system.connections import Variables, resolve_connections, unit_warnings
from ..text import short_number, short_path, shown
from ..variables.model_description import ModelDescription, Variable
from .arguments import Runs
from .file_arguments import CONFIGURATION
from .output.terminal import teller

__all__ = ["RUNS", "Model", "configuration_for"]

_RESERVED: Final = "mesh"
"""A name that no instance may have."""
_STEP_S: Final = 0.01
_STOP_S: Final = 10.0
"""Where no FMU has a default experiment."""
_COMMENT: Final = 70
"""Characters of a comment about a variable."""
_PARAMETERS: Final = 8
"""Parameters of one FMU that are shown as comments."""


class Model(msgspec.Struct, frozen=True):
    """One FMU."""

    name: str  # of its instance
    path: str  # as the configuration names it
    description: ModelDescription | None  # None if it cannot run here
    problem: str = ""  # why not


def _new(arguments: argparse.Namespace) -> int:
    paths = _fmus(arguments.models or [Path()])
    file = arguments.output if arguments.output is not None else paths[0].parent / CONFIGURATION
    schema = file.with_suffix(".schema.json")
    if not arguments.force:
        _refuse_to_overwrite(file, schema)
    models = _models(paths, arguments.models, file.absolute().parent, quiet=arguments.quiet)
    text = configuration_for(models, mesh=_name(file.absolute().parent.name, ()), file=file, schema=schema.name)
    plan = planned(read_text(text, file), PlanOptions()).plan
    files.write_whole(file, text)
    files.write_whole(schema, schema_text(installed_config()))
    print(f"{short_path(file)}: {len(plan.system.instances)} instances, {len(plan.connections)} connections")
    print(f"schema for editors: {short_path(schema)}")
    for model in models:
        if model.description is None:
            print(f"left out: {model.path}: {model.problem}")
    print(f"Look at it, then run it with `fmu-mesh launch {file}`.")
    return 0


def _refuse_to_overwrite(file: Path, schema: Path) -> None:
    if files.exists(file):
        raise ConfigurationError(f"'{file}' exists.", hint="--force overwrites it, --output writes another file.")
    if files.exists(schema) and SCHEMA_ID not in schema.read_text(encoding="utf-8", errors="replace"):
        raise ConfigurationError(f"'{schema}' exists and is not ours.", hint="--force overwrites it.")


def _fmus(given: Sequence[Path]) -> list[Path]:
    """The FMUs that were given, and those in folders that were given."""
    found: list[Path] = []
    for path in given:
        is_unpacked = files.is_folder(path) and files.exists(path / "modelDescription.xml")
        own = sorted(path.glob("*.fmu")) if files.is_folder(path) and not is_unpacked else [path]
        if names_package(path) and own in ([], [path]):
            hint = f"`fmu-mesh launch {path}` runs it, `fmu-mesh convert {path} mesh.yaml` makes a file to change."
            raise ConfigurationError(f"'{path}' is a package of SSP, which says already what runs.", hint=hint)
        if not own:
            raise ConfigurationError(f"there is no FMU in '{path}'.", hint="Name a folder with FMUs, or FMUs.")
        if not files.exists(own[0]):
            raise ConfigurationError(f"'{path}': no such file")
        found += [one for one in own if one not in found]
    return found


def _models(paths: Sequence[Path], named: Sequence[Path], folder: Path, *, quiet: bool) -> list[Model]:
    models: list[Model] = []
    for path in paths:
        name = _name(path.stem, {_RESERVED, *(model.name for model in models)})
        absolute = path.absolute()
        written = os.path.relpath(absolute, folder)
        section = msgspec.convert({KIND: "fmu", "fmu": str(absolute)}, KINDS.section("fmu"))
        if path not in named and needs_compiler(absolute, section, LimitsConfig()):
            models.append(Model(name, written, None, "sources are compiled only if you name the file itself"))
            continue
        try:
            models.append(Model(name, written, describe(absolute, section, tell=teller(quiet=quiet))))
        except LoadFailed as error:
            models.append(Model(name, written, None, " ".join(error.message.split())))
    if all(model.description is None for model in models):
        raise ConfigurationError(f"none of {len(models)} FMUs can run here: {models[0].path}: {models[0].problem}")
    return models


def _name(text: str, taken: Iterable[str]) -> str:
    """A name for a mesh or an instance, like ``text``, that is not taken."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "mesh"
    name = name if name[0].isalpha() else f"_{name}"
    candidates = (name if number == 1 else f"{name}_{number}" for number in range(1, len([*taken]) + 3))
    return next(one for one in candidates if one not in taken)


def configuration_for(models: Sequence[Model], *, mesh: str, file: Path, schema: str) -> str:
    """The text of a configuration, which is going to be ``file``; FMUs that cannot run here become comments."""
    step, grid = _simulation(models)
    lines = [
        f"# yaml-language-server: $schema={schema}",
        "#",
        f"# `fmu-mesh check {file.name}` shows what would run, `fmu-mesh launch {file.name}` runs it.",
        "",
        f"mesh: {mesh}",
        "",
        *grid,
        "",
        "instances:",
        *(line for model in models for line in _instance(model, step)),
        "",
        *_connections({model.name: model.description for model in models if model.description is not None}),
        "",
        "# All outputs are recorded, except text and binary data. `variables: [instance.variable]` chooses others.",
        'record: {file: "results/{mesh}.csv"}',
    ]
    return "\n".join(lines) + "\n"


def _simulation(models: Sequence[Model]) -> tuple[float, list[str]]:
    """The step size in s, and the section `simulation`."""
    experiments = [(model.path, model.description.default_experiment) for model in models if model.description]
    steps = [(own, model.path) for model in models if model.description and (own := model.description.step_size)]
    stops = [(one.stop_time, path) for path, one in experiments if one.stop_time]
    starts = {one.start_time or 0.0 for _, one in experiments}
    start = starts.pop() if len(starts) == 1 else 0.0
    step, of_step = min(steps, default=(_STEP_S, ""))
    stop, of_stop = max(stops, default=(start + _STOP_S, ""))
    points = max(1, round(max(stop - start, 0.0) / step))
    end = float(Decimal(repr(start)) + points * Decimal(repr(step)))
    return step, [
        "simulation:",
        *([f"  start_time: {start!r}"] if start else []),
        f"  # in s; {f'the default of {of_stop}' if of_stop else 'no FMU has a default'}",
        f"  stop_time: {end!r}",
        f"  # in s; {f'the default of {of_step}' if of_step else 'no FMU has a default'}",
        f"  step_size: {step!r}",
        "  # real_time_factor: 1  # as fast as the wall clock; without it, as fast as possible",
    ]


def _instance(model: Model, base_step: float) -> list[str]:
    if model.description is None:
        return [f"  # {model.name}: {{fmu: {_scalar(model.path)}}}  # cannot run here: {model.problem}"]
    lines = [f"  {model.name}:", f"    fmu: {_scalar(model.path)}"]
    own = model.description.step_size
    if own and own != base_step:
        whole = steps_between(0.0, own, base_step)
        note = "" if whole else f"  # its default, but no multiple of {short_number(base_step)}"
        lines.append(f"    {'' if whole else '# '}step_size: {own!r}{note}")
    with_start = (v for v in model.description.with_causality("parameter") if v.start is not None)
    parameters = [variable for variable in with_start if variable.settable_before_start]
    if parameters:
        lines.append("    # start_values:")
        lines += [f"    #   {_scalar(v.name)}: {_start(v)}{_about(v)}" for v in parameters[:_PARAMETERS]]
    if (more := len(parameters) - _PARAMETERS) > 0:
        lines.append(f"    #   {more} more: `fmu-mesh inspect {model.path} --all`")
    return lines


def _connections(descriptions: Mapping[str, ModelDescription]) -> list[str]:
    """The section `connections`: an input with the name of exactly one output that fits gets its values."""
    chosen: list[str] = []
    doubtful: list[str] = []
    free: list[str] = []
    for name, description in descriptions.items():
        for variable in description.with_causality("input"):
            target = f"{name}.{variable.name}"
            fitting = [
                source
                for other, others in descriptions.items()
                if other != name and variable.name in {output.name for output in others.with_causality("output")}
                if _fits(source := f"{other}.{variable.name}", target, descriptions)
            ]
            if len(fitting) == 1:
                chosen.append(f"  - {_scalar(f'{fitting[0]} -> {target}')}")
                continue
            if fitting:
                doubtful += [f"  # {len(fitting)} outputs fit {target}; choose one:"]
                doubtful += [f"  # - {_scalar(f'{source} -> {target}')}" for source in fitting]
            start = f" = {_start(variable)}" if variable.start is not None else ""
            free.append(f"#   {target}{start}{_about(variable)}")
    lines = ["# Each input gets the values of the output with its name, if type and unit fit."]
    lines += ["connections:", *chosen] if chosen else ["connections: []"]
    lines += doubtful
    if free:
        lines += ["# These inputs are not connected and keep their start values:", *free]
    return lines


def _fits(source: str, target: str, descriptions: Mapping[str, ModelDescription]) -> bool:
    """Whether a connection would be accepted without a finding or a warning about its units."""
    if "->" in source:
        return False
    variables = Variables(descriptions, descriptions)
    findings = Findings("")
    connections = resolve_connections([ConnectionConfig(source=source, target=target)], variables, findings)
    unit_warnings(connections, descriptions, findings)
    return not len(findings)


def _about(variable: Variable) -> str:
    words = " ".join((variable.description or "").split())
    text = ", ".join(filter(None, (variable.unit, words)))
    return f"  # {textwrap.shorten(text, _COMMENT, placeholder=' ...')}" if text else ""


def _start(variable: Variable) -> str:
    return shown(variable.start) if isinstance(variable.start, list | bytes) else json.dumps(variable.start)


def _scalar(text: str) -> str:
    """A text in YAML, in quotes where it needs them."""
    return text if read(text, Findings(""), {}) == text else json.dumps(text)


RUNS: Runs = {"new": _new}
