"""A Zenoh router inside a Python process, for a host that has no `zenohd`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from .session import Wiring, open_session, own_endpoints

__all__ = ["run_router"]


@contextmanager
def run_router(listen: Sequence[str]) -> Iterator[tuple[str, ...]]:
    """Route while inside; gives the endpoints it really listens on.

    Raises:
        ConfigurationError: an endpoint cannot be used.
    """
    session = open_session(Wiring(mode="router", listen=tuple(listen)))
    try:
        yield own_endpoints(session)
    finally:
        session.close()
