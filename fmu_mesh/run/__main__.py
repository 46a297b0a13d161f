"""The program of one process of a run: `python -Pm fmu_mesh.run node PLAN NODE`, or `master PLAN`, or `gateway PLAN`.

PLAN is the file of a run plan. The launcher lets the fork server start it, which is `forks DESCRIPTOR`; a node that
needs another Python is started by exec. The process ends with the process that started it.
"""

from __future__ import annotations

import gc
import signal
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from .run_plan import NodeRun


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
    if role != "forks":
        _job(role, *arguments)()
        return 0
    from setproctitle import setproctitle  # noqa: PLC0415 as above

    from .fork_server import serve  # noqa: PLC0415 as above
    from .process import die_with_parent  # noqa: PLC0415 as above

    gc.disable()  # until `serve` has imported everything: as in `fmu_mesh.__main__`
    die_with_parent(signal.SIGKILL)  # which also ends a process that is stopped
    setproctitle("fmu-mesh fork server")
    job = serve(int(arguments[0]), partial(_job, forks=True))
    if job is not None:  # this is a process that the server has forked
        job()
    return 0


def _job(role: str, plan: str, node: str = "", *, forks: bool = False) -> Callable[[], None]:
    """Read what a process needs; returns what it does. The fork server calls this, and the result in a new process."""
    file = Path(plan)
    if role == "node":
        from .roles import prepare_node  # noqa: PLC0415 only what the role needs
        from .run_plan import read_node  # noqa: PLC0415 as above

        run = read_node(file, node)
        if forks:
            prepare_node(run)
        return partial(_be_node, run)
    return partial(_be_master if role == "master" else _be_gateway, file)


def _be_node(run: NodeRun) -> None:
    from setproctitle import setproctitle  # noqa: PLC0415 as above

    from .roles import run_node  # noqa: PLC0415 as above

    setproctitle(f"fmu-mesh node {run.plan.node}")
    # What a component prints is shown at once, not when the buffer is full.
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]  # it is a text file
    run_node(run)


def _be_master(file: Path) -> None:
    from setproctitle import setproctitle  # noqa: PLC0415 as above

    from ..errors import FmuMeshError  # noqa: PLC0415 as above
    from .events import EventWriter  # noqa: PLC0415 as above
    from .roles import run_master  # noqa: PLC0415 as above
    from .run_plan import read_run  # noqa: PLC0415 as above

    run = read_run(file)
    setproctitle(f"fmu-mesh master {run.mesh}")
    try:
        run_master(run, EventWriter())
    except FmuMeshError as error:
        raise error.already_reported()  # noqa: B904 the launcher has the event and shows it


def _be_gateway(file: Path) -> None:
    from setproctitle import setproctitle  # noqa: PLC0415 as above

    from .events import EventWriter  # noqa: PLC0415 as above
    from .gateway_role import run_gateway  # noqa: PLC0415 as above
    from .run_plan import read_run  # noqa: PLC0415 as above

    run = read_run(file)
    setproctitle(f"fmu-mesh gateway {run.mesh}")
    run_gateway(run, EventWriter())


if __name__ == "__main__":
    raise SystemExit(main())
