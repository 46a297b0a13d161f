"""The variables of a component in Python: `Input`, `Output` and `Parameter`, with their types for a type checker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypedDict, TypeVar, Unpack, overload

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ...errors import CallRefused
from ...variables.model_description import Causality, Variable
from ...variables.value_conversion import ValueRefused, to_value
from ...variables.value_types import DTYPES, VariableType, is_float, nested, zero
from .unit_names import base_unit_of

__all__ = ["Declared", "Input", "Output", "Parameter"]

T = TypeVar("T")
Array = NDArray[Any]
ArrayStart = Sequence[Any] | Array | None
FloatType = Literal["Float64", "Float32"]
IntegerType = Literal["Int64", "UInt64", "Int32", "UInt32", "Int16", "UInt16", "Int8", "UInt8", "Enumeration"]
BooleanType = Literal["Boolean"]
StringType = Literal["String"]
BinaryType = Literal["Binary"]
Shape = int | tuple[int, ...]


class Details(TypedDict, total=False):
    """What every variable may have; see `Input`."""

    unit: str | None
    description: str | None
    min: float | None
    max: float | None
    items: Mapping[str, int]


class ScalarDetails(Details, total=False):
    """What a variable that is no array may have."""

    shape: tuple[()]


class OutputDetails(Details, total=False):
    """What an output may have."""

    depends_on: Sequence[str]


class ScalarOutput(OutputDetails, ScalarDetails, total=False):
    """What an output that is no array may have."""


class ParameterDetails(Details, total=False):
    """What a parameter may have."""

    tunable: bool


class Declared(Generic[T]):
    """Base of `Input`, `Output` and `Parameter`: one variable of a component.

    The value is an ordinary attribute of the component. So reading and writing it takes no longer than any attribute.

    Attributes:
        name: name of the variable, which is that of the attribute.
        has_start: whether a start value was given.
    """

    causality: ClassVar[Causality]

    def __init__(
        self,
        start: Any,  # noqa: ANN401 the overloads of the subclasses have the types
        type: VariableType,  # noqa: A002 the word of FMI
        shape: Shape,
        details: Details,
        **fields: Any,  # noqa: ANN401 of `Variable`
    ) -> None:
        if type not in DTYPES:
            raise CallRefused(f"'{type}' is no type of a variable", hint=f"The types are {', '.join(DTYPES)}.")
        sizes = (shape,) if isinstance(shape, int) else tuple(shape)
        if any(size < 1 for size in sizes):
            raise CallRefused(f"an array cannot have the shape {sizes}", hint="Each size is at least 1.")
        if unknown := details.keys() - Details.__annotations__.keys():
            known = ["start", "type", "shape", *Details.__annotations__]
            raise CallRefused(f"a variable has no '{min(unknown)}'", hint=f"It may have {', '.join(known)}.")
        unit = details.get("unit")
        self.name = ""
        self.has_start = start is not None
        self._variable = Variable(
            name="",
            value_reference=0,
            type=type,
            causality=self.causality,
            unit=unit,
            description=details.get("description"),
            minimum=details.get("min"),
            maximum=details.get("max"),
            items=tuple(details.get("items", {}).items()),
            base_unit=base_unit_of(unit) if unit is not None else None,
            dimensions=sizes,
            shape=sizes,
            **{"variability": "continuous" if is_float(type) else "discrete", **fields},
        )
        if start is None:
            self._start = nested([zero(type)] * self._variable.size, sizes)
            return
        try:
            self._start = to_value(start, self._variable)
        except ValueRefused as refused:
            raise CallRefused(f"the start value {start!r} is wrong: {refused.expected or refused}") from refused

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type) -> T: ...
    def __get__(self, instance: object | None, owner: type) -> Self | T:
        """On the class the declaration; on a component the start value, because nothing was assigned yet."""
        if instance is None:
            return self
        value: T = vars(instance).setdefault(self.name, self.start)
        return value

    if TYPE_CHECKING:
        # There is none at run time: an assignment makes an ordinary attribute, which Python finds without this class.
        def __set__(self, instance: object, value: T) -> None: ...

    @property
    def start(self) -> Any:  # noqa: ANN401 a value of any type
        """A new copy of the start value as the component sees it: an array is one of numpy."""
        variable = self._variable
        return np.array(self._start, dtype=DTYPES[variable.type]) if variable.shape else self._start

    def variable(self, reference: int) -> Variable:
        """The variable for the model description, with this value reference."""
        start = None if self.causality == "output" else self._start
        return replace(self._variable, name=self.name, value_reference=reference, start=start)


class Input(Declared[T]):
    """An input of a component.

    It is set before `initialize` and before each `step`: from its connection, by `set`, or to its start value. An array
    is a copy that belongs to the component.

    Args:
        start: the value if nothing is connected; default: 0, False or an empty text.
        type: the type, in the words of FMI 3.0 (2.4.4).
        shape: the sizes of the dimensions of an array; one number for one dimension.
        unit: such as `rad`, `N.m`, `m/s2`. Connections convert between units that are known.
        description: what it is.
        min: smallest value that may be set.
        max: largest value that may be set.
        items: names and numbers of the items of an Enumeration.

    Raises:
        CallRefused: there is no such type, or the start value does not fit.

    Example:
        >>> from fmu_mesh import Component, Input
        >>> class Brake(Component):
        ...     pressed = Input(type="Boolean")
        ...     speeds = Input(shape=4, unit="m/s")
        >>> Brake().pressed, Brake().speeds
        (False, array([0., 0., 0., 0.]))
    """

    causality = "input"

    @overload
    def __init__(
        self: Input[float], start: float | None = None, *, type: FloatType = ..., **details: Unpack[ScalarDetails]
    ) -> None: ...
    @overload
    def __init__(
        self: Input[int], start: int | str | None = None, *, type: IntegerType, **details: Unpack[ScalarDetails]
    ) -> None: ...
    @overload
    def __init__(
        self: Input[bool],
        start: bool | None = None,  # noqa: FBT001 the value
        *,
        type: BooleanType,
        **details: Unpack[ScalarDetails],
    ) -> None: ...
    @overload
    def __init__(
        self: Input[str], start: str | None = None, *, type: StringType, **details: Unpack[ScalarDetails]
    ) -> None: ...
    @overload
    def __init__(
        self: Input[bytes], start: bytes | None = None, *, type: BinaryType, **details: Unpack[ScalarDetails]
    ) -> None: ...
    @overload
    def __init__(
        self: Input[Array],
        start: ArrayStart = None,
        *,
        type: VariableType = ...,
        shape: Shape,
        **details: Unpack[Details],
    ) -> None: ...
    def __init__(
        self,
        start: Any = None,
        *,
        type: VariableType = "Float64",  # noqa: A002 the word of FMI
        shape: Shape = (),
        **details: Unpack[Details],
    ) -> None:
        super().__init__(start, type, shape, details)


class Output(Declared[T]):
    """An output of a component. It holds its value until the component assigns another one.

    Args:
        start: the value before the component assigns one; default: 0, False or an empty text. Without a start value, an
            output that is not assigned in the first step is an error.
        type: as of an `Input`; so are `shape`, `unit`, `description` and `items`.
        depends_on: the inputs that its value at a point depends on directly (FMI 2.0, 2.2.8), for the order of the
            initialization and for warnings of loops at every point. Default: nothing is said; the initial value depends
            on all inputs if the component has `initialize`, otherwise on none.

    Raises:
        CallRefused: there is no such type, or the start value does not fit.

    Example:
        >>> from fmu_mesh import Component, Input, Output
        >>> class Doubler(Component):
        ...     u = Input()
        ...     y = Output(unit="V", depends_on=("u",))
        ...
        ...     def step(self, time, step_size):
        ...         self.y = 2.0 * self.u
        >>> doubler = Doubler()
        >>> doubler.u = 1.5
        >>> doubler.step(0.0, 0.1)
        >>> doubler.y
        3.0
    """

    causality = "output"

    @overload
    def __init__(
        self: Output[float], start: float | None = None, *, type: FloatType = ..., **details: Unpack[ScalarOutput]
    ) -> None: ...
    @overload
    def __init__(
        self: Output[int], start: int | str | None = None, *, type: IntegerType, **details: Unpack[ScalarOutput]
    ) -> None: ...
    @overload
    def __init__(
        self: Output[bool],
        start: bool | None = None,  # noqa: FBT001 the value
        *,
        type: BooleanType,
        **details: Unpack[ScalarOutput],
    ) -> None: ...
    @overload
    def __init__(
        self: Output[str], start: str | None = None, *, type: StringType, **details: Unpack[ScalarOutput]
    ) -> None: ...
    @overload
    def __init__(
        self: Output[bytes], start: bytes | None = None, *, type: BinaryType, **details: Unpack[ScalarOutput]
    ) -> None: ...
    @overload
    def __init__(
        self: Output[Array],
        start: ArrayStart = None,
        *,
        type: VariableType = ...,
        shape: Shape,
        **details: Unpack[OutputDetails],
    ) -> None: ...
    def __init__(
        self,
        start: Any = None,
        *,
        type: VariableType = "Float64",  # noqa: A002 the word of FMI
        shape: Shape = (),
        **details: Unpack[OutputDetails],
    ) -> None:
        on = details.pop("depends_on", None)
        knowns = None if on is None else tuple(on)
        super().__init__(start, type, shape, details, initial="calculated", dependencies=knowns, feedthrough=knowns)


class Parameter(Declared[T]):
    """A parameter of a component. It is set before `initialize`.

    Args:
        start: its default value, which also says its type and shape: a number with a point is a Float64, a whole number
            an Int64, a list or an array of numbers an array of Float64.
        type: the type, where the default value does not say it.
        tunable: whether it may be set while the mesh runs.
        unit: as of an `Input`; so are `description`, `min`, `max` and `items`.

    Raises:
        CallRefused: the default value has no type of FMI, or does not fit to the one that is given.

    Example:
        >>> from fmu_mesh import Component, Parameter
        >>> class Filter(Component):
        ...     order = Parameter(2, min=1)
        ...     gains = Parameter([1.0, 0.5], tunable=True)
        >>> Filter().order, Filter().gains
        (2, array([1. , 0.5]))
    """

    causality = "parameter"

    @overload
    def __init__(self: Parameter[bool], start: bool, **details: Unpack[ParameterDetails]) -> None: ...  # noqa: FBT001 the value
    @overload
    def __init__(
        self: Parameter[int], start: int, *, type: IntegerType = ..., **details: Unpack[ParameterDetails]
    ) -> None: ...
    @overload
    def __init__(
        self: Parameter[float], start: float, *, type: FloatType = ..., **details: Unpack[ParameterDetails]
    ) -> None: ...
    @overload
    def __init__(self: Parameter[str], start: str, **details: Unpack[ParameterDetails]) -> None: ...
    @overload
    def __init__(self: Parameter[bytes], start: bytes, **details: Unpack[ParameterDetails]) -> None: ...
    @overload
    def __init__(
        self: Parameter[Array],
        start: Sequence[Any] | Array,
        *,
        type: VariableType = ...,
        **details: Unpack[ParameterDetails],
    ) -> None: ...
    def __init__(
        self,
        start: Any,
        *,
        type: VariableType | None = None,  # noqa: A002 the word of FMI
        **details: Unpack[ParameterDetails],
    ) -> None:
        variability = "tunable" if details.pop("tunable", False) else "fixed"
        shape = np.shape(start) if isinstance(start, list | tuple | np.ndarray) else ()
        super().__init__(start, type or _type_of(start), shape, details, initial="exact", variability=variability)


_TYPES: dict[type, VariableType] = {
    bool: "Boolean",
    int: "Int64",
    float: "Float64",
    str: "String",
    bytes: "Binary",
    list: "Float64",
    tuple: "Float64",
    np.ndarray: "Float64",
}


def _type_of(value: object) -> VariableType:
    """The type of a parameter with this default value."""
    for kind, type_ in _TYPES.items():
        if isinstance(value, kind):
            return type_
    text = f"the default value {value!r} of a parameter has no type of FMI"
    raise CallRefused(text, hint="It may be True, 2, 1.0, 'text', b'bytes', or a list or an array of numbers.")
