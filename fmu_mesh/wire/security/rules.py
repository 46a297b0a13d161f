"""Who may do what: one table of actions and roles, and the access rules of Zenoh that are made from it.

Whoever accepts links has these rules, and they count for what comes in. A query or a subscription has to lie within one
rule, so tools ask no wider keys than those here. `**` contains no chunk that begins with `@`: such keys have rules of
their own. Nothing is allowed that no rule allows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from ..keys import LOCAL
from ..messages import MAX_MESSAGE_SIZE
from .identity import Role

__all__ = ["ACTIONS", "HELLO", "ROLE_NAMES", "Action", "access_control", "for_networks"]

HELLO: Final = "**/mesh/hello"
"""What meshes answer to every certificate."""

ROLE_NAMES: Final[tuple[Role, ...]] = ("observer", "operator", "node")
_WHO_ACTS: Final[tuple[Role, ...]] = ("operator", "node")

_READS: Final = ("query", "declare_subscriber")
_ANSWERS: Final = ("put", "delete", "reply")
_TOKENS_IN: Final = ("liveliness_query", "declare_liveliness_subscriber")
_TOKENS_OUT: Final = ("liveliness_token",)
_SENDS: Final = ("put", "query")
_WHO_LISTENS: Final = ("declare_subscriber", "declare_queryable")
"""What declared publishers and queriers hear before they send. The key is that of who listens, which may be wide."""

_ALL: Final = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


class Action(NamedTuple):
    """Something that a role may do.

    Attributes:
        what: in words, for the table.
        roles: who may; empty: whoever has a certificate.
        keys: with `{mesh}`, and with `{name}` and `{role}` of who does it.
        comes: the messages that come in; ``goes``: those that go out.
    """

    what: str
    roles: tuple[Role, ...]
    keys: tuple[str, ...]
    comes: tuple[str, ...]
    goes: tuple[str, ...]


_OF_MESH: Final = ("info", "status", "plan", "log", "audit", "ros/*", "role/{role}")
_END: Final = "{ends}"
_ENDS: Final = (_END,)
_NAMED: Final = ("{mesh}/*/set/@by/**", "{mesh}/mesh/command/@by/**")
"""The keys with names: a router hands on what others send, and so whoever is a part of a run may use all names."""

ACTIONS: Final = (
    Action("know that a mesh is there", (), (HELLO,), ("query",), ("reply", "declare_queryable")),
    Action("see which meshes and instances run", ROLE_NAMES, ("**/mesh", "{mesh}/*"), _TOKENS_IN, _TOKENS_OUT),
    Action("see who listens", ROLE_NAMES, ("{mesh}/**",), (), _WHO_LISTENS),
    Action(
        "read values: outputs, inputs, parameters, local variables",
        ROLE_NAMES,
        tuple(f"{{mesh}}/*/{kind}/**" for kind in ("out", "in", "param", "local")),
        _READS,
        _ANSWERS,
    ),
    Action(
        "read what an instance is, its state and its log",
        ROLE_NAMES,
        ("{mesh}/*/info", "{mesh}/*/status", "{mesh}/*/log"),
        _READS,
        _ANSWERS,
    ),
    Action(
        "read the plan, the state, the log and the audit of the mesh",
        ROLE_NAMES,
        tuple(f"{{mesh}}/mesh/{what}" for what in _OF_MESH),
        _READS,
        _ANSWERS,
    ),
    Action("read the keys at ends of connections", ROLE_NAMES, _ENDS, _READS, (*_ANSWERS, *_WHO_LISTENS)),
    Action("write the keys at ends of connections", _WHO_ACTS, _ENDS, _ALL, _ALL),
    Action("set inputs and parameters", _WHO_ACTS, ("{mesh}/*/set/@by/{name}/**",), _SENDS, ("reply",)),
    Action(
        "pause, resume, step, reset, stop, checkpoint",
        _WHO_ACTS,
        ("{mesh}/mesh/command/@by/{name}",),
        _SENDS,
        ("reply",),
    ),
    Action("see who listens to settings and commands", _WHO_ACTS, _NAMED, (), _WHO_LISTENS),
    Action("be a part of a run", ("node",), ("{mesh}/**", "{mesh}/@sync/**", *_NAMED), _ALL, _ALL),
)


def access_control(root: str, roles: Mapping[str, Role], ends: Iterable[str] = ()) -> dict[str, Any]:
    """The section `access_control` of Zenoh's configuration, for who accepts links.

    Args:
        root: prefix and name of the mesh; `*` for any mesh.
        roles: by common name.
        ends: keys that the configuration names as ends of connections; with what `zenoh.ext` adds to them.
    """
    named: dict[str, Role] = {**roles, LOCAL: "node"}
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    at_ends = [key for end in ends for key in (end, f"{end}/@adv/**")]
    for number, action in enumerate(ACTIONS):
        for names in _together(action, named):
            words = {"mesh": root, "name": names[0], "role": named.get(names[0])}
            keys = at_ends if action.keys == _ENDS else [key.format(**words) for key in action.keys]
            for flow, messages in (("ingress", action.comes), ("egress", action.goes)):
                if messages and keys:
                    rule = f"{number} {names[0]} {flow}"
                    about = {"messages": [*messages], "flows": [flow], "key_exprs": keys}
                    rules.append({"id": rule, "permission": "allow", **about})
                    policies.append({"id": rule, "rules": [rule], "subjects": [*names]})
    subjects: list[dict[str, Any]] = [{"id": name, "cert_common_names": [name]} for name in roles]
    subjects += [{"id": LOCAL, "link_protocols": ["unixsock-stream"]}, {"id": _EVERYBODY}]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def for_networks(
    root: str, roles: Mapping[str, Role], ends: Iterable[str], priorities: Iterable[Any]
) -> dict[str, Any]:
    """The sections of Zenoh's configuration for who accepts links: the rules, and what messages may have beside them.

    Args:
        root: as of `access_control`.
        roles: as of it.
        ends: as of it.
        priorities: what else there is in the section `qos/network`.
    """
    read = [
        key.format(mesh=root, role="*") for own in ACTIONS if own.comes == _READS for key in own.keys if key != _END
    ]
    at_networks = {"link_protocols": ["tls", "quic"]}
    asked = {"messages": ["query"], "flows": ["ingress"], **at_networks}
    status = f"{root}/*/status"
    return {
        "access_control": access_control(root, roles, ends),
        # A message is put together before any rule: of one that is larger, nobody would take the content.
        "transport/link/rx/max_message_size": MAX_MESSAGE_SIZE + _KEY_BYTES,
        # Whoever reads sends no payload, and would make a node look at it.
        "low_pass_filter": [
            {"id": "reads", "key_exprs": [HELLO, *(key for key in read if key != status)], "size_limit": 0, **asked},
            {"id": "names", "key_exprs": [status], "size_limit": _NAMES_BYTES, **asked},
        ],
        # A sender would wait for an observer that does not read. `**` fits no key of the synchronization.
        "qos/network": [
            *priorities,
            {
                "messages": ["put"],
                "key_exprs": [f"{root}/**"],
                "overwrite": {"congestion_control": "drop"},
                "flows": ["egress"],
                **at_networks,
            },
        ],
    }


_KEY_BYTES: Final = 1 << 16
_NAMES_BYTES: Final = 1 << 22
"""A question for a state may have the names of the variables that its sender has subscribed to."""

_EVERYBODY: Final = "*"
"""A subject without any property; no name of a certificate is this."""


def _together(action: Action, roles: Mapping[str, Role]) -> Iterator[tuple[str, ...]]:
    """Those who share the rules of an action: each name for itself where keys have the name or the role."""
    names = tuple(name for name, role in roles.items() if role in action.roles)
    if not action.roles:
        yield (_EVERYBODY,)
    elif any("{name}" in key or "{role}" in key for key in action.keys):
        yield from ((name,) for name in names)
    elif names:
        yield names
