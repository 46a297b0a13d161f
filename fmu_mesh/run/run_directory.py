"""The directory of `recovery`: what `--resume` needs to go on with a run, also after a power cut.

It has `run`, which says what must agree; `on_disk`, which says what the disk had for sure; the newest checkpoints; and
the journals of the master and of all nodes. Each line in them has a checksum. The folder of a run has nothing of it:
its processes remove that folder, also when the launcher was killed.
"""

# Who meets here (ADR 91). The launcher has an exclusive lock on `lock` as long as it lives: only one run uses the
# directory. The processes with journals have a shared lock on `journals/in_use`: they may outlive a launcher that was
# killed for some seconds, and who resumes waits for them, on a thread because `flock` has no deadline.
# In the master's process, the recorder's thread tells `Syncing` about five times a second what it has given to the
# operating system; every few seconds, a thread of its own gives that to the disk. So no step and no row waits for a
# disk, but a disk that cannot be written ends the run at the next flush.
#
# The order makes it right: a journal has an entry before any row depends on it. So the rows are counted first, then
# the journals are measured and synced, then the results, and then `on_disk` replaces the one before. So it never
# promises a row whose journals or bytes could be missing. What a power cut leaves behind that is cut off.

from __future__ import annotations

import fcntl
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec
from msgspec.structs import replace

from ..config.loading import LoadedConfig
from ..errors import ConfigurationError
from ..files import Kept, is_file
from ..results.formats import required_format
from ..results.played_rows import PLAYED_ROWS, PlayedRows, cut_rows, rows_to_play
from ..results.record_files import rows_after
from ..system.digest import difference
from ..system.records import IN_MEMORY
from ..text import counted, listed
from ..wire.journal import IN_USE, JOURNAL, JOURNALS, line_of, whole_lines
from .outcome import last_recorded
from .run_plan import RunPlan
from .state_file import STATE, again_from_checkpoint, drop_older

__all__ = ["RunDirectory", "Syncing", "on_flush", "run_file"]

_RUN: Final = "run"
_ON_DISK: Final = "on_disk"
_EVERY_S: Final = 2.0
_LEAVE_S: Final = 20.0
"""How long the processes of a launcher that was killed may take to end."""
_TAIL_BYTES: Final = 1 << 20

T = TypeVar("T")


class _KeptRun(msgspec.Struct, frozen=True):
    """What a run must have to go on.

    Attributes:
        mesh: name of the mesh.
        digest: that of the plan: version, configuration and models.
        files: the result files, in their order.
    """

    mesh: str
    digest: str
    files: list[str]


class _OnDisk(msgspec.Struct, frozen=True):
    """What survives a power cut: of each result file, and of each journal the bytes by its name.

    And the points of which rows can be played.
    """

    files: tuple[Kept, ...]
    journals: dict[str, int]
    played: int = 0


def run_file(loaded: LoadedConfig) -> Path:
    """The file in the directory of a mesh that is there as long as it has a run to resume."""
    return loaded.resolve(loaded.config.recovery.directory or "").absolute() / _RUN


