"""From a configuration file to a plan: everything is checked here, before anything is spawned."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec.structs import replace

from ..errors import ConfigurationError, Finding, LoadFailed
from ..fmu import read_description
from ..model.config import ZenohConfig
from ..model.description import ModelDescription
from ..model.findings import nearest_file
from ..model.loading import LoadedConfig, examine
from ..model.plan import Plan, make_plan
from ..model.system import build
from ..ros.mapping import resolve as resolve_ros
from .results import check_results

__all__ = ["Options", "prepare", "zenoh_section"]


class Options(msgspec.Struct, frozen=True):
    """What the command line changes of a configuration.

    Attributes:
        start_values: `instance.variable=value` each.
        window: in points.
        output: the result file instead of the configured one.
        connect: Zenoh endpoints instead of the configured ones.
        profile: whether the nodes measure where their time goes.
        paused: whether the run starts at rest at its first point.
    """

    start_values: tuple[str, ...] = ()
    window: int | None = None
    output: Path | None = None
    connect: tuple[str, ...] = ()
    profile: bool = False
    paused: bool = False


def prepare(path: Path, options: Options = Options()) -> Plan:  # noqa: B008 a frozen Struct
    """Read, check and plan the configuration at ``path``.

    Raises:
        ConfigurationError: with everything that is wrong with it or its FMUs.
    """
    loaded, findings = examine(path, options.start_values)
    loaded = _with_options(loaded, options)
    descriptions, unreadable = _descriptions(loaded)
    findings.merge(unreadable)
    resolve_ros(loaded, descriptions, findings)
    system = build(loaded, descriptions, tuple(findings))
    check_results(loaded, system)
    return make_plan(system, window=options.window, file=str(path))


def zenoh_section(loaded: LoadedConfig, options: Options) -> ZenohConfig:
    """The `zenoh` section, with the endpoints of the command line if there are any."""
    section = loaded.config.zenoh
    return replace(section, connect=list(options.connect)) if options.connect else section


def _with_options(loaded: LoadedConfig, options: Options) -> LoadedConfig:
    if options.window is not None and options.window < 1:
        raise ConfigurationError(f"--window {options.window}: a window has at least 1 point")
    config = replace(loaded.config, zenoh=zenoh_section(loaded, options))
    if options.output is not None:
        config = replace(config, record=replace(config.record, file=str(options.output.absolute())))
    return replace(loaded, config=config)


def _descriptions(loaded: LoadedConfig) -> tuple[dict[str, ModelDescription], Sequence[Finding]]:
    """The description of every instance whose FMU can be read, and a finding for every other."""
    cache: dict[Path, ModelDescription | LoadFailed] = {}
    descriptions: dict[str, ModelDescription] = {}
    findings = []
    for name, instance in loaded.config.instances.items():
        if not instance.fmu:
            continue  # what stands there instead is a finding already
        path = loaded.resolve(instance.fmu)
        if path not in cache:
            try:
                cache[path] = read_description(path)
            except LoadFailed as error:
                cache[path] = error
        found = cache[path]
        if isinstance(found, LoadFailed):
            text = found.message.rstrip(".") + (f" ({found.hint.rstrip('.')})" if found.hint else "")
            expected = "a co-simulation FMU of FMI 1.0, 2.0 or 3.0 for this platform"
            findings.append(loaded.finding(f"instances.{name}.fmu", text, expected, _similar(path)))
        else:
            descriptions[name] = found
    return descriptions, findings


def _similar(path: Path) -> str | None:
    """The nearest existing file name, if there is no such file."""
    return None if path.exists() else nearest_file(path)
