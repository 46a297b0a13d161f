"""Plain Zenoh sessions with the certificates of folders, as programs of others have them, and routers with rules."""

from __future__ import annotations

import json
import socket
from pathlib import Path
from typing import Any, Final, Literal

import zenoh

from fmu_mesh.wire.security.identity import CA, CERTIFICATE, KEY
from tests.helpers import Launched, Place, wait_until

__all__ = ["DIALS", "free_endpoint", "opened", "secured_router"]

DIALS: Final = ("client", "peer", "router")
"""As what a program can dial."""


def opened(folder: Path, mode: str, **settings: object) -> zenoh.Session:
    """A plain session with the certificate of a folder, or with none if there is none in it."""
    own = {name: str(folder / name) for name in (CA, CERTIFICATE, KEY)}
    comes = (folder / KEY).exists()
    tls: dict[str, Any] = {"root_ca_certificate": own[CA], "enable_mtls": comes, "verify_name_on_connect": True}
    if comes:
        tls |= {f"{end}_certificate": own[CERTIFICATE] for end in ("listen", "connect")}
        tls |= {f"{end}_private_key": own[KEY] for end in ("listen", "connect")}
    scouting = {f"scouting/{kind}/enabled": False for kind in ("multicast", "gossip")}
    ends: dict[str, list[str]] = {"listen/endpoints": [], "connect/endpoints": []}
    config = zenoh.Config()
    for key, value in {"mode": mode, **ends, "transport/link/tls": tls, **scouting, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def free_endpoint(kind: Literal["tls", "quic", "tcp"] = "tls") -> str:
    """An endpoint of this host with a free port."""
    with socket.socket(type=socket.SOCK_DGRAM if kind == "quic" else socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{kind}/127.0.0.1:{probe.getsockname()[1]}"


def secured_router(place: Place, folder: Path, *ends: str) -> tuple[Launched, str]:
    """Our router with the certificate and the table of a folder, and its endpoint."""
    own = (word for end in ends for word in ("--end", end))
    router = place.start("router", "--listen", "tls/127.0.0.1:0", "--security", folder, *own)
    wait_until(lambda: "router at " in router.output, "a router")
    return router, router.output.split("router at ")[1].split()[0].rstrip(",")
