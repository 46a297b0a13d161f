"""pyarrow, which is optional, and how it reads Parquet: without threads of its own.

By default, pyarrow decodes columns on threads that live until the process ends. They free bytes that belong to Python,
which needs its lock; while the interpreter ends, whoever waits for this lock is ended by force, and in the midst of C++
that is `terminate called without an active exception`: exit code 134 after the right answer. So nothing here starts a
thread, and files of results are opened nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Final

from ..errors import ConfigurationError

__all__ = ["open_parquet", "parquet_batches", "parquet_module", "pyarrow_module"]

_BATCH_VALUES: Final = 1 << 20
"""A batch has about so many values."""


def pyarrow_module() -> Any:  # noqa: ANN401  an optional dependency
    """The module pyarrow.

    Raises:
        ConfigurationError: it is not installed.
    """
    try:
        import pyarrow as pa  # noqa: PLC0415  an optional dependency
        from pyarrow import ipc  # noqa: F401, PLC0415  an optional dependency; `pa.ipc`
    except ImportError as error:
        raise ConfigurationError(
            "results in .parquet need the package pyarrow", hint="Install it: pip install 'fmu-mesh[parquet]'."
        ) from error
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
    size = max(1, _BATCH_VALUES // len(columns or content.schema_arrow.names))
    rows: Iterator[Any] = content.iter_batches(size, columns=columns, use_threads=False)
    return rows
