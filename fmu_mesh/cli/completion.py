"""`completion`: shells complete commands, options, files, their names, and what is running (by argcomplete).

Owns what can stand for each argument, which its name and its `metavar` in the help tell. A long name is completed in
parts, up to its next dot. A shell waits for the answer: it starts no process and runs no code of a model, and there is
none after a deadline. An error means that there is nothing to offer. argcomplete quotes what a shell would read in
another way; names with line breaks or control characters are left out.
"""

# Signals: a shell waits for this process, and a call into Zenoh may last. So SIGALRM ends the process at the deadline,
# whatever the main thread is doing; nothing has been written then, which means that there is nothing to offer.

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args, get_type_hints

from argcomplete.completers import BaseCompleter, FilesCompleter
from argcomplete.finders import CompletionFinder
from argcomplete.shell_integration import shellcode
from msgspec.structs import fields

from ..api.inspection import readable_configuration, variables_of_fmu, variables_of_instance
from ..config.mesh import Config, SimulationConfig
from ..ssp.configuration_files import named_package
from ..ssp.package import Package
from ..wire.security.identity import CERTIFICATE
from .arguments import CommandParser, Runs

if TYPE_CHECKING:
    from ..variables.model_description import Variable
    from ..wire.client.reaching import Meshes

__all__ = ["RUNS", "complete"]

_PATIENCE_S: Final = 1.0
_LONGEST_S: Final = 5
"""After this time a shell gets no answer."""
_RESULTS: Final = ("csv", "mcap")
_FILES: Final[Mapping[str, tuple[str, ...]]] = {
    "CONFIG": ("yaml", "yml", "ssp", "ssd", "world", "sdf"),
    "CONFIG|MESH": ("yaml", "yml", "ssp", "ssd", "world", "sdf"),
    "MODEL.fmu": ("fmu",),
    "MODEL.fmu|PACKAGE": ("fmu", "ssp", "ssd"),
    "FILE.ssv": ("ssv",),
    "SOURCE": ("ssp", "ssd", "yaml", "yml", "world", "sdf"),
    "TARGET": ("ssp", "yaml", "yml"),
    "FMU": ("fmu",),
    "RESULTS.csv": _RESULTS,
    "BAG": ("mcap",),
    "FILE": _RESULTS,
    "FILE.png": ("png", "svg", "pdf"),
    "FILE.csv": ("csv",),
    "FILE.svg": ("svg", "png", "pdf", "txt"),
    "FILE.mp4": ("mp4", "gif"),
    "FILE.json": ("json",),
    "FILE.yaml": ("yaml", "yml"),
}
"""The endings of files by the `metavar` of an argument."""

_PACKAGES: Final = ("config", "fmu", "source", "of")
"""The arguments that may name a package of SSP."""


_KEYS: Final = [
    f"{section.name}.{key}" for section in fields(Config) for key in getattr(section.type, "__struct_fields__", ())
]
"""The keys of a configuration that `--set-config` and `--vary` are for."""


def complete(parser_of: Callable[[Collection[str]], tuple[CommandParser, Mapping[str, CommandParser]]]) -> int:
    """Answer the shell that asks how a line goes on; returns an exit code.

    Args:
        parser_of: makes the parser of the whole command line, with the arguments of the commands it is given.
    """
    signal.signal(signal.SIGALRM, lambda *_: os._exit(0))
    signal.alarm(_LONGEST_S)
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
        try:
            return [name for name in _offered(prefix, action, parsed_args) if name.isprintable()]
        except Exception:  # noqa: BLE001 whatever is wrong with a file, a shell shows no error while somebody types
            return ()


def _offered(prefix: str, action: argparse.Action, given: argparse.Namespace) -> Iterable[str]:
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    if metavar in _FILES:
        files: Iterable[str] = FilesCompleter(_FILES[metavar])(prefix)
        return [*files, *_meshes(prefix, given)] if metavar == "CONFIG|MESH" else files
    offer = _BY_COMMAND.get((given.command, action.dest)) or _BY_NAME.get(action.dest)
    return offer(prefix, given) if offer is not None else ()


# --- names in files


def _in_parts(names: Iterable[str], prefix: str) -> list[str]:
    """The names that begin with a prefix, each up to its next dot, as folders are completed."""
    ends = ((name, name.find(".", len(prefix)) + 1) for name in names if name.startswith(prefix))
    return list(dict.fromkeys(name[: end or None] for name, end in ends))


def _with_end(names: Iterable[str], end: str) -> list[str]:
    return [name if name.endswith(".") else f"{name}{end}" for name in names]


def _of_config(prefix: str, given: argparse.Namespace, wanted: Callable[[Variable], bool]) -> list[str]:
    """The instances, or the variables of the one that a prefix names, in parts."""
    loaded, (name, dot, _) = readable_configuration(given.config, given.ssd, given.ssv), prefix.partition(".")
    if not dot:
        return _in_parts([f"{own}." for own in loaded.config.instances], prefix)
    return _in_parts([f"{name}.{one.name}" for one in variables_of_instance(loaded, name) if wanted(one)], prefix)


