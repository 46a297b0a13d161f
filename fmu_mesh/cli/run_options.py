"""The options of a run as flags of the command line: their Structs say which there are and how they are spelt."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..config.call_options import CallOptions, option_fields
from ..config.mesh import MAX_WINDOW
from ..errors import ConfigurationError
from ..run.options import PlanOptions, RunOptions
from .arguments import PACKAGE, ArgumentPart, argument, count, endpoint, group, number, whole
from .output.terminal import teller

if TYPE_CHECKING:
    from ..api.mesh_builder import Mesh
    from ..config.yaml_text import Plain

__all__ = ["CONFIG", "CONFIGURED", "PLACED", "add_options", "forwarded", "given_options", "mesh_of", "options"]


def mesh_of(arguments: argparse.Namespace) -> Mesh:
    """The mesh of CONFIG, in the variant that the flags of `CONFIGURED` choose."""
    from ..api.mesh_builder import load  # noqa: PLC0415 the help needs no mesh

    return load(arguments.config, ssd=arguments.ssd, ssv=arguments.ssv)


def add_options(
    parser: argparse._ActionsContainer,
    *names: str,
    options: type[CallOptions] = RunOptions,
    defaults: Mapping[str, str] | None = None,
    metavars: Mapping[str, str] | None = None,
) -> None:
    """Add flags for options, the fields of a Struct, as it describes them.

    ``defaults`` has default values for the help, and ``metavars`` names of values that differ from those in the Struct.
    """
    for name in names:
        field = option_fields(options)[name]
        default = (defaults or {}).get(name)
        text = (
            field.line.removeprefix("False: ")
            + ("; repeatable" if field.repeatable else "")
            + (f"; default: {default}" if default else "")
        )
        flag = field.flag or ""
        details: dict[str, Any] = {"dest": name, "help": text.replace("%", "%%"), "default": None}
        if field.kinds == (bool,):
            action = "store_false" if field.parameter.default else "store_true"
            parser.add_argument(flag, action=action, **details)
            continue
        metavar = (metavars or {}).get(name, field.metavar)
        of_type = (_OF_TYPE[kind] for kind in field.kinds if kind in _OF_TYPE)
        reader = partial(_value, expected=metavar) if field.named else _READERS.get(name) or next(of_type, str)
        details |= {"metavar": metavar, "type": reader}
        if field.repeatable:
            details |= {"action": "append"}
        if field.bare is not None:
            details |= {"nargs": "?", "const": field.bare}
        parser.add_argument(flag, **details)


def options(*names: str, of: type[CallOptions] = RunOptions, **words: Mapping[str, str]) -> ArgumentPart:
    """The flags of options; see `add_options`."""
    return lambda parser: add_options(parser, *names, options=of, **words)


CONFIG = (
    argument("config", "CONFIG", "a configuration file, a package of SSP, or a world of Gazebo", type=Path),
    *PACKAGE,
)
"""The argument CONFIG, and what chooses a variant of a package."""
_INSTEAD = (
    "algorithm",
    "step_size",
    "stop_time",
    "window",
    "real_time_factor",
    "start_values",
    "config_values",
    "scenario",
    "output",
)
_ACCESS = ("security", "insecure")
_TITLE = "instead of what CONFIG says"
CONFIGURED = (
    *CONFIG,
    group(_TITLE, options(*_INSTEAD, "listen", "connect", *_ACCESS)),
    options("keys_from", "allow_code"),
)
"""The argument CONFIG, and the flags that replace what CONFIG says."""
PLACED = (*CONFIG, group(_TITLE, options(*_INSTEAD, *_ACCESS)), options("keys_from", "allow_code"))
"""As `CONFIGURED`, where an engine says how processes meet."""


def given_options(arguments: argparse.Namespace, options: type[CallOptions] = PlanOptions) -> dict[str, Any]:
    """The options from the arguments of a command, as the library takes them; only those that are given.

    Raises:
        ConfigurationError: two of them cannot be combined.
    """
    given = {name: value for name in option_fields(options) if (value := getattr(arguments, name, None)) is not None}
    if given.get("view") and "video" in given:
        raise ConfigurationError("--view and --video do not go together", hint="Leave one of them out.")
    if "on_notice" in option_fields(options):
        given["on_notice"] = teller(quiet=getattr(arguments, "quiet", False))
    return given


def forwarded(arguments: argparse.Namespace) -> list[str | Path]:
    """The arguments of `PLACED` that are given, but for access, as other processes of the mesh take them."""
    fields, words = option_fields(PlanOptions), list[str | Path]()
    for name, value in given_options(arguments).items():
        if (flag := fields[name].flag) is None or name in _ACCESS:
            continue
        if fields[name].named:
            words += [word for key, own in value for word in (flag, f"{key}={json.dumps(own)}")]
        elif value is True:
            words.append(flag)
        else:
            words += [flag, value.absolute() if isinstance(value, Path) else str(value)]
    words += ["--ssd", arguments.ssd] if arguments.ssd else []
    for file in arguments.ssv:
        words += ["--ssv", Path(file).absolute() if Path(file).exists() else file]
    return words


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


def _value(text: str, *, expected: str | None) -> tuple[str, Plain]:
    from ..config.yaml_text import read_value  # noqa: PLC0415 the help reads no YAML

    try:
        return read_value(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{error}; expected {expected}") from error


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number of at least 0")
    return int(text)


_READERS: Mapping[str, Callable[[str], object]] = {
    "window": _window,
    "profile": _trace_file,
    "listen": endpoint,
    "connect": endpoint,
    "restarts": count,
    "seed": _seed,
    "workers": count,
}
"""The readers of values by their options; what a key allows is checked with the file."""

_OF_TYPE: Mapping[object, Callable[[str], object]] = {int: whole, float: number, Path: Path}
"""The readers of all other values; text for any other type."""
