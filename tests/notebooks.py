"""Notebooks as a reader runs them: in a real kernel, cell after cell. What the tests of notebooks share."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
from nbclient import NotebookClient
from numpy.typing import NDArray
from PIL import Image

from tests.helpers import DEADLINE_S

__all__ = ["Executed", "assert_is_a_picture", "executed", "notebook_of"]


class Executed:
    """A notebook with its outputs.

    Attributes:
        cells: its cells of code.
        widgets: the last state of each widget, as a page has it; arrays are bytes.
    """

    def __init__(self, client: NotebookClient) -> None:
        self.cells: list[Any] = [cell for cell in client.nb.cells if cell.cell_type == "code"]
        self.widgets: dict[str, dict[str, Any]] = client.widget_state
        for model, buffers in client.widget_buffers.items():
            for path, found in buffers.items():
                *parents, last = path
                value: Any = self.widgets[model]
                for key in parents:
                    value = value[key]
                value[last] = base64.b64decode(found["data"])

    @property
    def outputs(self) -> list[Any]:
        """All outputs, in order."""
        return [output for cell in self.cells for output in cell.outputs]

    def shown(self, number: int) -> list[dict[str, Any]]:
        """What a cell shows, by MIME type, without the progress bars that have gone."""
        shown = [output.data for output in self.cells[number].outputs if "data" in output]
        return [data for data in shown if data != {"text/plain": ""}]


def notebook_of(cells: Sequence[str]) -> Any:  # noqa: ANN401  nbformat has no types
    """A notebook with these cells of code."""
    notebook = nbformat.v4.new_notebook()  # type: ignore[no-untyped-call]  # as above
    notebook.cells = [nbformat.v4.new_code_cell(cell) for cell in cells]  # type: ignore[no-untyped-call]  # as above
    return notebook


def executed(notebook: Any, folder: Path) -> Executed:  # noqa: ANN401  nbformat has no types
    """Run a notebook in a folder; a cell that raises is an error."""
    resources = {"metadata": {"path": str(folder)}}
    client = NotebookClient(notebook, timeout=DEADLINE_S, kernel_name="python3", resources=resources)
    client.execute()
    return Executed(client)


def assert_is_a_picture(png: str) -> NDArray[np.uint8]:
    """A picture of a cell is large enough to read, and not blank."""
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(png))).convert("L"))
    height, width = pixels.shape
    assert 600 <= width <= 1600
    assert 300 <= height <= 1600
    assert pixels.std() > 10.0
    return pixels
