"""`inspect`: the properties of one FMU, or of a package of SSP. Nothing of it is executed."""

from __future__ import annotations

import argparse
import shutil
from typing import TYPE_CHECKING, Final

import msgspec

from ..api.inspection import Inspection, inspect
from ..errors import ConfigurationError, LoadFailed
from ..printing import write_data
from ..ssp.configuration_files import named_package
from .arguments import Runs
from .output.json_output import print_failure

if TYPE_CHECKING:
    from ..api.package_inspection import PackageInspection

__all__ = ["RUNS"]

_NARROWEST: Final = 60
_WIDE: Final = 120


def _inspect(arguments: argparse.Namespace) -> int:
    try:
        found = _inspected(arguments)
    except ConfigurationError as error:
        if arguments.json:
            print_failure(error)
        raise
    if arguments.json:
        write_data(msgspec.json.format(msgspec.json.encode(found)) + b"\n")
    elif isinstance(found, Inspection):
        width = max(_NARROWEST, shutil.get_terminal_size((_WIDE, 0)).columns)
        print(found.page(width, arguments.variables, everything=arguments.all))
    else:
        print(found)
    return 0


def _inspected(arguments: argparse.Namespace) -> Inspection | PackageInspection:
    if named_package(arguments.fmu, arguments.ssd) is None:
        if arguments.ssd is not None:
            raise ConfigurationError(
                f"--ssd chooses a description of a package of SSP, and '{arguments.fmu}' is no package"
            )
        try:
            return inspect(arguments.fmu)
        except LoadFailed as error:  # a wrong argument: nothing was going to run
            raise ConfigurationError(error.message, hint=error.hint) from error
    if arguments.variables:
        path = arguments.fmu.parent if arguments.fmu.suffix.lower() == ".ssd" else arguments.fmu
        hint = f"Those of an FMU are shown by `fmu-mesh inspect {path}/resources/NAME.fmu`."
        raise ConfigurationError("a package of SSP has no variables of its own", hint=hint)
    from ..api.package_inspection import inspect_package  # noqa: PLC0415  it needs more than an FMU does

    return inspect_package(arguments.fmu, ssd=arguments.ssd)


RUNS: Runs = {"inspect": _inspect}
