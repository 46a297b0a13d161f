"""What rows of results go into: a CSV, or whatever else a run is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..model.description import VariableType

__all__ = ["OpenResult", "ResultFile"]


class ResultFile(Protocol):
    """Takes rows in the order of their points, from point 0 on; `close` at the end.

    Attributes:
        path: the file.
        rows: rows written so far.
    """

    path: Path
    rows: int

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, which hold during the call only."""
        ...

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives the end of this process."""
        ...

    def close(self) -> None:
        """Write what is left and close the file."""
        ...


OpenResult = Callable[[Path, Sequence[tuple[str, VariableType]]], ResultFile]
"""Opens a result file with these columns, each (`instance.variable`, type)."""
