"""The FMU of the start-up job, and what it tells: when all instances have done their first step.

It is the same FMU for every tool, so no tool has to be asked, and none is trusted. In its last step it waits until all
processes have been looked at; that time is not part of any figure. The FMU and this module share a file in memory.
"""

from __future__ import annotations

import ctypes
import mmap
import shutil
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from fmus.build import BuildError, build

__all__ = ["FMU", "POINTS", "FirstStep", "Started"]

POINTS = 10
"""Communication steps of a run: so few that stepping takes no time."""

_MODEL = Path(__file__).parent / "models" / "FirstStep"
_FOLDER = Path(__file__).resolve().parents[1] / "build" / "bench-programs"
FMU = str(_FOLDER / "FirstStep")
"""Path of the FMU without `.fmu`."""

_LOOK_EVERY_S = 0.002
_MB = 1024.0


@dataclass(frozen=True)
class Started:
    """What was seen of a command.

    Attributes:
        first_point_ns: when all instances had done their first step, on the monotonic clock.
        held_ns: how long the command was stopped.
        processes: how many it had.
        private_mb: memory that only one of its processes uses, the sum of all processes.
        pss_mb: the same, and of memory that several processes use the share of each (PSS).
        node_mb: the private memory of a process with an instance; the median.
    """

    first_point_ns: int
    held_ns: int
    processes: int
    private_mb: float
    pss_mb: float
    node_mb: float


class _Shared(ctypes.Structure):
    _fields_ = (
        ("hold_at", ctypes.c_int64),
        ("released", ctypes.c_int64),
        ("started", ctypes.c_int64),
        ("last_first_ns", ctypes.c_int64),
        ("held_since_ns", ctypes.c_int64),
    )


class FirstStep:
    """The FMU and the shared file; use it as a context manager. Nobody waits before `hold`.

    Args:
        folder: where they are.

    Raises:
        RuntimeError: the FMU cannot be built here.
    """

    def __init__(self, folder: Path = _FOLDER) -> None:
        path = folder / "FirstStep.shared"
        try:
            _build(path)
        except BuildError as error:
            raise RuntimeError(str(error)) from None
        path.write_bytes(bytes(ctypes.sizeof(_Shared)))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), ctypes.sizeof(_Shared))
        self._shared = _Shared.from_buffer(self._memory)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        del self._shared
        self._memory.close()

    def hold(self) -> None:
        """The next command waits in its last step."""
        self._shared.released = self._shared.started = 0
        self._shared.last_first_ns = self._shared.held_since_ns = 0
        self._shared.hold_at = POINTS

    def watch(self, process: subprocess.Popen[bytes], instances: int, deadline: float) -> Started | None:
        """Wait for the last step, look at all processes, and let them go on; None if the command ends before.

        Args:
            process: the command; leader of its session.
            instances: how many instances it has.
            deadline: of the monotonic clock, in s.
        """
        try:
            held_since = self._all_started(process, instances, deadline)
            if held_since is None:
                return None
            first = self._shared.last_first_ns
            memory = [used for pid in _processes_of(process.pid) if (used := _memory_of(pid)) is not None]
        finally:
            self._shared.hold_at, self._shared.released = 0, 1
        return Started(
            first_point_ns=first,
            held_ns=time.monotonic_ns() - max(first, held_since),
            processes=len(memory),
            private_mb=sum(private for private, _, _ in memory),
            pss_mb=sum(pss for _, pss, _ in memory),
            node_mb=statistics.median([private for private, _, has_fmu in memory if has_fmu] or [0.0]),
        )

    def _all_started(self, process: subprocess.Popen[bytes], instances: int, deadline: float) -> int | None:
        """When the first instance began to wait, once all have done a step; None if the command ends before."""
        while self._shared.started < instances or not self._shared.held_since_ns:
            if time.monotonic() > deadline:
                return None
            try:
                process.wait(_LOOK_EVERY_S)
            except subprocess.TimeoutExpired:
                continue
            return None
        held_since: int = self._shared.held_since_ns
        return held_since


def _build(shared_file: Path) -> None:
    """Build the FMU, which has the path of the shared file in it, beside that file."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        model = Path(shutil.copytree(_MODEL, Path(folder, "model")))
        (model / "shared_file.h").write_text(f'#define SHARED_FILE "{shared_file}"\n')
        build(model, shared_file.parent)


def _processes_of(leader: int) -> set[int]:
    """The processes of the session that ``leader`` leads, and all that descend from them."""
    parents: dict[int, int] = {}
    found: set[int] = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            # The name of a process may have spaces, and it ends at the last bracket.
            _, parent, _, session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        parents[int(folder.name)] = int(parent)
        if int(session) == leader:
            found.add(int(folder.name))
    size = 0
    while size != len(found):
        size = len(found)
        found |= {pid for pid, parent in parents.items() if parent in found}
    return found


def _memory_of(pid: int) -> tuple[float, float, bool] | None:
    """Private memory and PSS of a process in MB, and whether it has loaded the FMU; None if it is gone."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
        has_fmu = "FirstStep" in Path(f"/proc/{pid}/maps").read_text()
    except OSError:
        return None
    sizes = {name: int(value.split()[0]) / _MB for name, _, value in (line.partition(":") for line in lines)}
    return sizes.get("Private_Clean", 0.0) + sizes.get("Private_Dirty", 0.0), sizes.get("Pss", 0.0), has_fmu
