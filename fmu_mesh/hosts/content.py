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

__all__ = ["Content"]

_MOST_FILES: Final = 10_000
_MOST_BYTES: Final = 1 << 32
_HINT: Final = "Put a component into a folder of its own, without other files."


class Content:
    """The files that the nodes of one host need.

    Args:
        host: its name, for errors.
        nodes: the nodes.
        more: other files that they read.
        results: files that the run writes: they are no part of a model.

    Attributes:
        trees: the SHA-256 of each file by its path in the tree, by the name of the tree.
        files: the files by SHA-256.

    Raises:
        ConfigurationError: a file cannot be read, or there are too many.
    """

    def __init__(self, host: str, nodes: Sequence[NodePlan], more: Sequence[Path], results: Sequence[Path]) -> None:
        self._host = host
        self.trees: dict[str, dict[str, str]] = {}
        self.files: dict[str, Path] = {}
        self._results = {os.path.realpath(file) for file in results}
        self._moved: dict[str, str] = {}
        size = 0
        try:
            for item in (item for node in nodes for item in node.instances):
                if item.fmu and Path(item.fmu) != Path() and item.fmu not in self._moved:
                    path = Path(item.fmu)
                    own = archive_on_the_way(path)
                    self._add(path, [own] if own is not None else files_of(path, item.section), own)
                tables = [schedule.file.path for schedule in item.scenario if schedule.file is not None]
                tables += [item.recorded_keys.path] if item.recorded_keys is not None else []
                more = [*more, *map(Path, tables)]
            for file in more:
                self._add(file, [file])
            size = sum(file.stat().st_size for file in self.files.values())
        except OSError as error:
            text = f"'{error.filename}', which {host} needs, cannot be read: {error.strerror or error}"
            raise ConfigurationError(text) from error
        if size > _MOST_BYTES:
            text = f"the models of {host} have {size} bytes, and it gets at most {_MOST_BYTES}"
            raise ConfigurationError(text, hint=_HINT)

    def _add(self, path: Path, found: Sequence[Path], inside: Path | None = None) -> None:
        """Add the tree of a model at ``path``, which may be ``inside`` an archive."""
        own, model = [file for file in found if os.path.realpath(file) not in self._results], _place(inside or path)
        if len(own) > _MOST_FILES:
            text = f"'{path}' and what belongs to it are {len(own)} files, and {self._host} gets at most {_MOST_FILES}"
            raise ConfigurationError(text, hint=_HINT)
        places = [*map(_place, own)]
        root = os.path.commonpath([*(place.parent for place in places), model if model.is_dir() else model.parent])
        tree = {str(place.relative_to(root)): sha256_of(file) for place, file in zip(places, own, strict=True)}
        name = hashlib.sha256("\n".join(f"{sha} {place}" for place, sha in sorted(tree.items())).encode()).hexdigest()
        self.trees[name] = tree
        self.files |= zip(tree.values(), own, strict=True)
        rest = path.relative_to(inside) if inside is not None else Path()
        self._moved[str(path)] = f"{name}/{model.relative_to(root) / rest}"

    def moved(self, node: bytes, cache: str) -> bytes:
        """What a node needs, as MessagePack, with the paths in a cache."""

        def of(value: object) -> object:
            if isinstance(value, dict):
                return {key: of(item) for key, item in value.items()}
            if isinstance(value, list):
                return [of(item) for item in value]
            return f"{cache}/{self._moved[value]}" if isinstance(value, str) and value in self._moved else value

        return msgspec.msgpack.encode(of(msgspec.msgpack.decode(node)))


def _place(file: Path) -> Path:
    """Where a file is; a link stays one, under its name."""
    return file.parent.resolve() / file.name
