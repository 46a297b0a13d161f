"""The folder of a mesh whose processes are started by hand: each enters it and leaves it whenever it likes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.wire.runtime import (
    MeshNote,
    enter_run_folder,
    leave_run_folder,
    remove_stale_folders,
    run_folder,
    write_note,
)
from tests.helpers import DEADLINE_S

_VISITS = 400
_PROCESSES = 4

# What a node does, and what a launcher does that starts meanwhile.
_VISITOR = f"""
import os
from fmu_mesh.wire.runtime import enter_run_folder, leave_run_folder, remove_stale_folders, run_folder
for visit in range({_VISITS}):
    folder = run_folder("shared", "hand")
    enter_run_folder(folder, f"node{{os.getpid()}}")
    remove_stale_folders()
    assert [*folder.glob(f"{{os.getpid()}}.*.pid")]
    leave_run_folder(folder)
"""


def test_who_enters_while_last_one_leaves_has_folder_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path))
    visitors = [
        subprocess.Popen([sys.executable, "-c", _VISITOR], stderr=subprocess.PIPE, text=True) for _ in range(_PROCESSES)
    ]
    ends = [visitor.communicate(timeout=DEADLINE_S) for visitor in visitors]

    assert [(visitor.returncode, errors) for visitor, (_, errors) in zip(visitors, ends, strict=True)] == [
        (0, "")
    ] * _PROCESSES
    assert [*tmp_path.iterdir()] == []


def test_a_folder_that_is_in_use_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FMU_MESH_RUNTIME_DIR", str(tmp_path))
    folder = run_folder("shared", "hand")
    enter_run_folder(folder, "node")

    remove_stale_folders()
    assert folder.is_dir()

    leave_run_folder(folder)
    leave_run_folder(folder)  # it is not there any more
    assert not folder.exists()


def test_a_note_that_cannot_be_written_is_a_readable_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"no file can be made in the runtime folder .*: No such file"):
        write_note(tmp_path / "gone", MeshNote("mesh", "prefix", (), 1, "file"))
