"""The variables of a world of a physics engine: names, units and meaning are the same for every engine.

So one configuration fits all of them. Where the value of a variable is stored is a matter of the engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType

import msgspec
from msgspec.structs import replace

from ..variables.model_description import Variable

__all__ = ["Place", "WorldVariable", "body_variables", "joint_variables", "numbered", "world_input", "world_output"]

Place = tuple[str, int]
"""Where a value is stored: the kind of value, and the place in the flat array of that kind."""

_OF_THE_STEP = (".acceleration", ".effort_applied", ".force")
"""Ends of the names of outputs that efforts and forces of the same step act on at once."""


class WorldVariable(msgspec.Struct, frozen=True):
    """One variable, and its `Place`."""

    variable: Variable
    where: str
    index: int


def world_output(  # noqa: PLR0913, PLR0917  each is a column of a table
    name: str, place: Place, unit: str | None, text: str, start: float | None = None, depends_on: tuple[str, ...] = ()
) -> WorldVariable:
    """An output. At the first point the engine has not taken a step: only ``depends_on`` has an effect then."""
    variable = Variable(
        name=name,
        value_reference=0,
        type="Float64",
        causality="output",
        variability="continuous",
        initial="exact" if start is not None else "calculated",
        start=start,
        unit=unit,
        description=text,
        dependencies=depends_on,
        feedthrough=None if name.endswith(_OF_THE_STEP) else depends_on,
    )
    return WorldVariable(variable, *place)


def world_input(name: str, place: Place, unit: str | None, text: str, start: float = 0.0) -> WorldVariable:
    """An input."""
    own = world_output(name, place, unit, text, start)
    return replace(own, variable=replace(own.variable, causality="input", initial=None, feedthrough=()))


def joint_variables(
    joint: str, places: Mapping[str, Place], *, revolute: bool, start: Mapping[str, float] = MappingProxyType({})
) -> Iterator[WorldVariable]:
    """The variables of a revolute or prismatic joint; places and start values are by the last part of a name."""
    length, effort = ("rad", "N.m") if revolute else ("m", "N")
    outputs = {
        "position": (length, "position of the joint"),
        "velocity": (f"{length}/s", "velocity of the joint"),
        "acceleration": (f"{length}/s2", "acceleration in the last step"),
        "effort_applied": (effort, "effort applied in the last step"),
    }
    for what, (unit, text) in outputs.items():
        yield world_output(f"{joint}.{what}", places[what], unit, text, start.get(what))
    command = "effort_command"
    yield world_input(f"{joint}.{command}", places[command], effort, "what a controller asks for")
    text = "what is applied, such as the torque of an actuator"
    yield world_input(f"{joint}.effort", places["effort"], effort, text)


def body_variables(
    body: str, word: str, places: Mapping[str, Place], wind: tuple[str, ...] = ()
) -> Iterator[WorldVariable]:
    """The variables of a body, which the engine calls a ``word``; each place is that of the first of a vector.

    ``wind`` are the inputs that the wind in its axes, and its velocity against the wind, depend on.
    """
    rows = {
        "position": ("xyz", "m", f"of the {word}'s origin in world axes"),
        "orientation": ("wxyz", "1", f"attitude as a unit quaternion, {word} axes to world axes"),
        "linear_velocity": ("xyz", "m/s", f"of the {word}'s origin in world axes"),
        "angular_velocity": ("xyz", "rad/s", "in world axes"),
        "wind": ("xyz", "m/s", f"velocity of the medium in {word} axes"),
        "relative_velocity": ("xyz", "m/s", f"velocity of the {word}'s origin against the medium in {word} axes"),
        "force": ("xyz", "N", f"acts at the {word}'s origin, in {word} axes"),
        "moment": ("xyz", "N.m", f"acts about the {word}'s origin, in {word} axes"),
    }
    for what, (letters, unit, text) in rows.items():
        where, first = places[what]
        for number, letter in enumerate(letters):
            name, place = f"{body}.{what}_{letter}", (where, first + number)
            if what in ("force", "moment"):
                yield world_input(name, place, unit, text)
            else:
                depends_on = wind if what in ("wind", "relative_velocity") else ()
                yield world_output(name, place, unit, text, None, depends_on)


def numbered(variables: Iterable[WorldVariable]) -> tuple[WorldVariable, ...]:
    """The variables with their value references."""
    return tuple(
        replace(own, variable=replace(own.variable, value_reference=number)) for number, own in enumerate(variables)
    )
