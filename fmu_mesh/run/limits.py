"""The limits of memory: checks before a command starts that the address space (`ulimit -v`) and the memory are enough.

With too little, each library fails in its own way: a traceback of an import, a panic, an abort. Knows only the name of
a command and imports nothing large, so that the check itself works.
"""

from __future__ import annotations

import errno
import os
import re
import resource
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ..errors import ConfigurationError

__all__ = [
    "FEWEST_MIB",
    "RUN_MIB",
    "address_space_problem",
    "needed_mib",
    "out_of_memory",
    "resident_bytes",
    "ring_problem",
]

FEWEST_MIB = 300
"""Need of any command in MiB. Measured on two processors: `check` 200, `plot` 270."""
_SESSION_MIB = 1024
"""Need of a Zenoh session, mostly for the stacks of its threads. Measured: `top` 790."""
_LOCAL_MIB = 660
"""Need of a run in one process. Measured: 630."""
RUN_MIB = 1700
"""Need of a master, a node, and of what starts them. Measured: 1540, of which about a tenth is used."""
_WITHOUT_SESSION = ("check", "completion", "inspect", "new", "plot", "schema")
_RUNS = ("launch", "run", "node", "master", "gateway")
_SWEEP = "sweep"
_NO_MEMORY = ("can't start new thread", "failed to map segment", "Cannot allocate memory")
"""Texts in other errors than MemoryError that mean a lack of memory."""


def needed_mib(command: str, *, local: bool) -> int:
    """The address space that each process of a command needs, in MiB; ``local`` is a run in one process."""
    if command in _WITHOUT_SESSION:
        return FEWEST_MIB
    if command == _SWEEP:  # its workers need as much
        return _LOCAL_MIB
    if command in _RUNS:
        return _LOCAL_MIB if local else RUN_MIB
    return _SESSION_MIB


def address_space_problem(mib: int) -> ConfigurationError | None:
    """The error if the limit is below ``mib``, with the limit and what to do; None if it is not."""
    limit = _limit()
    if limit is None or limit >= mib << 20:
        return None
    return ConfigurationError(
        f"{_limited(limit)}, and this command needs {_gigabytes(mib << 20)} of it, most of which it never uses",
        hint=_WAY_OUT,
    )


def resident_bytes() -> int:
    """The memory that this process takes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def out_of_memory(error: BaseException) -> ConfigurationError | None:
    """The error to show if ``error`` means a lack of memory; None if it means something else."""
    if not (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or any(text in str(error) for text in _NO_MEMORY)
    ):
        return None
    limit = _limit()
    if limit is None:
        return ConfigurationError("there is not enough memory for this on this host")
    return ConfigurationError(f"{_limited(limit)}, and that was not enough", hint=_WAY_OUT)


def ring_problem(rings: Mapping[str, tuple[int, int]]) -> ConfigurationError | None:
    """The error if rings do not fit into the memory of this host, with the largest one; None if they do.

    Args:
        rings: number of rows, and size of a row in bytes, by instance.
    """
    sizes = {name: rows * size for name, (rows, size) in rings.items()}
    needed, available = sum(sizes.values()), _available()
    if available is None or needed <= available:
        return None
    name = max(sizes, key=sizes.__getitem__)
    rows, size = rings[name]
    text = (
        f"the rings of this run need {_gigabytes(needed)}, and this host has {_gigabytes(available)} for them: "
        f"the ring of '{name}' needs {_gigabytes(sizes[name])} ({rows} rows of {_gigabytes(size)})"
    )
    hint = "Set `simulation.window` to 1, use smaller arrays, or use `processes=False`, which needs a few rows."
    return ConfigurationError(text, hint=hint)


def _available() -> int | None:
    """The memory in bytes that processes can get here: of the host, or of its control group; None: not known."""
    found = []
    with suppress(OSError):
        found += [int(kib) << 10 for kib in re.findall(r"MemAvailable: +(\d+)", Path("/proc/meminfo").read_text())]
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # `max`: there is none
            found.append(int(Path(limit).read_text()))
    return min(found, default=None)


def _limit() -> int | None:
    """The limit of the address space of this process in bytes, or None."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return limit if limit != resource.RLIM_INFINITY else None


def _limited(limit: int) -> str:
    return f"the address space of a process is limited to {_gigabytes(limit)} here (`ulimit -v {limit >> 10}`)"


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


_WAY_OUT = (
    "Raise the limit with `ulimit -v unlimited`; where that is refused, it is `as` in /etc/security/limits.conf. "
    "What limits the memory itself is a control group, such as `systemd-run --scope -p MemoryMax=2G` makes."
)
