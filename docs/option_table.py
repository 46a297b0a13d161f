"""The options of all calls as rows of a table, from the Structs that the command line and the library use."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from fmu_mesh.run.options import RerunOptions, RunOptions, option_fields
from fmu_mesh.sweeps.planned_sweep import SweepOptions

__all__ = ["OptionRow", "option_rows"]

_UNIT = re.compile(r"\bin (s|bytes)\b|\b(bytes) of")


class OptionRow(NamedTuple):
    """One option.

    Attributes:
        name: as a program gives it.
        flag: as the command line spells it, with what stands for its value; empty if only a program has it.
        type: what a value is.
        unit: the unit of a number; empty without one.
        default: its value where it is not given, as Python writes it.
        key: key of the configuration that it replaces; empty if there is none.
        calls: which calls take it.
        text: one line about it.
    """

    name: str
    flag: str
    type: str
    unit: str
    default: str
    key: str
    calls: tuple[str, ...]
    text: str


_CALLS = {"Mesh.run": RunOptions, "sweep": SweepOptions, "rerun": RerunOptions}


def option_rows() -> Iterator[OptionRow]:
    """The rows, by name; an option that several calls have is there once."""
    fields = {name: field for own in _CALLS.values() for name, field in option_fields(own).items()}
    for name, field in sorted(fields.items()):
        unit = _UNIT.search(field.line)
        yield OptionRow(
            name=name,
            flag=" ".join(filter(None, (field.flag, field.metavar))),
            type=str(field.parameter.annotation),
            unit=(unit[1] or unit[2]) if unit is not None else "",
            default=repr(field.parameter.default),
            key=field.key or "",
            calls=tuple(call for call, own in _CALLS.items() if name in option_fields(own)),
            text=field.line.removeprefix("False: ") if field.parameter.default is not True else field.line,
        )
