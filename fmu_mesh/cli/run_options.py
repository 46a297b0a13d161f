"""The options of a run as flags of the command line: `Options` says which there are and how they are spelt."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, cast

from msgspec.structs import asdict

from ..api.mesh_builder import Mesh, load
from ..api.plan_options import PlanOptions
from ..config.base import Endpoint
from ..config.mesh import MAX_WINDOW
from ..errors import ConfigurationError
from ..run.options import Options, option_fields
from .arguments import add_package, endpoint, number, whole
from .output.display import teller

__all__ = ["add_configuration", "add_options", "given_options", "mesh_of", "read_options"]


def add_configuration(parser: argparse.ArgumentParser) -> None:
    """Add the argument CONFIG, and the flags that replace what CONFIG says."""
    parser.add_argument("config", type=Path, metavar="CONFIG", help="the configuration file, or a package of SSP")
    add_package(parser)
    add_options(
        parser.add_argument_group("instead of what CONFIG says"),
        "algorithm",
        "step_size",
        "stop_time",
        "window",
        "real_time_factor",
        "start_values",
        "config_values",
        "scenario",
        "output",
        "listen",
        "connect",
    )
    add_options(parser, "allow_code")


def mesh_of(arguments: argparse.Namespace) -> Mesh:
    """The mesh of CONFIG, in the variant that the flags of `add_configuration` choose."""
    return load(arguments.config, ssd=arguments.ssd, ssv=arguments.ssv)


def add_options(
    parser: argparse._ActionsContainer,
    *names: str,
    defaults: Mapping[str, str] | None = None,
    metavars: Mapping[str, str] | None = None,
) -> None:
    """Add flags for options of a run, as `Options` describes them.

    Args:
        parser: the parser of a command, or a group of its flags.
        names: the fields of `Options`.
        defaults: by field, the default value for the help.
        metavars: by field, the name of the value in the help, if it differs from that in `Options`.
    """
    for name in names:
        setting = option_fields()[name]
        flag, kind = setting.flag, setting.type
        default = (defaults or {}).get(name)
        text = setting.help + (f"; default: {default}" if default is not None else "")
        details: dict[str, Any] = {"dest": name, "help": text.replace("%", "%%")}
        if kind is bool:
            parser.add_argument(flag.name, action="store_true", **details)
            continue
        details |= {"metavar": (metavars or {}).get(name, flag.metavar), "type": _READERS.get(kind, str)}
        if setting.repeatable:
            details |= {"action": "append", "default": []}
        if flag.bare is not None:
            details |= {"nargs": "?", "const": flag.bare, "type": _trace_file}
        parser.add_argument(flag.name, **details)


def given_options(arguments: argparse.Namespace) -> PlanOptions:
    """The options from the arguments of a command, as the library takes them.

    Raises:
        ConfigurationError: two of them cannot be combined.
    """
    options = read_options(arguments)
    if options.view and options.video is not None:
        raise ConfigurationError("--view and --video do not go together", hint="Leave one of them out.")
    tell = teller(quiet=getattr(arguments, "quiet", False))
    return cast("PlanOptions", {**asdict(options), "on_notice": tell})


def read_options(arguments: argparse.Namespace) -> Options:
    """The options from the arguments of a command."""
    given: dict[str, Any] = {}
    for name, setting in option_fields().items():
        if hasattr(arguments, name):
            value = getattr(arguments, name)
            given[name] = tuple(value) if setting.repeatable else value
    return Options(**given)


def _trace_file(text: str) -> Path:
    if not text.endswith(".json"):
        raise argparse.ArgumentTypeError(f"'{text}' is no .json file; write --profile after the other arguments")
    return Path(text)


def _window(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    value = whole(text)
    if not 1 <= value <= MAX_WINDOW:
        raise argparse.ArgumentTypeError(f"'{text}' is no window: auto, or from 1 to {MAX_WINDOW} points")
    return value


_READERS: dict[Any, Callable[[str], object]] = {
    int: _window,
    float: number,
    Path: Path,
    Endpoint: endpoint,
}
"""The reader of a value by its type; text for any other type. What words a key allows is checked with the file."""
