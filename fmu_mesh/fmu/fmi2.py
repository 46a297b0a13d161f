"""FMI 2.0 co-simulation behind the `Instance` Protocol.

FMPy loads the library and declares its functions; the hot loop calls them through prototypes of its own, on arrays
that are allocated once: an input row is set from, and an output row read into, the memory of a `Ring` directly.
"""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import fmpy
import msgspec
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

from ..errors import InitializationFailed, LoadFailed, StepFailed
from ..model.description import ModelDescription, Value, Variable, VariableType
from ..model.ring import Layout, Ring
from ..simtime import TimeGrid
from .archive import Terms
from .sources import extract

__all__ = ["Fmi2Instance", "LogMessage"]

OK: Final = 0
WARNING: Final = 1
DISCARD: Final = 2
_STATUS_NAMES = ("ok", "warning", "discard", "error", "fatal", "pending")

_GET_OR_SET = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p)
_DO_STEP = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int)
_STORAGE: dict[VariableType, type[Any]] = {
    "Real": ctypes.c_double,
    "Integer": ctypes.c_int,
    "Boolean": ctypes.c_int,
    "Enumeration": ctypes.c_int,
    "String": ctypes.c_char_p,
}
_FUNCTION_SUFFIX: dict[VariableType, str] = {
    "Real": "Real",
    "Integer": "Integer",
    "Enumeration": "Integer",
    "Boolean": "Boolean",
    "String": "String",
}


class LogMessage(msgspec.Struct, frozen=True):
    """One message of an FMU's logger (FMI 2.0, 2.1.5).

    Attributes:
        step: the instance's own step during which it came; -1 before the first.
    """

    instance: str
    status: str
    category: str
    message: str
    step: int


LogSink = Callable[[LogMessage], None]

_instances: dict[bytes, Fmi2Instance] = {}


def _log(_environment: int | None, name: bytes, status: int, category: bytes, message: bytes) -> None:
    instance = _instances.get(name or b"")
    if instance is not None:
        instance.logged(status, category or b"", message or b"")