class RunDirectory:
    """The directory of a run; for this run alone, until `close`.

    Args:
        plan: the plan of the run; its configuration names a directory.
        resume: whether to go on with the run that the directory has.

    Attributes:
        plan: the plan, with what it needs to begin or to go on.
        told: what there is to say about it.

    Raises:
        ConfigurationError: there is no run to resume, or one that has not ended; another run uses the directory; the
            configuration, a model or a file is not as it was; or the directory cannot be used.
    """

    def __init__(self, plan: RunPlan, *, resume: bool) -> None:
        self._folder = run_file(plan.loaded).parent
        self.told: list[str] = []
        self._records = [record.file for record in plan.plan.system.records]
        if not self._records or any(Path(own).suffix == IN_MEMORY or _is_device(Path(own)) for own in self._records):
            text = f"there is nothing to keep in `recovery.directory` ('{self._folder}') without a result file"
            raise ConfigurationError(text, hint="Record into files, or leave the directory out.")
        try:
            _journals(self._folder).mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = self._locked()
            try:
                (_journals(self._folder) / IN_USE).touch()
                changed = self._resumed(plan) if resume else self._begun(plan)
                self.plan = replace(changed, directory=str(self._folder))
                self.sync(changed.rows or [0] * len(self._records))
            except BaseException:
                self.close()
                raise
        except OSError as error:
            raise _unwritable(self._folder, error) from error

    def sync(self, rows: Sequence[int]) -> None:
        """Give the result files, of which nobody writes one and which have so many rows, and the journals to the disk.

        Raises:
            ConfigurationError: they cannot be written.
        """
        ends = zip(map(_growing, self._records), rows, strict=True)
        try:
            kept = [Kept(own, file.stat().st_size if own else 0) for file, own in ends]
            _sync(self._folder, self._records, kept, rows_to_play(self._folder / PLAYED_ROWS))
        except OSError as error:
            raise _unwritable(self._folder, error) from error

    def clear(self) -> None:
        """The run has ended, and has nothing to resume: give its results to the disk, and remove what is here of it."""
        for file in self._records:
            with suppress(OSError):
                _give_to_disk(Path(file))
        states, journals = self._folder.glob(f"*{STATE}"), _journals(self._folder).glob(f"*{JOURNAL}")
        for path in (*(self._folder / name for name in (_RUN, _ON_DISK, PLAYED_ROWS)), *states, *journals):
            with suppress(OSError):
                path.unlink()

    def has_rows(self) -> bool:
        """Whether there is something to resume: rows that the disk has, or something that came from outside."""
        with suppress(ConfigurationError):
            kept = self._read(_ON_DISK, _OnDisk)
            has_rows = kept is not None and any(own.rows for own in kept.files)
            return has_rows or any(_journals(self._folder).glob(f"*{JOURNAL}"))
        return True

    def close(self) -> None:
        """Let other runs use the directory."""
        os.close(self._lock)

    def _begun(self, plan: RunPlan) -> RunPlan:
        if (kept := self._read(_RUN, _KeptRun)) is not None:
            text = f"'{self._folder}' has a run of mesh '{kept.mesh}' that has not ended"
            raise ConfigurationError(text, hint="Go on with it with `resume=True`, or remove the folder to begin anew.")
        self.clear()
        _replace(self._folder / _RUN, line_of(_KeptRun(plan.mesh, plan.plan.digest, self._records)))
        return plan

    def _resumed(self, plan: RunPlan) -> RunPlan:
        if (kept := self._read(_RUN, _KeptRun)) is None:
            text = f"there is no run to resume in '{self._folder}'"
            raise ConfigurationError(text, hint="It has ended, or never begun: start it without `resume=True`.")
        if kept.mesh != plan.mesh:
            raise self._refused(f"it is of mesh '{kept.mesh}', and this is '{plan.mesh}'")
        if kept.digest != plan.plan.digest:
            raise self._refused(f"it had {difference(plan.plan.digest, kept.digest, plan.plan.system.instances)}")
        if kept.files != self._records:
            raise self._refused(f"it has written {listed([repr(file) for file in kept.files])}")
        self._wait_for_others()
        on_disk, journals, seen = self._read(_ON_DISK, _OnDisk) or _OnDisk((), {}), _journals(self._folder), 0
        for path in {*journals.glob(f"*{JOURNAL}"), *map(journals.joinpath, on_disk.journals)}:
            whole = whole_lines(path)
            if whole.size < on_disk.journals.get(path.name, 0):
                raise self._refused(f"'{path}' has lost something that was set, on which rows depend")
            if whole.torn:
                self.told.append(f"the end of '{path}' was not whole: {counted(whole.torn, 'byte')} cut off")
            seen = max(seen, *map(_point_of, whole.lines), 0)
        found = list[tuple[str, int]]()
        for file, own in zip(self._records, on_disk.files, strict=False):
            found.append((file, rows := rows_after(Path(file), own)))
            if rows < own.rows:
                self.told.append(f"'{file}' had {own.rows} rows and has {rows}: the others are made again")
        seen = min(max(seen, last_recorded(plan.plan, found)), plan.plan.grid.last_point)
        self.told.append(f"the run is resumed, and goes on from point {seen}")
        cut_rows(self._folder / PLAYED_ROWS, on_disk.played)
        all_rows = tuple(rows for _, rows in found)
        again = replace(plan, rows=all_rows, replays_to=seen)
        return again_from_checkpoint(again, self._folder, all_rows)

    def _refused(self, why: str) -> ConfigurationError:
        hint = "Give it the same configuration, models and options as before, or remove the folder to begin anew."
        return ConfigurationError(f"the run in '{self._folder}' cannot be resumed: {why}", hint=hint)

    def _read(self, name: str, type_: type[T]) -> T | None:
        """What a file here says; None if there is none. Raises `ConfigurationError` if it is damaged."""
        path = self._folder / name
        if not path.exists():
            return None
        try:
            (line,) = whole_lines(path).lines
            return msgspec.json.decode(line, type=type_)
        except (ValueError, msgspec.MsgspecError) as error:
            text = f"'{path}' is damaged, and its run cannot be resumed"
            raise ConfigurationError(text, hint=f"Remove '{self._folder}' to begin anew.") from error

    def _locked(self) -> int:
        lock = os.open(self._folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            text = f"another run uses `recovery.directory` ('{self._folder}')"
            raise ConfigurationError(text, hint="Wait for its end, or give this run another directory.") from error
        except OSError:
            pass  # the file system has no locks
        return lock

    def _wait_for_others(self) -> None:
        """Wait until all processes of the launcher before have ended."""
        alone = threading.Event()

        def wait() -> None:
            with (_journals(self._folder) / IN_USE).open("r+b") as file:
                with suppress(OSError):  # the file system has no locks
                    fcntl.flock(file, fcntl.LOCK_EX)
                alone.set()

        threading.Thread(target=wait, name="waits for the last run", daemon=True).start()
        if not alone.wait(_LEAVE_S):
            text = f"processes of the run in '{self._folder}' still go on after {_LEAVE_S:g} s"
            raise ConfigurationError(text, hint="End them, and resume it then.")


def on_flush(run: RunPlan, played: PlayedRows | None, resets: int) -> Callable[[Sequence[Kept]], None]:
    """What the recorder of a run calls with what the operating system has of each file, after so many resets."""
    if resets or not (run.directory or run.checkpoint_s is not None):
        return lambda _kept: None
    if run.directory:
        return Syncing(run, played).flushed
    return lambda kept: drop_older(run.kept_in, run.plan, kept, played.points if played is not None else 0)


class Syncing:
    """Gives the rows of a run with a directory, and its journals, to the disk: every few seconds, on its own thread."""

    def __init__(self, run: RunPlan, played: PlayedRows | None) -> None:
        self._folder, self._plan, self._played = Path(run.directory), run.plan, played
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="sync")
        self._last: Future[None] | None = None
        self._due = 0.0

    def flushed(self, kept: Sequence[Kept]) -> None:
        """The operating system has this of each file.

        Raises:
            ConfigurationError: what it had before could not be given to the disk.
        """
        if self._last is not None and self._last.done():
            try:
                self._last.result()
            except OSError as error:
                raise _unwritable(self._folder, error) from error
            self._last = None
        if self._last is None and (now := time.monotonic()) >= self._due:
            self._due = now + _EVERY_S
            self._last = self._worker.submit(self._sync, kept, self._played.points if self._played is not None else 0)

    def _sync(self, kept: Sequence[Kept], played: int) -> None:
        _sync(self._folder, [record.file for record in self._plan.system.records], kept, played)
        drop_older(self._folder, self._plan, kept, played)