def _settable(prefix: str, given: argparse.Namespace) -> list[str]:
    if given.command == "run":
        names = [one.name for one in variables_of_fmu(given.fmu) if one.settable_before_start]
        return _with_end(_in_parts(names, prefix), "=")
    return _with_end(_of_config(prefix, given, lambda variable: variable.settable_before_start), "=")


def _keys(prefix: str, _given: argparse.Namespace) -> list[str]:
    return _with_end(_in_parts(_KEYS, prefix), "=")


def _reduced(prefix: str, given: argparse.Namespace) -> list[str]:
    from ..sweeps.reductions import FUNCTIONS  # noqa: PLC0415 slow, and only this needs it

    function, opened, name = prefix.partition("(")
    if not opened:
        return [f"{one}(" for one in FUNCTIONS]
    outputs = _of_config(name, given, lambda variable: variable.causality == "output")
    return [f"{function}({part}" for part in _with_end(outputs, ", " if function == "at" else ")")]


def _samplers(_prefix: str, _given: argparse.Namespace) -> list[str]:
    from ..sweeps.variants import SAMPLERS  # noqa: PLC0415 as above

    return [f"{name}:" for name in SAMPLERS]


def _columns(prefix: str, given: argparse.Namespace) -> list[str]:
    from ..api.result import Result  # noqa: PLC0415 as above
    from ..sweeps.sweep_folder import is_sweep  # noqa: PLC0415 as above
    from ..sweeps.sweep_result import SweepResult  # noqa: PLC0415 as above

    file = given.results[0] if given.command == "plot" else given.first
    return _in_parts(SweepResult.read(file).variables if is_sweep(file) else Result("", file=file), prefix)


def _descriptions_in(_prefix: str, given: argparse.Namespace) -> Iterable[str]:
    path = next((path for name in _PACKAGES if (path := getattr(given, name, None)) is not None), None)
    if path is None or (named := named_package(Path(path))) is None:
        return ()
    with Package(named[0]) as package:
        return package.descriptions


# --- names of what is running


def _reached(given: argparse.Namespace) -> Meshes:
    from ..wire.client.reaching import Meshes  # noqa: PLC0415 only this needs Zenoh

    access = getattr(given, "security", None), getattr(given, "insecure", False)
    return Meshes(getattr(given, "connect", ()), _PATIENCE_S, access[0], insecure=access[1])


def _meshes(_prefix: str, given: argparse.Namespace) -> list[str]:
    with _reached(given) as meshes:
        return [client.keys.mesh for client in meshes.all()]


def _instances(_prefix: str, given: argparse.Namespace) -> list[str]:
    with _reached(given) as meshes:
        return [*meshes.named(given.mesh).info().instances]


def _references(prefix: str, given: argparse.Namespace) -> list[str]:
    """Meshes, instances and, once an instance is there, variables; with the mesh in front if several are running."""
    found: list[str] = []
    with _reached(given) as meshes:
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
    return _in_parts(found, prefix)


_Offers = Mapping[Any, Callable[[str, argparse.Namespace], Iterable[str]]]
_BY_NAME: Final[_Offers] = {
    "algorithm": lambda *_: get_args(get_type_hints(SimulationConfig)["algorithm"]),
    "ssd": _descriptions_in,
    "node": lambda _, given: readable_configuration(given.config, given.ssd).config.instances,
    "start_values": _settable,
    "config_values": _keys,
    "vary": lambda prefix, given: [*_settable(prefix, given), *_keys(prefix, given)],
    "reduce": _reduced,
    "sampler": _samplers,
    "mesh": _meshes,
    "instance": _instances,
    "key": _references,
    "name": _references,
    "variables": _references,
    "watch": _references,
}
"""What can stand for an argument, by its destination."""
_BY_COMMAND: Final[_Offers] = {
    ("inspect", "variables"): lambda prefix, given: _in_parts(
        (one.name for one in variables_of_fmu(given.fmu)), prefix
    ),
    ("node", "host"): lambda _, given: readable_configuration(given.config, given.ssd).config.deploy.hosts,
    ("plot", "variables"): _columns,
    ("plot", "x"): _columns,
    ("compare", "variables"): _columns,
    ("security", "name"): lambda _, given: [own.parent.name for own in given.folder.glob(f"*/{CERTIFICATE}")],
}
"""The same where it depends on the command."""


def _completion(arguments: argparse.Namespace) -> int:
    code = shellcode(["fmu-mesh"], shell=arguments.shell).strip()
    print(code.replace("[=/:]", r"[=/:.\(]"))  # no space after a part of a name either
    return 0


RUNS: Runs = {"completion": _completion}