def _callbacks() -> fmi2CallbackFunctions:
    """One set of callbacks for the process: FMPy's proxy, which formats variadic messages, has one logger only."""
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(_log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(fmpy.free)
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


_CALLBACKS = _callbacks()


class Fmi2Instance:
    """One instance of an FMI 2.0 co-simulation FMU; see `fmu_mesh.model.instance.Instance` for the call sequence.

    Args:
        path: the .fmu file.
        name: instance name.
        description: what `read_description` returned for it.
        folder: an existing private folder to extract into.
        log: called with every log message, on the thread that calls the FMU.
        terms: what the FMU has to keep to.

    Raises:
        LoadFailed: the FMU cannot be extracted, loaded or instantiated.
    """

    def __init__(  # noqa: PLR0913, PLR0917  what an FMU is opened with
        self,
        path: Path,
        name: str,
        description: ModelDescription,
        folder: Path,
        log: LogSink = lambda _message: None,
        terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    ) -> None:
        self.name = name
        self._description = description
        self._variables = {variable.name: variable for variable in description.variables}
        self._log = log
        self._last_messages: list[str] = []
        self._step = -1
        self._state: Literal["instantiated", "initialization", "stepping", "failed", "closed"] = "instantiated"
        self._hot: _HotLoop | None = None
        self._fmu: FMU2Slave | None = None
        self._extracted = extract(path, folder, terms)
        key = name.encode()
        if key in _instances:
            msg = f"two instances of one process have the name '{name}'"
            raise ValueError(msg)
        _instances[key] = self
        try:
            fmu = FMU2Slave(
                guid=description.guid,
                modelIdentifier=description.model_identifier,
                unzipDirectory=str(self._extracted),
                instanceName=name,
            )
            fmu.instantiate(callbacks=_CALLBACKS, loggingOn=False)
            self._fmu = fmu
        except Exception as error:
            self._state = "failed"
            self.close()
            raise LoadFailed(f"'{path}' cannot be instantiated: {error}{self._said()}", instance=name) from error

    @property
    def description(self) -> ModelDescription:
        """The model description."""
        return self._description

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values`` and enter Initialization Mode (times in s, None: open end; FMI 2.0, 2.1.6 and 4.2.1)."""
        fmu = self._live()
        tolerance = self._description.default_experiment.tolerance
        self._initializing(
            "fmi2SetupExperiment",
            lambda: fmu.setupExperiment(tolerance=tolerance, startTime=start_time, stopTime=stop_time),
        )
        self.set_values(start_values)
        self._initializing("fmi2EnterInitializationMode", fmu.enterInitializationMode)
        self._state = "initialization"

    def exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        self._initializing("fmi2ExitInitializationMode", self._live().exitInitializationMode)
        self._state = "stepping"

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set variables by name."""
        for type_, names in self._by_type(values).items():
            storage = _STORAGE[type_]
            raw = [_to_c(type_, values[name]) for name in names]
            self._get_or_set(f"fmi2Set{_FUNCTION_SUFFIX[type_]}", names, (storage * len(raw))(*raw))

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values of variables by name."""
        values: dict[str, Value] = {}
        for type_, members in self._by_type(names).items():
            array = (_STORAGE[type_] * len(members))()
            self._get_or_set(f"fmi2Get{_FUNCTION_SUFFIX[type_]}", members, array)
            values.update({name: _from_c(type_, raw) for name, raw in zip(members, array, strict=True)})
        return [values[name] for name in names]

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Let `do_step` work on these rings, ``points`` of ``grid`` each; write the current outputs as row ``step``."""
        self._hot = hot = _HotLoop(self._live(), self._variables, inputs, outputs)
        self._start_time = grid.start_time
        self._base_step_size = grid.step_size
        self._points = points
        self._step_size = points * grid.step_size
        self._step = step
        self._hot_setters = hot.setters
        self._hot_getters = hot.getters
        self._hot_do_step = hot.do_step
        self._component = hot.component
        self._input_mask = inputs.mask
        self._output_mask = outputs[0].mask
        for function, references, count, rows in self._hot_getters:
            status = function(self._component, references, count, rows[step & self._output_mask])
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {_STATUS_NAMES[status]}")

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, advance to own step ``step + 1``, write the outputs to row ``step + 1``."""
        component = self._component
        slot = step & self._input_mask
        for function, references, count, rows in self._hot_setters:
            status = function(component, references, count, rows[slot])
            if status > WARNING:
                raise self._failed(f"setting the inputs returned {_STATUS_NAMES[status]}")
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        status = self._hot_do_step(component, time, self._step_size, 1)
        if status > WARNING:
            raise self._failed(f"fmi2DoStep returned {_STATUS_NAMES[status]}")
        self._step = step + 1
        slot = (step + 1) & self._output_mask
        for function, references, count, rows in self._hot_getters:
            status = function(component, references, count, rows[slot])
            if status > WARNING:
                raise self._failed(f"reading the outputs returned {_STATUS_NAMES[status]}")

    def advance(self, time: float, step_size: float) -> None:
        """One step of ``step_size`` from ``time`` (both in s) without rings, for callers with their own time base."""
        try:
            self._live().doStep(currentCommunicationPoint=time, communicationStepSize=step_size)
        except FMICallException as error:
            raise self._failed(f"{error.function} returned {_STATUS_NAMES[error.status]}") from error

    def close(self) -> None:
        """Terminate if allowed, free the instance and remove its files. Never raises; may be called twice."""
        if self._state == "closed":
            return
        fmu, self._fmu = self._fmu, None
        if fmu is not None:
            if self._state in ("initialization", "stepping"):
                _quietly(fmu.terminate)
            _quietly(fmu.freeInstance)
        self._state = "closed"
        self._hot = None
        _instances.pop(self.name.encode(), None)
        self.remove_files()

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        shutil.rmtree(self._extracted, ignore_errors=True)

    def logged(self, status: int, category: bytes, message: bytes) -> None:
        """Take a message from the FMU's logger; keeps the last ones for the error that may follow."""
        text = message.decode(errors="replace").strip()
        name = _STATUS_NAMES[status] if 0 <= status < len(_STATUS_NAMES) else str(status)
        if status > OK:
            self._last_messages = [*self._last_messages[-2:], text]
        self._log(LogMessage(self.name, name, category.decode(errors="replace"), text, self._step))

    def _live(self) -> FMU2Slave:
        if self._fmu is None:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)
        return self._fmu

    def _by_type(self, names: Sequence[str] | Mapping[str, Value]) -> dict[VariableType, list[str]]:
        groups: dict[VariableType, list[str]] = {}
        for name in names:
            groups.setdefault(self._variables[name].type, []).append(name)
        return groups

    def _get_or_set(self, function: str, names: Sequence[str], array: ctypes.Array[Any]) -> None:
        fmu = self._live()
        references = (ctypes.c_uint * len(names))(*(self._variables[name].value_reference for name in names))
        try:
            getattr(fmu, function)(fmu.component, references, len(names), array)
        except FMICallException as error:
            what = f"{function} of {', '.join(names)} returned {_STATUS_NAMES[error.status]}"
            raise self._failed(what, variable=names[0] if len(names) == 1 else None) from error

    def _initializing(self, function: str, call: Callable[[], object]) -> None:
        try:
            call()
        except FMICallException as error:
            self._state = "failed"
            text = f"{function} returned {_STATUS_NAMES[error.status]}{self._said()}"
            raise InitializationFailed(text, instance=self.name) from error

    def _failed(self, what: str, variable: str | None = None) -> StepFailed | InitializationFailed:
        kind = StepFailed if self._state == "stepping" else InitializationFailed
        self._state = "failed"
        return kind(f"{what}{self._said()}", instance=self.name, variable=variable)

    def _said(self) -> str:
        messages, self._last_messages = self._last_messages, []
        return f"; the FMU says: {' | '.join(messages)}." if messages else "; the FMU gave no message."


