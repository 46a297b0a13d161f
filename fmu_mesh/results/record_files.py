"""The result files of a run: each gets its own columns, at its own points, from the same rows.

Knows neither where the values come from nor any format: `fmu_mesh.results.formats` finds it by the name of the file.

A run in processes keeps a note for each file in its folder: how many rows the operating system has. The launcher reads
it if the process that writes was killed, to cut the file off after its last whole row. The note is written before the
first row. So while it is empty, the result file is not that of this run.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from msgspec import to_builtins
from msgspec.structs import replace
from numpy.typing import NDArray

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError, DeadlineExceeded
from ..files import Kept, is_file, open_alone, unwritable
from ..simtime import TimeGrid
from ..system.coupling_rule import Consistent
from ..system.defect import Defect
from ..system.live_keys import KeyValue
from ..system.records import IN_MEMORY, RecordPlan, record_paths
from ..system.run_metadata import metadata_of
from ..system.system import ResolvedSystem
from .defects import DefectWatch
from .formats import goes_on, reading, required_format
from .growth import GrowthWatch, ReadColumn
from .keys_file import KeysFile, keys_beside
from .recording import Recording, ResultFile
from .resumed_file import opened_again

__all__ = ["ReadColumn", "RecordFiles", "open_result", "open_results", "rows_after", "rows_left", "what_is_kept"]

_NOTE = struct.Struct("<qq")


def open_results(
    loaded: LoadedConfig,
    system: ResolvedSystem,
    *,
    digest: str = "",
    contents: Mapping[str, str] = {},
    rows: Sequence[int] = (),
) -> list[ResultFile]:
    """Open the result files of a run, in their order; none if nothing is recorded.

    Their metadata have the digest of the mesh and the SHA-256 of the model of each instance (``contents``). Without a
    digest they have no metadata, which saves milliseconds. If the run starts again, ``rows`` has the number of rows
    that each file has of it.

    Raises:
        ConfigurationError: a file cannot be written, or another run is writing it. All files are as they were.
    """
    descriptions = {name: instance.description for name, instance in system.instances.items()}
    places = {str(file): place for place, file in record_paths(loaded).items()}
    files: list[ResultFile] = []
    try:
        for number, record in enumerate(system.records):
            place = places.get(record.file, "record")
            recording = Recording(loaded, descriptions, record.variables, place, record.first, record.every)
            if digest:
                metadata = metadata_of(loaded, system, record, digest=digest, contents=contents)
                recording = replace(recording, metadata=to_builtins(metadata) | _keys_of(system, record.file))
            there = rows[number] if number < len(rows) else 0
            skipped = record.rows_before(system.grid.first_point)
            files.append(opened_again(Path(record.file), recording, there, skipped))
    except BaseException:
        for file in files:
            with suppress(OSError):
                file.close()
        raise
    return files


def _keys_of(system: ResolvedSystem, result: str) -> dict[str, str]:
    """Where the values of keys are that a run gets from an earlier one: its own results can be repeated, too."""
    own = system.recorded_keys
    return {"keys": os.path.relpath(own.path, Path(result).parent)} if own and own.path != os.devnull else {}


def open_result(loaded: LoadedConfig, system: ResolvedSystem) -> ResultFile:
    """Open the first result file of one of many runs, without metadata; the errors are those of `open_results`."""
    return open_results(loaded, replace(system, records=system.records[:1]))[0]


Result = TypeVar("Result")


class RecordFiles:
    """The open result files of a run.

    Call sequence: `begin`, then `write` and `flush` from one thread at a time; at the end, and after any exception,
    `close`. A file that cannot be written is only closed then; all others get their rows as before. `begin_again` is
    for another run whose values are read in the same way.

    Args:
        files: the files, in the order of their plans.
        growth: looks at all rows; ``defects`` as well.
        notes: the folder of the run, if somebody calls `rows_left` when this process was killed.

    Attributes:
        in_memory: whether no file has a path.
    """

    def __init__(
        self,
        files: Sequence[ResultFile],
        growth: GrowthWatch | None = None,
        notes: Path | None = None,
        defects: DefectWatch | None = None,
    ) -> None:
        self._growth, self._defects = growth, defects
        self._writing: tuple[Path] | None = None  # the file of the call under way, another tuple for each
        self._watched: tuple[tuple[Path] | None, float] = None, 0.0
        self._files = [
            _RecordFile(file, notes / _note_of(number) if notes is not None else None)
            for number, file in enumerate(files)
        ]
        self._begin_files()

    def _begin_files(self) -> None:
        self._events: dict[str, dict[str, Any]] = {}
        paths = [own.file.path for own in self._files]
        self.in_memory = not any(path.name for path in paths)
        self._keys = KeysFile(paths[0]) if paths and paths[0].name else None

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the rows so far warn of."""
        failed = {**self._events.get("held", {}), **self._events.get("disabled", {})}
        told = tuple(f"{name}, from point {own['point']} on: {own['message']}" for name, own in failed.items())
        return (*told, *(self._growth.warnings if self._growth is not None else ()))

    @property
    def defects(self) -> dict[str, Defect]:
        """Of each compared connection, how far what came in the rows so far was from what was assumed."""
        return self._defects.defects if self._defects is not None else {}

    @property
    def counted(self) -> tuple[tuple[str, int], ...]:
        """The path and the number of rows of each file; after `close`, of those in the file."""
        return tuple((str(own.file.path), own.file.rows) for own in self._files)

    @property
    def kept(self) -> tuple[Kept, ...]:
        """Of each file, what the operating system has (`ResultFile.kept`)."""
        return tuple(own.file.kept for own in self._files)

    def begin(self, grid: TimeGrid, records: Sequence[RecordPlan], column_of: Callable[[str, str], ReadColumn]) -> None:
        """Choose what the files get; ``column_of`` says how the values of a variable of an instance are read."""
        columns: dict[tuple[str, str], ReadColumn] = {}
        for own, record in zip(self._files, records, strict=True):
            for key in record.variables:
                if key not in columns:
                    own_sum = record.consistent.get(".".join(key))
                    columns[key] = column_of(*key) if own_sum is None else _sum(column_of, own_sum)
            own.begin(grid, record, [columns[key] for key in record.variables])
        if self._growth is not None:
            self._growth.begin(columns)
        if self._defects is not None:
            self._defects.begin(partial(_sum, column_of))

    def begin_again(self, files: Sequence[ResultFile]) -> None:
        """Another run begins, with as many files for the same columns."""
        for own, file in zip(self._files, files, strict=True):
            own.begin_again(file)
        self._begin_files()
        if self._growth is not None:
            self._growth.begin_again()
        if self._defects is not None:
            self._defects.begin_again()

    def write(self, first: int, end: int) -> None:
        """Write the rows of the points first to end - 1, as far as they are not written yet.

        Raises:
            ConfigurationError: a file cannot be written; the others have their rows.
        """
        if self._growth is not None:
            self._growth.look(first, end)
        if self._defects is not None:
            self._defects.look(first, end)
        if self._keys is not None:
            self._keep(self._keys.begin)
        self._each(lambda own: own.write(first, end))

    def note(self, entry: Mapping[str, Any]) -> None:
        """Add what happened to the metadata of all files; the errors are those of `write`."""
        self._each(lambda own: own.file.note(entry))

    def note_event(self, what: str, instance: str, point: int, message: str) -> None:
        """Add to the metadata what has turned out at a point: see `Noted`.

        The errors are those of `write`.
        """
        self._events[what] = {**self._events.get(what, {}), instance: {"point": point, "message": message}}
        self.note({what: self._events[what]})

    def keep(self, values: Sequence[KeyValue]) -> None:
        """Keep values that have come by keys, beside the first file; the errors are those of `write`."""
        if self._keys is not None:
            self._keep(partial(self._keys.add, values))

    def _keep(self, write: Callable[[], str | None]) -> None:
        first = self._files[0].file.path
        try:
            name = self.write_to(keys_beside(first), write)
        except OSError as error:
            raise unwritable(keys_beside(first), error) from error
        if name is not None:
            for own in self._files:
                own.file.note({"keys": os.path.relpath(first.with_name(name), own.file.path.parent)})

    def flush(self) -> None:
        """Give all rows to the operating system; the errors are those of `write`."""
        self._each(_RecordFile.flush)

    def close(self) -> None:
        """Close all files. Nothing happens if they are closed. The errors are those of `write`."""
        if self._keys is not None:
            self._keys.close()
        try:
            if defects := to_builtins(self.defects):
                self.note({"defects": defects})
        finally:
            self._raise_first([(own, self.write_to(own.file.path, own.close)) for own in self._files])

    def check_writing(self, now: float, limit_s: float) -> None:
        """From another thread, at least twice a second: look whether each call returns in time; ``now`` is in s.

        Raises:
            DeadlineExceeded: one has not returned for ``limit_s``. Its thread stays in it.
        """
        writing, (watched, since) = self._writing, self._watched
        if writing is not watched:
            self._watched = writing, now
        elif writing is not None and now - since > limit_s:
            text = f"'{writing[0]}' has not taken what the recorder writes for {now - since:.1f} s"
            raise DeadlineExceeded(text, hint="Does its file system answer? `timeouts.write` limits it.")

    def _each(self, call: Callable[[_RecordFile], None]) -> None:
        """Do something with each file that can be written; then raise the first error."""
        if any(errors := [self.write_to(own.file.path, partial(own.tried, call)) for own in self._files]):
            self._raise_first([*zip(self._files, errors, strict=True)])

    def write_to(self, path: Path, call: Callable[[], Result]) -> Result:
        """Write or close something, which `check_writing` looks at; returns what ``call`` returns."""
        self._writing = (path,)
        try:
            return call()
        finally:
            self._writing = None

    @staticmethod
    def _raise_first(done: Sequence[tuple[_RecordFile, OSError | None]]) -> None:
        for own, error in done:
            if error is not None:
                raise unwritable(own.file.path, error) from error


