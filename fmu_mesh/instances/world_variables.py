"""The variables of a world of a physics engine: names, units and meaning are the same for every engine.

So one configuration fits all of them. Where the value of a variable is stored is a matter of the engine.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import msgspec
from msgspec.structs import replace

from ..variables.model_description import Variable

__all__ = [
    "STATE",
    "Place",
    "WorldVariable",
    "body_state",
    "body_variables",
    "joint_variables",
    "numbered",
    "world_input",
    "world_output",
]

Place = tuple[str, int]
"""Where a value is stored: the kind of value, and the place in the flat array of that kind."""

STATE = 13
"""The numbers of the state of a body: position, orientation (w first), linear and angular velocity, in world axes."""

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
        "body_linear_velocity": ("xyz", "m/s", f"of the {word}'s origin in {word} axes"),
        "body_angular_velocity": ("xyz", "rad/s", f"in {word} axes"),
        "force": ("xyz", "N", f"acts at the {word}'s origin, in {word} axes"),
        "moment": ("xyz", "N.m", f"acts about the {word}'s origin, in {word} axes"),
    }
    for what, (letters, unit, text) in rows.items():
        where, first = places[what]
        for number, letter in enumerate(letters):
            name, place = f"{body}.{what}_{letter}", (where, first + number)
            if what in ("force", "moment"):
                yield world_input(name, place, unit, text)
                continue
            depends_on = wind if what in ("wind", "relative_velocity") else ()
            own = world_output(name, place, unit, text, None, depends_on)
            is_local = what.startswith("body_")  # for odometry: neither recorded nor published unless it is named
            yield replace(own, variable=replace(own.variable, causality="local")) if is_local else own


def body_state(body: str, word: str, place: Place, start: Sequence[float]) -> Iterator[WorldVariable]:
    """What sets a free body: its pose, its twist, or both at once; the place is that of the first of 13 numbers.

    They are arrays, because one message sets all of its numbers at the same point.
    """
    twist = "linear and angular velocity in world axes"
    pose = f"position (m) of the {word}'s origin in world axes, and orientation w, x, y, z"
    rows = {"pose": (0, 7, pose), "twist": (7, STATE, twist), "state": (0, STATE, f"{pose}; {twist}")}
    for what, (first, end, text) in rows.items():
        own = world_output(f"{body}.{what}", (place[0], place[1] + first), None, text)
        kind: dict[str, Any] = {"causality": "parameter", "variability": "tunable", "initial": "exact"}
        sizes: dict[str, Any] = {"dimensions": (end - first,), "shape": (end - first,), "start": [*start[first:end]]}
        yield replace(own, variable=replace(own.variable, **kind, **sizes, feedthrough=None))


def numbered(variables: Iterable[WorldVariable]) -> tuple[WorldVariable, ...]:
    """The variables with their value references."""
    return tuple(
        replace(own, variable=replace(own.variable, value_reference=number)) for number, own in enumerate(variables)
    )
