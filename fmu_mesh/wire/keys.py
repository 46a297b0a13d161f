"""The key space (design, section 6): one place that knows how a key is spelt."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

import msgspec

__all__ = ["Keys", "VariableKind", "batched", "escape", "unescape"]

VariableKind = Literal["out", "in", "param", "local"]

_UNSAFE = re.compile(r"[/*$?#%]|^@|[\x00-\x20\x7f]")
_ESCAPED = re.compile(r"%([0-9A-F]{2})")
_GRANT_CHUNKS = 16


def escape(name: str) -> str:
    """A variable name as one chunk of a key expression: `/ * $ ? # %`, blanks and a leading `@` become `%XX`."""
    return _UNSAFE.sub(lambda match: "".join(f"%{byte:02X}" for byte in match.group().encode()), name)


def unescape(chunk: str) -> str:
    """The variable name that `escape` made this chunk from."""
    return _ESCAPED.sub(lambda match: chr(int(match.group(1), 16)), chunk)


class Keys(msgspec.Struct, frozen=True):
    """The keys of one mesh.

    Attributes:
        prefix: first part of every key, `fmu_mesh` by default.
        mesh: name of the mesh.
    """

    prefix: str
    mesh: str

    @property
    def root(self) -> str:
        """What every key of the mesh starts with."""
        return f"{self.prefix}/{self.mesh}"

    def instance(self, name: str) -> str:
        """Liveliness token of an instance, and what its keys start with."""
        return f"{self.root}/{name}"

    def variable(self, instance: str, kind: VariableKind, variable: str) -> str:
        """Value of one variable."""
        return f"{self.root}/{instance}/{kind}/{escape(variable)}"

    def mesh_key(self, what: Literal["info", "status", "plan", "command"]) -> str:
        """A queryable of the master."""
        return f"{self.root}/mesh/{what}"

    @property
    def master(self) -> str:
        """Liveliness token of the master."""
        return f"{self.root}/mesh"

    def node_token(self, node: str) -> str:
        """Liveliness token of a node as a process; internal."""
        return f"{self.root}/@sync/node/{node}"

    def follower(self, name: str) -> str:
        """Liveliness token of a reader that has not got its last sample yet: the master stays for it; internal."""
        return f"{self.root}/@sync/follower/{name}"

    def hello(self, node: str) -> str:
        """Queryable of a node that answers as soon as its subscribers are declared."""
        return f"{self.root}/@sync/hello/{node}"

    @property
    def register(self) -> str:
        """Queryable of the master where nodes register; answered when all are there."""
        return f"{self.root}/@sync/register"

    @property
    def report(self) -> str:
        """Queryable of the master that takes the end or the failure of a node."""
        return f"{self.root}/@sync/report"

    def inbox(self, node: str) -> str:
        """Key expression that a node subscribes to for everything sent to it."""
        return f"{self.root}/@sync/**/to={node}/**"

    def frames(self, source: str, target_node: str) -> str:
        """Frames of one instance for one node."""
        return f"{self.root}/@sync/frame/{source}/to={target_node}"

    def progress(self) -> str:
        """Progress of the nodes, for the master."""
        return f"{self.root}/@sync/progress/to=@mesh"

    def wake(self, node: str) -> str:
        """A node's own key to wake itself up; never leaves the process."""
        return f"{self.root}/@sync/wake/to={node}"

    def grants(self, nodes: Iterable[str]) -> list[str]:
        """Keys on which one put each reaches up to 16 nodes."""
        return [f"{self.root}/@sync/grant/" + "/".join(f"to={node}" for node in part) for part in batched(nodes)]


def batched(nodes: Iterable[str]) -> list[list[str]]:
    """The nodes that one put of a grant reaches, for each of the keys of `Keys.grants`."""
    names = list(nodes)
    return [names[first : first + _GRANT_CHUNKS] for first in range(0, len(names), _GRANT_CHUNKS)]