def _sum(column_of: Callable[[str, str], ReadColumn], consistent: Consistent) -> ReadColumn:
    """A function that calculates a consistent output from the columns that it depends on."""
    terms = [(column_of(term.instance, term.column), term.factor) for term in consistent.terms]
    (read_first, factor), *others = terms
    if not others and (factor, consistent.constant) == (1.0, 0.0):
        return read_first

    def read(first: int, end: int) -> NDArray[Any]:
        with np.errstate(all="ignore"):  # the row that is not finite ends the run
            total = read_first(first, end) * factor + consistent.constant
            for read_one, times in others:
                total += read_one(first, end) * times
        return total

    return read


class _RecordFile:
    """One of the files. After its first error nothing more is written, and no other error is returned."""

    def __init__(self, file: ResultFile, note: Path | None) -> None:
        self.file = file
        self._failed = False
        self._is_open = True
        self._next = 0
        self._columns: Sequence[ReadColumn] = ()
        self._rows, self._times = (0, 0), np.zeros(0)
        # Opening is slow, so not with the first row. After a reset, the note of the run before is there.
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        self._note = os.open(note, flags, 0o600) if note is not None else None
        self._noted: Kept | None = None

    def begin(self, grid: TimeGrid, record: RecordPlan, columns: Sequence[ReadColumn]) -> None:
        """See `RecordFiles.begin`."""
        self._grid, self._record, self._columns = grid, record, columns
        self._has_all_points = (record.first, record.every) == (0, 1)

    def begin_again(self, file: ResultFile) -> None:
        """See `RecordFiles.begin_again`."""
        self.file, self._failed, self._is_open, self._next, self._noted = file, False, True, 0, None

    def tried(self, call: Callable[[_RecordFile], None]) -> OSError | None:
        """The error of a call that writes; nothing is called after the first error, or after the end."""
        if self._failed or not self._is_open:
            return None
        try:
            call(self)
        except OSError as error:
            self._failed = True
            return error
        return None

    def write(self, first: int, end: int) -> None:
        """See `RecordFiles.write`."""
        first = max(first, self._next)
        if first >= end or not self._columns:
            return
        rows = self._record.rows_within(first, end)
        if (first, end) != self._rows:  # in short runs one after another, these are the same
            self._rows, self._times = (first, end), self._grid.times(first, end)[rows]
            self._times.setflags(write=False)
        if len(times := self._times):
            if self._noted is None:
                self._note_kept(Kept())
            columns = [column(first, end) for column in self._columns]
            if not self._has_all_points:  # a slice of each of thousands takes its time
                columns = [column[rows] for column in columns]
            self.file.write(times, columns)
            self._note_kept(self.file.kept)
        self._next = end

    def flush(self) -> None:
        """See `RecordFiles.flush`."""
        self.file.flush()
        if self._noted is not None:
            self._note_kept(self.file.kept)

    def close(self) -> OSError | None:
        """See `RecordFiles.close`."""
        if not self._is_open:
            return None
        self._is_open = False
        try:
            try:
                self.file.close()
            finally:
                if self._noted is not None:
                    self._note_kept(self.file.kept)
                if self._note is not None:
                    os.close(self._note)
        except OSError as error:
            return error if not self._failed else None
        return None

    def _note_kept(self, kept: Kept) -> None:
        if self._note is not None and kept != self._noted:
            os.pwrite(self._note, _NOTE.pack(*kept), 0)
        self._noted = kept


