"""Who can reach a mesh: the sections `zenoh`, `security` and `runtime`, and what an endpoint opens to others.

A Unix socket is open to its user. A port of this host is open to all its users, and one at a network to everybody
there: with TLS they need a certificate; without it they can do everything, so a configuration has to say that they may.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

from msgspec import Meta

from fmu_mesh.config.base import KEY_PREFIX_PATTERN, Base, Endpoint
from fmu_mesh.config.findings import Findings

__all__ = [
    "SECURITY_VARIABLE",
    "Role",
    "RuntimeConfig",
    "SecurityConfig",
    "ZenohConfig",
    "check_access",
    "given_folder",
    "has_tls",
    "host_of",
    "is_socket",
    "leaves_host",
    "port_of",
    "why_closed",
    "why_open",
]

Role = Literal["observer", "operator", "node"]

SECURITY_VARIABLE: Final = "FMU_MESH_SECURITY"
"""The variable of a host with the folder of its certificate."""


class ZenohConfig(Base, frozen=True, kw_only=True):
    """How the processes of the mesh find each other."""

    key_prefix: Annotated[
        str,
        Meta(
            pattern=KEY_PREFIX_PATTERN,
            title="a key such as fmu_mesh or lab/fmu_mesh, without / * $ ? # @ in its parts",
            description="First part of every key of the mesh.",
        ),
    ] = "fmu_mesh"
    mode: Annotated[
        Literal["peer", "client"],
        Meta(
            description="peer: nodes link directly to each other; client: everything goes through the router "
            "in `connect`, which is always so for nodes and masters that are started manually and only connect."
        ),
    ] = "peer"
    listen: Annotated[
        list[Endpoint],
        Meta(
            description="Where other hosts and users can connect to the master, such as tls/0.0.0.0:7447, besides the "
            "Unix socket in the user's runtime folder. tls/ needs `security`; tcp/ beyond this host, `insecure`."
        ),
    ] = []
    connect: Annotated[
        list[Endpoint],
        Meta(description="Where to connect to a router or to the mesh of another host, such as tls/192.168.1.2:7447."),
    ] = []
    insecure: Annotated[
        bool,
        Meta(
            description="true: there may be endpoints without TLS at a network, and everybody there can read and set "
            "values and end runs."
        ),
    ] = False
    shared_memory: Annotated[
        bool,
        Meta(
            description="true: processes on the same host read values, grants and progress in shared memory; false: "
            "they exchange them as processes of different hosts do."
        ),
    ] = True
    row_streams: Annotated[
        bool | None,
        Meta(
            description="true: processes that share no memory exchange values, grants and progress through sockets of "
            "their own, where they can reach each other; false: through Zenoh. null: true, and with `security` false, "
            "because those sockets have no TLS."
        ),
    ] = None
    rows_address: Annotated[
        Annotated[str, Meta(min_length=1)] | None,
        Meta(
            description="Address at which other hosts reach this host for row streams. Each host has its own, so it is "
            "an option of each process. null: the one from which it reaches the master or the router in `connect`."
        ),
    ] = None
    config: Annotated[
        str | None,
        Meta(description="A Zenoh configuration file (JSON5), relative to this file, to start from."),
    ] = None


class SecurityConfig(Base, frozen=True, kw_only=True):
    """With which certificate the processes of the mesh come to others, and who may do what."""

    folder: Annotated[
        str,
        Meta(
            description="Folder of this host with its certificate, as `fmu-mesh security add` makes it, relative to "
            "this file. On a host with the variable FMU_MESH_SECURITY, the folder that it names.",
            examples=["../security/lab"],
        ),
    ]
    roles: Annotated[
        dict[str, Role],
        Meta(
            description="Who has which role, by the common names of certificates, where another authority has signed "
            "them; default: roles.json in the folder.",
            examples=[{"alice": "operator", "lab": "node"}],
        ),
    ] = {}


class RuntimeConfig(Base, frozen=True, kw_only=True):
    """Where the processes of one host meet."""

    share_with: Annotated[
        str | None,
        Meta(
            description="A group of this host: its members reach the mesh by its Unix socket, and may do what you "
            "may; null: only you.",
            examples=["robotics"],
        ),
    ] = None


def is_socket(endpoint: str) -> bool:
    """Whether an endpoint is a Unix socket, which is protected by the permissions of its folder."""
    return endpoint.startswith("unixsock-stream/")


def has_tls(endpoint: str) -> bool:
    """Whether both ends of a link show certificates."""
    return endpoint.startswith(("tls/", "quic/"))


def host_of(endpoint: str) -> str:
    """The address or the name of the host in an endpoint of a network, such as `tls/[::1]:7447?...`."""
    return _host_and_port(endpoint)[0]


def port_of(endpoint: str) -> int:
    """The port in an endpoint of a network."""
    return int(_host_and_port(endpoint)[1])


def _host_and_port(endpoint: str) -> tuple[str, str]:
    address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
    host, _, port = address.rpartition(":")
    return host.strip("[]"), port


def leaves_host(endpoint: str) -> bool:
    """Whether other hosts can connect to a process that listens at this endpoint."""
    host = host_of(endpoint)
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return not is_socket(endpoint) and host != "localhost"


def given_folder(folder: str | Path | None) -> Path | None:
    """The folder of a certificate that is given, or that this host has."""
    given = folder or os.environ.get(SECURITY_VARIABLE)
    return Path(given).absolute() if given else None


def why_closed(endpoint: str, *, secured: bool, insecure: bool, own_settings: bool = False) -> tuple[str, str] | None:
    """Why no process listens or connects there: what was found, and what was expected; None if it may.

    Args:
        endpoint: where.
        secured: whether the process has a certificate.
        insecure: whether the user has written that everybody may do everything.
        own_settings: whether the user has settings of Zenoh, which may have certificates.
    """
    if is_socket(endpoint):
        return None
    if has_tls(endpoint):
        if secured or own_settings:
            return None
        return f"'{endpoint}' without a certificate", f"`security=...`, or {SECURITY_VARIABLE}: a folder with one"
    if secured:
        return f"'{endpoint}' without TLS, although there is `security`", "an endpoint such as tls/192.168.1.2:7447"
    if insecure or not leaves_host(endpoint):
        return None
    ways = "tls/ and `security=...` (`fmu-mesh security init` begins), or `insecure=True`"
    return f"'{endpoint}' is open to everybody who can reach it", f"{ways}: everybody there can set values and end runs"


def why_open(ends: Mapping[str, Sequence[str]], *, secured: bool) -> Iterator[tuple[str, str]]:
    """What a user should know of the endpoints of a mesh, which are right: the path of each, and a sentence.

    Args:
        ends: the endpoints by the path of their list, such as `zenoh.listen`.
        secured: whether there are certificates and roles.
    """
    for path, endpoints in ends.items():
        for index, endpoint in enumerate(endpoints):
            place = f"{path}[{index}]"
            if is_socket(endpoint):
                continue
            if path.startswith("ros."):
                if leaves_host(endpoint):
                    yield place, f"whoever can reach {endpoint} can send to this mesh what its topics take"
            elif secured:
                continue
            elif has_tls(endpoint):
                yield place, f"no roles are known at {endpoint}: who has a certificate can read, set and end this mesh"
            elif leaves_host(endpoint):
                where = f"this host at {endpoint}" if path.endswith("listen") else endpoint
                yield place, f"whoever can reach {where} can read, set and end this mesh"
            else:
                yield place, f"every user of this host can set values at {endpoint}"


def check_access(
    zenoh: ZenohConfig,
    security: SecurityConfig | None,
    ros: Mapping[str, Sequence[str]],
    findings: Findings,
    warnings: Findings,
) -> None:
    """Check where a mesh can be reached; ``ros`` has the endpoints of the section `ros` by their paths."""
    secured = security is not None
    if secured and zenoh.insecure:
        findings.add("zenoh.insecure", "true, although there is `security`", "one of the two")
    if secured and zenoh.row_streams:
        findings.add("zenoh.row_streams", "true, although there is `security`", "false: row streams have no TLS")
    own = {"zenoh.listen": zenoh.listen if zenoh.mode == "peer" else [], "zenoh.connect": zenoh.connect}
    for place, endpoints in own.items():
        for index, endpoint in enumerate(endpoints):
            settings = zenoh.config is not None
            closed = why_closed(endpoint, secured=secured, insecure=zenoh.insecure, own_settings=settings)
            if closed is not None:
                findings.add(f"{place}[{index}]", *closed)
    for place, text in why_open({**own, **ros}, secured=secured):
        warnings.add(place, text, "")
