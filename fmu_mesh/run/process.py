"""What every process of a mesh does about signals, its parent and its end (design, invariant 5).

A process that was started by `launch` ends with it: the kernel tells it when its parent dies, and so does the end of
its standard input. An end that was asked for is carried out by a thread, because the main thread may be inside an FMU.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["GRACE_S", "SIGNAL_RECEIVED", "die_with_parent", "ended_by_signals"]

GRACE_S = 1.0
"""How long the main thread has to end by itself before the process is ended for it."""

SIGNAL_RECEIVED = " was received"
"""What follows the name of a signal in the reason of an end."""

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Ask the kernel to terminate this process when its parent dies (Linux), and end now if it has died already."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@contextmanager
def ended_by_signals(
    interrupt: Callable[[str], None], clean_up: Callable[[], None], *, watch_stdin: bool
) -> Iterator[None]:
    """While inside: SIGTERM, SIGINT, or the end of standard input call ``interrupt`` with the reason.

    If the main thread has not left within `GRACE_S`, ``clean_up`` is called and the process exits with 130. Use it on
    the main thread.
    """
    left = threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def end(reason: str) -> None:
        interrupt(reason)
        if not left.wait(GRACE_S):
            clean_up()
            _exit(reason, told=watch_stdin)

    def wait_for_signal() -> None:
        number = os.read(reading, 1)
        if number:
            end(f"{signal.Signals(number[0]).name}{SIGNAL_RECEIVED}")

    def wait_for_stdin() -> None:
        while os.read(0, 4096):
            pass
        if not left.is_set():
            end("the process that started this one is gone")

    # The C level handler writes the number at once, whichever thread the signal reaches and whatever it is doing.
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    handlers = {number: signal.signal(number, _ignore) for number in (signal.SIGTERM, signal.SIGINT)}
    watcher = threading.Thread(target=wait_for_signal, name="signals", daemon=True)
    watcher.start()
    if watch_stdin:
        threading.Thread(target=wait_for_stdin, name="stdin", daemon=True).start()
    try:
        yield
    finally:
        left.set()
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        os.close(writing)
        watcher.join(GRACE_S)
        os.close(reading)


def _exit(reason: str, *, told: bool) -> None:
    """End the process although its main thread does not come back; say why, unless the launcher does."""
    if not told:
        os.write(2, f"fmu-mesh: {reason}\n".encode())
    os._exit(130)


def _ignore(_number: int, _frame: FrameType | None) -> None:
    """The wakeup descriptor does the work."""
