"""The digest of a mesh: processes that compare it know that they have the same version, configuration and models.

Manually started processes, and those on several hosts, read the configuration and the models separately. The digest has
one part for each, so that an error can say what differs. `fmu_mesh.system.plan` decides what of the configuration
counts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

import msgspec

from .. import __version__
from ..text import listed
from .system import ResolvedSystem

__all__ = ["difference", "digest_of"]

_CONFIGURATION_DIGITS, _MODEL_DIGITS = 16, 12


def digest_of(configuration: object, system: ResolvedSystem, contents: Mapping[str, str]) -> str:
    """The digest of a mesh: our version, a hash of the configuration, and one of the model of each instance.

    A model is the GUID and the SHA-256 of its content; the configuration is what must be equal, as JSON can hold it.
    What the solver `auto` is depends on the host: without the library of C, the same configuration gives other floats.
    Which Wine runs an FMU for Windows is in its metadata only: a version for each host is no other configuration.
    """
    models = [(name, own.description) for name, own in sorted(system.instances.items())]
    hashes = [_hash((model.guid, contents.get(name, "")))[:_MODEL_DIGITS] for name, model in models]
    solved = [(name, model) for name, model in models if model.kind == "model_exchange"]
    solvers = [system.config.instances[name].summary(model).partition(", under ")[0] for name, model in solved]
    return " ".join([__version__, _hash((configuration, solvers))[:_CONFIGURATION_DIGITS], *hashes])


def difference(own: str, other: str, instances: Iterable[str]) -> str:
    """In words, what is different in a process with the digest ``other``: `another model of 'gain'`."""
    (version, configuration, *models), there = own.split(), other.split()
    if len(there) < 2 or there[0] != version:
        return f"another version of fmu_mesh than {version}"
    if there[1] != configuration:
        return "another configuration"
    pairs = zip(sorted(instances), models, there[2:], strict=False)
    changed = listed([f"'{name}'" for name, one, two in pairs if one != two])
    return f"another model of {changed}"


def _hash(value: object) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()
