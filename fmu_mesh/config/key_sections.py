"""Entries of `connections` with a Zenoh key at one end: values of other programs for an input, and of outputs for them.

Owns the keys of the file, and how people see one. What they mean is `fmu_mesh.system.live_keys`.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from fmu_mesh.config.base import NOT_NEGATIVE, POSITIVE, Base
from fmu_mesh.config.instance_sections import KIND

__all__ = ["KEY", "KeyInputConfig", "KeyOutputConfig", "KeyView"]

KEY: Final = "key "
"""Before the name of a key, where else an instance feeds an input, or takes an output."""

Key = Annotated[str, Meta(description="A Zenoh key.", examples=["plant/pump/flow"], extra_json_schema={"minLength": 1})]
Factor = Annotated[float, Meta(description="The value is factor * number + offset; Real only.")]
MessageType = Annotated[
    str | None, Meta(description="With `encoding: cdr`, the message type of ROS.", examples=["std_msgs/msg/Float64"])
]


class KeyView(msgspec.Struct, frozen=True):
    """One Zenoh key at an end of a connection, as pages, pictures and `info` show it.

    Attributes:
        direction: `in`: the values of the key are for the variable; `out`: those of the variable go to the key.
        encoding: the encoding or the type of its payloads, and which field of them.
        rule: when a value takes effect, or when there is one, in words.
    """

    instance: str
    key: str
    direction: Literal["in", "out"]
    variable: str
    encoding: str
    rule: str

    @property
    def ends(self) -> str:
        """Both ends, such as `plant/pump/flow -> pump.u`."""
        name = f"{self.instance}.{self.variable}"
        return f"{self.key} -> {name}" if self.direction == "in" else f"{name} -> {self.key}"

    @property
    def activity(self) -> str:
        """What came or went so far, in words; nothing is known of it here."""
        return ""

    @property
    def cells(self) -> list[str]:
        """A row of a table of keys."""
        return [self.ends, self.encoding, self.rule, *filter(None, [self.activity])]


class KeyInputConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="key_input"):
    """An input that gets what other programs publish under a Zenoh key."""

    key: Key
    target: Annotated[str, Meta(description="`instance.variable` of an input.", examples=["pump.u"])] = msgspec.field(
        name="to"
    )
    field: Annotated[
        str | None,
        Meta(
            description="Where the value is in JSON or in a message; default: the whole JSON, or its `value`.",
            examples=["sensors[0].value"],
        ),
    ] = None
    encoding: Annotated[
        Literal["auto", "json", "text", "cdr", "float64"],
        Meta(description="auto: as Zenoh's encoding says, else JSON, else text; float64: its eight bytes."),
    ] = "auto"
    type: MessageType = None
    factor: Factor = 1.0
    offset: Factor = 0.0
    unit: Annotated[str | None, Meta(description="Unit of the values; they are converted to that of the input.")] = None
    map: Annotated[
        dict[str, bool | int | float | str],
        Meta(description="What the input gets instead of a value, such as {open: 1}; others stay as they are."),
    ] = {}
    take: Annotated[
        Literal["all", "newest"],
        Meta(description="newest: needed for a key with a wildcard; the newest value of all keys counts."),
    ] = "all"
    time: Annotated[
        str,
        Meta(
            description="When a value takes effect: arrival: at the next point; timestamp: at that of Zenoh; or the "
            "field with its time: a number of seconds, or text of ISO 8601."
        ),
    ] = "arrival"
    origin: Annotated[
        float | str | None,
        Meta(
            description="The time of point 0 in the clock of `time`: seconds, ISO 8601, or first: the first value "
            "takes effect when it arrives. Default: first; but a number in a field is simulation time."
        ),
    ] = None
    interpolation: Annotated[
        Literal["hold", "linear"], Meta(description="linear: a line between two values, for Real inputs with a time.")
    ] = "hold"
    delay: Annotated[
        float,
        Meta(description="Time in s by which values take effect later than they say.", extra_json_schema=NOT_NEGATIVE),
    ] = 0.0
    wait: Annotated[
        bool,
        Meta(
            description="true: each step waits until the value for its start has come; with `time: arrival` it takes "
            "the next value. The deadline is timeouts.step."
        ),
    ] = False


class KeyOutputConfig(Base, frozen=True, kw_only=True, tag_field=KIND, tag="key_output"):
    """A variable whose values are published under a Zenoh key."""

    source: Annotated[str, Meta(description="`instance.variable` of an output.", examples=["pump.y"])] = msgspec.field(
        name="from"
    )
    key: Key
    on: Annotated[
        Literal["point", "change"], Meta(description="point: at each point; change: when the value has changed.")
    ] = "point"
    every: Annotated[
        float | None,
        Meta(description="Simulation time in s between two values; null: no limit.", extra_json_schema=POSITIVE),
    ] = None
    encoding: Annotated[
        Literal["json", "text", "cdr", "float64"],
        Meta(description='json: {"value", "time", "point"}; text: the value alone; float64: its eight bytes.'),
    ] = "json"
    type: MessageType = None
    field: Annotated[str | None, Meta(description="With `encoding: cdr`, where the value is; default: data.")] = None
    factor: Factor = 1.0
    offset: Factor = 0.0
    unit: Annotated[str | None, Meta(description="Unit of the values that are published; default: its own.")] = None
    map: Annotated[
        dict[str, bool | int | float | str],
        Meta(description="What is published instead of a value, such as {1: open}; others stay as they are."),
    ] = {}
    congestion: Annotated[
        Literal["drop", "block"],
        Meta(description="drop: who is too slow loses values, and a warning says so; block: the run waits."),
    ] = "drop"
