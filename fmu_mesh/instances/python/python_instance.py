"""One instance of a component in Python; see `fmu_mesh.instances.contract.Instance` for the call sequence.

One step sets the connected inputs as attributes of the component, calls its `step`, and writes its outputs to a row.
What the code of the user raises ends the instance, with the line of that code in the error. A value of another type, or
of another shape, is refused with its name.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Container, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ...errors import FmuError, FmuMeshError, InitializationFailed, LoadFailed, StepFailed, TerminationRequested
from ...rings.ring import Ring
from ...simtime import TimeGrid
from ...variables.model_description import Variable
from ...variables.value_conversion import ValueRefused, to_value
from ...variables.value_types import DTYPES, INTEGERS, Value, is_float, is_text, nested
from ..call_guard import lines_shown_of
from ..contract import LogMessage, Opening
from .component import Component, declared_variables
from .importing import ImportedComponent
from .plain_state import NotPlain, check_memory, encoded, plain
from .python_section import PythonConfig, class_place_of

__all__ = ["PythonInstance"]

Array = NDArray[Any]

_TEXT_CHARACTERS = 60

_ERRORS: Final = {"loading": LoadFailed, "initialization": InitializationFailed, "stepping": StepFailed}
_CHANGING: Final = re.compile(rb"\b(f?chdir|setlocale|umask|environ|(un)?setenv|putenv|signal|pthread_sigmask)\b")


class _State(NamedTuple):
    """A state: what the component returned, and the values of its variables."""

    own: object
    values: dict[str, object]


class PythonInstance:
    """A component in Python that is stepped by a mesh."""

    def __init__(self, opening: Opening[PythonConfig]) -> None:
        self.name = opening.name
        self.description = opening.description
        # A value may be beyond `min` and `max`, which are for whoever sets it.
        bare = (replace(v, minimum=None, maximum=None) for v in opening.description.variables)
        self._variables: dict[str, Variable] = {variable.name: variable for variable in bare}
        self._outputs = [v.name for v in opening.description.variables if v.causality == "output"]
        self._log = opening.log
        self._phase: Literal["loading", "initialization", "stepping"] = "loading"
        self._changed = True
        self._fresh: dict[str, Any] | None = None
        self._component: Component | None = None
        self._imported = ImportedComponent(opening.path, class_place_of(opening.section.python))
        try:
            loaded = self._called(self._imported.load)
            if loaded.guid != opening.description.guid:
                text = f"'{opening.section.python}' is another component than when the run was planned"
                raise LoadFailed(text, instance=self.name, hint="Was its file changed meanwhile? Start the run again.")
            lines_shown_of(self._imported.file)
            self._component = self._called(lambda: self._imported.cls(**opening.section.arguments))
        except FmuMeshError:
            self._imported.close()
            raise
        self._declared = declared_variables(self._imported.cls)
        self._step_component = self._component.step
        self._lent = self._imported.modules.lent
        self._values: dict[str, Any] = vars(self._component)

    @property
    def changes_process(self) -> bool:
        """Whether its code may change the state of the process in a step, such as the working directory."""
        return self._imported.modules.mention(_CHANGING)

    def enter_initialization(
        self, start_time: float, stop_time: float | None, start_values: Mapping[str, Value]
    ) -> None:
        """Set ``start_values``."""
        self._phase = "initialization"
        self._values["start_time"] = start_time
        self.set_values({name: to_value(value, self._variables[name]) for name, value in start_values.items()})

    def exit_initialization(self) -> None:
        """Leave Initialization Mode: `initialize` has been called with the last inputs."""
        self._initialize()
        self._fresh = None
        self._phase = "stepping"

    def set_values(self, values: Mapping[str, Value]) -> None:
        """Set inputs and parameters by name."""
        for name, value in values.items():
            self._values[name] = _as_attribute(value, self._variables[name])
        self._changed = True

    def get_values(self, names: Sequence[str]) -> list[Value]:
        """Current values by name; in Initialization Mode, outputs are computed from the inputs as they are now."""
        if self._phase == "initialization" and not set(names).isdisjoint(self._outputs):
            self._initialize()
        values: list[Value] = []
        for name in names:
            attribute = self._values[name] if name in self._values else self._declared[name].start
            variable = self._variables[name]
            try:
                if variable.shape:
                    values.append(nested(_array(attribute, variable).reshape(-1).tolist(), variable.shape))
                else:
                    values.append(_scalar(attribute, variable))
            except ValueRefused as refused:
                raise _ERRORS[self._phase](str(refused), instance=self.name, variable=name) from refused
        return values

    def bind(self, inputs: Ring, outputs: Sequence[Ring], grid: TimeGrid, points: int, step: int = 0) -> None:
        """Choose the rings of `do_step`, and write the current outputs to row ``step``."""
        self._start_time, self._base_step_size = grid.start_time, grid.step_size
        self._points = points
        self._step_size = points * grid.step_size
        self._input_mask = inputs.mask
        self._reads = [(name, _reader(inputs, self._variables[name])) for name in inputs.layout.names]
        self._writes: list[tuple[str, Callable[[int, object], None], int]] = [
            (name, _writer(ring, self._variables[name]), ring.mask) for ring in outputs for name in ring.layout.names
        ]
        values = (
            dict(zip(names, self.get_values(names), strict=True)) if (names := [n for n, *_ in self._writes]) else {}
        )
        for name, write, mask in self._writes:
            write(step & mask, _as_attribute(values[name], self._variables[name]))

    def do_step(self, step: int) -> None:
        """Set the inputs of row ``step``, call `step` of the component, write its outputs to row ``step + 1``."""
        values, slot = self._values, step & self._input_mask
        for name, read in self._reads:
            values[name] = read(slot)
        time = self._start_time + step * self._points * self._base_step_size  # `grid.time`, without a call
        try:
            self._step_component(time, self._step_size)
        except (Exception, SystemExit) as error:
            raise self._failed(error) from error
        if self._lent:
            self._imported.modules.forget_names()
        row = step + 1
        for name, write, mask in self._writes:
            try:
                write(row & mask, values[name])
            except KeyError:
                text = "the component has not assigned this output"
                hint = f"Assign `self.{name}` in `step`, or give the output a `start`."
                raise StepFailed(text, instance=self.name, variable=name, hint=hint) from None
            except ValueRefused as refused:
                raise StepFailed(str(refused), instance=self.name, variable=name) from refused

    def get_state(self) -> object:
        """The state of the component, and the values of its variables."""
        component = self._live()
        own = self._called(component.get_state)
        return _State(
            own, copy.deepcopy({name: vars(component)[name] for name in self._variables if name in self._values})
        )

    def set_state(self, state: object) -> None:
        """Restore what `get_state` returned."""
        assert isinstance(state, _State)
        component = self._live()
        self._called(lambda: component.set_state(state.own))
        self._values.update(copy.deepcopy(state.values))
        self._phase = "stepping"

    def free_state(self, state: object) -> None:
        """Nothing to free: a state is Python objects."""

    def serialize_state(self, state: object) -> bytes:
        """The state as bytes; only plain values have such (`fmu_mesh.instances.python.plain_state`).

        Raises:
            FmuError: the state has another value; names its attribute.
        """
        assert isinstance(state, _State)
        component = self._live()
        hint = "Leave it out of what `get_state` of the component returns, and make it again in `set_state`."
        try:
            if type(component).get_state is Component.get_state:
                check_memory(vars(component))
            return msgspec.msgpack.encode((encoded(state.own), encoded(state.values)))
        except NotPlain as refused:
            raise FmuError(f"its state cannot be written: it {refused}", instance=self.name, hint=hint) from refused

    def deserialize_state(self, data: bytes) -> object:
        """See `serialize_state`."""
        try:
            own, values = msgspec.msgpack.decode(data, type=tuple[bytes, bytes])
            return _State(plain(own), plain(values))
        except ValueError as error:  # `msgspec.DecodeError` is one
            raise FmuError(f"this is no state of a component: {error}", instance=self.name) from error

    def close(self) -> None:
        """Call `close` of the component; what it raises is logged, because the run has ended."""
        component, self._component = self._component, None
        if component is not None:
            try:
                component.close()
            except (Exception, SystemExit) as error:  # noqa: BLE001 it is code of the user
                text = f"close: {self._imported.told(error)}"
                self._log(LogMessage(self.name, "Warning", "component", text, -1))
        self._imported.close()

    def _initialize(self) -> None:
        """Call `initialize` if an input has changed since the last call.

        How often that is depends on how outputs are read. The result does not: the attributes are set back to what they
        were before the first call.
        """
        component = self._live()
        if not self._changed or type(component).initialize is Component.initialize:
            return
        self._changed = False
        given = {name: self._values[name] for name in self._variables if name not in self._outputs}
        if self._fresh is None:
            self._fresh = self._copied()
        else:
            self._values.clear()
            self._values.update(self._called(lambda: copy.deepcopy(self._fresh)) or {})
            self._values.update(given)
        self._called(component.initialize)

    def _copied(self) -> dict[str, Any]:
        """A copy of the attributes; one that cannot be copied stands for itself."""
        copied = {}
        for name, value in self._values.items():
            try:
                copied[name] = copy.deepcopy(value)
            except Exception:  # noqa: BLE001 it is code of the user
                copied[name] = value
        return copied

    def _live(self) -> Component:
        if self._component is None:
            msg = f"instance '{self.name}' is closed"
            raise ValueError(msg)
        return self._component

    def _called(self, call: Callable[[], Any]) -> Any:  # noqa: ANN401 what the call returns
        """Call code of the user; what it raises becomes an `FmuError`."""
        try:
            return call()
        except (Exception, SystemExit) as error:
            raise self._failed(error) from error
        finally:
            self._imported.modules.forget_names()

    def _failed(self, error: BaseException) -> FmuMeshError:
        """The error for an exception of the code of the user."""
        if isinstance(error, TerminationRequested):
            return TerminationRequested(error.message, instance=self.name)
        hint = error.hint if isinstance(error, FmuMeshError) else None
        return _ERRORS[self._phase](self._imported.told(error), instance=self.name, hint=hint)


# --- values of a component as rows of a ring


def _as_attribute(value: Value, variable: Variable) -> Any:  # noqa: ANN401 a value of any type
    """A value as the component sees it: an array is one of numpy, which belongs to the component."""
    return np.array(value, dtype=DTYPES[variable.type]).reshape(variable.shape) if variable.shape else value


def _reader(ring: Ring, variable: Variable) -> Callable[[int], Any]:
    """A function that returns the value of an input, as the component sees it, from a slot of a ring."""
    place = ring.layout.place(variable.name)
    part, first = ring.parts[place.part], place.first
    if place.shape:
        array = ring.array(variable.name)
        return lambda slot: array[slot].copy()
    if variable.type != "Float64":
        return lambda slot: part.item(slot, first)
    memory = _memory(part)
    return lambda slot: memory[slot, first]


def _writer(ring: Ring, variable: Variable) -> Callable[[int, object], None]:
    """A function that writes the value of an output to a slot of a ring; it raises `ValueRefused`."""
    place = ring.layout.place(variable.name)
    part, first = ring.parts[place.part], place.first

    if place.shape:
        array = ring.array(variable.name)

        def write_array(slot: int, attribute: object) -> None:
            array[slot] = _array(attribute, variable)

        return write_array

    if variable.type != "Float64":
        kind, allowed = _exact(variable)

        def write_scalar(slot: int, attribute: object) -> None:
            exact = attribute.__class__ is kind and attribute in allowed
            part[slot, first] = attribute if exact else _scalar(attribute, variable)

        return write_scalar

    memory = _memory(part)

    def write_float(slot: int, attribute: object) -> None:
        memory[slot, first] = attribute if attribute.__class__ is float else _scalar(attribute, variable)

    return write_float


def _exact(variable: Variable) -> tuple[type, Container[object]]:
    """A class, and which of its objects are values of a variable as they are."""
    if variable.type == "Boolean":
        return bool, (False, True)
    if variable.type in INTEGERS:
        return int, [number for _, number in variable.items] or INTEGERS[variable.type]
    return type(None), ()


def _memory(part: Any) -> Any:  # noqa: ANN401 an array, and a view of its memory
    """The numbers of an array by row and column: indexing this takes half the time of indexing numpy."""
    return part.data


def _scalar(attribute: object, variable: Variable) -> Value:
    plain = attribute.item() if isinstance(attribute, np.generic) else attribute
    if isinstance(plain, np.ndarray) and not plain.shape:
        plain = plain.item()
    # In a file, a text can also stand for a number or for bytes.
    in_a_file = isinstance(plain, str) and variable.type not in ("String", "Enumeration")
    try:
        return to_value(None if in_a_file else plain, variable)
    except ValueRefused as refused:
        raise ValueRefused(f"its value is {_shown(attribute)}, expected {refused.expected}") from None


def _array(attribute: object, variable: Variable) -> Array:
    """An attribute as an array of the variable's type and shape."""
    dtype, shape = np.dtype(DTYPES[variable.type]), variable.shape
    if is_text(variable.type):
        return _text_array(attribute, variable)
    if isinstance(attribute, np.ndarray) and attribute.dtype == dtype and attribute.shape == shape:
        return attribute
    try:
        array = np.asarray(attribute)
    except ValueError:  # rows of different lengths
        raise _refused(attribute, variable) from None
    is_boolean = array.dtype == np.bool_
    whole = array.dtype.kind == "i" and dtype.kind == "u"  # as a list of int: the numbers decide below
    fits = is_boolean == (variable.type == "Boolean") and (whole or np.can_cast(array.dtype, dtype, "same_kind"))
    if not fits or array.shape != shape:
        raise _refused(attribute, variable)
    with np.errstate(over="ignore"):
        converted = array.astype(dtype)
    if not is_float(variable.type) and not np.array_equal(converted, array):
        raise _refused(attribute, variable)  # a whole number that the type cannot hold
    return converted


def _text_array(attribute: Any, variable: Variable) -> Array:  # noqa: ANN401 whatever a user assigns
    array = np.empty(variable.shape, dtype=object)
    try:
        array[...] = attribute
    except ValueError:
        raise _refused(attribute, variable) from None
    if np.shape(attribute) != variable.shape:
        raise _refused(attribute, variable)
    element = replace(variable, shape=(), dimensions=())
    for place, text in np.ndenumerate(array):
        array[place] = _scalar(text, element)
    return array


def _refused(attribute: object, variable: Variable) -> ValueRefused:
    expected = f"an array of {variable.type} with the shape {variable.shape}"
    return ValueRefused(f"its value is {_shown(attribute)}, expected {expected}")


def _shown(attribute: object) -> str:
    if isinstance(attribute, np.ndarray):
        return f"an array of {attribute.dtype} with the shape {attribute.shape}"
    text = " ".join(repr(attribute).split())
    return text if len(text) <= _TEXT_CHARACTERS else f"{text[:_TEXT_CHARACTERS]}..."
