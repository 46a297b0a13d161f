"""What rows of results go into: a CSV, or whatever else a run is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..files import Kept
from ..variables.model_description import VariableType

__all__ = ["OpenResult", "ResultFile"]


class ResultFile(Protocol):
    """Takes rows in the order of their points, from point 0 on; `close` at the end.

    Until the first row is written, the path shows what was there before.
    """

    @property
    def path(self) -> Path:
        """The file."""
        ...

    @property
    def rows(self) -> int:
        """Rows written so far; once it is closed, those that are in the file, also where the disk was full."""
        ...

    @property
    def kept(self) -> Kept:
        """What the operating system has by now."""
        ...

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Append one row per time; ``columns`` are arrays of the same length, which hold during the call only."""
        ...

    def flush(self) -> None:
        """Hand everything to the operating system, so that it survives the end of this process."""
        ...

    def close(self) -> None:
        """Write what is left and close the file; without a row, nothing has changed."""
        ...


OpenResult = Callable[[Path, Sequence[tuple[str, VariableType]]], ResultFile]
"""Opens a result file with these columns, each (`instance.variable`, type)."""
