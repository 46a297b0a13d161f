"""Which processor the recorder wakes up on, where it has none of its own."""

from __future__ import annotations

import os
from contextlib import suppress

__all__ = ["Turns"]

_CAN_CHOOSE = hasattr(os, "sched_setaffinity")  # Linux


class Turns:
    """Lets a thread that works now and then take its time from all processors in turn.

    The scheduler wakes a thread where it slept last. A recorder left alone takes its time from the same node again and
    again, which then holds up the others, and often two nodes are left on one processor while another one is idle.

    Args:
        busy: how many nodes of this host step all the time. Where there are more processors than that, the scheduler
            finds the idle one by itself, and nothing is done.
    """

    def __init__(self, busy: int) -> None:
        self._busy = busy
        self._turn = 0

    def next(self) -> None:
        """Move the calling thread to the next processor; it is not bound to it, and may go where one is idle."""
        processors = sorted(os.sched_getaffinity(0)) if _CAN_CHOOSE else []
        if 1 < len(processors) <= self._busy:
            self._turn = (self._turn + 1) % len(processors)
            with suppress(OSError):  # just taken from this process
                os.sched_setaffinity(0, {processors[self._turn]})
                os.sched_setaffinity(0, processors)
