"""Lets a step of the mesh wait until the mesh has all values that ROS has sent before it."""

# Threads: `sent` is called on the thread of the gateway, `__call__` on that of a service, which lets the gateway do a
# job: all messages before it are carried then. A node takes what is put and answers queries in the order in which they
# come, so its answer says that it has all values (ADR 78).

from __future__ import annotations

import queue
from collections.abc import Callable

import zenoh

from ...errors import DeadlineExceeded
from ...wire.session import Question, ask

__all__ = ["Settling"]

_CARRIED_S = 10.0


class Settling:
    """Called without arguments, it waits until the nodes have all values of earlier messages.

    Args:
        mesh: a session that reaches the mesh.
        post: lets the gateway do a job after all that it has to do already.

    Raises:
        DeadlineExceeded: (the call) they do not have them in time.
    """

    def __init__(self, mesh: zenoh.Session, post: Callable[[Callable[[], None]], None]) -> None:
        self._mesh = mesh
        self._post = post
        self._keys: dict[str, str] = {}

    def sent(self, key: str) -> None:
        """Note that a value was put on the key of a variable."""
        self._keys[key.rpartition("/")[0]] = key  # one question for each instance is enough

    def __call__(self) -> None:
        """See the class."""
        carried: queue.SimpleQueue[list[str]] = queue.SimpleQueue()

        def take() -> None:
            keys, self._keys = self._keys, {}
            carried.put(list(keys.values()))

        self._post(take)
        try:
            keys = carried.get(timeout=_CARRIED_S)
        except queue.Empty:
            raise DeadlineExceeded("the gateway to ROS is too busy to carry the messages before this step") from None
        for key in keys:
            ask(self._mesh, Question(key, f"the instance of '{key}'", _CARRIED_S))
