"""What installed packages offer through entry points, found by name and imported when it is used.

In the usual process only the entry points of our own distribution are read, which takes less than 1 ms. All
distributions are read only for a name that is not ours.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

from .errors import ConfigurationError
from .installing import installed_from
from .text import listed

__all__ = ["own_plugin_names", "plugin", "plugin_names"]

_OURS = "fmu-mesh"
_FILE = "fmu_mesh-*.dist-info/entry_points.txt"


def plugin(group: str, name: str) -> Any | None:  # noqa: ANN401 the group decides what its entry points name
    """The object that is offered as ``name`` in a group of entry points, or None if no package offers it.

    Ours comes first: another package cannot replace it.

    Raises:
        ConfigurationError: two packages offer it, its package cannot be imported, or fmu-mesh has to be installed
            again.
    """
    own = _own(group)
    found = [(_OURS, own[name])] if name in own else [(package, of) for package, key, of in _all(group) if key == name]
    if not found:
        return None
    packages = listed(sorted(f"'{package}'" for package, _ in found))
    if len(found) > 1:
        text = f"the packages {packages} both offer '{name}' (entry points '{group}')."
        raise ConfigurationError(text, hint="Uninstall one of them.")
    [(_, place)] = found
    module, _, attribute = place.partition(":")
    try:
        return attrgetter(attribute)(import_module(module))
    except Exception as error:
        text = f"'{name}' of the package {packages} cannot be imported from '{place}': {type(error).__name__}: {error}"
        raise ConfigurationError(text, hint="Repair or uninstall it.") from error


def plugin_names(group: str) -> list[str]:
    """All names that are offered in a group of entry points, ours first.

    Raises:
        ConfigurationError: fmu-mesh has to be installed again.
    """
    own = _own(group)
    return [*own, *sorted({name for _, name, _ in _all(group)} - own.keys())]


def own_plugin_names(group: str) -> list[str]:
    """The names that fmu-mesh itself offers in a group of entry points; no other package is looked at.

    Raises:
        ConfigurationError: fmu-mesh has to be installed again.
    """
    return [*_own(group)]


@cache
def _own(group: str) -> dict[str, str]:
    """What we offer: `module:object` by name."""
    files = (file for folder in sys.path for file in Path(folder).glob(_FILE))
    lines = file.read_text(encoding="utf-8").splitlines() if (file := next(files, None)) is not None else []
    own, section = {}, ""
    for line in lines:
        name, equals, place = map(str.strip, line.partition("="))
        section = line.strip() if line.startswith("[") else section
        if equals and section == f"[{group}]":
            own[name] = place
    if not own:
        text = f"the installation of {_OURS} is older than its source: it has no entry points '{group}'"
        raise ConfigurationError(
            text, hint=f"Install it again, as you did before, from {installed_from() or 'a clone'}."
        )
    return own


def _all(group: str) -> list[tuple[str, str, str]]:
    """What all packages offer: package, name and `module:object`."""
    from importlib import metadata  # noqa: PLC0415 it takes 17 ms, and the usual process does without

    return [(entry.dist.name, entry.name, entry.value) for entry in metadata.entry_points(group=group) if entry.dist]
