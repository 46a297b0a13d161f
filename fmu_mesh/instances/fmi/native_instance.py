"""An FMU whose step is one call of the library: inputs, doStep and outputs by tables (`burst.c`).

Owns the tables, and the steps that the library does not take or does not complete: those are taken call by call. A
version of FMI adds how a step is taken and what its statuses mean.
"""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

import numpy as np

from ...errors import NotFinite
from ...rings import native
from ...rings.native import CopyCall, MemberTable, Move, NativeStep, Region, Span, Stage, StepKind
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...variables.model_description import ModelDescription, Variable
from ...variables.value_types import DTYPES, Value
from ..instance_wrapper import of_kind
from .buffers import NumberBuffer
from .calls import Function, Pointer, address_of, cffi_function, memory, pointer
from .fmu_instance import FmuInstance, FmuState
from .fmu_values import WARNING, PartCall, Verb

__all__ = ["NativeInstance"]

_MEMBER_STEP: Final = "int64_t (*)(void *, int64_t)"


class NativeInstance(FmuInstance):
    """An FMU of any kind and version; to be named before the base class of the version.

    `StepsNatively` without text, and where a step is nothing but setters, doStep and getters.
    """

    _kind: StepKind
    _do_step: Function  # the function of the FMU, as cffi calls it

    _by_calls = False  # whether the steps have a part that the library does not know

    _derivatives: Mapping[str, float] = {}  # of the linear inputs, in 1/s, for the next step

    _native: NativeStep | None = None
    _member: MemberTable | None = None  # the member that takes the steps of `do_step`

    @property
    def native(self) -> NativeStep | None:
        """See `StepsNatively`."""
        return self._native

    @property
    def stage(self) -> int:
        """See `StepsNatively`."""
        return int(self._member.stage) if self._member is not None else Stage.IN_PYTHON

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        super().bind(inputs, outputs, grid, points, step)
        self._native = self._member = None

        def by_calls(_member: Pointer, step: int) -> int:
            self._step_by_calls(step)
            return 0

        self._in_step: tuple[Callable[[Pointer, int], int], Pointer] = by_calls, None
        # A setter of the library has one address to read from; in a ring with more rows, it changes in every step.
        if native.library is None or inputs.rows > 1 or self._by_calls:
            return
        buffers = [part.buffer for part in (*self._setters, *self._getters) if part.buffer is not None]
        if not all(isinstance(buffer, NumberBuffer) for buffer in buffers):
            return
        self._native = self._hosted(self._tables(), inputs)
        self._keep += self._native.kept
        self._member = member = self._table(self._native, outputs)
        take = cffi_function(native.library.member_step, _MEMBER_STEP)
        self._in_step = take, pointer(ctypes.addressof(member))

    def set_input_derivatives(self, derivatives: Mapping[str, float], *, continuous: bool = False) -> None:
        """See `FmuInstance` (FMI 1.0 CS, 3.3; FMI 2.0, 4.2.1)."""
        self._derivatives = derivatives  # the FMU gets them after the values of these inputs

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        take, member = self._in_step
        if outcome := take(member, step):
            if outcome & 0xFFFFFF != native.WRONG_ROW:
                self.finish(step, outcome)
            own, library = self._member, native.library
            if own is not None and library is not None and not library.member_is_finite(ctypes.addressof(own), step):
                raise NotFinite("an output is not finite", instance=self.name)

    def check_rows(self, spans: Sequence[Span]) -> bool:
        """Let `do_step` itself raise `NotFinite` for these floats of its row; whether it does."""
        if self._member is None:
            return False
        self._member.give(finite=spans)
        return True

    def finish(self, step: int, outcome: int) -> None:
        """See `StepsNatively`."""
        stage, status = divmod(outcome, 1 << native.STAGE_BITS)
        match stage:
            case Stage.IN_PYTHON:
                self._step_by_calls(step)
            case Stage.STEPPING:
                self._complete(step, status)
                self._said.note(step=step + 1)
                self._read_outputs(step + 1)
            case Stage.SETTING:
                self._fail_to_set(step, status)
            case _:
                self._fail_to_get(status)

    def access(self, verb: Verb, names: Sequence[str]) -> CopyCall | None:
        """See `AccessedNatively`."""
        if not self._is_plain(verb):
            return None
        key = verb, *names
        if key in self._accesses:
            function, references, count, size = self._accesses[key]
            return CopyCall(function, self._component, address_of(references), count, size)
        variables = [self._variables[name] for name in names]
        type_, functions = variables[0].type, self._functions.values
        if any(variable.type != type_ for variable in variables) or not functions.is_direct(type_, variables):
            return None
        size = sum(variable.size for variable in variables) if functions.sized else -1
        function, arguments = address_of(self._function(verb, type_)), functions.arguments(variables, None)
        self._accesses[key] = function, *arguments, size
        return self.access(verb, names)

    def setter(self, name: str) -> Callable[[Value], None] | None:
        """See `Prepares`."""
        if (number := self._number("Set", name)) is None:
            return None
        variable, call, arguments, cell = number

        def put(value: Value) -> None:
            cell[0] = value
            if (status := call(*arguments)) > WARNING:
                raise self._transfer_failed("Set", variable.type, [variable], status)

        return put

    def getter(self, name: str) -> Callable[[], Value] | None:
        """See `Prepares`."""
        if (number := self._number("Get", name)) is None:
            return None
        variable, call, arguments, cell = number

        def get() -> Value:
            if (status := call(*arguments)) > WARNING:
                raise self._transfer_failed("Get", variable.type, [variable], status)
            value: Value = cell[0]
            return value

        return get

    def _number(self, verb: Verb, name: str) -> tuple[Variable, Function, tuple[Any, ...], Any] | None:
        """What sets or gets one number: a function, its arguments, and where the number is; None if it is none."""
        variable = self._variables[name]
        access = self.access(verb, [name]) if not variable.shape else None
        if access is None:
            return None
        cell, size = np.zeros(1, DTYPES[variable.type]), (1,) if access.size >= 0 else ()
        call = self._function(verb, variable.type)
        return variable, call, (self._self, pointer(access.references), 1, memory(cell), *size), cell.data

    def state_access(self, state: object) -> CopyCall | None:
        """See `AccessedNatively`."""
        if not self._is_plain("State"):
            return None
        name = self._functions.names.get("setFMUState", f"{self._symbols}SetFMUState")
        function = address_of(cffi_function(getattr(self._fmu.dll, name), "int (*)(void *, void *)"))
        return CopyCall(function, self._component, of_kind(FmuState, state).handle.value, -1, -1)

    def _describe(self, description: ModelDescription) -> None:
        super()._describe(description)
        # functions, value references, their number and that of their elements, by what `access` was asked
        self._accesses: dict[tuple[str, ...], tuple[int, Pointer, int, int]] = {}

    def _follow_component(self) -> None:
        """The instance may be another one than that of the last `bind`."""
        if self._native is not None and self._member is not None and self._native.component != self._component:
            self._native = self._native._replace(component=self._component)
            self._member.note(component=self._component)

    def _is_plain(self, verb: Verb | Literal["State"]) -> bool:
        """Whether nothing but a function of the FMU gets or sets values, or sets a state."""
        return not self._by_calls

    @abstractmethod
    def _complete(self, step: int, status: int | None) -> None:
        """Complete own step ``step`` after the FMU has returned ``status``, or has said that there is more to do.

        None: it was not called yet; the inputs are set.
        """

    def _step_by_calls(self, step: int) -> None:
        """`do_step` with one call for each function."""
        self._set_inputs(step)
        self._complete(step, None)
        self._said.note(step=step + 1)
        self._read_outputs(step + 1)

    def _step_address(self) -> int:
        """What `NativeStep.do_step` is."""
        return address_of(self._do_step)

    def _tables(self) -> NativeStep:
        return NativeStep(
            kind=self._kind,
            component=self._component,
            do_step=self._step_address(),
            said=ctypes.addressof(self._said),
            loads=[move for part in self._setters for move in _moves(part, load=True)],
            setters=[part.in_table for part in self._setters],
            getters=[part.in_table for part in self._getters],
            stores=[move for part in self._getters for move in _moves(part, load=False)],
            kept=(self._said, *self._setters, *self._getters),
        )

    def _hosted(self, tables: NativeStep, inputs: Ring) -> NativeStep:
        """The tables with the host of the FMU, if there is one, and all memory that their addresses point to.

        The equations of model exchange are solved here; then each function is called by itself.
        """
        host = self._fmu.dll.host
        if host is None or tables.kind == StepKind.EQUATIONS:
            return tables
        own = [Region(inputs.address, inputs.rows * inputs.stride)]
        for part in (*self._setters, *self._getters):
            own.append(Region(address_of(part.arguments[0]), 4 * len(part.variables)))
            if isinstance(part.buffer, NumberBuffer):
                own.append(Region(part.buffer.address, part.buffer.size))
        return tables._replace(host=host.address, regions=own, share=host.map)

    def _table(self, tables: NativeStep, outputs: Sequence[Ring]) -> MemberTable:
        """The member that takes the steps in this process."""
        own = [native.OutputTable(ring.address, ring.stride, ring.mask) for ring in outputs]
        member = MemberTable(
            kind=tables.kind,
            component=tables.component,
            do_step=tables.do_step,
            said=tables.said,
            host=tables.host,
            start_time=self._start_time,
            base_step_size=self._base_step_size,
            step_size=self._step_size,
            points=self._points,
            outputs=(native.OutputTable * 2)(*own),
            bases=(ctypes.c_void_p * native.RowBase.FIRST_GATE)(),
        )
        member.give(loads=tables.loads, setters=tables.setters, getters=tables.getters, stores=tables.stores)
        member.give(regions=tables.regions)
        return member

    def _fail_to_set(self, step: int, status: int) -> None:
        """Raise the error for inputs that the library could not set."""
        if status != native.OUT_OF_RANGE:
            raise self._part_failed("Set", self._setters[self._said.call], status)
        slot = step & self._input_mask
        for part in self._setters:
            if part.buffer is not None:
                self._load(part.buffer, part.array[slot], part.names)
        raise self._failed("setting the inputs: a value is out of the range of the type of its input")

    def _fail_to_get(self, status: int) -> None:
        """Raise the error for outputs that the library could not get."""
        if status != native.OUT_OF_RANGE:
            raise self._part_failed("Get", self._getters[self._said.call], status)
        for part in self._getters:
            if part.buffer is not None:
                self._elements(part.buffer, part.names)
        raise self._failed("reading the outputs: a value is out of the range of the type of its output")


def _moves(part: PartCall, *, load: bool) -> list[Move]:
    if not isinstance(part.buffer, NumberBuffer):
        return []
    return part.buffer.moves(part.base, part.place, load=load)
