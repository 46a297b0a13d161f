"""Whether code that a configuration names may run: one rule, asked wherever a file names code.

A configuration of the user's own may name code. A result, the folder of a sweep, a package, and a configuration of
another user may not, nor may they name hosts to log in to; and code that other users can write does not run.
`--allow-code` lifts these, and the user is told what runs. Models are no code in this sense: an FMU runs wherever it is
named. But its sources are compiled only where the user's own configuration, program or command names the FMU, or in its
sandbox; one that is only looked at (by `inspect`, by `new` in a folder, by completion) is not compiled.
"""

from __future__ import annotations

import grp
import os
import pwd
import stat
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ..config.findings import Findings
from ..config.instance_sections import InstanceSection, key_of
from ..config.loading import LoadedConfig
from ..config.mesh import LimitsConfig
from ..errors import ConfigurationError
from ..instances.registry import needs_compiler

__all__ = ["check_code", "check_owner", "names_code"]


def check_code(
    loaded: LoadedConfig,
    findings: Findings,
    tell: Callable[[str], None],
    allowed: str,
    compiles: Callable[[Path, InstanceSection, LimitsConfig], bool] = needs_compiler,
) -> None:
    """Check that all code of a configuration may run: add a finding for each instance or host that may not.

    Args:
        loaded: the configuration, with absolute paths of interpreters.
        findings: those of the configuration.
        tell: called with what runs only because it is allowed.
        allowed: why it is allowed, in words, such as "because of `allow_code=True`"; empty if it is not.
        compiles: whether to describe a model compiles it.
    """
    source = loaded.foreign or _other_owner(loaded.file)
    for name, section in loaded.config.instances.items():
        if not section.runs_code:
            is_apart = not section.follows_fmi or loaded.config.process_of(section).is_sandboxed
            if not source or allowed or is_apart or not section.path:
                continue
            if compiles(loaded.resolve(section.path), loaded.config.model_section(section), loaded.config.limits):
                expected = "a binary for this platform, or `allow_code=True`"
                findings.add(f"instances.{name}.{key_of(section)}", f"sources to compile, in {source}", expected)
            continue
        key, path = key_of(section), loaded.resolve(section.path) if section.path else None
        found, expected = f"Python code, in {source}", "a file of your own, or `allow_code=True`"
        if not source:
            if path is None or (open_path := _writable_by_others(path)) is None:
                continue
            mode = stat.S_IMODE(open_path.stat().st_mode)
            found = f"other users can write '{open_path}', which has mode {mode:04o}"
            expected = f"one that only you can write (`chmod go-w {open_path}`), or `allow_code=True`"
        if not allowed:
            findings.add(f"instances.{name}.{key}", found, expected)
            continue
        code = str(getattr(section, key)).replace(section.path, str(path or ""), 1)
        by = f" with {section.interpreter}" if section.interpreter is not None else ""
        tell(f"instance '{name}' runs {code}{by}, {allowed} ({found})")
    if source:
        _check_hosts(loaded, source, findings, tell, allowed)


def _check_hosts(
    loaded: LoadedConfig, source: str, findings: Findings, tell: Callable[[str], None], allowed: str
) -> None:
    for name, host in loaded.config.deploy.hosts.items():
        if host.ssh is not None and allowed:
            tell(
                f"nodes run on host '{name}', by `ssh {host.ssh}` and its `{host.python}`, {allowed} (as {source} says)"
            )
        elif host.ssh is not None:
            expected = "a file of your own, or `allow_code=True`"
            findings.add(f"deploy.hosts.{name}.ssh", f"a host that you would log in to, in {source}", expected)


def names_code(loaded: LoadedConfig) -> bool:
    """Whether a configuration names code."""
    return any(section.runs_code for section in loaded.config.instances.values())


def check_owner(path: Path, what: str) -> None:
    """Check that this user, or root, owns a file that says what to run.

    Raises:
        ConfigurationError: another user owns it.
    """
    if _other_owner(path):
        raise ConfigurationError(
            f"{what} belongs to another user", hint="`allow_code=True` runs it, with the Python code that it may name."
        )


def _other_owner(file: Path) -> str:
    """A configuration file of another user in words; empty if this user, or root, owns it."""
    try:
        owner = file.stat().st_uid
    except OSError:
        return ""  # there is no file: a program of this user has made the configuration
    name = repr(_name_of(owner)) if _name_of(owner) else owner
    return f"a file of the user {name}" if owner not in {os.getuid(), 0} else ""


def _name_of(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:  # as in a container
        return ""


def _writable_by_others(path: Path) -> Path | None:
    """The file, or the folder on the way to it, by which other users could replace its content; None: they cannot."""
    for place in dict.fromkeys([path, *path.parents, *(real := path.resolve()).parents, real]):
        with suppress(OSError):  # whoever reads it says why
            found = place.stat()
            is_shared = found.st_mode & stat.S_IWGRP and not _is_private(found.st_gid, found.st_uid)
            is_sticky = place.is_dir() and found.st_mode & stat.S_ISVTX  # only owners replace entries
            if (is_shared or found.st_mode & stat.S_IWOTH) and not is_sticky:
                return place
    return None


def _is_private(group: int, user: int) -> bool:
    """Whether a group is the one of a user alone, as distributions make one for each, or that of root."""
    own, name = None, _name_of(user)
    with suppress(KeyError):
        own = grp.getgrgid(group)
    has_others = own is not None and {*own.gr_mem} - {name}
    return group == 0 or (not has_others and (group == user or (own is not None and own.gr_name == name)))
