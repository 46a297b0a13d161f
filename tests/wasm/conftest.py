"""Without what a sandbox needs, its tests are skipped; otherwise all of a session share what is compiled."""

from __future__ import annotations

import importlib.util

import pytest

from tests.fmus.helpers import session_folder

MISSING = [name for name in ("wasmtime", "ziglang") if importlib.util.find_spec(name) is None]


@pytest.fixture(autouse=True)
def compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler makes its C library for WebAssembly once, which takes longer than all tests."""
    if MISSING:
        pytest.skip(f"{' and '.join(MISSING)} is not installed")
    monkeypatch.setenv("FMU_MESH_CACHE_DIR", str(session_folder() / "wasm"))
