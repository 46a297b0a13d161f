"""What installed packages offer through entry points, found by name and imported when it is used.

In the usual process only the entry points of our own distribution are read, which takes about 1 ms. All distributions
are read only for a name that is not ours.
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from typing import Any

from .errors import ConfigurationError
from .text import listed

__all__ = ["plugin", "plugin_names"]

_OURS = "fmu-mesh"


def plugin(group: str, name: str) -> Any | None:  # noqa: ANN401 the group decides what its entry points name
    """The object that is offered as ``name`` in a group of entry points, or None if no package offers it.

    Ours comes first: another package cannot replace it.

    Raises:
        ConfigurationError: two packages offer it, its package cannot be imported, or fmu-mesh has to be installed
            again.
    """
    own = _own(group).get(name)
    found = (own,) if own is not None else tuple(metadata.entry_points(group=group, name=name))
    if not found:
        return None
    packages = sorted(f"'{entry.dist.name}'" for entry in found if entry.dist is not None)
    if len(found) > 1:
        text = f"the packages {listed(packages)} both offer '{name}' (entry points '{group}')."
        raise ConfigurationError(text, hint="Uninstall one of them.")
    try:
        return found[0].load()
    except Exception as error:
        text = f"'{name}' of the package {listed(packages)} cannot be imported from '{found[0].value}'"
        raise ConfigurationError(f"{text}: {type(error).__name__}: {error}", hint="Repair or uninstall it.") from error


def plugin_names(group: str) -> list[str]:
    """All names that are offered in a group of entry points, ours first.

    Raises:
        ConfigurationError: fmu-mesh has to be installed again.
    """
    own = _own(group)
    return [*own, *sorted({entry.name for entry in metadata.entry_points(group=group)} - own.keys())]


@cache
def _own(group: str) -> dict[str, metadata.EntryPoint]:
    try:
        own = {entry.name: entry for entry in metadata.distribution(_OURS).entry_points.select(group=group)}
    except metadata.PackageNotFoundError:
        own = {}
    if not own:
        text = f"the installation of {_OURS} is older than its source: it has no entry points '{group}'"
        raise ConfigurationError(text, hint="Install it again, in a checkout with `pip install --editable .`.")
    return own
