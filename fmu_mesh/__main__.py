"""The command `fmu-mesh`, and `python -m fmu_mesh`. Ctrl-C gives its exit code even during the imports."""

import gc
import os
import sys
from contextlib import AbstractContextManager, nullcontext, redirect_stderr, redirect_stdout


def main() -> int:
    """Import the command and run it; returns the exit code."""
    gc.disable()  # until the command runs: imports leave no garbage, and looking for it takes a sixth of their time
    try:
        _open_standard_streams()
        from .run.threads import one_thread_from_now_on  # noqa: PLC0415 before numpy is imported

        one_thread_from_now_on()
        from .run.limits import FEWEST_MIB, address_space_problem  # noqa: PLC0415 an interrupt must find us here
        from .wire.last_exit import LastExit  # noqa: PLC0415 as above

        last_exit = LastExit()
        if sys.argv[1:2] in (["launch"], ["node"]):  # it may have instances
            from .instances.process_end import ends_with_run  # noqa: PLC0415 as above

            ends_with_run(lambda: last_exit.code or 0)
        if (problem := address_space_problem(FEWEST_MIB)) is not None:
            print(f"fmu-mesh: {problem}", file=sys.stderr)
            return problem.exit_code
        with _prepared(sys.argv[1:]):
            from .cli.main import main as command  # noqa: PLC0415 as above

            return last_exit.with_code(command())  # it imports the module of the command
    except KeyboardInterrupt:
        from .errors import Interrupted  # noqa: PLC0415 as above

        print("fmu-mesh: interrupted", file=sys.stderr)
        return Interrupted.exit_code


def _open_standard_streams() -> None:
    """Let what a shell has closed (`>&-`) lead nowhere: a file that is opened next would get its number."""
    while (opened := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(opened)
    for number, stream, redirect in ((1, sys.stdout, redirect_stdout), (2, sys.stderr, redirect_stderr)):
        if stream is None:
            redirect(os.fdopen(number, "w", encoding="utf-8")).__enter__()


def _prepared(arguments: list[str]) -> AbstractContextManager[None]:
    """While the command is imported, start what takes as long and can be done at the same time."""
    if arguments[:1] not in (["launch"], ["run"]) or not {"--local", "--help", "-h"}.isdisjoint(arguments):
        return nullcontext()
    from .run.fork_server import started_ahead  # noqa: PLC0415 as above

    return started_ahead()


if __name__ == "__main__":
    if not sys.flags.safe_path:
        # `python -m` searches modules in the current folder first; `fmu-mesh` does not, and both must behave alike.
        del sys.path[0]
    raise SystemExit(main())