def rows_left(result_files: Sequence[str], folder: Path) -> tuple[tuple[str, int], ...]:
    """Each result file of a killed process, and the number of rows in it. What follows the last row is cut off.

    ``folder`` is that of the run, with the notes.
    """
    return tuple((file, _rows_left(Path(file), folder / _note_of(number))) for number, file in enumerate(result_files))


def rows_after(path: Path, kept: Kept) -> int:
    """Cut a result file back to what the disk had (``kept``), or to what it has of it; returns the number of its rows.

    A file of a format that cannot go on begins again, and has 0.

    Raises:
        ConfigurationError: it is damaged, another run writes it, or it cannot be written.
    """
    format_ = required_format(path)
    if not kept.rows or not goes_on(path):
        return 0
    growing = format_.growing_file(path)
    with reading(path), open_alone(growing, path):
        if growing.is_file() and growing.stat().st_size >= kept.size > 0:
            os.truncate(growing, kept.size)
            return format_.keep_whole_rows(path, kept)
        return format_.keep_whole_rows(path, Kept()) if is_file(growing) or is_file(path) else 0


def what_is_kept(files: Sequence[tuple[str, int]]) -> str | None:
    """The sentence for a run that ended early, and left these numbers of rows; None if there are none."""
    kept = [(where, rows) for file, rows in files if rows and (where := _where(file)) is not None]
    if not kept:
        return None
    if kept[0][0].endswith(f"{IN_MEMORY}'"):
        return f"What was recorded up to then ({kept[0][1]} rows) is in the `result` of this error."
    if len(kept) == 1:
        return f"What was recorded up to then ({kept[0][1]} rows) is in {kept[0][0]}."
    *others, last = [f"{where} ({rows} rows)" for where, rows in kept]
    return f"What was recorded up to then is in {', '.join(others)} and {last}."


def _where(file: str) -> str | None:
    """Where the rows of a result file are, in words; None if there is no such file."""
    path = Path(file)
    growing = required_format(path).growing_file(path)
    if growing != path and growing.is_file():
        return f"'{growing}', from which `fmu-mesh recover {path}` makes the result"
    return f"'{file}'" if path.is_file() else None


def _note_of(number: int) -> str:
    """The name of the note about a result file."""
    return f"recorded.{number}" if number else "recorded"


def _rows_left(path: Path, note: Path) -> int:
    if path.exists() and not path.is_file():
        return 0  # a device keeps nothing
    try:
        kept = Kept(*_NOTE.unpack(note.read_bytes()))
    except (FileNotFoundError, struct.error):
        kept = None
    format_ = required_format(path)
    growing = format_.growing_file(path)
    # Opening the file makes sure that no other run is writing it, and removes a draft that the process has left.
    with suppress(ConfigurationError), reading(path), open_alone(growing):
        if kept is not None and growing.is_file() and growing.stat().st_size >= kept.size:  # or it is another file
            return format_.keep_whole_rows(path, kept)
    return 0
