"""Where tests of the library run: in a place of their own, which is empty again at the end."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers import Place


@pytest.fixture(autouse=True)
def folder(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory of a program that uses the library; nothing of its runs is left at the end."""
    for name in ("FMU_MESH_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.setenv(name, place.environment[name])
    monkeypatch.chdir(place.folder)
    yield place.folder
    place.assert_nothing_left(10.0)
