"""pyarrow, which is optional, and how it reads Parquet: without threads of its own.

By default, pyarrow decodes columns on threads that live until the process ends. They free bytes that belong to Python,
which needs its lock; while the interpreter ends, whoever waits for this lock is ended by force, and in the midst of C++
that is `terminate called without an active exception`: exit code 134 after the right answer. So nothing here starts a
thread, and files of results are opened nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from ..installing import importing
from ..variables.value_types import MAX_ELEMENTS, element_names

__all__ = [
    "DIMENSIONS",
    "elements_of",
    "open_parquet",
    "parquet_batches",
    "parquet_module",
    "places_of",
    "pyarrow_module",
    "values_at",
]

DIMENSIONS: Final = b"dimensions"
"""The metadata of a field that has all elements of an array, row by row, in lists of one size: `[2,3]`."""

_BATCH_VALUES: Final = 1 << 20
_LEAST_ROWS: Final = 8
"""A batch has about so many values, or so many rows if these are wide: each batch costs some time for each name."""


def pyarrow_module() -> Any:  # noqa: ANN401  an optional dependency
    """The module pyarrow.

    Raises:
        LibraryMissing: it is not installed.
    """
    with importing("pyarrow"):
        import pyarrow as pa  # noqa: PLC0415  an optional dependency
        from pyarrow import ipc  # noqa: F401, PLC0415  an optional dependency; `pa.ipc`
    return pa


def parquet_module() -> Any:  # noqa: ANN401  an optional dependency
    """The module pyarrow.parquet; see `pyarrow_module`."""
    pyarrow_module()
    from pyarrow import parquet  # noqa: PLC0415  slow to import, and writing rows does without

    return parquet


def open_parquet(source: Path | IO[bytes]) -> Any:  # noqa: ANN401  pyarrow has no types
    """A complete Parquet file, as pyarrow has it; its rows come from `parquet_batches`."""
    return parquet_module().ParquetFile(source, pre_buffer=False)


def parquet_batches(content: Any, columns: Sequence[str] | None = None) -> Iterator[Any]:  # noqa: ANN401  pyarrow has no types
    """The rows of a file from `open_parquet`; of these columns, if some are named."""
    fields = [field for field in content.schema_arrow if columns is None or field.name in columns]
    size = max(_LEAST_ROWS, _BATCH_VALUES // max(1, sum(getattr(field.type, "list_size", 1) for field in fields)))
    rows: Iterator[Any] = content.iter_batches(size, columns=columns, use_threads=False)
    return rows


def elements_of(field: Any) -> tuple[str, ...]:  # noqa: ANN401  pyarrow has no types
    """The names of the columns of a result that a field has: of an array one for each element, as `y[1,2]`.

    Raises:
        ValueError: its dimensions are not those of its lists.
    """
    about = field.metadata or {}
    if DIMENSIONS not in about or not pyarrow_module().types.is_fixed_size_list(field.type):
        return (field.name,)
    shape = msgspec.json.decode(about[DIMENSIONS], type=tuple[int, ...])
    if min(shape) < 1 or math.prod(shape) != field.type.list_size or field.type.list_size > MAX_ELEMENTS:
        raise ValueError(f"the dimensions {list(shape)} of '{field.name}' are wrong")
    return element_names(field.name, shape)


def places_of(schema: Any) -> dict[str, tuple[str, int | None]]:  # noqa: ANN401  pyarrow has no types
    """The field of each column of a result, and which element of its lists it is; None: it has no lists."""
    return {
        name: (field.name, index if name != field.name else None)
        for field in schema
        for index, name in enumerate(elements_of(field))
    }


def values_at(batch: Any, place: tuple[str, int | None]) -> Any:  # noqa: ANN401  pyarrow has no types
    """The values at one of the `places_of` a batch or a table, as pyarrow has them."""
    from pyarrow import compute  # noqa: PLC0415  an optional dependency

    name, index = place
    return batch.column(name) if index is None else compute.list_element(batch.column(name), index)
