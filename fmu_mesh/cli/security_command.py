"""`security`: an authority in a folder, and the folders that it hands over.

The work is `fmu_mesh.wire.security.authority`; here is only what is said of it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigurationError
from ..text import listed, short_path
from ..wire.security.identity import CERTIFICATE, ends_soon, time_left
from ..wire.security.rules import ACTIONS, ROLE_NAMES, for_networks
from .arguments import Runs
from .output.json_output import print_json

if TYPE_CHECKING:
    from ..wire.security.authority import Authority, Member

__all__ = ["RUNS"]

_DAYS: Final = 90.0
_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "init": (),
    "add": ("name", "role", "days", "host"),
    "renew": ("name", "days", "host"),
    "remove": ("name",),
    "show": ("table", "zenohd", "json", "end"),
}


def _security(arguments: argparse.Namespace) -> int:
    what, given = arguments.what, vars(arguments)
    for option in ("name", "role", "days", "host", "table", "zenohd", "json", "end"):
        if given[option] and option not in _OPTIONS[what]:
            shown = f"'{arguments.name}'" if option == "name" else f"--{option}"
            raise ConfigurationError(f"`security {what}` takes no {shown}")
    if "name" in _OPTIONS[what] and arguments.name is None:
        raise ConfigurationError(f"`security {what}` needs a name after the folder.")
    if arguments.table:
        for action in ACTIONS:
            print(f"{action.what:62} {', '.join(action.roles) or 'every certificate'}")
        return 0
    from ..wire.security.authority import LIST, Authority  # noqa: PLC0415  it needs an optional library

    folder: Path = arguments.folder
    if what == "init":
        authority = Authority.made(folder)
        print(f"{short_path(folder)}: a new authority, '{authority.name}', which {time_left(authority.until)}.")
        print("Its key, ca.key, stays here: who has it can certify anybody. No run reads it.")
        print(f"Next, a folder for each host and person: `fmu-mesh security add {folder} NAME --role ROLE`.")
    elif what == "show" and not (folder / LIST).exists() and (folder / CERTIFICATE).exists():
        _show_one(folder, as_json=arguments.json)
    else:
        _DO[what](Authority(folder), arguments)
    return 0


def _add(authority: Authority, arguments: argparse.Namespace) -> None:
    name, role = arguments.name, arguments.role
    if role is None:
        raise ConfigurationError(f"'{name}' needs a role.", hint=f"`--role` is one of {listed(ROLE_NAMES)}.")
    _hand_over(authority, authority.add(name, role, arguments.days or _DAYS, arguments.host))
    _tell_of_tables(authority, name)


def _renew(authority: Authority, arguments: argparse.Namespace) -> None:
    _hand_over(authority, authority.renew(arguments.name, arguments.days or _DAYS, arguments.host))
    print("Who dials takes it at the next dial, who listens at its next start. The old one is valid until it ends.")


def _remove(authority: Authority, arguments: argparse.Namespace) -> None:
    name, member = arguments.name, authority.members.get(arguments.name)
    authority.remove(name)
    print(f"'{name}' has no role in {authority.table}, nor in what is started with it.")
    if member is not None:
        print(f"What is running keeps its table until it is started again. The certificate {_life(member)}.")
    _tell_of_tables(authority, name)


def _show(authority: Authority, arguments: argparse.Namespace) -> None:
    if arguments.zenohd:
        rules: dict[str, Any] = {}
        for path, value in for_networks(f"{arguments.key_prefix}/*", authority.table.roles, arguments.end, ()).items():
            *above, last = path.split("/")
            reduce(lambda section, name: section.setdefault(name, {}), above, rules)[last] = value
        print(json.dumps(rules, indent=2))
        return
    if arguments.json:
        for name, member in authority.members.items():
            print_json({"name": name, "role": member.role, "until": member.until, "hosts": member.hosts})
        return
    print(f"The authority '{authority.name}' {time_left(authority.until)}; {authority.table}:")
    for name, member in authority.members.items():
        soon = ": renew it" if ends_soon(datetime.fromisoformat(member.until)) else ""
        print(f"{name:20} {member.role:9} {_life(member)}{soon}")


def _show_one(folder: Path, *, as_json: bool) -> None:
    from ..wire.security.certificates import identity_in  # noqa: PLC0415  as above

    own = identity_in(folder)
    if as_json:
        print_json({"name": own.name, "role": own.role, "until": own.until.isoformat(), "authority": own.authority})
        return
    role = f"{own.role} " if own.role is not None else ""
    print(f"{short_path(folder)}: {role}'{own.name}' of the authority '{own.authority}', {time_left(own.until)}")
    if own.table is not None:
        print(f"It has {own.table}: {', '.join(f'{name} ({role})' for name, role in own.table.roles.items())}")


def _life(member: Member) -> str:
    hosts = f"; listens as {', '.join(member.hosts)}" if member.hosts else ""
    return time_left(datetime.fromisoformat(member.until)) + hosts


def _hand_over(authority: Authority, folder: Path) -> None:
    member = authority.members[folder.name]
    print(f"{short_path(folder)}: {member.role} '{folder.name}', {_life(member)}")
    print("Hand this folder over, and nothing else: its key.pem is a secret.")


def _tell_of_tables(authority: Authority, changed: str) -> None:
    """A table is read at a start, so each host needs the newest one before."""
    nodes = [own for own, member in authority.members.items() if member.role == "node" and own != changed]
    if nodes:
        print(
            f"The folder of {listed(nodes)} has a new roles.json: copy it to each host that has a copy of its folder."
        )


_DO: Final[Mapping[str, Callable[[Authority, argparse.Namespace], None]]] = {
    "add": _add,
    "renew": _renew,
    "remove": _remove,
    "show": _show,
}

RUNS: Runs = {"security": _security}
