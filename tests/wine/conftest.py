"""Each worker of a test session has a prefix of Wine of its own: its server is no process of another worker's test."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from fmu_mesh.instances.fmi.wine import wine_environment, wine_program
from tests.fmus.helpers import session_folder


@pytest.fixture(scope="module", autouse=True)
def own_cache() -> Iterator[None]:
    """The cache of this worker, with the prefix: a launch says nothing of it."""
    with pytest.MonkeyPatch.context() as patch:
        worker = os.environ.get("PYTEST_XDIST_WORKER", "alone")
        patch.setenv("FMU_MESH_CACHE_DIR", str(session_folder() / f"cache_{worker}"))
        if wine_program() is not None:
            wine_environment()
        yield
