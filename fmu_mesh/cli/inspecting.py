"""`inspect`: the properties of one FMU. Nothing of it is executed."""

from __future__ import annotations

import argparse
import shutil
import sys
import textwrap
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from .. import files
from ..api.functions import inspect
from ..errors import ConfigurationError, LoadFailed
from ..instances.fmi import read_description, sha256_of
from ..instances.registry import KINDS
from ..text import fits, nearest, nearest_file, short_number, shown
from ..variables.model_description import Causality, Kind, ModelDescription, Variable
from .arguments import CommandParser, Parsers, add_json
from .output.json_output import print_failure
from .output.tables import pairs

__all__ = ["PARSERS", "Inspection", "inspect_fmu", "inspection_page", "no_fmu"]

_SHOWN_VARIABLES: Final = 20
"""Variables of one causality on a page without `--all`."""

_NARROWEST: Final = 60
_WIDE: Final = 120
_CAUSALITIES: Final[tuple[tuple[Causality, str], ...]] = (
    ("input", "Inputs"),
    ("output", "Outputs"),
    ("structuralParameter", "Structural parameters"),
    ("parameter", "Parameters"),
    ("calculatedParameter", "Calculated parameters"),
    ("independent", "Independent variable"),
    ("local", "Local variables"),
)
_CAPABILITIES: Final = (
    ("can_handle_variable_step_size", "variable step size"),
    ("can_reject_steps", "repeat a step"),
    ("can_get_and_set_state", "get and set its state"),
    ("can_serialize_state", "serialize its state"),
    ("can_interpolate_inputs", "interpolate inputs"),
    ("has_event_mode", "event mode"),
)


class Inspection(msgspec.Struct, frozen=True, omit_defaults=False):
    """The output of `inspect --json`; documented in `docs/commands.md`.

    Attributes:
        file: the path as it was given.
        sha256: of the archive, as hexadecimal digits; null for a folder.
        bytes: size of the archive; null for a folder.
        runs_here: whether it can run on this platform.
        problems: violations and warnings as text; if it cannot run here, the first one says why.
        description: the model description.
    """

    file: str
    sha256: str | None
    bytes: int | None
    runs_here: bool
    problems: tuple[str, ...]
    description: ModelDescription


def _add_inspect(parser: CommandParser) -> None:
    parser.add_argument("fmu", type=Path, metavar="MODEL.fmu", help="the FMU, or the folder of an unpacked one")
    parser.add_argument(
        "variables",
        nargs="*",
        metavar="VARIABLE",
        help="show only these variables; * stands for any characters",
    )
    parser.add_argument(
        "--all", action="store_true", help=f"show all variables instead of {_SHOWN_VARIABLES} of each causality"
    )
    add_json(parser, "print everything as one JSON object")
    parser.set_defaults(run_command=_inspect)


def inspect_fmu(path: Path) -> Inspection:
    """Read all properties of an FMU without loading it, or of a file whose ending is another kind of instance.

    Raises:
        ConfigurationError: it cannot be read; says why.
    """
    reasons: tuple[str, ...] = ()
    try:
        if files.is_file(path) and path.suffix != ".fmu" and path.suffix[1:] in KINDS.names():
            size, other = path.stat().st_size, inspect(path)
            return Inspection(str(path), sha256_of(path), size, runs_here=True, problems=(), description=other)
        try:
            description = read_description(path)
        except LoadFailed as error:
            description = read_description(
                path, to_run=False
            )  # if the description can be read, the page says why the FMU cannot run
            reasons = (str(error),)
    except LoadFailed as error:
        raise no_fmu(path, error) from error
    return Inspection(
        file=str(path),
        sha256=sha256_of(path),
        bytes=None if path.is_dir() else path.stat().st_size,
        runs_here=not reasons,
        problems=(*reasons, *description.problems),
        description=description,
    )


def no_fmu(path: Path, error: LoadFailed) -> ConfigurationError:
    """The error for a path that should be an FMU and is something else, or nothing."""
    hint = error.hint
    if not files.exists(path):
        near = nearest_file(path)
        hint = f"Did you mean '{near}'?" if near is not None else hint
    elif path.suffix in (".yaml", ".yml"):
        hint = f"A configuration is run by `fmu-mesh launch {path}`."
    return ConfigurationError(error.message, hint=hint)


def inspection_page(
    inspection: Inspection, width: int, patterns: Sequence[str] = (), *, everything: bool = False
) -> list[str]:
    """The page about an FMU, in lines of at most ``width`` columns, unless a name is longer.

    Args:
        inspection: the properties of the FMU.
        width: in columns.
        patterns: names of variables, with `*` for any characters; if given, only these are shown.
        everything: whether all variables are listed.
    """
    description = inspection.description
    chosen = [v for v in description.variables if not patterns or any(fits(pattern, v.name) for pattern in patterns)]
    lines = [] if patterns else [*_facts(inspection, width), *_problems(inspection, width)]
    for causality, title in _CAUSALITIES:
        members = [variable for variable in chosen if variable.causality == causality]
        if members:
            lines += ([""] if lines else []) + [f"{title} ({len(members)})"]
            limit = None if everything or patterns else _SHOWN_VARIABLES
            lines += _variables(members[:limit], width)
            if limit is not None and len(members) > limit:
                lines.append(f"  ... and {len(members) - limit} more: --all lists them, a name such as 'x*' some")
    return lines


