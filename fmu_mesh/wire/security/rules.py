"""Who may do what: one table of actions and roles, and the access rules of Zenoh that are made from it.

Whoever accepts links has these rules, and they count for what comes in. A query or a subscription has to lie within one
rule, so tools ask no wider keys than those here. `**` contains no chunk that begins with `@`: such keys have rules of
their own. Nothing is allowed that no rule allows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from .identity import LOCAL, Role

__all__ = ["ACTIONS", "HELLO", "ROLE_NAMES", "Action", "access_control"]

ROLE_NAMES: Final[tuple[Role, ...]] = ("observer", "operator", "node")

_READS: Final = ("query", "declare_subscriber")
_ANSWERS: Final = ("put", "delete", "reply")
_TOKENS_IN: Final = ("liveliness_query", "declare_liveliness_subscriber")
_TOKENS_OUT: Final = ("liveliness_token",)
_SENDS: Final = ("put", "query")
_ABOUT_SENDS: Final = ("reply", "declare_subscriber", "declare_queryable")
"""What somebody who sends has to hear: an answer, and whether somebody listens."""

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


HELLO: Final = "**/mesh/hello"
"""What meshes answer to every certificate."""


class Action(NamedTuple):
    """Something that a role may do.

    Attributes:
        what: in words, for the table.
        roles: who may.
        keys: below the mesh, with `{name}` and `{role}` of who does it; of the whole prefix with `{all}`.
        comes: the messages that come in; ``goes``: those that go out.
    """

    what: str
    roles: tuple[Role, ...]
    keys: tuple[str, ...]
    comes: tuple[str, ...]
    goes: tuple[str, ...]


_WHO_ACTS: Final[tuple[Role, ...]] = ("operator", "node")

ACTIONS: Final = (
    # A tool that knows neither the prefix nor the name of a mesh asks for all of them.
    Action("see which meshes and instances run", ROLE_NAMES, ("**/mesh", "{mesh}/*"), _TOKENS_IN, _TOKENS_OUT),
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
        tuple(f"{{mesh}}/mesh/{what}" for what in ("info", "status", "plan", "log", "audit", "role/{role}")),
        _READS,
        _ANSWERS,
    ),
    Action("set inputs and parameters", _WHO_ACTS, ("{mesh}/*/set/@by/{name}/**",), _SENDS, _ABOUT_SENDS),
    Action("pause, resume, step, reset and stop", _WHO_ACTS, ("{mesh}/mesh/command/@by/{name}",), _SENDS, _ABOUT_SENDS),
    Action("be a part of a run", ("node",), ("{mesh}/**", "{mesh}/@sync/**"), _ALL, _ALL),
)


def access_control(root: str, roles: Mapping[str, Role], ends: Iterable[str] = ()) -> dict[str, Any]:
    """The section `access_control` of Zenoh's configuration, for who accepts links.

    Args:
        root: prefix and name of the mesh; `*` for any mesh.
        roles: by common name.
        ends: keys that the configuration names as ends of connections: operators may write and read them.
    """
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    named = {**roles, LOCAL: "node"}
    own_ends = tuple(ends)
    for number, action in enumerate(ACTIONS):
        texts = [key for key in action.keys if "{name}" in key or "{role}" in key]
        for group, names in _groups(action, named, own=bool(texts)):
            keys = [key.format(mesh=root, name=names[0], role=named[names[0]]) for key in action.keys]
            for flow, messages in (("ingress", action.comes), ("egress", action.goes)):
                rule = f"{number} {group} {flow}"
                rules.append(
                    {"id": rule, "permission": "allow", "flows": [flow], "messages": [*messages], "key_exprs": keys}
                )
                policies.append({"id": rule, "rules": [rule], "subjects": [*names]})
    if own_ends:
        rules.append(
            {
                "id": "ends",
                "permission": "allow",
                "flows": ["ingress", "egress"],
                "messages": [*_ALL],
                "key_exprs": [*own_ends],
            }
        )
        policies.append(
            {"id": "ends", "rules": ["ends"], "subjects": [name for name, role in named.items() if role != "observer"]}
        )
    # So a client with a certificate and without a role learns that it has none.
    for flow, messages in (("ingress", _READS), ("egress", _ANSWERS)):
        rule, keys = f"hello {flow}", [HELLO]
        rules.append({"id": rule, "permission": "allow", "flows": [flow], "messages": [*messages], "key_exprs": keys})
        policies.append({"id": rule, "rules": [rule], "subjects": ["anybody"]})
    subjects: list[dict[str, Any]] = [{"id": name, "cert_common_names": [name]} for name in roles]
    subjects.append({"id": "anybody"})  # without names: everybody
    subjects.append({"id": LOCAL, "link_protocols": ["unixsock-stream"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _groups(action: Action, roles: Mapping[str, Role], *, own: bool) -> Sequence[tuple[str, tuple[str, ...]]]:
    """Those who share the rules of an action: each name for itself where keys have the name."""
    names = [name for name, role in roles.items() if role in action.roles]
    if own:
        return [(name, (name,)) for name in names]
    return [("all", tuple(names))] if names else []
