"""Configuration files with all installed kinds of instances: `fmu_mesh.config.loading` with the kinds handed in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..config import loading
from ..config.findings import Findings
from ..config.loading import LoadedConfig, PlainConfig
from ..config.mesh import Config, config_type
from .registry import KINDS

__all__ = ["examine", "examine_data", "installed_config", "load", "parse"]


def load(path: Path, overrides: Sequence[str] = ()) -> LoadedConfig:
    """Read a configuration file; see `fmu_mesh.config.loading.load`."""
    return loading.load(path, overrides, KINDS)


def examine(path: Path, overrides: Sequence[str] = ()) -> tuple[LoadedConfig, Findings]:
    """As `load`, but go on where the structure is wrong; see `fmu_mesh.config.loading.examine`."""
    return loading.examine(path, overrides, KINDS)


def examine_data(plain: PlainConfig, overrides: Sequence[str] = ()) -> tuple[LoadedConfig, Findings]:
    """As `examine`, for values that were read before; see `fmu_mesh.config.loading.examine_data`."""
    return loading.examine_data(plain, overrides, KINDS)


def parse(text: str, path: Path, overrides: Sequence[str] = ()) -> LoadedConfig:
    """As `load`, with the text of the file; see `fmu_mesh.config.loading.parse`."""
    return loading.parse(text, path, overrides, KINDS)


def installed_config() -> type[Config]:
    """The type of a configuration with all installed kinds of instances, for its JSON Schema.

    Raises:
        ConfigurationError: a package with a kind cannot be imported, or two packages have the same key.
    """
    own = KINDS.own()
    others = {name: KINDS.section(name) for name in KINDS.names() if name not in own}
    return config_type((*own.values(), *others.values()))
