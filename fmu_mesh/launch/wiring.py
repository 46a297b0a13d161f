"""Which process of a mesh listens and connects where.

Processes of one host meet on Unix sockets in the folder of the run: one per node, so that data goes peer to peer. The
master also listens where tools, other hosts and bridges can reach it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..model.config import ZenohConfig
from ..wire.runtime import socket_endpoint
from ..wire.session import Wiring

__all__ = ["MASTER", "wiring"]

MASTER = "@mesh"
"""Name of the master's process where node names stand."""

_ANY_LOOPBACK_PORT = "tcp/127.0.0.1:0"


def wiring(config: ZenohConfig, config_file: Path, folder: Path, process: str, peers: Iterable[str]) -> Wiring:
    """The wiring of one process.

    Args:
        config: the `zenoh` section.
        config_file: the configuration file, for relative paths.
        folder: folder of the run.
        process: node name, or `MASTER`.
        peers: nodes that this one exchanges frames with; of each two, the later name connects.
    """
    base = config_file.absolute().parent / config.config if config.config is not None else None
    if config.mode == "client":
        return Wiring(mode="client", connect=tuple(config.connect), config=base)
    listen = [socket_endpoint(folder, process)]
    sockets = []
    if process == MASTER:
        listen += config.listen or [_ANY_LOOPBACK_PORT]
    else:
        sockets = [socket_endpoint(folder, MASTER)]
        sockets += [socket_endpoint(folder, peer) for peer in sorted(set(peers)) if peer < process]
    return Wiring(
        mode="peer",
        listen=tuple(listen),
        connect=(*sockets, *config.connect),
        # Beyond this host, peers learn of each other from those they know.
        gossip=bool(config.connect or config.listen),
        config=base,
    )
