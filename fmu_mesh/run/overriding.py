"""The configuration of a run: the values of a file with those that options replace.

Owns the place in the configuration of each option, and how a finding names the option.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..config.findings import Findings
from ..config.loading import PlainConfig
from ..config.yaml_text import Plain
from ..recorder.arrays_file import ENDING
from ..text import listed, nearest, option_text
from .options import PlanOptions, option_fields

__all__ = ["with_options"]


def with_options(plain: PlainConfig, options: PlanOptions) -> PlainConfig:
    """The values of a configuration with the keys replaced that options give; they are checked with the others.

    A key that the file cannot have, and that no option gives either, becomes a finding.

    Example:
        >>> from pathlib import Path
        >>> plain = PlainConfig({"mesh": "m"}, Path("m.ssp"), needed={"simulation.step_size": "`step_size`"})
        >>> with_options(plain, PlanOptions(step_size=0.1)).data
        {'mesh': 'm', 'simulation': {'step_size': 0.1}}
        >>> print(*with_options(plain, PlanOptions()).findings)
        m.ssp: simulation.step_size: the package gives none; expected `step_size`
    """
    plain = _with_config_values(plain, options.keys)
    findings = Findings(str(plain.file), plain.lines, overrides := {**plain.overrides}, plain.findings, plain.origins)
    findings.explain(plain.explained)
    data, lines = plain.data, plain.lines
    for name, path, value in _replacements(options):
        option, keys, place = option_text(name, getattr(options, name)), path.split("."), path
        if isinstance(data, dict) and keys[0] == "record" and isinstance(records := data.get("record"), list):
            place, data = f"record[0].{keys[1]}", {**data, "record": _with_record(records, keys[1], value)}
        elif isinstance(data, dict) and _obstacle(data, keys) is None:
            data = _replaced(data, keys, value)
        else:
            continue  # the section is wrong, as the check of the whole says
        if isinstance(value, dict):  # its findings say where in it
            lines = {line: number for line, number in lines.items() if line.partition(".")[0] != keys[0]}
            continue
        if place in overrides:
            findings.add(place, f"replaced by `{name}=...` as well", "one of the two options")
        overrides[place] = option
    for key, option in plain.needed.items():
        if _is_absent(data, key):
            findings.add(key, "the package gives none", option)
    return plain._replace(data=data, lines=lines, findings=tuple(findings), overrides=overrides)


def _with_config_values(plain: PlainConfig, config_values: Mapping[str, Any]) -> PlainConfig:
    """The values of a configuration with keys replaced by the option `config_values`; they are checked with the others.

    Example:
        >>> from pathlib import Path
        >>> from fmu_mesh.config.loading import read_text
        >>> plain = read_text("simulation: {step_size: 0.1}", Path("mesh.yaml"))
        >>> _with_config_values(plain, {"simulation.window": 16, "zenoh": {"mode": "client"}}).data
        {'simulation': {'step_size': 0.1, 'window': 16}, 'zenoh': {'mode': 'client'}}

    Args:
        plain: the values of the file.
        config_values: values by the path of a key in the file.
    """
    findings = Findings(str(plain.file))
    data, overrides = plain.data, dict(plain.overrides)
    for path, value in config_values.items():
        option, keys = option_text("config_values", {path: value}), path.split(".")
        if not all(keys):
            findings.add(option, "no path of a key", "one such as simulation.window")
        elif "[" in path:
            findings.add(option, "a key inside a list", f"a value for the whole list {path.partition('[')[0]}")
        elif keys[2:3] == ["start_values"]:
            expected = option_text("start_values", {".".join((keys[1], *keys[3:])): value})
            findings.add(option, "a start value", expected)
        elif (problem := _obstacle(data, keys)) is not None:
            findings.add(option, *problem)
        else:
            data = _replaced(data, keys, value)
            overrides[path] = option
    return plain._replace(data=data, findings=(*plain.findings, *findings), overrides=overrides)


def _is_absent(data: Plain, key: str) -> bool:
    """Whether a key of a section is not there; false if the section is no mapping, which is another error."""
    section, _, name = key.partition(".")
    inner = data.get(section, {}) if isinstance(data, dict) else None
    return isinstance(inner, dict) and name not in inner


def _obstacle(data: Plain, keys: Sequence[str]) -> tuple[str, str, str | None] | None:
    """Why a key cannot be replaced: what was found, what was expected, and the nearest name."""
    for depth, key in enumerate(keys):
        if not isinstance(data, dict | None):
            where = ".".join(keys[:depth])
            what = "a list" if isinstance(data, list) else "a single value"
            return f"a key inside '{where}', which is {what}", f"{where}=VALUE", None
        if keys[0] == "instances" and depth == 1 and key not in (names := list(data or {})):
            return f"the unknown instance '{key}'", f"one of {listed(names)}", nearest(key, names)
        data = (data or {}).get(key)
    return None


def _replaced(data: Plain, keys: Sequence[str], value: Plain) -> Plain:
    """Nested mappings with another value of one key; mappings on the way are made where there are none."""
    if not keys:
        return value
    section = data if isinstance(data, dict) else {}
    return {**section, keys[0]: _replaced(section.get(keys[0]), keys[1:], value)}


def _replacements(options: PlanOptions) -> Iterator[tuple[str, str, Any]]:
    """Name, key and value of each option that replaces a key."""
    if options.scenario is not None:
        yield "scenario", "scenario", _written(options.scenario)
    if options.record not in (None, "memory"):
        yield "record", "record.variables", _written(options.record)
    for name, field in option_fields(PlanOptions).items():
        if field.option.key is not None and (value := getattr(options, name)) is not None:
            yield name, field.option.key, _written(value)


def _written(value: Any) -> Any:  # noqa: ANN401  any value of an option
    return str(value.absolute()) if isinstance(value, Path) else [*value] if isinstance(value, tuple) else value


def _with_record(records: list[Plain], key: str, value: Plain) -> list[Plain]:
    """The sections `record` with another value of a key of the first one.

    Of what stays in memory, or of variables that the option names, there is one section.
    """
    others = records[1:] if isinstance(value, str) and not value.endswith(ENDING) else []
    return [_replaced(records[0] if records else None, (key,), value), *others]
