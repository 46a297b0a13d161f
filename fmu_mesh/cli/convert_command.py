"""`convert`: a package of SSP becomes a YAML file, and a mesh becomes a package."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from .. import files
from ..api.converting import convert
from ..errors import ConfigurationError
from ..ssp.configuration_files import named_package
from ..ssp.package import DEFAULT, Package
from ..ssp.system_reading import chosen_description
from .arguments import Runs
from .file_arguments import TIMES
from .output.terminal import say

__all__ = ["RUNS"]


def _convert(arguments: argparse.Namespace) -> int:
    source, target = arguments.source, arguments.target
    if files.exists(target) and not arguments.force:
        raise ConfigurationError(f"'{target}' exists.", hint="--force overwrites it.")
    given = {name: value for name in TIMES if (value := getattr(arguments, name)) is not None}
    lost = convert(source, target, ssd=arguments.ssd, ssv=arguments.ssv, version=arguments.version, simulation=given)
    if not arguments.quiet:
        for finding in lost:
            say(f"warning: {finding}")
    print(f"{target}: run it with `{_launch(source, arguments.ssd, target)}`")
    return 0


def _launch(source: Path, ssd: str | None, target: Path) -> str:
    words = ["fmu-mesh", "launch", str(target)]
    named = named_package(source, ssd)
    if named is not None and target.suffix.lower() == ".ssp":
        with Package(named[0]) as package:
            name = chosen_description(package, named[1])
        with Package(target) as package:
            if name != DEFAULT and name in package.descriptions:
                words += ["--ssd", name]
    return shlex.join(words)


RUNS: Runs = {"convert": _convert}
