"""The end of a process that had a Zenoh session.

Zenoh has threads that call into Python. If one of them does so while Python finalizes itself, Python ends that thread,
and the C library then aborts the process with `FATAL: exception not rethrown`. Closing the session does not wait for
these threads. So such a process ends without the finalization, after everything else that Python does at an exit.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import sys

__all__ = ["LastExit"]

_NOT_WRITTEN = 120
"""Exit code of Python if it cannot write its standard output at the end."""


class LastExit:
    """Ends the process without the finalization of Python if `zenoh` was loaded.

    Make it before anything else registers with `atexit`: what is registered first is called last.

    ```python
    last_exit = LastExit()
    sys.exit(last_exit.with_code(command()))
    ```

    Attributes:
        code: the exit code; None before `with_code`.
    """

    def __init__(self) -> None:
        self.code: int | None = None
        atexit.register(self._exit)

    def with_code(self, code: int) -> int:
        """Set the exit code; returns it. Without a call the process ends as any other."""
        self.code = code
        return code

    def _exit(self) -> None:
        if self.code is None or "zenoh" not in sys.modules:
            return
        code = self.code
        try:
            for stream in (sys.stdout, sys.stderr):
                if stream is not None:
                    stream.flush()
        except (OSError, ValueError):
            code = code or _NOT_WRITTEN
        ctypes.CDLL(None).fflush(None)  # an FMU may have printed through the C library
        os._exit(code)
