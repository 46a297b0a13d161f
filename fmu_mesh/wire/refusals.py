"""Refused messages: they are counted and logged once, and the run continues (ADR 8).

Everything that an unknown sender can send is handled inside `Refusals.guard`, which catches all errors of a message.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import zenoh

from ..errors import FmuMeshError, MessageRefused

__all__ = ["Refusals", "payload_of"]

log = logging.getLogger(__name__)

_MOST_TOLD = 20
_SHOWN_KEY = 120
_MOST_WAITING = 1024
"""Queries of one queryable that wait for an answer at most."""


class Refusals:
    """The refused messages of one process."""

    def __init__(self) -> None:
        self.count = 0
        self._told: set[tuple[str, str]] = set()

    def add(self, key: str, reason: str) -> None:
        """Count a message with ``key``; log it unless a similar one was logged."""
        self.count += 1
        shown = key if len(key) <= _SHOWN_KEY else f"{key[:_SHOWN_KEY]}..."
        like = shown, reason.partition(":")[0]
        if like in self._told or len(self._told) >= _MOST_TOLD:
            return
        self._told.add(like)
        more = "" if len(self._told) < _MOST_TOLD else "; further ones are only counted"
        log.warning("a message on %s was refused: %s%s", ascii(shown), ascii(reason)[1:-1], more)

    @contextmanager
    def guard(self, key: str, query: zenoh.Query | None = None) -> Iterator[None]:
        """Handle a message with ``key`` inside this context; if it is refused, the ``query`` gets the reason.

        Errors that end the run, such as those of an FMU, are not caught.
        """
        try:
            yield
        except MessageRefused as refused:
            self._refuse(key, str(refused), query)
        except zenoh.ZError as error:  # the client is gone
            log.info("answer_not_sent", extra={"error": str(error)})
        except FmuMeshError:
            raise
        except Exception as error:
            log.debug("refused", exc_info=True)
            self._refuse(key, f"it cannot be handled ({type(error).__name__}: {error})", query)

    def answering(
        self, answer: Callable[[zenoh.Query], None], post: Callable[[Callable[[], None]], None]
    ) -> Callable[[zenoh.Query], None]:
        """The callback of a queryable: ``post`` lets a thread ``answer`` its queries, of which only some may wait."""
        waiting: deque[zenoh.Query] = deque()

        def take() -> None:
            query = waiting.popleft()
            with self.guard(str(query.key_expr), query):
                answer(query)

        def arrived(query: zenoh.Query) -> None:
            """On a thread of Zenoh, one query after the other."""
            if len(waiting) >= _MOST_WAITING:
                self._refuse(str(query.key_expr), f"{_MOST_WAITING} others wait for an answer", query)
            else:
                waiting.append(query)
                post(take)

        return arrived

    def _refuse(self, key: str, reason: str, query: zenoh.Query | None) -> None:
        self.add(key, reason)
        if query is not None:
            try:
                query.reply_err(reason)
                query.drop()
            except zenoh.ZError as error:
                log.info("answer_not_sent", extra={"error": str(error)})


def payload_of(query: zenoh.Query) -> bytes:
    """The payload of a query that was sent to exactly one key.

    Raises:
        MessageRefused: it was sent to a key with wildcards, which may reach every run.
    """
    if "*" in str(query.key_expr):
        raise MessageRefused("it was sent to a key with wildcards")
    return query.payload.to_bytes() if query.payload is not None else b""
