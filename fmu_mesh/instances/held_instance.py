"""An instance whose failure does not end the run: `on_failure: hold`, or `disable` with substitutes for outputs.

Owns what the outputs are from the failed step on, and that it is told. The same wrapper is used wherever instances are
stepped: in nodes, in copies and in the plain reference; so rows are equal in all of them (ADR 89). It is inside
`Guarded`: a call that does not return, and a crash, end the process as ever.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec

from ..config.instance_sections import SubstitutesConfig
from ..errors import FmuError
from ..rings.native import CopyCall, NativeStep, Span, Stage
from ..rings.ring import Ring
from ..simtime import TimeGrid
from ..variables.model_description import Value
from ..variables.value_conversion import to_value
from ..variables.value_types import is_float, nested, zero
from .contract import Instance, KeepsFiles, LogMessage, Opening
from .instance_wrapper import AroundNativeSteps, of_kind, packed, unpacked

__all__ = ["HeldInstance"]


class _Failure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The own step that has failed, why, and the own step of the rows that are held now."""

    step: int
    reason: str
    reached: int


class _HeldState(msgspec.Struct, frozen=True):
    """A state of the inner instance; or that it has failed, and has none any more."""

    inner: object
    failure: _Failure | None


class HeldInstance(AroundNativeSteps):
    """An instance that takes its steps as it would alone, until one fails; then its outputs hold, or are substitutes.

    A step fails if it raises an `FmuError`, or if whoever steps finds an output that is not finite, and calls `hold`.
    From then on the inner instance is not called any more, but to be closed: what is set has no effect. What is read is
    in the rows of outputs; any other variable has its substitute, or is NaN, 0, false or empty.

    A state says whether it has failed. After a failure an earlier state can be restored where the model allows that;
    FMI allows it after an error, and not after fatal.
    """

    def __init__(self, instance: Instance, opening: Opening[Any]) -> None:
        super().__init__(instance)
        own, variables = opening.section.on_failure, {v.name: v for v in instance.description.variables}
        given = own.disable if isinstance(own, SubstitutesConfig) else {}
        self._name, self._log = opening.name, opening.log
        self._substitutes: dict[str, Value] = {name: to_value(value, variables[name]) for name, value in given.items()}
        self._variables = variables
        self._failure: _Failure | None = None
        self._outputs: Sequence[Ring] = ()
        self._points = 1

    @property
    def failed(self) -> str:
        """See `AroundInstance`."""
        own = self._failure
        return f"{self._what} since point {own.step * self._points}: {own.reason}" if own is not None else ""

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`; None after a failure."""
        return super().native if self._failure is None else None

    @property
    def stage(self) -> int:
        """See `StepsNatively`."""
        return super().stage if self._failure is None else Stage.IN_PYTHON

    def check_rows(self, spans: Sequence[Span]) -> bool:
        """False: whoever steps looks at the rows, and calls `hold`."""
        return False

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """See `Instance`. After a failure, further outputs that somebody watches have no value any more."""
        self._outputs, self._points = outputs, points
        if self._failure is None:
            super().bind(inputs, outputs, grid, points, step)
            return
        for ring in outputs[1:]:
            for column in ring.layout.columns:
                ring.put(step, column.name, self._without_row(column.name))

    def set_values(self, values: Mapping[str, Value]) -> None:
        """See `Instance`; no effect after a failure."""
        if self._failure is None:
            super().set_values(values)

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """See `Instance`."""
        if (own := self._failure) is None:
            return super().get_values(names)
        rows = self._outputs[0]
        known = rows.layout.names
        return [rows.value(own.reached, name) if name in known else self._without_row(name) for name in names]

    def do_step(self, step: int) -> None:
        """See `Instance`."""
        if self._failure is None:
            try:
                self._instance.do_step(step)
            except FmuError as error:
                self.hold(step, error)
        else:
            self._hold_rows(step)

    def finish(self, step: int, outcome: int) -> None:
        """See `StepsNatively`."""
        try:
            super().finish(step, outcome)
        except FmuError as error:
            self.hold(step, error)

    def hold(self, step: int, error: FmuError) -> bool:
        """See `AroundInstance`; True, if it has not failed before."""
        if self._failure is not None:
            return False
        reason = error.message.rstrip(".")
        self._failure = _Failure(step, reason, step)
        given = ", ".join(f"{name} = {value!r}" for name, value in self._substitutes.items())
        then = f"{given}, and all other outputs hold" if given else "its outputs hold"
        text = f"it has failed: {reason}; from here on {then}"
        self._hold_rows(step)
        self._log(LogMessage(self._name, "warning", "failure", text, step, noted=self._what))
        return True

    @property
    def _what(self) -> Literal["held", "disabled"]:
        return "disabled" if self._substitutes else "held"

    def _hold_rows(self, step: int) -> None:
        """Write row ``step + 1``: that of before, with the substitutes."""
        assert self._failure is not None
        for ring in self._outputs:
            for part in ring.parts:
                part[(step + 1) & ring.mask] = part[step & ring.mask]
            for name, value in self._substitutes.items():
                if name in ring.layout.names:
                    ring.put(step + 1, name, value)
        self._failure = msgspec.structs.replace(self._failure, reached=step + 1)

    def _without_row(self, name: str) -> Value:
        variable = self._variables[name]
        if name in self._substitutes:
            return self._substitutes[name]
        value: Value = math.nan if is_float(variable.type) else zero(variable.type)
        return nested([value] * variable.size, variable.shape) if variable.shape else value

    def remove_files(self) -> None:
        """See `KeepsFiles`."""
        if isinstance(self._instance, KeepsFiles):
            self._instance.remove_files()

    # --- states

    def get_state(self) -> object:
        """See `KeepsState`."""
        return _HeldState(super().get_state() if self._failure is None else None, self._failure)

    def set_state(self, state: object) -> None:
        """See `KeepsState`."""
        saved = of_kind(_HeldState, state)
        if saved.failure is None:
            super().set_state(saved.inner)
        self._failure = saved.failure

    def free_state(self, state: object) -> None:
        """See `KeepsState`."""
        saved = of_kind(_HeldState, state)
        if saved.failure is None:
            super().free_state(saved.inner)

    def serialize_state(self, state: object) -> bytes:
        """See `KeepsState`."""
        saved = of_kind(_HeldState, state)
        failure = () if saved.failure is None else (saved.failure,)
        return packed(failure, b"" if failure else super().serialize_state(saved.inner))

    def deserialize_state(self, data: bytes) -> object:
        """See `KeepsState`."""
        failure, inner = unpacked(data, tuple[_Failure, ...], self._name)
        return _HeldState(None if failure else super().deserialize_state(inner), next(iter(failure), None))

    def access(self, verb: Literal["Get", "Set"], names: Sequence[str]) -> CopyCall | None:
        """None: `get_values` and `set_values` know whether it has failed."""
        return None

    def state_access(self, state: object) -> CopyCall | None:
        """None, because there is more to do."""
        return None
