"""`security`: an authority in a folder, and the folders that it hands over.

The work is `fmu_mesh.wire.security.authority`; here is only what is said of it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ..errors import ConfigurationError
from ..installing import importing
from ..text import counted, listed, short_path
from ..wire.security.rules import ACTIONS, ROLE_NAMES, access_control
from .arguments import Runs
from .output.json_output import print_json

if TYPE_CHECKING:
    from ..wire.security.authority import Authority, Member

__all__ = ["RUNS"]

_SOON: Final = timedelta(days=30)


def _security(arguments: argparse.Namespace) -> int:
    with importing("cryptography", "certificates"):
        from ..wire.security.authority import Authority  # noqa: PLC0415  an optional library
    if arguments.what == "init":
        authority = Authority.made(arguments.folder)
        print(f"{short_path(authority.folder)}: a new authority. Its key, ca.key, stays here; no run reads it.")
        print(f"Next, a folder for each host and person: `fmu-mesh security add {arguments.folder} NAME --role ROLE`.")
        return 0
    return _DO[arguments.what](Authority(arguments.folder), arguments)


def _add(authority: Authority, arguments: argparse.Namespace) -> int:
    name = _name(arguments)
    if arguments.role is None:
        raise ConfigurationError(f"'{name}' needs a role.", hint=f"`--role` is one of {listed(ROLE_NAMES)}.")
    if arguments.host and arguments.role != "node":
        raise ConfigurationError("`--host` is for who listens, and only a node does.")
    _hand_over(authority, authority.add(name, arguments.role, arguments.days, arguments.host))
    return 0


def _renew(authority: Authority, arguments: argparse.Namespace) -> int:
    _hand_over(authority, authority.renew(_name(arguments), arguments.days))
    return 0


def _remove(authority: Authority, arguments: argparse.Namespace) -> int:
    name = _name(arguments)
    authority.remove(name)
    nodes = [own for own, member in authority.members.items() if member.role == "node"]
    print(f"'{name}' has no role any more, from the next start of who listens with the new table on.")
    if nodes:
        print(f"Copy roles.json of {listed(nodes)} to their hosts again.")
    return 0


def _show(authority: Authority, arguments: argparse.Namespace) -> int:
    if arguments.zenohd:
        roles = {name: member.role for name, member in authority.members.items()}
        print(json.dumps({"access_control": access_control("fmu_mesh/*", roles)}, indent=2))
        return 0
    if arguments.table:
        for action in ACTIONS:
            print(f"{action.what:62} {', '.join(action.roles)}")
        return 0
    if arguments.json:
        for name, member in authority.members.items():
            print_json({"name": name, "role": member.role, "until": member.until, "hosts": member.hosts})
        return 0
    for name, member in authority.members.items():
        hosts = f"  listens as {', '.join(member.hosts)}" if member.hosts else ""
        print(f"{name:20} {member.role:9} {_until(member)}{hosts}")
    return 0


def _until(member: Member) -> str:
    until = datetime.fromisoformat(member.until)
    left = until - datetime.now(UTC)
    if left < timedelta(0):
        return f"ended at {until:%Y-%m-%d %H:%M} UTC"
    days = f"{counted(left.days, 'day')} left" if left >= timedelta(days=1) else "less than a day left"
    return f"until {until:%Y-%m-%d %H:%M} UTC ({days}{': renew it' if left < _SOON else ''})"


def _hand_over(authority: Authority, folder: Path) -> None:
    member = authority.members[folder.name]
    print(f"{short_path(folder)}: {member.role} '{folder.name}', {_until(member)}")
    print("Hand this folder over, and nothing else: its key.pem is a secret.")


def _name(arguments: argparse.Namespace) -> str:
    if arguments.name is None:
        raise ConfigurationError(f"`security {arguments.what}` needs a name after the folder.")
    return str(arguments.name)


_DO: Final[Mapping[str, Callable[[Authority, argparse.Namespace], int]]] = {
    "add": _add,
    "renew": _renew,
    "remove": _remove,
    "show": _show,
}

RUNS: Runs = {"security": _security}
