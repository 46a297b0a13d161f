"""One process of a batch and its successors, as the batch sees it: its start, what it says, and how it has ended.

Does not know what the batch asks it for.
"""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from ..config.mesh import TimeoutsConfig
from ..errors import FmuMeshError, MeshLost, from_report
from ..instances.contract import LogMessage
from ..simtime import TimeGrid
from ..wire.host_processes import STOPPED, is_stopped
from .child import how_it_ended
from .copies_messages import Answer, Channel, Failed, LoggedByModel, News, Request, SharedBlock
from .fork_server import Forked, ForkServer
from .run_plan import RunPlan

__all__ = ["CopiesHost"]

_EXIT_S: Final = 5.0
"""How long it may take until the exit code of a process is known whose socket has ended."""


class CopiesHost:
    """One process of a batch and its successors, as the batch sees it.

    Attributes:
        part: which copies it has.
        process: None if it has ended, or was not started yet.
        channel: of the running process.
        starts: how often it was started.
        failed: what it has said before its end, if it could.
    """

    def __init__(self, number: int, part: slice, block: SharedBlock) -> None:
        self.part = part
        self.process: Forked | None = None
        self.channel: Channel
        self.starts = 0
        self.failed: Failed | None = None
        self._number, self._block = number, block
        self._how = ""
        self._beat, self._since = 0, 0.0
        self._is_ready = False  # whether it has opened its first copies

    def is_at(self, descriptor: int) -> bool:
        """Whether this is the descriptor of its channel."""
        return self.process is not None and self.channel.fileno() == descriptor

    @property
    def size(self) -> int:
        """How many copies it has."""
        return int(self.part.stop - self.part.start)

    @property
    def copies(self) -> str:
        """Which copies it has, in words."""
        first, last = self.part.start, self.part.stop - 1
        return f"copy {first}" if first == last else f"copies {first} to {last}"

    @property
    def guilty(self) -> int | None:
        """The copy that has ended it, by its number in the batch; None if it is not known."""
        if self.failed is None or self.failed.copy is None:
            return None
        return int(self.part.start) + self.failed.copy

    def start(self, server: ForkServer, run: RunPlan, file: Path, processes: int) -> None:
        """Start it."""
        own, theirs = socket.socketpair()
        self._block.beats[self._number] = 0
        part = f"{self.part.start}:{self.part.stop}/{self._block.points.size}"
        with theirs:
            self.process = server.fork_with(
                run.mesh,
                "copies",
                str(file),
                f"{self._number}/{processes}",
                part,
                descriptors=(theirs.fileno(), self._block.descriptor),
            )
        self.channel = Channel(own, News, run.loaded.config.timeouts.step)
        self.starts += 1
        self.failed, self._how, self._is_ready = None, "", False

    def ask(self, request: Request) -> None:
        """Send it a request; one that is gone takes none, which the end of its channel tells."""
        with suppress(OSError):
            self.channel.send(request)

    def news(self, log_message: Callable[[LogMessage], None]) -> tuple[Answer | None, bool]:
        """What it says within a second: an answer, if there is one, and whether there may be more."""
        answer = None
        try:
            messages, more = self.channel.received()
        except (OSError, msgspec.DecodeError):
            messages, more = [], False
        for message in messages:
            match message:
                case Answer():
                    answer, self._is_ready = message, True
                case LoggedByModel(own):
                    log_message(own)
                case Failed():
                    self.failed = message
        return answer, more

    def awaited(self, now: float) -> None:
        """From now on an answer is awaited."""
        self._beat, self._since = int(self._block.beats[self._number]), now

    def look(self, now: float, timeouts: TimeoutsConfig) -> None:
        """Kill it if it has done nothing for too long; its own watch has not seen it."""
        beat, process = int(self._block.beats[self._number]), self.process
        assert process is not None
        limit_s = timeouts.step if self._is_ready else timeouts.start
        if beat != self._beat:
            self._beat, self._since = beat, now
        elif now - self._since > limit_s:
            is_stopped_now = process.pid is not None and is_stopped(process.pid)
            why = STOPPED if is_stopped_now else "does not answer, because a component does not let it"
            self._how = f"{why} for {now - self._since:.1f} s, and was ended"
            process.send_signal(signal.SIGKILL)

    def lose(self) -> None:
        """It is gone: note how it has ended."""
        assert self.process is not None
        self._how = self._how or how_it_ended(self.process.wait(_EXIT_S))
        self.channel.close()
        self.process = None

    def reason(self, grid: TimeGrid, copy: int | None = None, point: int = 0) -> FmuMeshError:
        """Why a copy has ended with the process; None: the copy that has ended it."""
        failed = self.failed
        if failed is not None and copy in {None, self.guilty}:
            return from_report(failed.error)
        if failed is None:
            error = MeshLost(f"the process of {self.copies} {self._how}", hint="`reset` starts another one.")
        else:
            whose = f"copy {self.guilty}" if self.guilty is not None else "one of them"
            text = f"the process of {self.copies} has ended, because of {whose}: {from_report(failed.error)}"
            error = MeshLost(text)
        return error.at(point, grid.time(point)) if copy is not None else error
