"""The endpoints at which each process of a mesh listens and to which it connects.

Processes of one host meet at Unix sockets in the folder of the run, which only their user can enter. Each node has one,
so that data goes peer to peer. The tools of this user connect to the socket of the master. Other hosts and users can
reach the master only at the endpoints of `zenoh.listen`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from ..config.access_sections import SecurityConfig, is_socket
from ..config.mesh import TimeoutsConfig, ZenohConfig
from ..errors import ConfigurationError
from ..files import beside
from ..system.plan import MASTER
from ..wire.keys import LOCAL
from ..wire.runtime import leave_shared, shared_endpoint, shared_file, socket_endpoint
from ..wire.session import Wiring
from .run_plan import RunPlan

if TYPE_CHECKING:  # as below
    from ..wire.security.identity import Identity

__all__ = [
    "certified",
    "identity_of",
    "name_of",
    "patient",
    "shared_with_group",
    "table_of",
    "warnings_of",
    "wiring",
    "with_doors",
]


_ACCESS: Final = re.compile(r"\b(?:zenoh|ros)\.(?:listen|connect)|^`(?:listen|connect)=|\bruntime\.share_with")
"""The place of a warning about a connection: in a file, or an option."""


def wiring(config: ZenohConfig, config_file: Path, folder: Path, process: str, peers: Iterable[str]) -> Wiring:
    """The endpoints of one process.

    Args:
        config: the `zenoh` section.
        config_file: the configuration file, for relative paths.
        folder: the folder of the run.
        process: name of the node, or `MASTER`.
        peers: the nodes that this one exchanges frames with; of two nodes, the one with the later name connects.
    """
    base = beside(config_file, config.config) if config.config is not None else None
    if config.mode == "client":
        return Wiring(mode="client", connect=tuple(config.connect), config=base, insecure=config.insecure)
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
        # So peers of others on this host reach the nodes, too.
        gossip=bool(config.connect or config.listen),
        config=base,
        # Processes of one host start at the same time, so one of two that connect is not there yet. Each waits for the
        # others later: it registers, and says hello.
        waits=bool(config.connect),
        insecure=config.insecure,
    )


def with_doors(run: RunPlan) -> RunPlan:
    """The plan of a run whose processes here have a door at the network, for hosts that exchange rows directly."""
    zenoh = run.loaded.config.zenoh
    direct = [host for host in run.plan.hosts.values() if host.rows == "tcp" and host.ssh]
    if zenoh.rows_address is not None or not direct:
        return run
    from ..wire.meeting import address_towards  # noqa: PLC0415  most launchers meet nobody

    towards = direct[0].address or (direct[0].ssh or "").rpartition("@")[2]
    zenoh = replace(zenoh, rows_address=address_towards(towards))
    return replace(run, loaded=replace(run.loaded, config=replace(run.loaded.config, zenoh=zenoh)))


def certified(made: Wiring, security: SecurityConfig | None, root: str, ends: tuple[str, ...] = ()) -> Wiring:
    """The wiring of a process of a run with the certificate of this host, if it goes beyond the sockets of its user.

    Args:
        made: the wiring.
        security: the section, whose folder is absolute.
        root: prefix and name of the mesh.
        ends: the keys of other programs at ends of its connections.

    Raises:
        ConfigurationError: the certificate cannot be used, or not for this.
    """
    if security is None:
        return made
    # With gossip, a node could reach the master of its host by the port for others, whose rules do not know it.
    made = replace(made, gossip=False)
    if all(map(is_socket, (*made.listen, *made.connect))):
        return made
    from ..wire.security.certificates import identity_in  # noqa: PLC0415  most runs have no certificate

    own = identity_in(Path(security.folder), security.roles or None)
    if own.role not in ("node", None):  # None: only others know it
        text = f"'{own.name}' of '{security.folder}' is {own.role}, and who runs a mesh at a network has the role node"
        raise ConfigurationError(text, hint="`fmu-mesh security add` makes such a certificate for each host.")
    return replace(made, identity=own, root=root, ends=ends)


def identity_of(run: RunPlan) -> Identity | None:
    """The certificate with which the processes of a run come to others; None: they need none.

    Raises:
        ConfigurationError: it cannot be used.
    """
    zenoh, listens = run.loaded.config.zenoh, run.loaded.config.zenoh.mode == "peer"
    ends = Wiring(listen=tuple(zenoh.listen) if listens else (), connect=tuple(zenoh.connect))
    return certified(ends, run.loaded.config.security, "").identity


def warnings_of(run: RunPlan) -> list[str]:
    """What somebody should know who starts a part of a run: who can reach it, and when its certificate ends.

    Raises:
        ConfigurationError: it cannot be used.
    """
    open_ones = [str(warning) for warning in run.plan.system.warnings if _ACCESS.search(warning.path)]
    if (own := identity_of(run)) is None:
        return open_ones
    from ..wire.security.identity import warnings_about  # noqa: PLC0415  as above

    grid, factor = run.plan.grid, run.loaded.config.simulation.real_time_factor
    ends_at = None
    if factor and grid.stop_time is not None:
        with suppress(OverflowError):  # in more years than a date can have
            ends_at = datetime.now(UTC) + timedelta(seconds=(grid.stop_time - grid.start_time) / factor)
    return [*open_ones, *warnings_about(own, ends_at)]


def name_of(made: Wiring, security: SecurityConfig | None) -> str | None:
    """In whose name a process of a run sets values and gives commands; None: it needs none."""
    if made.identity is not None:
        return made.identity.name
    return LOCAL if security is not None else None


def table_of(own: Wiring) -> int:
    """Number of the table of roles of a process; 0: it needs none, or has none of our authority."""
    return own.identity.table.number if own.identity is not None and own.identity.table is not None else 0


def patient(made: Wiring, timeouts: TimeoutsConfig, *, is_node: bool, is_mirrored: bool = False) -> Wiring:
    """The wiring of a process that waits for the others as long as the configuration says.

    On one host the end of a process closes its sockets, so no link is given up before a step is: its deadlines come
    first. Of two hosts the one that connects decides. Between hosts a queue is full during a cut, and links wait for
    its end. A master that is on one host with all others does not wait so long for a tool that is stopped. Sockets that
    are ``is_mirrored`` are those of another host.
    """
    is_local = all(map(is_socket, made.connect)) and not is_mirrored
    lease_s = max(timeouts.link, 4 * timeouts.step) if is_local else timeouts.link
    waits = is_node or not all(map(is_socket, (*made.listen, *made.connect)))
    stuck_s = lease_s if waits else made.stuck_s
    return replace(made, lease_s=lease_s, stuck_s=stuck_s, patience_s=timeouts.router)


def shared_with_group(
    run: RunPlan, folder: Path, own: Wiring, at_end: Callable[[Callable[[], None]], object]
) -> tuple[str, ...]:
    """Where the members of a group reach a mesh, if it is shared with one; ``at_end`` takes what leaves that place.

    Raises:
        ConfigurationError: it cannot be.
    """
    if (group := run.loaded.config.runtime.share_with) is None:
        return ()
    if own.mode == "client":
        text = f"mesh '{run.mesh}' cannot be shared with the group '{group}': its master only connects to a router"
        raise ConfigurationError(text, hint="With `zenoh.mode: peer`, or started by `launch`, it has a socket.")
    endpoint = shared_endpoint(folder, group)
    at_end(partial(leave_shared, shared_file(folder, group)))
    return (endpoint,)