def _inspect(arguments: argparse.Namespace) -> int:
    try:
        inspection = inspect_fmu(arguments.fmu)
    except ConfigurationError as error:
        if arguments.json:
            print_failure(error)
        raise
    if arguments.json:
        sys.stdout.buffer.write(msgspec.json.format(msgspec.json.encode(inspection)) + b"\n")
        return 0
    names = [variable.name for variable in inspection.description.variables]
    for pattern in arguments.variables:
        if not any(fits(pattern, name) for name in names):
            near = nearest(pattern, names)
            hint = f"Did you mean '{near}'?" if near else None
            raise ConfigurationError(f"'{arguments.fmu}' has no variable '{pattern}'", hint=hint)
    width = max(_NARROWEST, shutil.get_terminal_size((_WIDE, 0)).columns)
    print("\n".join(inspection_page(inspection, width, arguments.variables, everything=arguments.all)))
    return 0


def _facts(inspection: Inspection, width: int) -> list[str]:
    description = inspection.description
    experiment = description.default_experiment
    can = [words for field, words in _CAPABILITIES if getattr(description, field)]
    needs = ["one process for each instance"] if description.only_once_per_process else []
    needs += ["the tool that made it"] if description.needs_execution_tool else []
    counts = [
        f"{count} {title.lower() if count > 1 else title.lower().removesuffix('s')}"
        for causality, title in _CAUSALITIES
        if (count := len(description.with_causality(causality)))
    ]
    times = [
        f"{what} {short_number(value)} s"
        for what, value in (
            ("start", experiment.start_time),
            ("stop", experiment.stop_time),
            ("step", experiment.step_size),
        )
        if value is not None
    ]
    states = [f"{description.continuous_states} continuous"] if description.continuous_states else []
    if indicators := description.event_indicators:
        states.append(f"{indicators} event indicator{'s' if indicators > 1 else ''}")
    times += [f"tolerance {short_number(experiment.tolerance)}"] if experiment.tolerance is not None else []
    kinds = " or ".join(_KIND_WORDS[kind] for kind in description.kinds)
    platforms = ", ".join(_PLATFORM_WORDS.get(name, name) for name in description.platforms)
    size = f" ({inspection.bytes} bytes)" if inspection.bytes is not None else " (a folder)"
    facts = [
        ("File", f"{inspection.file}{size}"),
        ("SHA-256", inspection.sha256 or ""),
        ("Model", description.model_name),
        ("Description", description.description or ""),
        ("Kind", f"FMI {description.fmi_version} {kinds}" if kinds else description.kind.replace("_", " ")),
        ("Identifier", description.model_identifier),
        ("GUID", description.guid),
        ("Made by", description.generation_tool or ""),
        ("Platforms", platforms or ("none" if kinds else "")),
        ("Runs here", "yes" if inspection.runs_here else "no, see Problems"),
        ("Can", ", ".join(can)),
        ("Needs", ", ".join(needs)),
        ("Experiment", ", ".join(times)),
        ("Variables", ", ".join(counts) or "none"),
        ("States", ", ".join(states)),
        ("Clocks", ", ".join(map(str, description.clocks))),
    ]
    lines = pairs((name, " ".join(value.split())) for name, value in facts)
    indent = " " * (2 + max(len(name) for name, value in facts if value))
    return [part for line in lines for part in _wrapped(line, width, indent)]


_KIND_WORDS: Final[dict[Kind, str]] = {"co_simulation": "co-simulation", "model_exchange": "model exchange"}
_PLATFORM_WORDS: Final = {"c-code": "C sources"}


def _problems(inspection: Inspection, width: int) -> list[str]:
    if not inspection.problems:
        return []
    lines = ["", f"Problems ({len(inspection.problems)})"]
    for problem in inspection.problems:
        lines += _wrapped("  " + " ".join(problem.split()), width, "    ")
    return lines


def _wrapped(line: str, width: int, indent: str) -> list[str]:
    """Wrap a line without breaking paths and hashes, so that they can be copied."""
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
        replace_whitespace=False,
    )


def _variables(variables: Sequence[Variable], width: int) -> list[str]:
    """One line each: name, type, variability, start value with unit, and as much of the description as fits."""
    rows = [[v.name, v.type_name, v.variability, _start(v), " ".join((v.description or "").split())] for v in variables]
    widest = [max(len(row[column]) for row in rows) for column in range(4)]
    # A very long name must not move the other columns off the page.
    widest[0] = min(widest[0], width // 2)
    lines = []
    for row in rows:
        cells = "  ".join(cell.ljust(size) for cell, size in zip(row, widest, strict=False) if size)
        line = f"  {cells.rstrip()}" if not row[4] else f"  {cells}  {row[4]}"
        lines.append(line if len(line) <= width or not row[4] else _cut(line, width, 2 + len(cells)))
    return lines


def _cut(line: str, width: int, least: int) -> str:
    """The line with a shortened description, or without it on a narrow page."""
    return f"{line[: width - 3].rstrip()}..." if width - 3 > least + 10 else line[:least].rstrip()


def _start(variable: Variable) -> str:
    """The start value with its unit; only the unit if there is none."""
    unit = variable.unit or ""
    if variable.start is None:
        return f"[{unit}]" if unit else ""
    match variable.start:
        case list() as rows:
            text = msgspec.json.encode(rows).decode()
        case bytes() as data:
            text = shown(b64encode(data).decode())
        case start:
            item = next((item for item, value in variable.items if value == start), None)
            text = f"{item} ({start})" if item is not None else shown(start)
    return f"= {text} {unit}".rstrip()


PARSERS: Parsers = {"inspect": _add_inspect}
