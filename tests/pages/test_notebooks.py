"""The notebooks of the examples run as they are, and show what they say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import nbformat
import pytest

from tests.helpers import Place
from tests.notebooks import Executed, assert_is_a_picture, executed
from tests.pages.blocks import ROOT

FOLDER = ROOT / "examples" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.fixture
def clone(place: Place, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that looks like a clone, with the folder of the notebooks."""
    for name in ("FMU_MESH_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.setenv(name, place.environment[name])
    shutil.copytree(FOLDER, place.folder / "examples" / "notebooks")
    (place.folder / "fmus").symlink_to(ROOT / "fmus")
    return place.folder / "examples" / "notebooks"


def run(clone: Path, name: str) -> Executed:
    return executed(nbformat.read(clone / name, as_version=4), clone)  # type: ignore[no-untyped-call]  # it has no types


def pictures(found: Executed) -> list[Any]:
    return [output.data["image/png"] for output in found.outputs if "image/png" in output.get("data", {})]


def assert_is_short(found: Executed) -> None:
    """No cell shows more text than a page holds, and none of it is an error."""
    for output in found.outputs:
        assert output.output_type in {"display_data", "execute_result", "stream"}
        assert output.get("name") != "stderr", output.text
        for kind, text in output.get("data", {}).items():
            assert kind == "image/png" or len(str(text)) < 8_000, (kind, str(text)[:200])


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_kept_without_its_outputs(notebook: Path) -> None:
    content = json.loads(notebook.read_text(encoding="utf-8"))

    code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
    nbformat.validate(nbformat.from_dict(content))  # type: ignore[no-untyped-call]  # it has no types


def test_the_first_mesh_shows_tables_a_graph_two_pictures_and_live_cell(clone: Path) -> None:
    found = run(clone, "first_mesh.ipynb")

    assert_is_short(found)
    assert [assert_is_a_picture(png).shape[1] > 1000 for png in pictures(found)] == [True, True]
    html = [output.data["text/html"] for output in found.outputs if "text/html" in output.get("data", {})]
    assert sum("<table>" in one for one in html) >= 5
    [graph] = [one for one in html if "<svg" in one]
    assert 'data-instance="pendulum"' in graph
    [view] = [state for state in found.widgets.values() if "curves" in state]
    assert view["state"] == "ended"
    assert [curve["name"] for curve in view["curves"]][-1] == "delay.y"


def test_the_study_finds_the_pendulum_that_was_measured(clone: Path) -> None:
    found = run(clone, "study.ipynb")

    assert_is_short(found)
    assert len([assert_is_a_picture(png) for png in pictures(found)]) == 3
    texts = [output.data["text/plain"] for output in found.outputs if "data" in output]
    assert "<SweepResult of 'study': 42 of 42 runs, 0 failed>" in texts
    assert "{'pendulum.l': 1.23, 'pendulum.d': 0.17}" in texts
    assert not list(clone.glob("*sweep*"))