class _HotLoop:
    """Everything `do_step` needs, prepared: functions, value references, and the address of every row.

    `setters` and `getters` hold (function, value references, count, row addresses) per FMI type of the columns.
    """

    def __init__(
        self, fmu: FMU2Slave, variables: Mapping[str, Variable], inputs: Ring, outputs: Sequence[Ring]
    ) -> None:
        self.component = fmu.component
        self.do_step = _DO_STEP(("fmi2DoStep", fmu.dll))
        self._keep: list[object] = [inputs, *outputs]
        self.setters = self._calls(fmu, "Set", variables, inputs)
        self.getters = [call for ring in outputs for call in self._calls(fmu, "Get", variables, ring)]

    def _calls(self, fmu: FMU2Slave, verb: str, variables: Mapping[str, Variable], ring: Ring) -> list[Any]:
        calls = []
        for suffix, first, names, array in _runs(ring):
            function = _GET_OR_SET((f"fmi2{verb}{suffix}", fmu.dll))
            references = (ctypes.c_uint * len(names))(*(variables[name].value_reference for name in names))
            self._keep.append(references)
            base = array.ctypes.data + first * array.itemsize
            rows = [base + slot * array.strides[0] for slot in range(ring.rows)]
            calls.append((function, ctypes.addressof(references), len(names), rows))
        return calls


def _runs(ring: Ring) -> list[tuple[str, int, tuple[str, ...], Any]]:
    """Runs of neighbouring columns that one FMI call can take: (function suffix, first column, names, array)."""
    layout: Layout = ring.layout
    runs: list[tuple[str, int, tuple[str, ...], Any]] = []
    if layout.reals:
        runs.append(("Real", 0, layout.reals, ring.reals))
    first = 0
    for last in range(1, len(layout.integers) + 1):
        suffix = _FUNCTION_SUFFIX[layout.integer_types[first]]
        if last == len(layout.integers) or _FUNCTION_SUFFIX[layout.integer_types[last]] != suffix:
            runs.append((suffix, first, layout.integers[first:last], ring.integers))
            first = last
    return runs


def _to_c(type_: VariableType, value: Value) -> float | int | bytes:
    match type_:
        case "Real":
            return float(value)
        case "String":
            return str(value).encode()
        case _:
            return int(value)


def _from_c(type_: VariableType, raw: float | bytes | None) -> Value:
    match type_:
        case "Boolean":
            return bool(raw)
        case "String":
            return raw.decode(errors="replace") if isinstance(raw, bytes) else ""
        case "Real":
            return float(raw or 0.0)
        case _:
            return int(raw or 0)


def _quietly(call: Callable[[], object]) -> None:
    """Call a function of the FMU on the way out, where its failure changes nothing any more."""
    try:
        call()
    except (FMICallException, OSError):
        return
