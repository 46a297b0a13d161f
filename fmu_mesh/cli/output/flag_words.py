"""Messages in the words of the command line: options of a program become the flags that they are here."""

from __future__ import annotations

import re

from ...config.call_options import option_fields
from ...run.options import ConvergenceOptions, RunOptions, SimulateOptions
from ...sweeps.sweep_options import SweepOptions

__all__ = ["in_flags"]

_FLAGS = {name: f"--{name}" for name in ("port", "ssd", "ssv", "start", "timeout", "vary", "version")} | {
    name: field.flag
    for options in (SimulateOptions, ConvergenceOptions, SweepOptions, RunOptions)
    for name, field in option_fields(options).items()
    if field.flag
}
_OPTION = re.compile(r"`(\w+)(?:=([^`]*))?`")
_PLACE = re.compile(r"(?:(?<=: )|(?<=  )|(?<=\")|^)`(\w+=[^`]*)`(?=: |\"|$)", re.MULTILINE)
"""An option in the place of a path in a file, where the flag has no quotes."""
_SUBSCRIBED = re.compile(r"^mesh\.subscribe\('([^']*)', '[^.']*\.([^']*)'\)(?=: |$)")
_PUBLISHED = re.compile(r"^mesh\.publish\('[^.']*\.([^']*)', '([^']*)'\)(?=: |$)")
_MAPPING = re.compile(r"\{'([^']*)': (.*)\}", re.DOTALL)


def in_flags(text: str) -> str:
    """A message with its options as flags: those with a value, or with `_` in their name; others are ordinary words.

    Example:
        >>> in_flags("m.yaml: `start_values={'gain.k': 2.0}`: 2.0; expected a number, or `allow_code=True`")
        'm.yaml: --set gain.k=2: 2.0; expected a number, or `--allow-code`'
    """
    text = _PUBLISHED.sub(r"--publish \1=\2", _SUBSCRIBED.sub(r"--subscribe \2=\1", text))
    text = _PLACE.sub(lambda found: _flag(*found[1].split("=", 1)) or found[0], text)
    return _OPTION.sub(lambda found: f"`{flag}`" if (flag := _flag(found[1], found[2])) else found[0], text)


def _flag(name: str, value: str | None) -> str:
    """An option as a flag with its value; empty if it is none."""
    if name not in _FLAGS or (value is None and "_" not in name):
        return ""
    if value in (None, "True", "False", "..."):
        return _FLAGS[name]
    pair = _MAPPING.fullmatch(value)
    return f"{_FLAGS[name]} {f'{pair[1]}={_value(pair[2])}' if pair is not None else _value(value)}"


def _value(text: str) -> str:
    return text.strip("[]'").replace("', '", ", ").removesuffix(".0")
