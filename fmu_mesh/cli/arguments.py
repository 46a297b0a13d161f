"""The common parts of all commands: adding one, its options, and readers of values with clear errors.

argparse shows the name of a reader function in its own message for a wrong value, so these raise messages of their own.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

from .. import files
from ..config.base import ENDPOINT_PATTERN, Endpoint
from ..config.mesh import MAX_WINDOW
from ..errors import ConfigurationError, LoadFailed
from ..run.options import Options, option_fields
from ..text import listed, nearest, nearest_file

__all__ = [
    "CommandParser",
    "add_command",
    "add_options",
    "count",
    "endpoint",
    "no_fmu",
    "number",
    "positive_seconds",
    "read_options",
]

Parsers = Sequence[argparse.ArgumentParser]

_NEGATIVE = re.compile(r"-(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?$|-\.?(?:inf|Inf|INF)$")


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one sentence. The usage that argparse prints would hide it."""

    def __init__(self, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 the arguments of argparse
        super().__init__(*arguments, **options)
        self._negative_number_matcher = _NEGATIVE  # by default argparse takes -1e-3 and -inf for options

    def error(self, message: str) -> NoReturn:
        """Exit with code 2 and one sentence about the error."""
        name, _, what = message.removeprefix("argument ").partition(": ")
        hint = None
        if name == "the following arguments are required":
            # argparse also lists optional ones at the end.
            free = [str(action.metavar) for action in self._get_positional_actions() if action.nargs in ("*", "?")]
            needed = " and ".join(one for one in what.split(", ") if one not in free)
            text, hint = f"`{self.prog}` needs {needed}", f"`{self.prog} --help` tells more."
        elif what.startswith("expected") and (option := self._option_string_actions.get(name)) is not None:
            text = f"{name} needs a value, as in `{name} {option.metavar}`"
        else:
            text = f"{name}: {what}" if what else name
        problem = ConfigurationError(text, hint=hint)
        self.exit(problem.exit_code, f"fmu-mesh: {problem}\n")

    def unknown(self, argument: str, others: Mapping[str, CommandParser]) -> ConfigurationError:
        """The error for an argument that this command does not have; ``others`` are all commands."""
        if not argument.startswith("-"):
            return ConfigurationError(f"`{self.prog}` takes no '{argument}'", hint=f"`{self.prog} --help` tells more.")
        name = argument.partition("=")[0]
        own = self.option_names
        near = nearest(name, own)
        elsewhere = [command for command, parser in others.items() if name in parser.option_names]
        if name in own:
            hint = f"It comes after the command: `{self.prog} {name}`."
        elif elsewhere and near is None:
            hint = f"It is an option of {listed([f'`{command}`' for command in elsewhere])}."
        else:
            hint = f"Did you mean '{near}'?" if near is not None else f"`{self.prog} --help` lists them."
        return ConfigurationError(f"`{self.prog}` has no option '{name}'", hint=hint)

    @property
    def option_names(self) -> list[str]:
        """The options in its help."""
        return [name for name, action in self._option_string_actions.items() if action.help != argparse.SUPPRESS]


def add_command(
    commands: argparse._SubParsersAction[Any], name: str, text: str, parents: Parsers
) -> argparse.ArgumentParser:
    """Add a command; ``text`` is its line in the list of commands and the first line of its own help."""
    description = f"{text[0].upper()}{text[1:]}."
    parser: argparse.ArgumentParser = commands.add_parser(name, parents=parents, help=text, description=description)
    return parser


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
        details |= {"metavar": (metavars or {}).get(name, flag.metavar), "type": _READERS[kind]}
        if setting.repeatable:
            details |= {"action": "append", "default": []}
        if flag.bare is not None:
            details |= {"nargs": "?", "const": flag.bare, "type": _trace_file}
        parser.add_argument(flag.name, **details)


def read_options(arguments: argparse.Namespace) -> Options:
    """The options from the arguments of a command."""
    given: dict[str, Any] = {}
    for name, setting in option_fields().items():
        if hasattr(arguments, name):
            value = getattr(arguments, name)
            given[name] = tuple(value) if setting.repeatable else value
    return Options(**given)


def number(text: str) -> float:
    """A finite number."""
    value = _read(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def positive_seconds(text: str) -> float:
    """A time in s above 0."""
    value = _read(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is not a time above 0")
    return value


def count(text: str) -> int:
    """A positive whole number."""
    value = _whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return value


def endpoint(text: str) -> str:
    """A Zenoh endpoint."""
    if not re.search(ENDPOINT_PATTERN, text):
        raise argparse.ArgumentTypeError(f"'{text}' is no Zenoh endpoint such as tcp/192.168.1.2:7447")
    return text


def no_fmu(path: Path, error: LoadFailed) -> ConfigurationError:
    """The error for a path that should be an FMU and is something else, or nothing."""
    hint = error.hint
    if not files.exists(path):
        near = nearest_file(path)
        hint = f"Did you mean '{near}'?" if near is not None else hint
    elif path.suffix in (".yaml", ".yml"):
        hint = f"A configuration is run by `fmu-mesh launch {path}`."
    return ConfigurationError(error.message, hint=hint)


def _trace_file(text: str) -> Path:
    if not text.endswith(".json"):
        raise argparse.ArgumentTypeError(f"'{text}' is no .json file; write --profile after the other arguments")
    return Path(text)


def _window(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    value = _whole(text)
    if not 1 <= value <= MAX_WINDOW:
        raise argparse.ArgumentTypeError(f"'{text}' is no window: auto, or from 1 to {MAX_WINDOW} points")
    return value


def _whole(text: str) -> int:
    """A whole number; 0, which no option here allows, for any other text."""
    try:
        return int(text)
    except ValueError:
        return 0


def _read(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no number") from None


_READERS: dict[Any, Callable[[str], object]] = {
    int: _window,
    float: number,
    str: str,
    Path: Path,
    Endpoint: endpoint,
}
"""The reader of a value by its type."""
