"""The common parts of all commands: their parser, flags that several have, and readers of values with clear errors.

argparse shows the name of a reader function in its own message for a wrong value, so these raise messages of their own.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, Protocol

from ..config.base import ENDPOINT_PATTERN
from ..errors import ConfigurationError
from ..text import listed, meant, nearest

__all__ = [
    "ACCESS",
    "PACKAGE",
    "QUIET",
    "RULED",
    "SSD",
    "ArgumentPart",
    "CommandParser",
    "Parsers",
    "Runs",
    "argument",
    "count",
    "endpoint",
    "group",
    "json_switch",
    "number",
    "port_number",
    "positive_seconds",
    "reach",
    "reaching",
    "switch",
    "tolerance",
    "whole",
]

_TIMEOUT_S = 5.0
_LAST_PORT = 65535

_NEGATIVE = re.compile(r"-(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?$|-\.?(?:inf|Inf|INF)$")


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one sentence. The usage that argparse prints would hide it."""

    def __init__(self, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 the arguments of argparse
        super().__init__(*arguments, **options)
        self._negative_number_matcher = _NEGATIVE  # by default argparse takes -1e-3 and -inf for options

    def error(self, message: str) -> NoReturn:
        """Raise one sentence about the error."""
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
        raise ConfigurationError(text, hint=hint)

    def unknown(self, argument: str, others: Mapping[str, CommandParser]) -> ConfigurationError:
        """The error for an argument that this command does not have; ``others`` are all commands."""
        if not argument.startswith("-"):
            return ConfigurationError(f"`{self.prog}` takes no '{argument}'", hint=f"`{self.prog} --help` tells more.")
        name = argument.partition("=")[0]
        own = self.option_names
        near = nearest(name, own)
        elsewhere = [command for command, parser in others.items() if name in parser.option_names]
        hint = meant(near, f"`{self.prog} --help` lists them.")
        if name in own:
            hint = f"It comes after the command: `{self.prog} {name}`."
        elif elsewhere and near is None:
            hint = f"It is an option of {listed([f'`{command}`' for command in elsewhere])}."
        return ConfigurationError(f"`{self.prog}` has no option '{name}'", hint=hint)

    @property
    def option_names(self) -> list[str]:
        """The options in its help."""
        return [name for name, action in self._option_string_actions.items() if action.help != argparse.SUPPRESS]


class ArgumentPart(Protocol):
    """Adds an argument, or several, to a command or to a group of its arguments."""

    def __call__(self, parser: argparse._ActionsContainer, /) -> object:
        """Add them."""


Runs = Mapping[str, Callable[[argparse.Namespace], int]]
"""What a module of commands offers: for each command the function that runs it and returns the exit code."""
Parsers = Mapping[str, Sequence[ArgumentPart]]
"""What a module of arguments offers: for each command its arguments, in the order of the help."""


def argument(name: str, metavar: str, text: str, **details: Any) -> ArgumentPart:  # noqa: ANN401 the arguments of argparse
    """An argument with a value: its name, what stands for the value in the help, and the help."""
    return lambda parser: parser.add_argument(name, metavar=metavar, help=text, **details)


def switch(*names: str, text: str) -> ArgumentPart:
    """A flag without a value."""
    return lambda parser: parser.add_argument(*names, action="store_true", help=text)


def group(title: str, *parts: ArgumentPart) -> ArgumentPart:
    """Arguments with a title in the help."""

    def add(parser: argparse._ActionsContainer) -> None:
        own = parser.add_argument_group(title)
        for part in parts:
            part(own)

    return add


def json_switch(text: str = "JSON, one object per line") -> ArgumentPart:
    """`--json`."""
    return switch("--json", text=text)


ACCESS: tuple[ArgumentPart, ...] = (
    argument("--security", "DIR/NAME", "folder with your certificate; default: that of FMU_MESH_SECURITY", type=Path),
    switch("--insecure", text="also use a network without TLS, where everybody can set values and end runs"),
)
"""How a command reaches others at a network."""


RULED: tuple[ArgumentPart, ...] = (
    argument("--key-prefix", "PREFIX", "rules: what the keys of the meshes begin with (fmu_mesh)", default="fmu_mesh"),
    argument(
        "--end",
        "KEY",
        "rules: a key of other programs at an end of a connection; repeatable",
        action="append",
        default=[],
    ),
)
"""For which keys the rules of a router are, which it has with a certificate."""


def reaching(timeout_s: float = _TIMEOUT_S) -> tuple[ArgumentPart, ...]:
    """The flags of all commands for running meshes; ``timeout_s`` is the default deadline of a query in s."""
    where = "Zenoh endpoint of a mesh or a router; repeatable; default: the meshes of this user on this host"
    return (
        argument("--connect", "ENDPOINT", where, type=endpoint, action="append", default=[]),
        argument(
            "--timeout", "S", f"deadline of every query in s ({timeout_s:g})", type=positive_seconds, default=timeout_s
        ),
        *ACCESS,
    )


def reach(arguments: argparse.Namespace) -> dict[str, Any]:
    """The flags of `reaching`, as the library takes them; warns of a network without TLS."""
    if arguments.insecure:
        from ..config.access_sections import why_open  # noqa: PLC0415  the list of commands needs neither
        from .output.terminal import say_warning  # noqa: PLC0415  as above

        for _, text in why_open({"--connect": arguments.connect}, secured=False):
            say_warning(text)
    return {name: getattr(arguments, name) for name in ("connect", "timeout", "security", "insecure")}


def _finite(text: str, *, least: float = -math.inf, above: float = -math.inf, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no number") from None
    if not (math.isfinite(value) and value >= least and value > above):
        raise argparse.ArgumentTypeError(f"{text} is not {what}")
    return value


number = partial(_finite, what="a finite number")
positive_seconds = partial(_finite, above=0.0, what="a time above 0")
tolerance = partial(_finite, least=0.0, what="a number of 0 or more")


def count(text: str) -> int:
    """A positive whole number."""
    value = whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of 1 or more")
    return value


def port_number(text: str) -> int:
    """A TCP port, or 0 for a free one."""
    if not (text.isdecimal() and int(text) <= _LAST_PORT):
        raise argparse.ArgumentTypeError(f"'{text}' is no port: expected 0 to {_LAST_PORT}")
    return int(text)


def endpoint(text: str) -> str:
    """A Zenoh endpoint."""
    if not re.search(ENDPOINT_PATTERN, text):
        raise argparse.ArgumentTypeError(f"'{text}' is no Zenoh endpoint such as tcp/192.168.1.2:7447")
    return text


def whole(text: str) -> int:
    """A whole number; 0, which no argument here allows, for any other text."""
    try:
        return int(text)
    except ValueError:
        return 0


QUIET = switch("-q", "--quiet", text="print errors only")
SSD = argument(
    "--ssd", "NAME", "the description in a package of SSP: its file or its name; default: SystemStructure.ssd"
)
PACKAGE = (
    SSD,
    argument(
        "--ssv",
        "FILE.ssv",
        "values of an SSV file, which replace those of a package: a file in it, or another one; repeatable",
        action="append",
        default=[],
    ),
)
"""What chooses a variant of a package."""
