"""Writes the pages of all keys of a configuration and of all options: `python docs/reference_pages.py`.

Types, defaults and descriptions are those of the Structs that read a file, and of the parsers of the commands.
`reference/keys.yaml` adds what no program needs to know: examples, units, and since which version a key is there. The
pages are committed, and `tests/unit/test_reference_pages.py` compares them with what this writes.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import yaml
from msgspec import NODEFAULT, inspect

from fmu_mesh.cli.main import COMMANDS, command_parser
from fmu_mesh.config.call_options import CallOptions, Option, option_fields
from fmu_mesh.config.deadlines import Deadlines
from fmu_mesh.config.instance_sections import KIND, InstanceSection
from fmu_mesh.config.mesh import TimeoutsConfig, config_type
from fmu_mesh.config.structure import describe
from fmu_mesh.instances.registry import KINDS
from fmu_mesh.run.options import ConvergenceOptions, RunOptions, SimulateOptions
from fmu_mesh.sweeps.planned_sweep import SweepOptions

__all__ = [
    "REFERENCE",
    "Key",
    "Section",
    "call_options",
    "command_options",
    "configuration_page",
    "deadlines_page",
    "keys_of",
    "known",
    "options_page",
    "reference_pages",
    "said",
    "sections",
    "since",
]

REFERENCE = Path(__file__).resolve().parent / "reference"
_COMMON = ("start_values", "inputs", "step_size", "group", "host", "not_finite", "on_failure", "process")
_INTERPOLATION = "interpolation"
_WRITTEN = "<!-- written by `python docs/reference_pages.py` -->"

_CONFIGURATION = f"""\
# Configuration
{_WRITTEN}

