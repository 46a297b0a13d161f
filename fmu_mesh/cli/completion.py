"""`completion`: shells complete commands, options, files, and the names of what is running (by argcomplete).

Owns what can stand for each argument, which its `metavar` in the help tells. A shell waits for the answer, so questions
to running meshes have a short deadline, and an error means that there is nothing to offer.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Final, get_args, get_type_hints

from argcomplete.completers import BaseCompleter, FilesCompleter
from argcomplete.finders import CompletionFinder
from argcomplete.shell_integration import shellcode

from ..config.mesh import SimulationConfig
from ..errors import FmuMeshError
from ..ssp.configuration_files import named_package, read_configuration
from ..ssp.package import Package
from ..wire.client.reaching import Meshes
from .arguments import CommandParser, Runs

__all__ = ["RUNS", "complete"]

_PATIENCE_S: Final = 1.0
_RESULTS: Final = ("csv", "mcap")
_FILES: Final[Mapping[str, tuple[str, ...]]] = {
    "CONFIG": ("yaml", "yml", "ssp", "ssd"),
    "CONFIG|MESH": ("yaml", "yml", "ssp", "ssd"),
    "MODEL.fmu": ("fmu",),
    "MODEL.fmu|PACKAGE": ("fmu", "ssp", "ssd"),
    "FILE.ssv": ("ssv",),
    "SOURCE": ("ssp", "ssd", "yaml", "yml"),
    "TARGET": ("ssp", "yaml", "yml"),
    "FMU": ("fmu",),
    "RESULTS.csv": _RESULTS,
    "BAG": ("mcap",),
    "FILE": _RESULTS,
    "FILE.png": ("png", "svg", "pdf"),
    "FILE.svg": ("svg", "png", "pdf", "txt"),
    "FILE.mp4": ("mp4", "gif"),
    "FILE.json": ("json",),
    "FILE.yaml": ("yaml", "yml"),
}
"""The endings of files by the `metavar` of an argument."""

_PACKAGES: Final = ("config", "fmu", "source", "of")
"""The arguments that may name a package of SSP."""


def complete(parser_of: Callable[[Collection[str]], tuple[CommandParser, Mapping[str, CommandParser]]]) -> int:
    """Answer the shell that asks how a line goes on; returns an exit code.

    Args:
        parser_of: makes the parser of the whole command line, with the arguments of the commands it is given.
    """
    line = os.environ.get("COMP_LINE", "")[: int(os.environ.get("COMP_POINT", "0"))]
    words = line.split()[1:]
    CompletionFinder()(parser_of(words[:1])[0], default_completer=_Offer(), always_complete_options=False)
    return 0  # only where no shell asks: otherwise the process has ended here


class _Offer(BaseCompleter):
    """What can stand for one argument; nothing where that cannot be known."""

    def __call__(
        self,
        *,
        prefix: str,
        action: argparse.Action,
        parser: argparse.ArgumentParser,  # noqa: ARG002 argcomplete passes it
        parsed_args: argparse.Namespace,
    ) -> Iterable[str]:
        """As argcomplete calls it."""
        try:
            return _offered(prefix, action, parsed_args)
        except FmuMeshError:
            return ()


def _offered(prefix: str, action: argparse.Action, parsed_args: argparse.Namespace) -> Iterable[str]:
    name = action.metavar if isinstance(action.metavar, str) else ""
    if name in _FILES:
        files: Iterable[str] = FilesCompleter(_FILES[name])(prefix)
        return [*files, *_meshes(prefix, parsed_args)] if name == "CONFIG|MESH" else files
    if action.dest in _from_running:
        return _from_running[action.dest](prefix, parsed_args)
    if action.dest == "algorithm":
        return get_args(get_type_hints(SimulationConfig)["algorithm"])
    if action.dest == "ssd":
        return _descriptions_in(parsed_args)
    if action.dest == "node":
        return _instances_in(parsed_args.config, getattr(parsed_args, "ssd", None))
    return ()


def _meshes(_prefix: str, given: argparse.Namespace) -> list[str]:
    with Meshes(getattr(given, "connect", ()), _PATIENCE_S) as meshes:
        return [client.keys.mesh for client in meshes.all()]


def _instances(_prefix: str, given: argparse.Namespace) -> list[str]:
    with Meshes(given.connect, _PATIENCE_S) as meshes:
        return [*meshes.named(given.mesh).info().instances]


def _references(prefix: str, given: argparse.Namespace) -> list[str]:
    """Meshes, instances and, once an instance is there, variables; with the mesh in front if several are running."""
    found: list[str] = []
    with Meshes(given.connect, _PATIENCE_S) as meshes:
        clients = meshes.all()
        for client in clients:
            mesh = client.keys.mesh
            front = f"{mesh}/" if len(clients) > 1 or prefix.startswith(f"{mesh}/") else ""
            found += [mesh] if given.command in ("ls", "status", "info") else []
            for instance in client.info().instances:
                name = f"{front}{instance}"
                if given.command in ("ls", "status", "info"):
                    found.append(name)
                elif prefix.startswith(f"{name}."):
                    found += [f"{name}.{variable.name}" for variable in client.instance_info(instance).variables]
                else:
                    found.append(f"{name}.")
    return found


_from_running: Final[Mapping[str, Callable[[str, argparse.Namespace], list[str]]]] = {
    "mesh": _meshes,
    "instance": _instances,
    "key": _references,
    "name": _references,
}
"""What only running meshes know, by the destination of an argument."""


def _instances_in(file: Path, ssd: str | None) -> Iterable[str]:
    data = read_configuration(file, ssd).data
    instances = data.get("instances") if isinstance(data, dict) else None
    return [*instances] if isinstance(instances, dict) else []


def _descriptions_in(given: argparse.Namespace) -> Iterable[str]:
    """The descriptions of the package that an argument names."""
    path = next((path for name in _PACKAGES if (path := getattr(given, name, None)) is not None), None)
    if path is None or (named := named_package(Path(path))) is None:
        return ()
    with Package(named[0]) as package:
        return package.descriptions


def _completion(arguments: argparse.Namespace) -> int:
    print(shellcode(["fmu-mesh"], shell=arguments.shell).strip())
    return 0


RUNS: Runs = {"completion": _completion}
