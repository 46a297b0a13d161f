"""The program of one process of a run: `python -Pm fmu_mesh.run node PLAN NODE`, or `master PLAN`, or `gateway PLAN`.

PLAN is the file of a run plan. The launcher lets the fork server start it, which is `forks DESCRIPTOR`; a node that
needs another Python is started by exec. A batch lets the fork server start `copies`. The process ends with the process
that started it.
"""

from __future__ import annotations

import gc
import signal
import sys


def main() -> int:
    """Be the process that the arguments name; returns the exit code."""
    from ..errors import Interrupted  # noqa: PLC0415 an interrupt must find us here

    try:
        from ..instances.process_end import ends_with_run  # noqa: PLC0415 as above
        from ..wire.last_exit import LastExit  # noqa: PLC0415 as above

        last_exit = LastExit()
        ends_with_run(lambda: last_exit.code or 0)
        from .limits import RUN_MIB  # noqa: PLC0415 as above
        from .program import exit_code_of  # noqa: PLC0415 as above

        return last_exit.with_code(exit_code_of(lambda: _run(*sys.argv[1:]), RUN_MIB))
    except KeyboardInterrupt:
        return Interrupted.exit_code


def _run(role: str, *arguments: str) -> int:
    """Take a role in the run."""
    # The launcher takes lines of UTF-8, and alone decides what of them a terminal can show. What a component prints is
    # shown at once, not when the buffer is full.
    for stream in (sys.stdout, sys.stderr):
        stream.reconfigure(encoding="utf-8", errors="backslashreplace", line_buffering=True)  # type: ignore[union-attr]  # they are text files
    if role != "forks":
        from .process import die_with_parent  # noqa: PLC0415 as above
        from .roles import job_of  # noqa: PLC0415 as above

        die_with_parent()  # a node may have no launcher, only the command that has started all nodes of a host
        job_of(role, *arguments)()
        return 0
    from setproctitle import setproctitle  # noqa: PLC0415 as above

    from .fork_server import serve  # noqa: PLC0415 as above
    from .process import die_with_parent  # noqa: PLC0415 as above

    gc.disable()  # until `serve` has imported everything: as in `fmu_mesh.__main__`
    die_with_parent(signal.SIGKILL)  # which also ends a process that is stopped
    setproctitle("fmu-mesh fork server")
    job = serve(int(arguments[0]))
    if job is not None:  # this is a process that the server has forked
        job()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
