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
    # Peers behind it, such as ROS nodes, learn of each other here and meet directly: it passes nothing on for them.
    session = open_session(Wiring(mode="router", listen=tuple(listen), gossip=True))
    try:
        yield own_endpoints(session)
    finally:
        session.close()
