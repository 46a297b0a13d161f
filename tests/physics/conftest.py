"""Fixtures of the tests about models of physics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fmus.helpers import extracted_fmu


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return the extracted folder of an FMU by its name."""
    base = tmp_path_factory.mktemp("physics_fmus")
    return lambda name: extracted_fmu(name, base)
