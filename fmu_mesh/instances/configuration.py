"""Configuration files with all installed kinds of instances: `fmu_mesh.config.loading` with the kinds handed in."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from ..config import loading
from ..config.findings import Findings
from ..config.loading import LoadedConfig, PlainConfig
from ..config.mesh import Config, config_type
from ..config.yaml_text import Plain
from .registry import KINDS

__all__ = ["examine_data", "installed_config"]


def examine_data(
    plain: PlainConfig, overrides: Mapping[str, Plain] = MappingProxyType({})
) -> tuple[LoadedConfig, Findings]:
    """A configuration and its findings, start values replaced; see `fmu_mesh.config.loading.examine_data`."""
    return loading.examine_data(plain, overrides, KINDS)


def installed_config() -> type[Config]:
    """The type of a configuration with all installed kinds of instances, for its JSON Schema."""
    own = KINDS.own()
    others = {name: KINDS.section(name) for name in KINDS.names() if name not in own}
    return config_type((*own.values(), *others.values()))
