"""The columns of a result as pyarrow has them, and back: their types, units, metadata and values.

The rows of an array are lists of one size, unless only some of its elements are recorded: these have a column each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError
from ..system.arrow import DIMENSIONS, elements_of, pyarrow_module
from ..variables.value_types import VariableType, element_name
from .recording import Columns, Recording, metadata_in

__all__ = [
    "KEY",
    "TIME",
    "array_of",
    "arrays_of",
    "arrow_array",
    "columns_of",
    "decoded",
    "no_result",
    "plain_schema",
    "schema_of",
]

KEY: Final = b"fmu_mesh"
"""Of the metadata."""

TIME: Final = "time"
_UNIT: Final = b"unit"
_ABOUT_TIME: Final = {"type": "Float64", "unit": "s"}

_ARROW_TYPES: Final[dict[VariableType, str]] = {"Enumeration": "int64", "Boolean": "bool_"}
"""Where the name of a type is another one than ours."""


def schema_of(recording: Recording) -> Any:  # noqa: ANN401  pyarrow has no types
    """The columns of a recording as pyarrow has them, with what is known of each variable."""
    pa = pyarrow_module()
    fields, recorded, place = [_time_field()], recording.recorded, 0
    while place < len(recorded):
        instance, name = recorded[place]
        variable = recording.variable(instance, name)
        about: dict[str, str] = {"type": variable.type}
        about |= {"causality": variable.causality, "variability": variable.variability}
        known = {"unit": variable.unit, "description": variable.description}
        about |= {key: text for key, text in known.items() if text is not None}
        if variable.items:
            about["items"] = msgspec.json.encode(dict(variable.items)).decode()
        arrow_type, end = _arrow_type(variable.type), place + variable.size
        is_first = bool(variable.shape) and name == element_name(variable.name, (0,) * len(variable.shape))
        if is_first and recorded[place:end] == tuple((instance, element) for element in variable.elements):
            arrow_type = pa.list_(pa.field("element", arrow_type, nullable=False), variable.size)
            about[DIMENSIONS.decode()] = msgspec.json.encode(variable.shape).decode()
            name, place = variable.name, end - 1
        fields.append(pa.field(f"{instance}.{name}", arrow_type, nullable=False, metadata=about))
        place += 1
    return pa.schema(fields, {KEY: msgspec.json.encode(recording.metadata)})


def plain_schema(types: Mapping[str, VariableType], columns: Columns) -> Any:  # noqa: ANN401  pyarrow has no types
    """The same for columns of which only the types, units and metadata are known."""
    pa = pyarrow_module()
    fields = [_time_field()]
    for name, type_ in types.items():
        about = {"type": type_} | ({"unit": columns.units[name]} if name in columns.units else {})
        fields.append(pa.field(name, _arrow_type(type_), nullable=False, metadata=about))
    return pa.schema(fields, {KEY: msgspec.json.encode(columns.metadata)})


def _time_field() -> Any:  # noqa: ANN401  pyarrow has no types
    pa = pyarrow_module()
    return pa.field(TIME, pa.float64(), nullable=False, metadata=_ABOUT_TIME)


def _arrow_type(type_: VariableType) -> Any:  # noqa: ANN401  pyarrow has no types
    return getattr(pyarrow_module(), _ARROW_TYPES.get(type_, type_.lower()))()


def arrow_array(values: NDArray[Any], type_: Any) -> Any:  # noqa: ANN401  pyarrow has no types
    """A copy of the values as pyarrow has it. `pyarrow.array` would import pandas, which takes half a second."""
    pa = pyarrow_module()
    if values.ndim > 1:
        elements = arrow_array(values.reshape(-1), type_.value_type)
        return pa.Array.from_buffers(type_, len(values), [None], null_count=0, children=[elements])
    if values.dtype == object:
        texts = [value.encode() if isinstance(value, str) else value for value in values.tolist()]
        ends = np.zeros(1 + len(texts), np.int32)
        np.cumsum([len(text) for text in texts], out=ends[1:])
        buffers = [ends, b"".join(texts)]
    elif values.dtype == np.bool_:
        buffers = [np.packbits(values, bitorder="little")]
    else:
        buffers = [values.copy()]
    return pa.Array.from_buffers(type_, len(values), [None, *map(pa.py_buffer, buffers)], null_count=0)


def columns_of(path: Path, schema: Any) -> tuple[Columns, list[tuple[str, ...]]]:  # noqa: ANN401  pyarrow has no types
    """The columns without rows, and the names of those of each field.

    Raises:
        ConfigurationError: the first column is not the time.
    """
    if not schema.names or schema.names[0] != TIME or not pyarrow_module().types.is_float64(schema[0].type):
        raise no_result(path, f"its first column is not '{TIME}' in float64")
    names = [elements_of(field) for field in schema]
    known = [(field.metadata or {}).get(_UNIT) for field in schema]
    units = {name: unit.decode() for unit, own in zip(known, names, strict=True) if unit is not None for name in own}
    return Columns(**arrays_of(schema.empty_table(), names), units=units, metadata=decoded(schema)), names


def arrays_of(batch: Any, names: Sequence[tuple[str, ...]]) -> dict[str, Any]:  # noqa: ANN401  pyarrow has no types
    """The times and values of a batch, as numpy has them; ``names`` are those of the columns of each field."""
    arrays: dict[str, NDArray[Any]] = {}
    for name, own, column in zip(batch.schema.names, names, batch.columns, strict=True):
        if own == (name,):
            arrays[name] = array_of(column)
        else:
            from pyarrow.compute import list_flatten  # noqa: PLC0415  an optional dependency, slow to import

            table = array_of(list_flatten(column)).reshape(len(column), len(own))
            arrays |= zip(own, np.ascontiguousarray(table.T), strict=True)
    return {"times": arrays.pop(TIME), "values": arrays}


def array_of(column: Any) -> NDArray[Any]:  # noqa: ANN401  pyarrow has no types
    """A column as numpy has it; `object` for texts and bytes."""
    types = pyarrow_module().types
    if types.is_string(column.type) or types.is_binary(column.type):
        return np.array([*column.to_pylist(), None], object)[:-1]  # never an array of more dimensions
    array: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return array


def decoded(container: Any) -> dict[str, Any]:  # noqa: ANN401  a schema of pyarrow, or the end of a file
    """The metadata of a run in it; empty if there are none."""
    return metadata_in((container.metadata or {}).get(KEY, b"{}"))


def no_result(path: Path, why: str) -> ConfigurationError:
    """The error for a file that is none of ours."""
    return ConfigurationError(f"'{path}' is no result file: {why}.".replace("..", "."))
