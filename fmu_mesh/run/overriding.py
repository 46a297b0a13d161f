"""The configuration of a run: the values of a file with those that options replace.

Owns the place in the configuration of each option, how a finding names the option, and where results in memory are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..config.access_sections import SECURITY_VARIABLE, given_folder, has_tls
from ..config.call_options import option_fields
from ..config.findings import Findings
from ..config.loading import PlainConfig
from ..config.yaml_text import Plain
from ..system.records import IN_MEMORY
from ..text import listed, nearest, option_text
from ..wire.runtime import run_name, runtime_folder
from .options import PlanOptions
from .run_plan import RunPlan

__all__ = ["memory_file", "memory_of", "with_options"]

_MEMORY = "memory."


def with_options(plain: PlainConfig, options: PlanOptions) -> PlainConfig:
    """The values of a configuration with the keys replaced that options give; they are checked with the others.

    A key that the file cannot have, and that no option gives either, becomes a finding.

    Example:
        >>> from pathlib import Path
        >>> plain = PlainConfig({"mesh": "m"}, Path("m.ssp"), needed={"simulation.step_size": "`step_size`"})
        >>> with_options(plain, PlanOptions(step_size=0.1, config_values={"zenoh.mode": "peer"})).data
        {'mesh': 'm', 'zenoh': {'mode': 'peer'}, 'simulation': {'step_size': 0.1}}
        >>> print(*with_options(plain, PlanOptions()).findings)
        m.ssp: simulation.step_size: the package gives none; expected `step_size`
    """
    if not isinstance(data := plain.data, dict):
        return plain
    findings = Findings(str(plain.file), plain.lines, overrides := {**plain.overrides}, plain.findings, plain.origins)
    findings.explain(plain.explained)
    lines = plain.lines
    for name, path, value in (*_replacements(options), *_of_this_host(data, options)):
        named, keys, records = name == "config_values", path.split("."), data.get("record")
        option = option_text(name, {path: value} if named else getattr(options, name, value))
        place = path
        if keys[0] == "record" and isinstance(records, list) and not named:
            # Of what stays in memory, or of variables that the option names, there is one section.
            others = records[1:] if isinstance(value, str) and not value.endswith(IN_MEMORY) else []
            first = _replaced(records[0] if records else None, keys[1:], value)
            place, data = f"record[0].{keys[1]}", {**data, "record": [first, *others]}
        elif (problem := _problem(data, path, value)) is not None:
            if named:  # what is wrong with a whole section, the check of the file says
                findings.add(option, *problem)
            continue
        else:
            data = _replaced(data, keys, value)
        if isinstance(value, dict) and not named:  # a scenario, whose findings say where in it
            lines = {line: number for line, number in lines.items() if line.partition(".")[0] != path}
            continue
        if place in overrides:
            findings.add(place, f"replaced by `{name}=...` as well", "one of the two options")
        overrides[place] = option
    for path, option in plain.needed.items():
        section, key = path.split(".")
        if isinstance(inner := data.get(section, {}), dict) and key not in inner:
            findings.add(path, "the package gives none", option)
    return plain._replace(data=data, lines=lines, findings=tuple(findings), overrides=overrides)


def _replacements(options: PlanOptions) -> Iterator[tuple[str, str, Any]]:
    """Name, key and value of each option that replaces a key."""
    for path, value in dict(options.config_values or {}).items():
        yield "config_values", path, value
    keys = {name: field.key for name, field in option_fields(PlanOptions).items() if field.key is not None}
    for name, key in {"scenario": "scenario", "record": "record.variables", **keys}.items():
        value = getattr(options, name)
        if value is not None and value is not False and (name, value) != ("record", "memory"):
            value = list(value) if isinstance(value, tuple) else value
            yield name, key, str(value.absolute()) if isinstance(value, Path) else value


def _of_this_host(data: dict[str, Plain], options: PlanOptions) -> Iterator[tuple[str, str, Any]]:
    """The folder of the certificate that this host has, where the configuration needs one."""
    zenoh = own if isinstance(own := data.get("zenoh"), dict) else {}
    given = options.listen, options.connect, zenoh.get("listen"), zenoh.get("connect")
    ends = [str(end) for ends in given if isinstance(ends, list | tuple) for end in ends]
    if options.security is None and (data.get("security") is not None or any(map(has_tls, ends))):
        folder = given_folder(None)
        if folder is not None and not (options.insecure or zenoh.get("insecure")):
            yield SECURITY_VARIABLE, "security.folder", str(folder)


def _problem(data: Plain, path: str, value: Plain) -> tuple[str, str, str | None] | None:
    """Why a key cannot be replaced: what was found, what was expected, and the nearest name."""
    keys = path.split(".")
    if not all(keys):
        return "no path of a key", "one such as simulation.window", None
    if "[" in path:
        return "a key inside a list", f"a value for the whole list {path.partition('[')[0]}", None
    if keys[2:3] == ["start_values"]:
        return "a start value", option_text("start_values", {".".join((keys[1], *keys[3:])): value}), None
    for depth, key in enumerate(keys):
        if not isinstance(data, dict | None):
            where = ".".join(keys[:depth])
            what = "a list" if isinstance(data, list) else "a single value"
            return f"a key inside '{where}', which is {what}", f"{where}=VALUE", None
        if keys[0] == "instances" and depth == 1 and key not in (names := list(data or {})):
            return f"the unknown instance '{key}'", f"one of {listed(names)}", nearest(key, names)
        data = (data or {}).get(key)
    return None


def _replaced(data: Plain, keys: Sequence[str], value: Plain) -> Any:  # noqa: ANN401  a mapping, if there are keys
    """Nested mappings with another value of one key; mappings on the way are made where there are none."""
    if not keys:
        return value
    section = data if isinstance(data, dict) else {}
    return {**section, keys[0]: _replaced(section.get(keys[0]), keys[1:], value)}


def memory_file() -> Path:
    """The file for results that stay in memory; the run makes its folder, and removes it.

    If this process is killed, the next run of this user removes them.
    """
    return runtime_folder() / f"{_MEMORY}{run_name()}" / f"rows{IN_MEMORY}"


def memory_of(plan: RunPlan) -> Path | None:
    """The file for results that stay in memory; None if they go where the configuration says."""
    file = Path(plan.plan.system.result_file or "")
    own = file.suffix == IN_MEMORY and file.parent.name.startswith(_MEMORY) and file.parent.parent == runtime_folder()
    return file if own else None
