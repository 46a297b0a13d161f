"""From one value of a parameter set to the start value of one variable.

Owns the order of the steps, unit conversion first, then the transformation, then the type and the shape of the target,
and what can be converted without loss. Which value belongs to which variable is `parameter_bindings`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from ..text import listed, nearest, shown
from ..variables.model_description import Variable
from ..variables.units import Linear, conversion
from ..variables.value_conversion import to_plain
from ..variables.value_types import INTEGERS, PlainValue, VariableType, flattened, is_float, nested
from .flattening import PathChange
from .parameter_reading import VARIABLE_TYPES
from .problems import Problems
from .system_structure import Connector, FilePlace, MappingEntry, ParameterValue, Transformation, Unit

__all__ = ["AppliedValue", "ValueTarget", "changed", "converted", "target_of_connector", "target_of_variable"]


class AppliedValue(msgspec.Struct, frozen=True):
    """A value for a variable of an FMU, or for a connector of a system.

    Attributes:
        value: as a start value in YAML.
        type: of the value; that of the target if this is known.
        origin: where it is written.
        how: what was done to it on the way, such as `mapped in gain.ssm:4, from mm to m, 2 * value + 10`; empty if
            nothing was.
        unit: in which the value is; None if it has none.
        shape: the sizes of an array; empty for a scalar.
        items: the numbers by the names of the items of an Enumeration, if they are known.
    """

    value: PlainValue
    type: VariableType
    origin: FilePlace
    how: str = ""
    unit: Unit | None = None
    shape: tuple[int, ...] = ()
    items: dict[str, int] = {}


class ValueTarget(msgspec.Struct, frozen=True):
    """What a value is for.

    Attributes:
        words: it in a message, such as `the Real 'k' of 'gain'`.
        type: None if it is not known; then the value keeps its own. ``shape`` likewise.
        unit: None if it has none.
        is_relative: whether it is a difference, to which the offset of a unit does not apply.
        items: the numbers by the names of the items of an Enumeration; empty if they are not known.
    """

    words: str
    type: VariableType | None
    shape: tuple[int, ...] | None
    unit: Unit | None = None
    is_relative: bool = False
    items: dict[str, int] = {}


class _Misfit(Exception):
    """A value that the target cannot have; every step below raises it."""

    def __init__(self, expected: str, suggestion: str | None = None) -> None:
        super().__init__(expected)
        self.expected = expected
        self.suggestion = suggestion


def target_of_variable(variable: Variable, path: tuple[str, ...], connector: Connector | None = None) -> ValueTarget:
    """A variable of a component as a target; the unit of its connector counts where it has one."""
    unit = connector.unit if connector is not None else None
    if unit is None and variable.unit:
        unit = Unit(variable.unit, variable.base_unit)
    words = f"the {variable.type_name} '{variable.name}' of '{'.'.join(path)}'"
    return ValueTarget(words, variable.type, variable.shape, unit, variable.relative_quantity, dict(variable.items))


def target_of_connector(connector: Connector, path: tuple[str, ...]) -> ValueTarget:
    """A connector of the system at ``path`` as a target."""
    sizes = tuple(size for size in connector.dimensions if isinstance(size, int))
    shape = None if len(sizes) < len(connector.dimensions) or connector.type is None else sizes
    owner = f" of '{'.'.join(path)}'" if path else ""
    words = f"the connector '{connector.name}'{owner}"
    return ValueTarget(
        words, VARIABLE_TYPES.get(connector.type or ""), shape, connector.unit, items=connector.enumeration or {}
    )


def converted(
    parameter: ParameterValue, entry: MappingEntry | None, target: ValueTarget, problems: Problems
) -> AppliedValue | None:
    """The value of a parameter as one for a target; None after a finding: the value does not fit.

    The parameter has at least one value, and ``entry`` is that of the mapping that led to the target.
    """
    type_ = VARIABLE_TYPES[parameter.type]
    items = parameter.enumeration or {}
    sizes = (len(parameter.values),) if len(parameter.values) > 1 else ()
    shape = _shape(parameter, parameter.dimensions or sizes, target, problems)
    if shape is None:
        return None
    elements: list[Any] = [_PARSERS.get(type_, int)(text) for text in parameter.values]
    steps = [f"mapped in {_where(entry.place, parameter.place)}"] if entry is not None else []
    unit = parameter.unit
    if unit is not None and not (entry is not None and entry.suppress_unit_conversion):
        change = _unit_conversion(unit, parameter, target, problems)
        if change is None:
            return None
        if not change.identity:
            elements = _calculated(elements, change)
            steps.append(f"from {unit.name} to {target.unit.name if target.unit is not None else ''}")
    value = AppliedValue("", type_, parameter.place, unit=target.unit or unit, shape=shape, items=items)
    try:
        if entry is not None and entry.transformation is not None:
            value, elements, step = _transformed(value, elements, entry.transformation, target)
            steps.append(step)
        return _as_target(value, elements, target, ", ".join(steps))
    except _Misfit as misfit:
        text = ", ".join(parameter.values)
        text = text if type_ not in ("String", "Enumeration") else shown(text)
        found = f"the {parameter.type} value {text[:60]} for {target.words}"
        problems.add(parameter.place, found, misfit.expected, misfit.suggestion)
        return None


def changed(
    value: AppliedValue, change: PathChange, variable: Variable | None, path: tuple[str, ...], problems: Problems
) -> AppliedValue | None:
    """A value of a connector of a system as that of the variable of a component that it leads to.

    None after a finding: the value does not fit. The variable is None if it is not known.
    """
    target = ValueTarget(f"'{'.'.join(path)}'", None, None)
    if variable is not None:
        target = target_of_variable(variable, path)
    elements = flattened(value.value, len(value.shape))
    if is_float(value.type):
        elements = [float(one) if isinstance(one, str) else one for one in elements]
    try:
        steps = [value.how] if value.how else []
        if not change.linear.identity:
            why = "the connections on the way have a factor or an offset"
            value, elements, step = _linear(value, elements, change.linear, why)
            steps.append(step)
        if change.mapping:
            elements = [_mapped(one, value.items, change.mapping) for one in elements]
            steps.append("mapped by its connection")
        return _as_target(value, elements, target, ", ".join(steps))
    except _Misfit as misfit:
        found = f"the {value.type} value {shown(value.value)} for {target.words}"
        problems.add(value.origin, found, misfit.expected, misfit.suggestion)
        return None


# --- steps


def _shape(
    parameter: ParameterValue, sizes: tuple[int, ...], target: ValueTarget, problems: Problems
) -> tuple[int, ...] | None:
    """The shape that the value gets; None after a finding. An array of unknown dimensions takes those of the target."""
    if target.shape is None or target.shape == sizes:
        return sizes
    if not parameter.dimensions and math.prod(target.shape) == len(parameter.values):
        return target.shape
    several = "s" if math.prod(sizes) != 1 else ""
    have = f"an array of {' x '.join(map(str, sizes))} value{several}" if sizes else "one value"
    problems.add(parameter.place, f"{have} for {target.words}", _number_of_values(target.shape))
    return None


def _number_of_values(shape: tuple[int, ...]) -> str:
    return f"{' x '.join(map(str, shape))} values, with a Dimension for each size" if shape else "one value"


def _unit_conversion(unit: Unit, parameter: ParameterValue, target: ValueTarget, problems: Problems) -> Linear | None:
    """The conversion from the unit of a parameter to that of the target; None after a finding."""
    want = target.unit
    if want is None or not unit.name or not want.name or unit == want:
        return Linear()
    if unit.base is None or want.base is None:
        if unit.name != want.name:
            undefined = unit.name if unit.base is None else want.name
            found = (
                f"a value in '{unit.name}' for {target.words} in '{want.name}' is not converted, because the unit "
                f"'{undefined}' is not defined"
            )
            problems.warn_once(("value", parameter.place.file, unit.name, want.name), parameter.place, found, "value")
        return Linear()
    change = conversion(unit.base, want.base, relative=target.is_relative)
    if change is None:
        found = f"a value in '{unit.name}' ({unit.base}) for {target.words} in '{want.name}' ({want.base})"
        problems.add(parameter.place, found, 'units of one dimension, or a mapping with suppressUnitConversion="true"')
    return change


def _transformed(
    value: AppliedValue, elements: list[Any], transformation: Transformation, target: ValueTarget
) -> tuple[AppliedValue, list[Any], str]:
    """A value after the transformation of its mapping (SSP 2.0, 4.5.2), and what was done in words."""
    entries = transformation.entries
    match transformation.kind:
        case "linear":
            if target.type is not None and not is_float(target.type):
                raise _Misfit("a Real variable: its mapping has a LinearTransformation")
            linear = Linear(transformation.factor, transformation.offset)
            return _linear(value, elements, linear, "its mapping has a LinearTransformation")
        case "boolean":
            if value.type != "Boolean":
                raise _Misfit("a Boolean: its mapping has a BooleanMappingTransformation")
            elements = [entries.get(str(one).lower(), str(one).lower()) == "true" for one in elements]
        case "integer":
            if value.type == "Boolean":
                raise _Misfit("a whole number: its mapping has an IntegerMappingTransformation")
            numbers = [_whole(one, value.items or target.items) for one in elements]
            elements = [int(entries.get(str(one), one)) for one in numbers]
            value = replace(value, type="Int64")
        case "enumeration":
            if value.type != "Enumeration":
                raise _Misfit("an Enumeration: its mapping has an EnumerationMappingTransformation")
            elements = [entries.get(one, one) for one in elements]
            value = replace(value, items={})
    return value, elements, "mapped by value"


def _as_target(value: AppliedValue, elements: list[Any], target: ValueTarget, how: str) -> AppliedValue:
    """A value with the type and the shape of a target."""
    if target.shape is not None and target.shape != value.shape:
        raise _Misfit(_number_of_values(target.shape))
    plain = to_plain(nested([_element(one, value, target) for one in elements], value.shape))
    return replace(value, value=plain, type=target.type or value.type, how=how, items=target.items or value.items)


def _element(element: Any, value: AppliedValue, target: ValueTarget) -> Any:  # noqa: ANN401  the type says which
    """One element as a value of the type of the target, without loss."""
    kind = target.type
    if kind is None:
        return element
    if is_float(kind):
        if isinstance(element, bool) or not isinstance(element, int | float):
            raise _Misfit("a number")
        if isinstance(element, int) and float(element) != element:
            raise _Misfit("a whole number that a floating-point number can hold")
        return float(element)
    if kind == "Enumeration":
        return _item(element, value, target)
    if kind in INTEGERS:
        number = _whole(element, value.items)
        if number not in INTEGERS[kind]:
            raise _Misfit(f"a whole number from {INTEGERS[kind][0]} to {INTEGERS[kind][-1]}")
        return number
    if value.type != kind:
        raise _Misfit(f"a value of type {kind}")
    return element


def _item(element: Any, value: AppliedValue, target: ValueTarget) -> str | int:  # noqa: ANN401  the type says which
    """An item of an Enumeration by its name, or by its number."""
    known = [f"{name} ({number})" for name, number in target.items.items()]
    expected = f"one of {listed(known)}" if known else "the number of an item"
    if value.type == "Enumeration" and isinstance(element, str):
        if element in target.items or not target.items:
            return element
        raise _Misfit(expected, nearest(element, target.items))
    if isinstance(element, bool) or not isinstance(element, int):
        raise _Misfit(expected)
    if target.items and element not in target.items.values():
        raise _Misfit(expected)
    return element


def _whole(element: Any, items: Mapping[str, int]) -> int:  # noqa: ANN401  the type says which
    """A whole number without loss: of a number, of true and false, of the name of an item."""
    if isinstance(element, bool | int):
        return int(element)
    if isinstance(element, float) and math.isfinite(element) and element == int(element):
        return int(element)
    if isinstance(element, str) and element in items:
        return items[element]
    raise _Misfit("a whole number")


def _mapped(element: Any, items: Mapping[str, int], mapping: Mapping[str, str]) -> Any:  # noqa: ANN401  any type
    """A value after the mapping of a connection; one that it does not name stays what it is."""
    match element:
        case bool():
            text = str(element).lower()
            return mapping.get(text, text) == "true"
        case str():
            number = str(items.get(element))
            return mapping[element] if element in mapping else int(mapping[number]) if number in mapping else element
        case float() if not element.is_integer():
            return element
        case _:
            return int(mapping.get(str(int(element)), element))


def _where(place: FilePlace, origin: FilePlace) -> str:
    """A place as somebody finds it who has found the origin of the value."""
    return f"line {place.line}" if place.file == origin.file else f"{PurePosixPath(place.file).name}:{place.line}"


def _calculated(elements: list[Any], linear: Linear) -> list[Any]:
    return elements if linear.identity else [linear.factor * one + linear.offset for one in elements]


def _linear(value: AppliedValue, elements: list[Any], linear: Linear, why: str) -> tuple[AppliedValue, list[Any], str]:
    """A number with a factor and an offset, and what was done in words: `2 * value + 10`."""
    if not is_float(value.type) and value.type not in INTEGERS:
        raise _Misfit(f"a number: {why}")
    text = "value" if linear.factor == 1.0 else f"{linear.factor:.12g} * value"
    if linear.offset != 0.0:
        text += f" {'+' if linear.offset > 0 else '-'} {abs(linear.offset):.12g}"
    return replace(value, type="Float64"), _calculated(elements, linear), text


_PARSERS: Final[dict[VariableType, Callable[[str], Any]]] = {
    "Float64": float,
    "Float32": float,
    "Boolean": lambda text: text in ("true", "1"),
    "String": str,
    "Enumeration": str,
    "Binary": lambda text: bytes.fromhex(text.strip()),
}
"""From the text of a value to the value; every other type is an integer."""
