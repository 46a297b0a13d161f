"""Unconnected inputs and tunable parameters of a mesh as parameters in Foxglove.

Owns what Foxglove is told that a parameter is: a value that was set is shown at once, although it holds from the next
point on. Called on threads of the SDK.
"""

# Threads: the SDK calls `values` and `set`, and the thread that asks for values calls `changes`. The lock is for the
# values that were set and are not in effect yet; nobody holds it while the mesh is asked.

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from foxglove import Parameter, ParameterType

from ..errors import FmuMeshError
from ..text import did_you_mean
from ..variables.value_types import INTEGERS, is_float
from ..wire.client.mesh_client import MeshClient
from ..wire.client.readings import Target
from .mesh_topics import type_of

__all__ = ["MeshParameters"]

_INT64: Final = range(-(2**63), 2**63)


class MeshParameters:
    """The parameters of one run of a mesh."""

    def __init__(
        self, client: MeshClient, targets: Mapping[str, Target], tell: Callable[[str], None], *, read_only: bool
    ) -> None:
        self._client = client
        self._targets = targets
        self._tell = tell
        self._read_only = read_only
        self._lock = threading.Lock()
        self._set: dict[str, tuple[Any, int]] = {}
        self._shown: dict[str, Any] = {}

    def values(self, names: Sequence[str] = ()) -> list[Parameter]:
        """The current values of these parameters, of all if none is named; not of those that do not exist."""
        found = self._read(names or self._targets)
        return [_parameter(name, value, self._targets[name]) for name, value in found.items()]

    def set(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Set values; returns the values that the parameters have now."""
        for parameter in parameters:
            self._set_one(parameter.name, parameter.get_value())
        return self.values([parameter.name for parameter in parameters])

    def changes(self, names: Sequence[str]) -> list[Parameter]:
        """Those of these parameters whose values have changed since the last call."""
        found = self._read(names)
        changed = {name: value for name, value in found.items() if self._shown.get(name, ...) != value}
        self._shown.update(changed)
        return [_parameter(name, value, self._targets[name]) for name, value in changed.items()]

    def _set_one(self, name: str, value: object) -> None:
        target = self._targets.get(name)
        if target is None:
            hint = did_you_mean(name, self._targets, "")
            self._tell(f"'{name}' cannot be set: it is no unconnected input and no tunable parameter. {hint}".rstrip())
        elif self._read_only:
            self._tell(f"'{name}' is not set: `fmu-mesh foxglove` was started without --steer")
        elif value is None:
            self._tell(f"'{name}' cannot be removed")
        else:
            plain = _plain(value, target)
            try:
                answer = self._client.set(target, plain)
            except FmuMeshError as error:
                self._tell(f"'{name}' is not set: {error}")
            else:
                with self._lock:
                    self._set[name] = (plain, answer.point)

    def _read(self, asked: Iterable[str]) -> dict[str, Any]:
        """The values that these parameters have, or have from the next point on."""
        names = {self._targets[name].key: name for name in asked if name in self._targets}
        try:
            readings = self._client.get([self._targets[name] for name in names.values()])
        except FmuMeshError as error:
            self._tell(f"the parameters cannot be read: {error}")
            return {}
        found = {}
        with self._lock:
            for reading in readings:
                name = names[reading.key]
                value, point = self._set.get(name, (None, -1))
                if reading.point >= point:
                    value = reading.value
                    self._set.pop(name, None)
                found[name] = value
        return found


def _parameter(name: str, value: Any, target: Target) -> Parameter:  # noqa: ANN401  plain JSON
    """A parameter as Foxglove has it; floats say that they are some, because 2.0 is 2 in JSON."""
    if is_float(type_of(target.variable)) and not _has_text(value):
        kind = ParameterType.Float64Array if isinstance(value, list) else ParameterType.Float64
        return Parameter(name, value=_floats(value), type=kind)
    if isinstance(value, int) and not isinstance(value, bool) and value not in _INT64:
        value = str(value)
    return Parameter(name, value=value)


def _plain(value: object, target: Target) -> object:
    """A value from Foxglove for a variable: whole numbers may come as floats, and large ones as text."""
    if isinstance(value, list):
        return [_plain(element, target) for element in value]
    if type_of(target.variable) in INTEGERS:
        if isinstance(value, float) and value.is_integer():
            return int(value)
        if isinstance(value, str) and value.removeprefix("-").isdecimal():
            return int(value)
    return value


def _floats(value: Any) -> Any:  # noqa: ANN401  plain JSON
    return [_floats(element) for element in value] if isinstance(value, list) else float(value)


def _has_text(value: object) -> bool:
    """Whether a number is not finite, which is text over the wire."""
    return any(map(_has_text, value)) if isinstance(value, list) else isinstance(value, str)
