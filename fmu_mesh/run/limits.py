"""Limits: checks before a command starts that the memory is enough, and what `process` allows the process of a node.

With too little, each library fails in its own way: a traceback of an import, a panic, an abort. The checks know only
the name of a command and import nothing large, so that they work themselves.
"""

from __future__ import annotations

import errno
import math
import os
import re
import resource
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import ConfigurationError

if TYPE_CHECKING:
    from ..config.instance_sections import ProcessConfig

__all__ = [
    "FEWEST_MIB",
    "RUN_MIB",
    "address_space_problem",
    "available_bytes",
    "limit_process",
    "memory_share",
    "needed_mib",
    "out_of_memory",
    "resident_bytes",
    "ring_problem",
    "strain",
    "why_ended",
]

FEWEST_MIB = 300
"""Need of any command in MiB. Measured on two processors: `check` 200, `plot` 270."""
_SESSION_MIB = 1024
"""Need of a Zenoh session, mostly for the stacks of its threads. Measured: `top` 790."""
_LOCAL_MIB = 660
"""Need of a run in one process. Measured: 630."""
RUN_MIB = 1700
"""Need of a master, a node, and of what starts them. Measured: 1540, of which about a tenth is used."""
_WITHOUT_SESSION = ("check", "completion", "doctor", "inspect", "new", "plot", "schema")
_RUNS = ("launch", "run", "node", "master", "gateway")
_SWEEP = "sweep"
_NEARLY = 0.9
"""From this part of a limit on, it may be why a model fails."""
_OWN_BYTES = 128 << 20
"""What a node takes after its models are loaded: the stacks of a dozen threads, most of which it never uses."""
_OWN_FILES = 16
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
    needed, available = sum(sizes.values()), available_bytes()
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


def limit_process(process: ProcessConfig) -> None:
    """Limit this process from here on, above what it has used so far.

    Raises:
        ConfigurationError: the limit of the system is lower.
    """
    wanted = []  # the key, the kind, the limit, and what the process gets to say that it was reached
    if (memory := process.memory_bytes) is not None:
        wanted.append(("memory", resource.RLIMIT_DATA, _data_bytes("self") + _OWN_BYTES + memory, _OWN_BYTES))
    if process.cpu_time is not None:
        wanted.append(("cpu_time", resource.RLIMIT_CPU, math.ceil(time.process_time() + process.cpu_time), 1))
    if process.open_files is not None:
        wanted.append(("open_files", resource.RLIMIT_NOFILE, process.open_files, _OWN_FILES))
    for name, kind, limit, more in wanted:
        most = resource.getrlimit(kind)[1]
        if most != resource.RLIM_INFINITY and limit + more > most:
            text = f"`process.{name}` of {getattr(process, name)} is above the limit of this system ({most})"
            raise ConfigurationError(text, hint="Lower it, or raise the limit with `ulimit -H`.")
        resource.setrlimit(kind, (limit, limit + more))


def memory_share(process: ProcessConfig, pid: int | None = None) -> float | None:
    """The part of its memory limit that a process uses, such as 0.96; None: it has no limit, or is gone."""
    if (memory := process.memory_bytes) is None:
        return None
    try:
        limit, _ = resource.prlimit(pid or 0, resource.RLIMIT_DATA)
        share = 1 - (limit - _data_bytes(str(pid or "self"))) / memory
    except (OSError, IndexError):
        return None
    return max(0.0, share) if limit != resource.RLIM_INFINITY else None


def strain(process: ProcessConfig) -> str | None:
    """Of this process, after a failure: a sentence with each limit that it has nearly reached; None: with none."""
    said = []
    if (share := memory_share(process)) is not None and share > _NEARLY:
        said.append(f"{share:.0%} of its memory limit ({process.memory}) is in use")
    for kind in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE):  # to say it takes some of both
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (hard, hard))
    if (most := process.open_files) is not None and (
        count := len([*Path("/proc/self/fd").iterdir()]) - 1
    ) > _NEARLY * most:
        said.append(f"{count} of {most} descriptors are open")
    return f"In its process, {' and '.join(said)} (`process` in the configuration)." if said else None


def why_ended(code: int, process: ProcessConfig, share: float | None) -> str | None:
    """How a process of this exit code has ended, if its limits may say that; ``share``: see `memory_share`."""
    if code == -signal.SIGXCPU and process.cpu_time is not None:
        return f"has used its cpu_time of {process.cpu_time:g} s"
    if code < 0 and share is not None:
        return f"was ended by {signal.Signals(-code).name} with {share:.0%} of its memory limit in use"
    return None


def _data_bytes(process: str) -> int:
    """What RLIMIT_DATA counts: private memory that can be written, except the stack."""
    return int(Path(f"/proc/{process}/status").read_text(encoding="ascii").partition("VmData:")[2].split()[0]) << 10


def available_bytes() -> int | None:
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
