"""An instance around another one: everything goes to the one within, until a subclass does more."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Generic, TypeVar

from ..variables.model_description import ModelDescription, Value
from .contract import Instance

__all__ = ["AroundInstance"]

Within = TypeVar("Within", bound=Instance)


class AroundInstance(Generic[Within]):
    """Hands through what does not concern stepping; a subclass adds `bind` and `do_step`.

    Args:
        instance: the one within; is closed with this.
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
        self._instance.enter_initialization(start_time, stop_time, start_values)

    def exit_initialization(self) -> None:
        """See `Instance`."""
        self._instance.exit_initialization()

    def set_values(self, values: Mapping[str, Value]) -> None:
        """See `Instance`."""
        self._instance.set_values(values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """See `Instance`."""
        return self._instance.get_values(names)

    def close(self) -> None:
        """See `Instance`."""
        self._instance.close()
