"""The result file of a run: checked before the run, opened in its format, counted after its writer was killed.

Knows no format: `fmu_mesh.system.recording` finds the format by the name of the file.

A run in processes keeps a note in its folder: how many rows the operating system has. The note is written before the
first row. So while it is empty, the result file is not that of this run.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError
from ..files import Kept, open_alone
from ..recorder.arrays_file import ENDING
from ..system.recording import Recording, ResultFile, ResultFormat, result_format
from ..system.system import ResolvedSystem

__all__ = ["check_results", "open_result", "rows_left", "what_is_kept"]

_NAME = "recorded"
_NOTE = struct.Struct("<qq")


def check_results(loaded: LoadedConfig, system: ResolvedSystem) -> None:
    """Check that the result file can hold what is recorded.

    Raises:
        ConfigurationError: it cannot; carries all findings.
    """
    if system.result_file is not None:
        findings = loaded.findings()
        _format(system.result_file).check(_recording(loaded, system), findings)
        findings.raise_any()


def open_result(loaded: LoadedConfig, system: ResolvedSystem, folder: Path | None = None) -> ResultFile:
    """Open the result file of a run.

    Args:
        loaded: the configuration.
        system: the system of this configuration; it has a result file.
        folder: the folder of the run, if somebody calls `rows_left` when this process was killed.

    Raises:
        ConfigurationError: the file cannot be written, or another run is writing it.
    """
    assert system.result_file is not None
    path = Path(system.result_file)
    file = _format(path).open(path, _recording(loaded, system))
    return _NotedFile(file, folder) if folder is not None else file


def rows_left(result_file: str, folder: Path) -> int:
    """The number of rows that a killed process has left in its result file. What follows the last row is cut off.

    Args:
        result_file: path of the file.
        folder: the folder of the run.
    """
    path = Path(result_file)
    if path.exists() and not path.is_file():
        return 0  # a device keeps nothing
    try:
        kept = Kept(*_NOTE.unpack((folder / _NAME).read_bytes()))
    except (FileNotFoundError, struct.error):
        kept = None
    growing = _format(path).growing_file(path)
    # Opening the file makes sure that no other run is writing it, and removes a draft that the process has left.
    with suppress(ConfigurationError, OSError), open_alone(growing):
        if kept is not None and growing.is_file() and growing.stat().st_size >= kept.size:  # or it is another file
            return _format(path).keep_whole_rows(path, kept)
    return 0


def what_is_kept(result_file: str | None, rows: int) -> str | None:
    """The sentence for a run that ended early and left rows; None if there are no rows, as on a device."""
    if not rows or result_file is None:
        return None
    path = Path(result_file)
    if result_file.endswith(ENDING) and path.is_file():
        return f"What was recorded up to then ({rows} rows) is in the `result` of this error."
    growing = _format(path).growing_file(path)
    if growing != path and growing.is_file():
        return (
            f"What was recorded up to then ({rows} rows) is in '{growing}': `fmu-mesh recover {path}` makes the file."
        )
    return f"What was recorded up to then ({rows} rows) is in '{result_file}'." if path.is_file() else None


def _format(path: str | Path) -> ResultFormat:
    found = result_format(path)
    if found is None:  # it was there when the configuration was checked
        raise ConfigurationError(f"no installed package writes the format of '{path}'")
    return found


def _recording(loaded: LoadedConfig, system: ResolvedSystem) -> Recording:
    descriptions = {name: instance.description for name, instance in system.instances.items()}
    return Recording(loaded, descriptions, system.recorded)


class _NotedFile:
    """A result file that notes in the folder of the run how many of its rows the operating system has.

    Args:
        file: the result file; it is closed with this.
        folder: the folder of the run.
    """

    def __init__(self, file: ResultFile, folder: Path) -> None:
        self._file = file
        self._descriptor = os.open(folder / _NAME, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)  # slow, so not later
        self._noted: Kept | None = None

    @property
    def path(self) -> Path:
        return self._file.path

    @property
    def rows(self) -> int:
        return self._file.rows

    @property
    def kept(self) -> Kept:
        return self._file.kept

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        if self._noted is None:
            self._note(Kept())
        self._file.write(times, columns)
        self._note_kept()

    def note(self, entry: Mapping[str, Any]) -> None:
        self._file.note(entry)

    def flush(self) -> None:
        self._file.flush()
        self._note_kept()

    def close(self) -> None:
        try:
            self._file.close()
        finally:
            self._note_kept()
            os.close(self._descriptor)

    def _note_kept(self) -> None:
        if self._noted is not None and (kept := self._file.kept) != self._noted:
            self._note(kept)

    def _note(self, kept: Kept) -> None:
        self._noted = kept
        os.pwrite(self._descriptor, _NOTE.pack(*kept), 0)
