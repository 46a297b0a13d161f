"""The files that the nodes of another host need: a tree for each model, whose name is a hash of contents and places.

The trees are in the cache there (`fmu_mesh.hosts.cache`), and the plans of the nodes get their paths in it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from ..errors import ConfigurationError
from ..files import archive_on_the_way, sha256_of
from ..instances.registry import files_of
from ..system.plan import NodePlan
from ..text import counted

__all__ = ["Content"]

_MOST_FILES: Final = 10_000
_MOST_BYTES: Final = 1 << 32


class Content:
    """The files that the nodes of one host need.

    Args:
        host: its name, for errors.
        nodes: the nodes.
        results: files that the run writes: they are no part of a model.

    Attributes:
        trees: the SHA-256 of each file by its path in the tree, by the name of the tree.
        files: the files by SHA-256.

    Raises:
        ConfigurationError: a file cannot be read, or there are too many.
    """

    def __init__(self, host: str, nodes: Sequence[NodePlan], results: Sequence[Path]) -> None:
        self._host = host
        self.trees: dict[str, dict[str, str]] = {}
        self.files: dict[str, Path] = {}
        self._results = {os.path.realpath(file) for file in results}
        self._places: dict[str, tuple[str, str]] = {}
        size = 0
        try:
            for item in (item for node in nodes for item in node.instances):
                if item.fmu and Path(item.fmu) != Path() and item.fmu not in self._places:
                    path = Path(item.fmu)
                    own = archive_on_the_way(path)
                    self._add(path, [own] if own is not None else files_of(path, item.section), own)
                tables = [schedule.file.path for schedule in item.scenario if schedule.file is not None]
                tables += [item.recorded_keys.path] if item.recorded_keys is not None else []
                for table in map(Path, tables):
                    self._add(table, [table])
            size = sum(file.stat().st_size for file in self.files.values())
        except OSError as error:
            text = f"'{error.filename}', which host '{host}' needs, cannot be read: {error.strerror or error}"
            raise ConfigurationError(text) from error
        if size > _MOST_BYTES:
            text = f"the models of host '{host}' have {size} bytes, and at most {_MOST_BYTES} are sent"
            raise ConfigurationError(text, hint="Put a component into a folder of its own, without other files.")

    def _add(self, path: Path, found: Sequence[Path], inside: Path | None = None) -> None:
        """Add the tree of a model at ``path``, which may be ``inside`` an archive."""
        found = [file for file in found if os.path.realpath(file) not in self._results]
        if len(found) > _MOST_FILES:
            text = (
                f"'{path}' and what belongs to it are {counted(len(found), 'file')}; host '{self._host}' gets at most"
            )
            hint = "Put a component into a folder of its own, without other files."
            raise ConfigurationError(f"{text} {_MOST_FILES}", hint=hint)
        real = [(file.parent.resolve() / file.name, file) for file in found]
        is_folder = inside is None and path.is_dir()
        base = path.parent.resolve() / path.name if is_folder else None
        root = Path(os.path.commonpath([*(file.parent for file, _ in real), *([base] if base is not None else [])]))
        tree = {str(place.relative_to(root)): sha256_of(file) for place, file in real}
        name = hashlib.sha256("\n".join(f"{sha} {place}" for place, sha in sorted(tree.items())).encode()).hexdigest()
        self.trees[name] = tree
        self.files |= {tree[str(place.relative_to(root))]: file for place, file in real}
        model = path.parent.resolve() / path.name if inside is None else inside.parent.resolve() / inside.name
        rest = path.relative_to(inside) if inside is not None else Path()
        self._places[str(path)] = name, str(model.relative_to(root) / rest)

    def moved(self, node: bytes, cache: str) -> bytes:
        """What a node needs, as MessagePack, with the paths in a cache."""
        places = {path: f"{cache}/{tree}/{place}" for path, (tree, place) in self._places.items()}

        def of(value: object) -> object:
            if isinstance(value, dict):
                return {key: of(item) for key, item in value.items()}
            if isinstance(value, list):
                return [of(item) for item in value]
            return places.get(value, value) if isinstance(value, str) else value

        return msgspec.msgpack.encode(of(msgspec.msgpack.decode(node)))
