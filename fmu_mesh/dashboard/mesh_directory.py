"""The meshes that a dashboard shows: one that was named, or all that run now and later."""

# Threads: `meshes` looks for new meshes once a second, and each follower has threads of its own. The event loop of the
# server reads `followers` meanwhile without a lock: the mapping is replaced, never changed (ADR 0061).

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, Self

from ..errors import FmuMeshError
from ..wire.client.reaching import Meshes
from .mesh_follower import MeshFollower

__all__ = ["MeshDirectory"]

# A mesh that starts is in the list within a second, as fast as a person looks for it.
_MESHES_S: Final = 1.0
_MOST_MESHES: Final = 32
"""Meshes that are followed; of those that have ended, the ones that ended first are left out beyond it."""


class MeshDirectory:
    """Followers of meshes by key, as long as the `with` block lasts; ``reach`` is what `attach` takes."""

    def __init__(self, mesh: str | None, reach: Mapping[str, Any]) -> None:
        self._mesh = mesh
        self._reach = reach
        self._followers: dict[str, MeshFollower] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._live, name="meshes", daemon=True)

    def __enter__(self) -> Self:
        """Look for the meshes once, then again and again.

        Raises:
            ConfigurationError: the mesh with the name does not run, or there are several.
            DeadlineExceeded: an endpoint does not answer.
        """
        with Meshes(**self._reach) as found:
            if self._mesh is not None:
                key = found.named(self._mesh).keys.root
                self._followers = {key: MeshFollower(key, self._reach)}
                return self
            self._add(found.roots)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        for follower in self._followers.values():
            follower.close()

    @property
    def followers(self) -> Mapping[str, MeshFollower]:
        """All by key, in the order in which they were found."""
        return self._followers

    def _live(self) -> None:
        while not self._closing.is_set():
            with suppress(FmuMeshError), Meshes(**self._reach) as found:
                while not self._closing.wait(_MESHES_S):
                    found.look()
                    self._add(found.roots)
            self._closing.wait(_MESHES_S)

    def _add(self, keys: Sequence[str]) -> None:
        """Follow what is new. The mapping is replaced and not changed, since pages read it meanwhile."""
        new = [key for key in dict.fromkeys(keys) if key not in self._followers]
        if not new:
            return
        ended = [key for key, follower in self._followers.items() if follower.view.ended and key not in keys]
        gone = ended[: max(0, len(self._followers) + len(new) - _MOST_MESHES)]
        closed = [self._followers[key] for key in gone]
        kept = {key: follower for key, follower in self._followers.items() if key not in gone}
        self._followers = kept | {key: MeshFollower(key, self._reach) for key in new}
        for follower in closed:
            follower.close()
