"""What all programs of fmu_mesh share: logging, exit codes, and errors as one paragraph."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable

from ..errors import ConfigurationError, FmuMeshError, Interrupted
from ..printing import OutputFailed, paragraph
from .limits import address_space_problem, out_of_memory

__all__ = ["exit_code_of"]


def exit_code_of(command: Callable[[], int], needed_mib: int, *, debug: bool = False) -> int:
    """Run a command and return its exit code (design, section 7); an error goes to standard error.

    Args:
        command: does the work.
        needed_mib: the address space that the command needs, in MiB.
        debug: raise an error instead of writing it.
    """
    code = 0
    try:
        code = _code_of(command, needed_mib, debug=debug)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output is gone, as in `fmu-mesh watch … | head`.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OutputFailed as error:
        sys.stderr.write(f"fmu-mesh: {error}\n")
        return code or ConfigurationError.exit_code  # as for a result file that cannot be written
    return code


def _code_of(command: Callable[[], int], needed_mib: int, *, debug: bool) -> int:
    try:
        _start_logging(os.environ.get("FMU_MESH_LOG") or "WARNING")
        if (lack := address_space_problem(needed_mib)) is not None:
            raise lack
        try:
            return command()
        except (MemoryError, OSError, RuntimeError, ImportError) as error:
            problem = out_of_memory(error)  # a problem of this host and not an internal error
            if problem is None:
                raise
            raise problem from error
    except FmuMeshError as error:
        if debug:
            raise
        if not error.reported:
            sys.stderr.write(f"fmu-mesh: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("fmu-mesh: interrupted\n")
        return Interrupted.exit_code


def _start_logging(level: str) -> None:
    """Log messages of this level and above go to standard error."""
    names = logging.getLevelNamesMapping()
    if level.upper() not in names:
        raise ConfigurationError(
            f"FMU_MESH_LOG is '{level}', which is no level.", hint="There are DEBUG, INFO, WARNING, ERROR and CRITICAL."
        )
    logging.basicConfig(level=names[level.upper()])
    for handler in logging.root.handlers:
        handler.setFormatter(_Formatter("%(name)s: %(levelname)s: %(message)s"))
    # The warning of matplotlib about a missing folder of its own does not concern the user.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


class _Formatter(logging.Formatter):
    """Shows messages, which may quote what others have written, as printable text."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  the name of the base class
        return paragraph(super().formatMessage(record))
