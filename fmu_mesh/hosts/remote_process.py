"""A node on another host, as the launcher sees it."""

# Threads: that of the launcher waits and signals; that of the host takes what the node writes, and tells its end, which
# the launcher's thread may do, too, where the host is lost. The lock lets only one of them close the pipes (ADR 85).

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from typing import Final

__all__ = ["LOST", "RemoteProcess"]

LOST: Final = -signal.SIGHUP
"""The exit code of nodes whose host is lost."""


class RemoteProcess:
    """A node on another host, as the launcher sees it; offers what `subprocess.Popen` does.

    Args:
        send: sends a signal to it.
    """

    stdin: None = None
    pid: None = None
    """No process of this host."""

    def __init__(self, send: Callable[[int], None]) -> None:
        self._send = send
        self._code: int | None = None
        self._ended = threading.Event()
        self._ending = threading.Lock()
        (output, self._output), (errors, self._errors) = os.pipe(), os.pipe()
        self.stdout, self.stderr = os.fdopen(output, "rb"), os.fdopen(errors, "rb")

    def poll(self) -> int | None:
        """None if it still runs; otherwise its exit code, as `wait` tells it."""
        return self._code

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait until its exit code is known, or its host is lost."""
        self._ended.wait(timeout_s)
        return self._code if self._code is not None else LOST

    def send_signal(self, number: int) -> None:
        """Send a signal if it still runs."""
        if self._code is None:
            self._send(number)

    def take(self, data: bytes, *, error: bool) -> None:
        """On the thread of its host: it has written a line."""
        if self._code is None:
            os.write(self._errors if error else self._output, data)

    def end(self, code: int) -> None:
        """From any thread: it has ended, unless that is known."""
        with self._ending:
            if self._code is None:
                self._code = code
                os.close(self._output)
                os.close(self._errors)
                self._ended.set()
