"""An instance around another one: all calls go to the inner instance, and a subclass changes some of them.

Also owns the form in which a wrapper stores its own part of a state next to that of the inner instance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Generic, Literal, TypeVar, cast

import msgspec

from ..errors import FmuError, FmuMeshError
from ..rings.native import CopyCall, NativeStep, Span, Stage
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import ModelDescription, Value
from .contract import AccessedNatively, ChangesProcess, Instance, KeepsState, StepsNatively

__all__ = ["AroundInstance", "AroundNativeSteps", "of_kind", "packed", "unpacked"]

Within = TypeVar("Within", bound=Instance)
Own = TypeVar("Own")
Found = TypeVar("Found")
Result = TypeVar("Result")


class AroundInstance(Generic[Within]):
    """Forwards all calls of `Instance` and `KeepsState` to another instance.

    `close` closes the inner instance.

    A subclass overrides the calls that it changes, and `_forward` if it puts something around every call.
    """

    def __init__(self, instance: Within) -> None:
        self._instance = instance

    @property
    def description(self) -> ModelDescription:
        """See `Instance`."""
        return self._instance.description

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """See `Instance`."""
        self._forward(self._instance.enter_initialization, start_time, stop_time, start_values)

    def exit_initialization(self) -> None:
        """See `Instance`."""
        self._forward(self._instance.exit_initialization)

    def set_values(self, values: Mapping[str, Value]) -> None:
        """See `Instance`."""
        self._forward(self._instance.set_values, values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """See `Instance`."""
        return self._forward(self._instance.get_values, names)

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`."""
        self._forward(self._instance.bind, inputs, outputs, grid, points, step)

    def close(self) -> None:
        """See `Instance`."""
        self._forward(self._instance.close)

    def get_state(self) -> object:
        """See `KeepsState`."""
        return self._forward(self._keeper().get_state)

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        self._forward(self._keeper().set_state, state)

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        self._forward(self._keeper().free_state, state)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        return self._forward(self._keeper().serialize_state, state)

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        return self._forward(self._keeper().deserialize_state, data)

    @property
    def changes_process(self) -> bool:
        """See `ChangesProcess`."""
        return isinstance(self._instance, ChangesProcess) and self._instance.changes_process

    def hold(self, step: int, error: FmuError) -> bool:
        """Whether the instance goes on with held outputs, although own step ``step`` has failed; see `HeldInstance`."""
        return isinstance(self._instance, AroundInstance) and self._instance.hold(step, error)

    @property
    def failed(self) -> str:
        """In words since when and why the outputs of the instance are held; empty: they are not."""
        inner: object = self._instance
        return inner.failed if isinstance(inner, AroundInstance) else ""

    @property
    def waits_for_program(self) -> bool:
        """Whether it waits for a program of the user, and has deadlines of its own."""
        return bool(getattr(self._instance, "waits_for_program", False))

    @property
    def awaited(self) -> str:
        """For which program of the user its step waits, and since when, in words; empty: it does not wait."""
        return str(getattr(self._instance, "awaited", ""))

    def take_care(self) -> None:
        """From the next step on, undo after each step what it does to the state of the process."""
        if isinstance(self._instance, AroundInstance):
            self._instance.take_care()

    def within(self, kind: type[Found]) -> Found:
        """The wrapper of this kind around the same instance: there is one, at this place or farther inside."""
        return self if isinstance(self, kind) else cast("AroundInstance[Any]", self._instance).within(kind)

    def _forward(self, call: Callable[..., Result], *arguments: Any) -> Result:  # noqa: ANN401 those of any method
        """Call a method of the inner instance."""
        return call(*arguments)

    def _keeper(self) -> KeepsState:
        """The inner instance as one that has states; `FmuError` if its kind has none."""
        if not hasattr(self._instance, "get_state"):
            raise FmuError("its state cannot be kept", instance=getattr(self._instance, "name", None))
        return cast("KeepsState", self._instance)


def packed(own: msgspec.Struct | tuple[msgspec.Struct, ...], within: bytes) -> bytes:
    """Our own part of a state and the serialized state of the inner instance as one."""
    return msgspec.msgpack.encode((own, within))


def unpacked(data: bytes, kind: type[Own], instance: str | None) -> tuple[Own, bytes]:
    """The two arguments of `packed`; `FmuMeshError` if ``data`` is no such state."""
    try:
        return msgspec.msgpack.decode(data, type=tuple[kind, bytes])  # type: ignore[valid-type]  # a variable here
    except msgspec.DecodeError as error:
        raise FmuMeshError(f"this is no state of an instance: {error}", instance=instance) from error


class AroundNativeSteps(AroundInstance[Instance]):
    """Also forwards the calls of `StepsNatively`, where the inner instance has such steps."""

    @cached_property
    def _stepping(self) -> StepsNatively | None:
        """The inner instance, if it has such steps: to ask whether it has takes longer than a step."""
        return self._instance if isinstance(self._instance, StepsNatively) else None

    @cached_property
    def _accessed(self) -> AccessedNatively | None:
        """As `_stepping`."""
        return self._instance if isinstance(self._instance, AccessedNatively) else None

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`; None if the inner instance has no such steps."""
        return self._stepping.native if self._stepping is not None else None

    @property
    def stage(self) -> int:
        """See `StepsNatively`; `IN_PYTHON` if the inner instance has no such steps."""
        return self._stepping.stage if self._stepping is not None else Stage.IN_PYTHON

    def check_rows(self, spans: Sequence[Span]) -> bool:
        """See `StepsNatively`; False if the inner instance has no such steps."""
        return self._stepping.check_rows(spans) if self._stepping is not None else False

    def access(self, verb: Literal["Get", "Set"], names: Sequence[str]) -> CopyCall | None:
        """See `AccessedNatively`; None if the inner instance is none."""
        return self._accessed.access(verb, names) if self._accessed is not None else None

    def state_access(self, state: object) -> CopyCall | None:
        """See `AccessedNatively`; None if the inner instance is none."""
        return self._accessed.state_access(state) if self._accessed is not None else None

    def finish(self, step: int, outcome: int) -> None:
        """See `StepsNatively`; only called if there is `native`."""
        cast("StepsNatively", self._instance).finish(step, outcome)


def of_kind(kind: type[Own], state: object) -> Own:
    """``state``, which has to be one of this kind."""
    if not isinstance(state, kind):
        msg = f"{type(state).__name__} is no state of this instance"
        raise TypeError(msg)
    return state
