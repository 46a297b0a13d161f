"""The options of a run: what may be chosen beside the configuration file.

Owns one list of them. The flags of the command line, their help and the configuration keys that they replace follow
from the annotations of `Options`. Knows nothing of argparse.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

import msgspec
from msgspec import inspect
from msgspec.structs import replace

from ..config.base import Base, Endpoint
from ..config.findings import Findings
from ..config.loading import LoadedConfig, PlainConfig
from ..config.mesh import Config, RecordConfig, SimulationConfig, ZenohConfig
from ..config.structure import check
from ..config.yaml_text import Plain, read
from ..instances.contract import Showing
from ..recorder.arrays_file import ENDING
from ..text import listed, nearest

__all__ = ["Flag", "OptionField", "Options", "option_fields", "with_config_values", "with_needed", "with_options"]

_SECTIONS: dict[str, type[Base]] = {"simulation": SimulationConfig, "record": RecordConfig, "zenoh": ZenohConfig}
_NEEDED = ("step_size", "stop_time", "algorithm")
"""The options that may give what a file leaves out."""


class Flag(NamedTuple):
    """How an option is written on the command line.

    Attributes:
        name: with its dashes.
        metavar: what stands for its value in the help; None for an option without a value.
        key: key of the configuration that it replaces.
        text: its help, where that of the key does not fit or there is no key.
        bare: its value where the flag is given without one; None if it needs a value.
    """

    name: str
    metavar: str | None = None
    key: str | None = None
    text: str | None = None
    bare: Path | None = None


class Options(msgspec.Struct, frozen=True):
    """What is chosen beside the configuration; None and an empty tuple leave what the configuration says.

    Each field is an option, and its annotation says how the command line spells it.

    Example:
        >>> Options(window=1, start_values=("gain.k=2.5",)).window
        1
    """

    algorithm: Annotated[str | None, Flag("--algorithm", "NAME", "simulation.algorithm")] = None
    step_size: Annotated[float | None, Flag("--step-size", "S", "simulation.step_size")] = None
    stop_time: Annotated[float | None, Flag("--stop-time", "S", "simulation.stop_time")] = None
    window: Annotated[int | Literal["auto"] | None, Flag("--window", "N", "simulation.window")] = None
    real_time_factor: Annotated[float | None, Flag("--real-time-factor", "F", "simulation.real_time_factor")] = None
    update_period: Annotated[float | None, Flag("--update-period", "S", "simulation.update_period")] = None
    catch_up: Annotated[float | None, Flag("--catch-up", "S", "simulation.catch_up")] = None
    start_values: Annotated[
        tuple[str, ...], Flag("--set", "INSTANCE.VARIABLE=VALUE", text="start value of a variable")
    ] = ()
    config_values: Annotated[
        tuple[str, ...],
        Flag("--set-config", "KEY=VALUE", text="any key by its path, as in simulation.window=16; the value is YAML"),
    ] = ()
    output: Annotated[
        Path | None, Flag("--output", "FILE", "record.file", "result file; its ending chooses the format")
    ] = None
    scenario: Annotated[
        Path | None, Flag("--scenario", "FILE", text="values of inputs and parameters over time, from this file")
    ] = None
    listen: Annotated[tuple[Endpoint, ...], Flag("--listen", "ENDPOINT", "zenoh.listen")] = ()
    connect: Annotated[tuple[Endpoint, ...], Flag("--connect", "ENDPOINT", "zenoh.connect")] = ()
    paused: Annotated[
        bool, Flag("--paused", text="stay paused at the first point until `resume`, `step` or `play`")
    ] = False
    allow_code: Annotated[
        bool, Flag("--allow-code", text="run Python code that a file of others names, or that others can write")
    ] = False
    view: Annotated[bool, Flag("--view", text="show the world of the physics engine in a window")] = False
    video: Annotated[
        Path | None, Flag("--video", "FILE.mp4", text="film that world into a file, .mp4 or .gif; needs no screen")
    ] = None
    profile: Annotated[
        Path | None,
        Flag(
            "--profile",
            "FILE.json",
            text="show where the time went; with a file, also write a trace for Perfetto",
            bare=Path(),
        ),
    ] = None

    @property
    def showing(self) -> Showing:
        """Whether and how a physics engine shows its world."""
        return Showing(view=self.view, video=self.video.absolute() if self.video is not None else None)


class OptionField(NamedTuple):
    """One option.

    Attributes:
        name: that of its field.
        type: what a value is; for an option that may be repeated, what each value is.
        repeatable: whether it may be given more than once.
        flag: how the command line spells it.
        help: one line about it.
    """

    name: str
    type: Any
    repeatable: bool
    flag: Flag
    help: str


@cache
def option_fields() -> dict[str, OptionField]:
    """All options by the names of their fields."""
    found = {}
    for name, hint in get_type_hints(Options, include_extras=True).items():
        kind, flag = hint.__origin__, hint.__metadata__[0]
        repeatable = getattr(kind, "__origin__", None) is tuple
        value = kind.__args__[0] if repeatable else next((a for a in _alternatives(kind) if a is not type(None)), kind)
        text = flag.text or _description(flag.key)
        found[name] = OptionField(name, value, repeatable, flag, f"{text}; repeatable" if repeatable else text)
    return found


def with_config_values(plain: PlainConfig, config_values: Sequence[str]) -> PlainConfig:
    """The values of a configuration with keys replaced by `--set-config`; they are checked with the others.

    Example:
        >>> from pathlib import Path
        >>> from fmu_mesh.config.loading import read_text
        >>> plain = read_text("simulation: {step_size: 0.1}", Path("mesh.yaml"))
        >>> with_config_values(plain, ["simulation.window=16", "zenoh={mode: client}"]).data
        {'simulation': {'step_size': 0.1, 'window': 16}, 'zenoh': {'mode': 'client'}}

    Args:
        plain: the values of the file.
        config_values: `KEY=VALUE` each: the path of a key in the file, and its value as YAML.
    """
    findings = Findings(str(plain.file))
    data, overrides = plain.data, dict(plain.overrides)
    for text in config_values:
        option, (path, equals, written) = f"--set-config {text}", text.partition("=")
        keys = path.split(".")
        value = read(written, wrong := Findings(option), {})
        if not (equals and written and all(keys)):
            findings.add(option, "no value of a key", "KEY=VALUE, such as simulation.window=16")
        elif "[" in path:
            findings.add(option, "a key inside a list", f"the whole list, as in {path.partition('[')[0]}=[...]")
        elif keys[2:3] == ["start_values"]:
            findings.add(option, "a start value", f"--set {'.'.join((keys[1], *keys[3:]))}={written}")
        elif len(wrong):
            findings.add(option, next(iter(wrong)).found, "a value in YAML")
        elif (problem := _obstacle(data, keys)) is not None:
            findings.add(option, *problem)
        else:
            data = _replaced(data, keys, value)
            overrides[path] = option
    return plain._replace(data=data, findings=(*plain.findings, *findings), overrides=overrides)


def with_needed(plain: PlainConfig, options: Options) -> PlainConfig:
    """The values of a configuration with the times and the algorithm that only the options give.

    A key that the file cannot have, and that no option gives either, becomes a finding.

    Example:
        >>> from pathlib import Path
        >>> plain = PlainConfig({"mesh": "m"}, Path("m.ssp"), needed={"simulation.step_size": "`--step-size S`"})
        >>> with_needed(plain, Options(step_size=0.1)).data
        {'mesh': 'm', 'simulation': {'step_size': 0.1}}
        >>> print(*with_needed(plain, Options()).findings)
        m.ssp: simulation.step_size: the package gives none; expected `--step-size S`
    """
    data, overrides = plain.data, dict(plain.overrides)
    for name in _NEEDED:
        setting, value = option_fields()[name], getattr(options, name)
        key = setting.flag.key
        if key is not None and value is not None and _is_absent(data, key):
            data = _replaced(data, key.split("."), value)
            overrides[key] = _as_option(setting, value)
    findings = Findings(str(plain.file), plain.lines, overrides, plain.findings, plain.origins)
    findings.explain(plain.explained)
    for key, option in plain.needed.items():
        if _is_absent(data, key):
            findings.add(key, "the package gives none", option)
    return plain._replace(data=data, findings=tuple(findings), overrides=overrides)


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


def with_options(loaded: LoadedConfig, options: Options, findings: Findings | None = None) -> LoadedConfig:
    """The configuration with its keys replaced by the options that are given.

    Args:
        loaded: the configuration, whose start values were replaced when it was read.
        options: what replaces its keys.
        findings: collects what is wrong with the values of options; None where they were checked before.
    """
    config, overrides = loaded.config, dict(loaded.overrides)
    if options.scenario is not None:
        overrides["scenario"] = f"--scenario {options.scenario}"
        config = replace(config, scenario=str(options.scenario.absolute()))
    for setting in option_fields().values():
        value, flag = getattr(options, setting.name), setting.flag
        if flag.key is None or value in (None, ()):
            continue
        section, _, key = flag.key.partition(".")
        place = f"{next(iter(config.records), section)}.{key}" if section == "record" else flag.key
        option = _as_option(setting, value)
        if overrides.get(place, option) != option and findings is not None:
            findings.add(place, f"replaced by {flag.name} as well", "one of the two options")
        overrides[place] = option
        plain = list(value) if setting.repeatable else str(value.absolute()) if isinstance(value, Path) else value
        if section == "record":
            config = replace(config, record=_with_output(config, str(plain)))
        else:
            config = replace(config, **{section: replace(getattr(config, section), **{key: plain})})
        if findings is not None:
            wrong = Findings(str(loaded.file), loaded.lines, overrides)
            if place not in findings.places:  # the value of a key that the file does not have is checked with the file
                check(plain, _type_of(section, key), place, wrong)
            findings.merge(wrong)
    return replace(loaded, config=config, overrides=overrides)


def _with_output(config: Config, file: str) -> RecordConfig | list[RecordConfig]:
    """The section `record` with another first file; of what stays in memory there is one."""
    first, *others = (*config.records.values(),) or (RecordConfig(),)
    first = replace(first, file=file)
    if isinstance(config.record, RecordConfig):
        return first
    return [first] if file.endswith(ENDING) else [first, *others]


def _alternatives(kind: Any) -> tuple[Any, ...]:  # noqa: ANN401 a type, which has no common class
    return getattr(kind, "__args__", (kind,))


def _type_of(section: str, key: str) -> inspect.Type:
    kind = inspect.type_info(_SECTIONS[section])
    assert isinstance(kind, inspect.StructType)
    return next(field.type for field in kind.fields if field.encode_name == key)


def _description(key: str) -> str:
    """What the configuration says about a key, as help: no full stop, and nothing about null, which no option takes."""
    section, _, name = key.partition(".")
    hint = get_type_hints(_SECTIONS[section], include_extras=True)[name]
    text: str = next(meta.description for meta in hint.__metadata__)
    return f"{text[0].lower()}{text[1:]}".partition("; null:")[0].removesuffix(".")


def _as_option(setting: OptionField, value: object) -> str:
    """An option as it is written on the command line."""
    return f"{setting.flag.name} {_written(value)}"


def _written(value: object) -> str:
    match value:
        case float():
            return f"{value:g}"
        case tuple():
            return ", ".join(value)
        case _:
            return str(value)
