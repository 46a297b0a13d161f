"""The variables of instances and FMUs, to complete names: a wrong part of a file hides no other, and no code runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec

from ..config.instance_sections import KIND
from ..config.loading import LoadedConfig
from ..instances.configuration import examine_data
from ..instances.registry import KINDS, describe
from ..ssp.configuration_files import read_configuration
from ..variables.model_description import Variable

__all__ = ["readable_configuration", "variables_of_fmu", "variables_of_instance"]


def readable_configuration(path: Path, ssd: str | None = None, ssv: Sequence[str] = ()) -> LoadedConfig:
    """What can be read of a configuration; see `read_configuration`."""
    return examine_data(read_configuration(path, ssd, ssv))[0]


def variables_of_instance(loaded: LoadedConfig, name: str) -> tuple[Variable, ...]:
    """The variables of an instance; none if there is no such instance, or only its code knows them."""
    section = loaded.config.instances.get(name)
    if section is None or section.names_code or section.interpreter is not None:
        return ()
    return describe(loaded.resolve(section.path), section, loaded.config.limits).variables


def variables_of_fmu(path: Path) -> tuple[Variable, ...]:
    """The variables of an FMU."""
    return describe(path, msgspec.convert({KIND: "fmu", "fmu": str(path)}, KINDS.section("fmu"))).variables
