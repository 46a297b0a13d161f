"""Threads that answer requests of ROS, because a mesh may answer slowly and nobody else must wait for it."""

# Threads: Zenoh or rclpy only put a job into the queue; the threads here do the jobs. Nobody waits for them but
# `__exit__`, for a while: a job that waits for the mesh ends with it, or with the process (ADR 0030).

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Self

import zenoh

from ...ros_wire.cdr import Message
from ...ros_wire.rmw_zenoh import Service

__all__ = ["ServiceThreads"]

log = logging.getLogger(__name__)

_ANSWERS_END_S = 2.0
"""As long as the mesh may take for the answers that are under way, in s."""


class ServiceThreads:
    """Do jobs while the `with` block lasts: one by one, or ``count`` at once."""

    def __init__(self, name: str, count: int = 1) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=self._run, name=name, daemon=True) for _ in range(count)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        end = time.monotonic() + _ANSWERS_END_S
        for _ in self._threads:
            self._jobs.put(None)
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))

    def do(self, job: Callable[[], None]) -> None:
        """From any thread: do a job soon."""
        self._jobs.put(job)

    def service(self, answer: Callable[[Message], Message]) -> Service:
        """A service whose requests are answered here."""
        return lambda request, reply: self.do(lambda: reply(answer(request)))

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except zenoh.ZError as error:  # the client is gone
                log.info("answer_not_sent", extra={"error": str(error)})
