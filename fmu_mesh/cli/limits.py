"""The limit of the address space (`ulimit -v`): whether a command can run within it, before it fails somewhere inside.

Below what is needed, each library fails in a way of its own: a traceback of an import, a panic, an abort. Knows a
command by its name only, so that it can be asked before anything large is imported.
"""

from __future__ import annotations

import errno
import resource

from ..errors import ConfigurationError

__all__ = ["FEWEST_MIB", "address_space_problem", "needed_mib", "out_of_memory"]

FEWEST_MIB = 300
"""What any command needs in MiB: `check` reserves 200 where it was measured (two processors), `plot` 270."""
_SESSION_MIB = 1024
"""With a Zenoh session, whose threads reserve most of it: `top` 790 there."""
_LOCAL_MIB = 660
"""A run in one process: 630 there."""
_RUN_MIB = 1700
"""A master or a node, and so all that starts them: 1540 there; they use about a tenth of it."""
_WITHOUT_SESSION = ("check", "schema", "inspect", "plot")
_RUNS = ("launch", "run", "node", "master", "gateway")
_NO_MEMORY = ("can't start new thread", "failed to map segment", "Cannot allocate memory")
"""What errors say that are of other types than MemoryError."""


def needed_mib(command: str, *, local: bool) -> int:
    """How much address space each process of a command needs in MiB; ``local`` is a run in one process."""
    if command in _WITHOUT_SESSION:
        return FEWEST_MIB
    if command in _RUNS:
        return _LOCAL_MIB if local else _RUN_MIB
    return _SESSION_MIB


def address_space_problem(mib: int) -> ConfigurationError | None:
    """What to say where a process may not have so much address space: where the limit is, and what to do."""
    limit = _limit()
    if limit is None or limit >= mib << 20:
        return None
    return ConfigurationError(
        f"{_limited(limit)}, and this command needs {_gigabytes(mib << 20)} of it, most of which it never uses",
        hint=_WAY_OUT,
    )


def out_of_memory(error: BaseException) -> ConfigurationError | None:
    """What to say if ``error`` means that there is no memory left; None if it means something else."""
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


def _limit() -> int | None:
    """The most address space of this process in bytes, or None."""
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