Every key of a configuration file, version 1. [Your own FMUs](../../README.md#your-own-fmus) begins with an example;
`fmu-mesh check` says what is wrong in a file, and editors complete keys by the [schema](../commands.md#schema). *next*
is the version that is not released yet. Any key can also be given by
[`--set-config`](../commands.md#options-instead-of-keys).

Who may reach a mesh (`security`, `runtime`, `zenoh`) is on [a page of its own](../security.md), and so is what an FMU
may do to [its host](../fmi-support-protection.md#what-an-fmu-may-do-to-the-host) (`process`).
"""


_OPTIONS = f"""\
# Options
{_WRITTEN}

Every option of every command. `--help` and `--debug` (show a traceback) are those of all. *next* is the version that is
not released yet. What one does with the commands is on [their page](../commands.md).

## Options of a run

`Mesh.run` and `Mesh.start` take all of these by name, as in `mesh.run(window=16)`; `plan`, `check`, `open`, `sweep` and
`rerun` those that make sense for them ([meshes](meshes.md), [runs](runs.md)). The column *option* has the spelling of
the command line. One with a key replaces what the [configuration](configuration.md) says; `None` leaves it.
"""

_SIMULATION = """\
## Options of a simulation

`fmu_mesh.simulate` and the command take these for one FMU, and some of a run ([from FMPy](../from-fmpy.md)).
"""

_SWEEP = """\
## Options of a sweep

`fmu_mesh.sweep` and the command take these beside those of a run that any variant has ([sweeps](../sweeps.md)).
"""

_CONVERGENCE = """\
## Options of a convergence study

`Mesh.convergence` and the command take these beside those of a run that any variant has
([how right is a result](../convergence.md)).
"""

_DEADLINES = f"""\
# Deadlines
{_WRITTEN}

No wait of a run is without an end. This page has the deadlines that a user may meet. The first table has those that you
can change, in the section `timeouts` of the [configuration](configuration.md), in s. A deadline counts only time in
which the process that waits can run: a suspended host, or a debugger, misses none. [Failures](../failures.md) says what
is shown.

## `timeouts`
"""

_LAUNCHER = """\
## The launcher and the master

What follows from `timeouts` has its formula. The others are fixed.
"""

_FIXED = """\
## Fixed

These have no key: what they wait for takes far less time, or nothing depends on it.
"""

_FORMS: Mapping[object, str] = {"key_input": "with `key` and `to`", "key_output": "with `from` and `key`"}
"""What tells sections of one list apart, by their tags."""

_OF_ALL = ("--help", "--debug")


class Key(NamedTuple):
    """A key of a section: its name, type, whether it is needed, its default, and what is known beside the Struct."""

    name: str
    type: inspect.Type
    required: bool
    default: Any
    text: str
    since: str
    example: Any
    unit: str


class Section(NamedTuple):
    """A section of the file: its Struct, the path that leads to it, what it is, and its keys."""

    @property
    def title(self) -> str:
        """Its heading."""
        return "The file" if not self.path else self.path if " " in self.path else f"`{self.path}`"

    @property
    def link(self) -> str:
        """A link to its heading."""
        return f"[section](#{re.sub(r'[^a-z0-9 _-]', '', self.title.lower()).replace(' ', '-')})"

    cls: type
    path: str
    about: str
    keys: tuple[Key, ...]


@cache
def known() -> dict[str, Any]:
    """What `keys.yaml` says: `keys` by class and key, `options` by version and command, `calls` by Struct."""
    found: dict[str, Any] = yaml.safe_load((REFERENCE / "keys.yaml").read_text())
    return found


def sections() -> list[Section]:
    """All sections of a configuration, in the order in which a file has them."""
    kind = inspect.type_info(config_type(tuple(KINDS.own().values())))
    assert isinstance(kind, inspect.StructType)
    return [*_sections(kind, "", {})]


def keys_of(kind: inspect.StructType, names: Sequence[str] | None = None) -> tuple[Key, ...]:
    """The keys of a Struct, or those with these names."""
    return tuple(
        _key(kind, field)
        for field in kind.fields
        if field.encode_name != KIND and (names is None or field.encode_name in names)
    )


def configuration_page() -> str:
    """The page of all keys."""
    found = sections()
    links = {section.cls: section.link for section in found}
    return "\n".join([_CONFIGURATION, *(_shown(section, links) for section in found)]).rstrip() + "\n"


def options_page() -> str:
    """The page of all options: those of a run once, those of a sweep, and the others of each command."""
    shared = {option.flag for option in option_fields(RunOptions).values()} - {None}
    parts = [_OPTIONS, _calls(RunOptions), "", _SIMULATION, _calls(SimulateOptions), "", _SWEEP, _calls(SweepOptions)]
    parts += ["", _CONVERGENCE, _calls(ConvergenceOptions)]
    for command, (_, _, about) in COMMANDS.items():
        options = command_options(command)
        own = [option for option in options if option not in shared]
        parts += ["", f"## `{command}`", "", f"{about[0].upper()}{about[1:]}."]
        if common := [f"`{option}`" for option in options if option in shared]:
            parts += ["", f"Of the options of a run: {', '.join(common)}."]
        if own:
            table = [(*options[option], since(command, option)) for option in own]
            parts += ["", _table(("option", "meaning", "since"), table)]
    return "\n".join(parts).rstrip() + "\n"


def deadlines_page() -> str:
    """The page of all deadlines: those of `timeouts`, those of the launcher and the master, and fixed ones."""
    told = known()["deadlines"]
    kind = inspect.type_info(TimeoutsConfig)
    assert isinstance(kind, inspect.StructType)
    keys = [(f"`{key.name}`", f"{key.default:g}", key.text, told["timeouts"][key.name]) for key in keys_of(kind)]
    meanings = re.findall(r"^        (\w+): (.+(?:\n            .+)*)", Deadlines.__doc__ or "", re.MULTILINE)
    formulas = {name: told["launcher"].get(name) for name in Deadlines.__struct_fields__}
    fixed = dict(zip(Deadlines.__struct_fields__[::-1], (Deadlines.__struct_defaults__ or ())[::-1], strict=False))
    launcher = [
        (f"`{name}`", formulas[name] or f"{fixed[name]:g}", f"{text[0].upper()}{' '.join(text.split())[1:]}")
        for name, text in meanings
    ]
    constants = []
    for place, (what, then) in told["fixed"].items():
        module, _, name = place.rpartition(".")
        value = getattr(import_module(f"fmu_mesh.{module}"), name)
        constants.append((f"`{module}`", f"`{name}`", f"{value:g}", what, then))
    parts = [
        _DEADLINES,
        _table(("key", "default", "for what", "then"), keys),
        "",
        _LAUNCHER,
        _table(("name", "s", "for what"), launcher),
        "",
        _FIXED,
        _table(("where", "name", "s", "for what", "then"), constants),
    ]
    return "\n".join(parts).rstrip() + "\n"


def call_options(options: type[CallOptions]) -> dict[str, Option]:
    """The options of a Struct; of any but `RunOptions` those that are not the same there."""
    of_run = {} if options is RunOptions else option_fields(RunOptions)
    return {name: option for name, option in option_fields(options).items() if option != of_run.get(name)}


def said(options: type[CallOptions], name: str) -> dict[str, Any]:
    """What `keys.yaml` says of an option of a call: of this one, or of a run."""
    calls = known()["calls"]
    found: dict[str, Any] = calls[options.__name__].get(name) or calls["RunOptions"].get(name, {})
    return found


def _calls(options: type[CallOptions]) -> str:
    rows = [
        (
            f"`{name}`",
            f"`{field.parameter.annotation}`",
            f"`{field.parameter.default!r}`",
            f"`{said(options, name)['example']!r}`" if "example" in said(options, name) else "",
            f"`{field.flag}`" if field.flag else "",
            f"`{field.key}`" if field.key else "",
            said(options, name).get("since", ""),
            field.line,
        )
        for name, field in call_options(options).items()
    ]
    return _table(("in Python", "type", "default", "example", "option", "instead of the key", "since", "meaning"), rows)


@cache
def command_options(command: str) -> dict[str, tuple[str, str]]:
    """How each option of a command is written, and its help; by its long form. Those of every command are left out."""
    found = {}
    for action in command_parser([command])[1][command]._actions:  # noqa: SLF001  argparse has no other way
        long = next((option for option in action.option_strings if option.startswith("--")), None)
        if long is None or long in _OF_ALL or action.help == argparse.SUPPRESS:
            continue
        value = argparse.HelpFormatter("")._format_args(action, str(action.dest).upper())  # noqa: SLF001  as above
        written = ", ".join(f"`{option}{f' {value}' if value else ''}`" for option in reversed(action.option_strings))
        found[long] = written, (action.help or "") % {"default": action.default}
    return found


def since(command: str, option: str) -> str:
    """The version since when a command has an option; empty if `keys.yaml` does not say."""
    table = known()["options"]
    return next((version for version, commands in table.items() if option in commands.get(command, ())), "")


def reference_pages() -> dict[str, str]:
    """The text of each page by its name."""
    return {"configuration.md": configuration_page(), "options.md": options_page(), "deadlines.md": deadlines_page()}


def _sections(kind: inspect.StructType, path: str, seen: dict[type, str]) -> Iterator[Section]:
    """A section, and those inside it that were not there before."""
    if kind.cls in seen:
        return
    seen[kind.cls] = path
    own = [field.encode_name for field in kind.fields]
    if issubclass(kind.cls, InstanceSection):
        own = [name for name in own if name not in _COMMON and (name != _INTERPOLATION or kind.tag != "fmu")]
        about = f"{_first_line(kind.cls)} Keys of every instance are [above](#every-instance)."
        yield Section(kind.cls, f"`instances.NAME` with `{kind.tag}`", about, keys_of(kind, own))
    else:
        path = f"`{path}` {_FORMS[kind.tag]}" if kind.tag in _FORMS else path
        yield Section(kind.cls, path, _first_line(kind.cls), keys_of(kind))
    for field in kind.fields:
        place = f"{path}.{field.encode_name}" if path else field.encode_name
        for struct, suffix in _structs(field.type):
            if field.encode_name == "instances" and struct.tag == "fmu":
                every = "The keys that an instance of any kind has; `interpolation` only FMUs and components."
                yield Section(InstanceSection, "Every instance", every, keys_of(struct, (*_COMMON, _INTERPOLATION)))
            yield from _sections(struct, place + suffix, seen)


def _structs(kind: inspect.Type) -> Iterator[tuple[inspect.StructType, str]]:
    """The Structs in a type, and what follows in the path of each: `[N]` in a list, `.NAME` in a mapping."""
    match kind:
        case inspect.StructType():
            yield kind, ""
        case inspect.Metadata():
            yield from _structs(kind.type)
        case inspect.UnionType():
            for option in kind.types:
                yield from _structs(option)
        case inspect.ListType():
            yield from ((struct, f"[N]{suffix}") for struct, suffix in _structs(kind.item_type))
        case inspect.DictType():
            yield from ((struct, f".NAME{suffix}") for struct, suffix in _structs(kind.value_type))


def _key(kind: inspect.StructType, field: inspect.Field) -> Key:
    """A field with what `keys.yaml` says of its class, or of one of its bases."""
    table = known()["keys"]
    own = next(
        (
            table[c.__name__][field.encode_name]
            for c in kind.cls.__mro__
            if field.encode_name in table.get(c.__name__, {})
        ),
        {},
    )
    default = field.default_factory() if field.default_factory is not NODEFAULT else field.default
    text = field.type.extra_json_schema or {} if isinstance(field.type, inspect.Metadata) else {}
    inner = next(_structs(field.type), None)
    return Key(
        field.encode_name,
        field.type,
        field.required,
        default,
        text.get("description") or (_first_line(inner[0].cls) if inner is not None else ""),
        own.get("since", ""),
        own.get("example"),
        own.get("unit", ""),
    )


def _shown(section: Section, links: Mapping[type, str]) -> str:
    """A section as a heading and a table."""
    rows = [
        (
            f"`{key.name}`",
            _bounded(key.type, _type(key.type, links)),
            key.unit,
            "needed" if key.required else "" if isinstance(key.default, msgspec.Struct) else _code(key.default),
            "" if key.example is None else _code(key.example),
            key.since,
            key.text,
        )
        for key in section.keys
    ]
    header = ("key", "type", "unit", "default", "example", "since", "meaning")
    return f"## {section.title}\n\n{section.about}\n\n{_table(header, rows)}\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _type(kind: inspect.Type, links: Mapping[type, str]) -> str:
    """A type in words; a section leads to its table."""
    match kind:
        case inspect.Metadata(extra_json_schema={"title": title}):
            words = re.sub(r"^(an? .+?)( of | as | such as ).*", r"\1", str(title))
        case inspect.Metadata():
            words = _type(kind.type, links)
        case inspect.UnionType() if {inspect.BoolType, inspect.FloatType, inspect.StrType} <= {*map(type, kind.types)}:
            words = " or ".join(["a value", *(link for struct, _ in _structs(kind) if (link := links.get(struct.cls)))])
        case inspect.UnionType() if all(isinstance(option, inspect.StructType) for option in kind.types):
            words = "section of one of the kinds below"
        case inspect.UnionType():
            words = " or ".join(dict.fromkeys(_type(option, links) for option in kind.types))
        case inspect.LiteralType():
            words = " or ".join(_code(value) for value in kind.values)
        case inspect.StructType():
            words = links[kind.cls]
        case inspect.ListType():
            words = f"list: {_type(kind.item_type, links)}"
        case inspect.DictType():
            words = f"mapping: name to {_type(kind.value_type, links)}"
        case _:
            words = describe(kind)
    return re.sub(r"^an? |finite ", "", words)


def _bounded(kind: inspect.Type, words: str) -> str:
    """The words of a type with the bound that only its schema has."""
    schema = kind.extra_json_schema or {} if isinstance(kind, inspect.Metadata) else {}
    bound = " > 0" if "exclusiveMinimum" in schema else " >= 0" if "minimum" in schema else ""
    return words.replace("number", f"number{bound}", 1)


def _code(value: Any) -> str:  # noqa: ANN401 any value of YAML
    """A value as in a file, in one line."""
    if isinstance(value, str):
        return f"`{value}`" if value else "empty"
    if isinstance(value, bool | int | float | None):
        return f"`{json.dumps(value)}`"
    return f"`{yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False).strip()}`"


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().partition("\n")[0]


def main() -> None:
    """Write the pages."""
    for name, text in reference_pages().items():
        (REFERENCE / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
