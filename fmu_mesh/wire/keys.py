"""The key space (docs/key-space.md): the only module that knows how keys are written."""

from __future__ import annotations

import re
import secrets
from collections.abc import Sequence
from typing import Literal

import msgspec

from ..system.memory_map import MASTER, RECORDER

__all__ = ["BY", "LOCAL", "RUN_ID_BYTES", "SUBSCRIBED", "Keys", "RunKeys", "VariableKind", "escape", "unescape"]

VariableKind = Literal["out", "in", "param", "local"]

_UNSAFE = re.compile(r"[/*$?#%]|^@|[\x00-\x20\x7f]")
_ESCAPED = re.compile(r"%([0-9A-F]{2})")
_GRANT_CHUNKS = 16

SUBSCRIBED = "subscribed"
"""Parameter of a query for a status: the node first finds what its sender has subscribed to."""

BY = "@by"
"""The chunk before the name of who sets or commands, where there is security. A rule lets each name use its own keys;
wildcards do not match such a chunk."""

LOCAL = "local"
"""Who comes by the Unix socket of a mesh: an operator and node that no certificate can name."""

RUN_ID_BYTES = 8
"""Hexadecimal digits of a run's id. So the id never begins with `@`: wildcards do not match such a chunk."""


def escape(name: str) -> str:
    """A variable name as one chunk of a key expression: `/ * $ ? # %`, blanks and a leading `@` become `%XX`."""
    return _UNSAFE.sub(lambda match: "".join(f"%{byte:02X}" for byte in match.group().encode()), name)


def unescape(chunk: str) -> str:
    """The variable name that `escape` made this chunk from."""
    return _ESCAPED.sub(lambda match: chr(int(match.group(1), 16)), chunk)


class Keys(msgspec.Struct, frozen=True):
    """The public keys of one mesh, and the beginning of its internal keys; all begin with ``prefix``.

    Attributes:
        by: who uses them, in a mesh with security: the name in the keys on which it sets and commands.
    """

    prefix: str
    mesh: str
    by: str | None = None

    @property
    def root(self) -> str:
        """What every key of the mesh starts with."""
        return f"{self.prefix}/{self.mesh}"

    def instance(self, name: str) -> str:
        """Liveliness token of an instance, and the beginning of its keys."""
        return f"{self.root}/{name}"

    def variable(self, instance: str, kind: VariableKind, variable: str) -> str:
        """Key of the value of one variable."""
        return f"{self.variables(instance, kind)}/{escape(variable)}"

    def variables(self, instance: str, kind: VariableKind) -> str:
        """What the keys of the variables of one kind begin with."""
        return f"{self.root}/{instance}/{kind}"

    def setting(self, instance: str, variable: str | None = None) -> str:
        """Key on which a variable is set, or without it several at one point."""
        return self._by(f"{self.root}/{instance}/set") + (f"/{escape(variable)}" if variable is not None else "")

    @property
    def command(self) -> str:
        """Key on which the master takes commands."""
        return self._by(self.mesh_key("command"))

    def _by(self, key: str) -> str:
        return f"{key}/{BY}/{self.by}" if self.by is not None else key

    def mesh_key(self, what: Literal["info", "status", "plan", "command", "log", "ros", "hello"]) -> str:
        """A queryable of the master; `ros` begins the keys of the gateways to ROS."""
        return f"{self.root}/mesh/{what}"

    def role(self, role: str) -> str:
        """A queryable of the master that the rules let only one role ask."""
        return f"{self.root}/mesh/role/{role}"

    @property
    def master(self) -> str:
        """Liveliness token of the master."""
        return f"{self.root}/mesh"

    @property
    def register(self) -> str:
        """Queryable of the master where nodes register and learn the run's id."""
        return f"{self.root}/@sync/register"

    def run(self, run: str) -> RunKeys:
        """The internal keys of one run."""
        return RunKeys(self.root, run)


class RunKeys(msgspec.Struct, frozen=True):
    """The internal keys of one run of a mesh, or of any run if its id is `*`.

    They contain the id, so that two runs never exchange messages.
    """

    root: str
    run: str

    @classmethod
    def new(cls, keys: Keys) -> RunKeys:
        """The keys of a new run, with a random id."""
        return keys.run(secrets.token_hex(RUN_ID_BYTES))

    @property
    def base(self) -> str:
        """What every internal key of the run starts with."""
        return f"{self.root}/@sync/{self.run}"

    @property
    def master(self) -> str:
        """Liveliness token of the master of this run."""
        return f"{self.base}/master"

    @staticmethod
    def node_in(key: str) -> str:
        """The node whose token, readiness or report has this key."""
        return key.rpartition("/of=")[2]

    def node(self, node: str) -> str:
        """Liveliness token of a node as a process."""
        return f"{self.base}/node/{_of(node)}"

    def follower(self, name: str) -> str:
        """Liveliness token of a reader that has not got its last sample yet: the master waits for it."""
        return f"{self.base}/follower/{name}"

    def hello(self, node: str) -> str:
        """Queryable of a node that answers when it knows the subscription of the asking node."""
        return f"{self.base}/hello/{_of(node)}"

    def ready(self, node: str) -> str:
        """Queryable of the master where a node reports that its links work; it answers when all nodes have reported."""
        return f"{self.base}/ready/{_of(node)}"

    def report(self, node: str) -> str:
        """Queryable of the master where a node reports its end or its failure."""
        return f"{self.base}/report/{_of(node)}"

    def inbox(self, node: str) -> str:
        """Key expression that a node subscribes to for everything sent to it."""
        return f"{self.base}/**/to={node}/**"

    def wake(self, node: str) -> str:
        """What a node sends to its own inbox, to wake its main thread."""
        return f"{self.base}/wake/to={node}"

    def frames(self, source: str, target_node: str) -> str:
        """Frames of one instance for one node."""
        return f"{self.base}/frame/{source}/to={target_node}"

    def settings(self, node: str) -> str:
        """The values that others have set on the instances of a node, for the recorder."""
        return f"{self.base}/set/{_of(node)}/to={RECORDER}"

    def progress(self, node: str) -> str:
        """Progress of a node, for the master."""
        return f"{self.base}/progress/{_of(node)}/to={MASTER}"

    def grants(self, nodes: Sequence[str]) -> dict[str, str]:
        """The key of the master's messages to each node; one put reaches all nodes with the same key, up to 16."""
        parts = [nodes[first : first + _GRANT_CHUNKS] for first in range(0, len(nodes), _GRANT_CHUNKS)]
        return {
            node: f"{self.base}/grant/" + "/".join(f"to={name}" for name in part) for part in parts for node in part
        }


def _of(node: str) -> str:
    """The chunk of a node, or of all nodes. A name may begin with `@`, and wildcards do not match such a chunk."""
    return node if node == "*" else f"of={node}"
