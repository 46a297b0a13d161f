"""The result files of a run: opened in their formats, counted after their writer was killed.

Knows no format: `fmu_mesh.results.recording` finds the format by the name of the file.

A run in processes keeps a note for each file in its folder: how many rows the operating system has. The note is written
before the first row. So while it is empty, the result file is not that of this run.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins
from msgspec.structs import replace
from numpy.typing import NDArray

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError
from ..files import Kept, open_alone
from .arrays_file import ENDING
from .recording import Recording, ResultFile, ResultFormat, reading, result_format
from ..system.records import record_paths
from ..system.run_metadata import metadata_of
from ..system.system import ResolvedSystem

__all__ = ["open_result", "open_results", "rows_left", "what_is_kept"]

_NAME = "recorded"
_NOTE = struct.Struct("<qq")


def open_results(
    loaded: LoadedConfig,
    system: ResolvedSystem,
    folder: Path | None = None,
    *,
    digest: str = "",
    contents: Mapping[str, str] = {},
) -> list[ResultFile]:
    """Open the result files of a run, in their order; none if nothing is recorded.

    Args:
        loaded: the configuration.
        system: the system of this configuration.
        folder: the folder of the run, if somebody calls `rows_left` when this process was killed.
        digest: the digest of the mesh, for the metadata; without it the files have none.
        contents: the SHA-256 of the model of each instance, for the metadata.

    Raises:
        ConfigurationError: a file cannot be written, or another run is writing it. All files are as they were.
    """
    files: list[ResultFile] = []
    try:
        for number, (record, recording) in enumerate(zip(system.records, _recordings(loaded, system), strict=True)):
            path = Path(record.file)
            if digest:
                metadata = metadata_of(loaded, system, record, digest=digest, contents=contents)
                recording = replace(recording, metadata=to_builtins(metadata))  # noqa: PLW2901  with what belongs to it
            file = _format(path).open(path, recording)
            files.append(_NotedFile(file, folder / _note_of(number)) if folder is not None else file)
    except BaseException:
        for file in files:
            with suppress(OSError):
                file.close()
        raise
    return files


def open_result(loaded: LoadedConfig, system: ResolvedSystem) -> ResultFile:
    """Open the first result file of one of many runs; the system has one. It has no metadata, which take milliseconds.

    Raises:
        ConfigurationError: the file cannot be written, or another run is writing it.
    """
    (file,) = open_results(loaded, replace(system, records=system.records[:1]))
    return file


def rows_left(result_files: Sequence[str], folder: Path) -> tuple[tuple[str, int], ...]:
    """Each result file of a killed process, and the number of rows in it. What follows the last row is cut off.

    Args:
        result_files: paths of the files.
        folder: the folder of the run.
    """
    return tuple((file, _rows_left(Path(file), folder / _note_of(number))) for number, file in enumerate(result_files))


def what_is_kept(files: Sequence[tuple[str, int]]) -> str | None:
    """The sentence for a run that ended early and left rows; None if there are no rows, as on a device.

    Args:
        files: each result file, and the number of its rows.
    """
    kept = [(where, rows) for file, rows in files if rows and (where := _where(file)) is not None]
    if not kept:
        return None
    if kept[0][0].endswith(f"{ENDING}'"):
        return f"What was recorded up to then ({kept[0][1]} rows) is in the `result` of this error."
    if len(kept) == 1:
        return f"What was recorded up to then ({kept[0][1]} rows) is in {kept[0][0]}."
    *others, last = [f"{where} ({rows} rows)" for where, rows in kept]
    return f"What was recorded up to then is in {', '.join(others)} and {last}."


def _where(file: str) -> str | None:
    """Where the rows of a result file are, in words; None if there is no such file."""
    path = Path(file)
    growing = _format(path).growing_file(path)
    if growing != path and growing.is_file():
        return f"'{growing}', from which `fmu-mesh recover {path}` makes the result"
    return f"'{file}'" if path.is_file() else None


def _note_of(number: int) -> str:
    """The name of the note about a result file."""
    return f"{_NAME}.{number}" if number else _NAME


def _rows_left(path: Path, note: Path) -> int:
    if path.exists() and not path.is_file():
        return 0  # a device keeps nothing
    try:
        kept = Kept(*_NOTE.unpack(note.read_bytes()))
    except (FileNotFoundError, struct.error):
        kept = None
    growing = _format(path).growing_file(path)
    # Opening the file makes sure that no other run is writing it, and removes a draft that the process has left.
    with suppress(ConfigurationError), reading(path), open_alone(growing):
        if kept is not None and growing.is_file() and growing.stat().st_size >= kept.size:  # or it is another file
            return _format(path).keep_whole_rows(path, kept)
    return 0


def _format(path: str | Path) -> ResultFormat:
    found = result_format(path)
    if found is None:  # it was there when the configuration was checked
        raise ConfigurationError(f"no installed package writes the format of '{path}'")
    return found


def _recordings(loaded: LoadedConfig, system: ResolvedSystem) -> Iterator[Recording]:
    """What each result file holds."""
    descriptions = {name: instance.description for name, instance in system.instances.items()}
    places = {str(file): place for place, file in record_paths(loaded).items()}
    for record in system.records:
        place = places.get(record.file, "record")
        yield Recording(loaded, descriptions, record.variables, place, record.first, record.every)


class _NotedFile:
    """A result file that notes in the folder of the run how many of its rows the operating system has.

    Args:
        file: the result file; it is closed with this.
        note: the file of the note.
    """

    def __init__(self, file: ResultFile, note: Path) -> None:
        self._file = file
        self._descriptor = os.open(note, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)  # slow, so not later
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
