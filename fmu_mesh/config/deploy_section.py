"""Where the nodes of a mesh run: the section `deploy`, and what it means for the `host` of an instance.

A host is a name of this file. With `ssh`, `launch` starts the nodes of that host over the user's own ssh; without, a
person starts them there. An instance without a `host` runs on the host of `launch`, as does the master.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from msgspec import Meta

from fmu_mesh.config.access_sections import ZenohConfig
from fmu_mesh.config.base import Base, Name
from fmu_mesh.config.findings import Findings
from fmu_mesh.text import listed, nearest

__all__ = ["DeployConfig", "HostConfig", "check_deploy"]

_SHELL_SAFE = r"^[A-Za-z0-9_./~+:@%][A-Za-z0-9_./~+:@%,=-]*$"
"""The remote shell gets such a text as one word, and expands a `~` at its beginning; it is no option."""


class HostConfig(Base, frozen=True, kw_only=True):
    """One host, and how its nodes are started."""

    ssh: Annotated[
        Annotated[
            str,
            Meta(
                pattern=r"^[^-\s\x00-\x1f\x7f][^\s\x00-\x1f\x7f]*$",
                title="a destination of ssh such as user@lab2",
            ),
        ]
        | None,
        Meta(
            description="What your own `ssh` connects to: [user@]host, or a name of ~/.ssh/config; null: its nodes are "
            "started there with `fmu-mesh node CONFIG --host NAME`.",
            examples=["user@lab2"],
        ),
    ] = None
    python: Annotated[
        str,
        Meta(
            pattern=_SHELL_SAFE,
            title="a path such as ~/mesh/bin/python or a name, without spaces",
            description="The Python there that has fmu_mesh: a path, or a name that its shell finds.",
            examples=["~/mesh/bin/python"],
        ),
    ] = "python3"
    address: Annotated[
        Annotated[str, Meta(min_length=1)] | None,
        Meta(
            description="Address at which the other hosts reach this one; null: the one from which its nodes reach "
            "the master.",
            examples=["192.168.1.3"],
        ),
    ] = None
    rows: Annotated[
        Literal["sockets", "tcp"],
        Meta(
            description="With `ssh`, how rows go to and from its nodes: sockets: through ssh; tcp: directly, without "
            "encryption, which needs `zenoh: {insecure: true}`."
        ),
    ] = "sockets"


class DeployConfig(Base, frozen=True, kw_only=True):
    """On which hosts nodes run, besides the one of `launch`."""

    hosts: Annotated[
        dict[Name, HostConfig],
        Meta(description="The hosts that instances can name as their `host`, by name."),
    ] = {}

    def known(self, host: str | None) -> str | None:
        """The `host` of an instance; None: that of `launch`, which a `host` without an entry means, too."""
        return host if host in self.hosts else None


def check_deploy(
    deploy: DeployConfig,
    zenoh: ZenohConfig,
    placed: Mapping[str, str | None],
    findings: Findings,
    warnings: Findings,
) -> None:
    """Check the hosts, and the `host` of each instance.

    A file without any entry is as it was before there were entries, for two versions: `host` has no effect in it.
    """
    for name, host in placed.items():
        place = f"instances.{name}.host"
        if host is None or host in deploy.hosts:
            continue
        if deploy.hosts:
            expected = f"one of {listed(list(deploy.hosts))}, or null: where `launch` runs"
            findings.add(place, f"the unknown host '{host}'", expected, nearest(host, deploy.hosts))
            continue
        found = f"the host '{host}', which has no entry in `deploy.hosts`, so `launch` runs '{name}' here"
        expected = f"`deploy: {{hosts: {{{host}: {{ssh: ...}}}}}}`; from version 0.6 on, it is needed"
        warnings.add(place, found, expected)
    for name, entry in deploy.hosts.items():
        if entry.rows == "tcp" and not zenoh.insecure:
            expected = "`zenoh: {insecure: true}`: everybody in that network can read them; or `rows: sockets`"
            findings.add(f"deploy.hosts.{name}.rows", "tcp, for rows without encryption", expected)
