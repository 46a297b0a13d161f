"""Which process of a mesh listens and connects where.

Processes of one host meet on Unix sockets in the folder of the run, which only their user can enter: one per node, so
that data goes peer to peer. That of the master is also the way in for the tools of this user. Other hosts and users
reach the master only where the configuration has it listen.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from pathlib import Path

from ..config.mesh import ZenohConfig
from ..wire.keys import MASTER
from ..wire.runtime import socket_endpoint
from ..wire.session import Wiring

__all__ = ["is_socket", "leaves_host", "wiring"]


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
        listen += config.listen
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


def is_socket(endpoint: str) -> bool:
    """Whether an endpoint is a Unix socket, which the permissions of its folder protect."""
    return endpoint.startswith("unixsock-stream/")


def leaves_host(endpoint: str) -> bool:
    """Whether others than the users of this host may come in by an endpoint that somebody listens at."""
    address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
    host = address.rpartition(":")[0].strip("[]")
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return not is_socket(endpoint) and host != "localhost"
