"""Configurations and plans of files as tests need them, without what a `Mesh` has around them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from fmu_mesh.config.loading import LoadedConfig, read_text
from fmu_mesh.config.yaml_text import Plain
from fmu_mesh.instances.configuration import examine_data
from fmu_mesh.run.options import PlanOptions
from fmu_mesh.run.preparing import planned
from fmu_mesh.run.run_plan import RunPlan
from fmu_mesh.ssp.configuration_files import read_configuration
from fmu_mesh.system.plan import Plan

__all__ = ["parse", "plan_run", "prepare"]


def parse(text: str, path: Path, overrides: Mapping[str, Plain] = MappingProxyType({})) -> LoadedConfig:
    """A configuration from the text of a file; its structure is checked, and what it means is not."""
    loaded, findings = examine_data(read_text(text, path), overrides)
    findings.raise_any()
    return loaded


def plan_run(path: Path, options: PlanOptions = PlanOptions()) -> RunPlan:  # noqa: B008  a frozen Struct
    """Read, check and plan the configuration at ``path``."""
    return planned(read_configuration(path), options)


def prepare(path: Path, options: PlanOptions = PlanOptions()) -> Plan:  # noqa: B008  a frozen Struct
    """The plan of the mesh alone."""
    return plan_run(path, options).plan