def _sync(folder: Path, results: Sequence[str], kept: Sequence[Kept], played: int) -> None:
    journals = {path.name: _give_to_disk(path) for path in _journals(folder).glob(f"*{JOURNAL}")}
    _give_to_disk(_journals(folder))
    for file, own in zip(results, kept, strict=True):
        if own.rows:
            _give_to_disk(_growing(file))
            _give_to_disk(_growing(file).parent)
    if played:
        _give_to_disk(folder / PLAYED_ROWS)
    _replace(folder / _ON_DISK, line_of(_OnDisk(tuple(kept), journals, played)))


def _give_to_disk(path: Path) -> int:
    """Have the disk what the operating system has of a file or a folder; returns the bytes of whole lines of a file."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        size = 0
        if path.suffix == JOURNAL:
            begin = max(0, os.fstat(descriptor).st_size - _TAIL_BYTES)
            size = begin + os.pread(descriptor, _TAIL_BYTES, begin).rfind(b"\n") + 1
        os.fsync(descriptor)
        return size
    finally:
        os.close(descriptor)


def _replace(path: Path, data: bytes) -> None:
    """Write a file in the place of an older one, so that one of both survives a power cut."""
    draft = path.with_name(f"{path.name}.new")
    with draft.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    _give_to_disk(path.parent)


def _growing(result: str) -> Path:
    """The file that has the rows of a result at this moment."""
    growing = required_format(result).growing_file(Path(result))
    return growing if is_file(growing) else Path(result)


def _journals(folder: Path) -> Path:
    return folder / JOURNALS


def _is_device(path: Path) -> bool:
    return path.exists() and not path.is_file()


def _point_of(line: bytes) -> int:
    """The last point at which something of an entry of a journal takes effect; 0 for a command."""
    entry: Any = msgspec.json.decode(line)
    return max((own[1] for own in entry), default=0) if isinstance(entry, list) else int(entry.get("point", 0))


def _unwritable(folder: Path, error: OSError) -> ConfigurationError:
    text = f"`recovery.directory` ('{folder}') cannot be written: {error.strerror or error}"
    return ConfigurationError(text, hint="Free some disk space, or choose another directory.")
