"""Which variables may be set from outside during a run: unconnected inputs and tunable parameters, no others."""

from __future__ import annotations

import msgspec

from ..variables.model_description import Value
from ..wire.keys import unescape
from ..wire.values import ValueRefused, decode_time, decode_value
from .stepping import Runner
from .streams import kind_of

__all__ = ["Setting", "checked_setting"]


class Setting(msgspec.Struct, frozen=True):
    """A value for a variable; ``time`` (s): from when on it holds; None: from the next point on."""

    variable: str
    value: Value
    time: float | None = None


def checked_setting(runner: Runner, root: str, key: str, data: bytes, attachment: bytes | None) -> Setting:
    """The variable, value and time of a setting that arrived for an instance.

    Args:
        runner: the instance.
        root: what its keys start with.
        key: the key that the value was sent to.
        data: the value as JSON.
        attachment: the time of the value as JSON, if there is one.

    Raises:
        ValueRefused: with the reason.
    """
    parts = key.removeprefix(root + "/").split("/")
    if len(parts) != 2 or "*" in key:
        raise ValueRefused(f"'{key}' is not the key of one variable")
    kind, name = parts[0], unescape(parts[1])
    variable = runner.instance.description.variable(name)
    if variable is None or kind_of(variable) != kind:
        raise ValueRefused(f"'{runner.name}' has no variable '{name}' under '{kind}'")
    if kind == "in" and name in runner.plan.inputs.names:
        layout = runner.plan.inputs
        feed = next(f for f in runner.plan.feeds if name in {layout.column(column[1]).name for column in f.columns})
        raise ValueRefused(
            f"'{runner.name}.{name}' is connected to '{feed.source}'; only unconnected inputs can be set"
        )
    if kind == "param" and variable.variability != "tunable":
        raise ValueRefused(
            f"'{runner.name}.{name}' is a {variable.variability} parameter; only tunable ones can be set while it runs"
        )
    if kind not in ("in", "param"):
        raise ValueRefused(f"'{runner.name}.{name}' is no input and no parameter, so it cannot be set")
    try:
        time = decode_time(attachment) if attachment is not None else None
        return Setting(name, decode_value(data, variable), time)
    except ValueRefused as refused:
        raise ValueRefused(f"'{runner.name}.{name}': {refused}") from refused
