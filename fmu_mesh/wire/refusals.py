"""What comes over the wire and is not taken: it is counted, told once, and the run goes on (design, invariant 7).

Everything that a stranger can send is handled inside `Refusals.guard`: whatever is wrong with it ends there.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from ..errors import FmuMeshError, MessageRefused

__all__ = ["Refusals", "payload_of"]

log = logging.getLogger(__name__)

_MOST_TOLD = 20
_SHOWN_KEY = 120


class Refusals:
    """The refused messages of one process.

    Attributes:
        count: how many there were.
    """

    def __init__(self) -> None:
        self.count = 0
        self._told: set[tuple[str, str]] = set()

    def add(self, key: str, reason: str) -> None:
        """Count a message that came by ``key``; tell it unless one like it was told."""
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
        """Handle inside what came by ``key``; if it is refused, whoever sent the ``query`` is told.

        An error that ends the run, such as that of an FMU, goes through.
        """
        try:
            yield
        except MessageRefused as refused:
            self._refuse(key, str(refused), query)
        except zenoh.ZError as error:  # whoever asked is gone
            log.info("answer_not_sent", extra={"error": str(error)})
        except FmuMeshError:
            raise
        except Exception as error:
            log.debug("refused", exc_info=True)
            self._refuse(key, f"it cannot be handled ({type(error).__name__}: {error})", query)

    def _refuse(self, key: str, reason: str, query: zenoh.Query | None) -> None:
        self.add(key, reason)
        if query is not None:
            try:
                query.reply_err(reason)
                query.drop()
            except zenoh.ZError as error:
                log.info("answer_not_sent", extra={"error": str(error)})


def payload_of(query: zenoh.Query) -> bytes:
    """What came with a query that was sent to one key.

    Raises:
        MessageRefused: it was sent to a key with wildcards, which may reach every run.
    """
    if "*" in str(query.key_expr):
        raise MessageRefused("it was sent to a key with wildcards")
    return query.payload.to_bytes() if query.payload is not None else b""
