"""The files of models on the way to another host: what a launcher offers, and the cache in which a helper keeps them.

A model is a tree of files: its name is a hash of their contents and places. The cache has each content once, and each
tree with links to the contents, so that a model whose files are there is not sent again.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec

from ..errors import ConfigurationError
from ..files import archive_on_the_way, cache_folder, remove_tree, sha256_of
from ..instances.registry import files_of
from ..system.plan import NodePlan
from ..text import counted

__all__ = ["Cache", "Content"]

_MOST_FILES: Final = 10_000
_MOST_BYTES: Final = 1 << 32
"""Of the models of a host; and the cache has at most four times as much."""

_DAYS: Final = 30
"""A model that was not used for so long leaves the cache."""

_UNLINKED_S: Final = 3600.0
"""So old is a content of no tree that no helper makes one of it."""


class Content:
    """The files that the nodes of one host need.

    Args:
        host: its name, for errors.
        nodes: the nodes.
        results: files that the run writes: they are no part of a model.

    Attributes:
        trees: the SHA-256 of each file by its path in the tree, by the name of the tree.

    Raises:
        ConfigurationError: a file cannot be read, or there are too many.
    """

    def __init__(self, host: str, nodes: Sequence[NodePlan], results: Sequence[Path]) -> None:
        self._host = host
        self.trees: dict[str, dict[str, str]] = {}
        self.files: dict[str, Path] = {}
        """The files by SHA-256."""
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
        places = {path: f"{cache}/trees/{tree}/{place}" for path, (tree, place) in self._places.items()}

        def of(value: object) -> object:
            if isinstance(value, dict):
                return {key: of(item) for key, item in value.items()}
            if isinstance(value, list):
                return [of(item) for item in value]
            return places.get(value, value) if isinstance(value, str) else value

        return msgspec.msgpack.encode(of(msgspec.msgpack.decode(node)))


class Cache:
    """The cache of a helper.

    Args:
        folder: of the cache.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or cache_folder() / "hosts"
        self._contents, self._trees = self.folder / "contents", self.folder / "trees"
        self._held: list[int] = []

    def missing(self, trees: Mapping[str, Mapping[str, str]]) -> Iterator[str]:
        """The contents that are not here yet."""
        for own in (self._contents, self._trees):
            own.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, tree in trees.items():
            if not self._hold(name):
                yield from (sha for sha in dict.fromkeys(tree.values()) if not (self._contents / sha).is_file())

    def take(self, content: str, data: bytes, *, last: bool) -> None:
        """Take a part of a content.

        Raises:
            OSError: there is no room, or it is not what was announced.
        """
        draft = self._contents / f"{content}.{os.getpid()}"
        with draft.open("ab") as file:
            file.write(data)
        if last:
            with draft.open("rb") as file:
                if hashlib.file_digest(file, "sha256").hexdigest() != content:
                    draft.unlink()
                    raise OSError(errno.EIO, "it has changed on the way", str(draft))
            draft.replace(self._contents / content)

    def make(self, trees: Mapping[str, Mapping[str, str]]) -> None:
        """Make the trees that are not here yet; then remove what nobody uses and is old, or too much.

        Raises:
            OSError: there is no room.
        """
        for name, tree in trees.items():
            if self._hold(name):
                continue
            draft = self._trees / f"{name}.{os.getpid()}"
            for place, content in tree.items():
                (file := draft / place).parent.mkdir(parents=True, exist_ok=True)
                os.link(self._contents / content, file)
            with suppress(OSError):  # another helper was faster
                draft.rename(self._trees / name)
            remove_tree(draft)
            self._hold(name)
        self._bound()

    def _hold(self, name: str) -> bool:
        """Keep a tree from being removed while this process runs; whether it is here."""
        with suppress(FileNotFoundError):
            tree = os.open(self._trees / name, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(tree, fcntl.LOCK_SH)
            self._held.append(tree)
            if (self._trees / name).exists():
                os.utime(tree)
                return True
        return False

    def _bound(self) -> None:
        """Remove what was not used for long, and the oldest of what is too much; nothing that a helper uses."""
        now = time.time()
        for used, tree in sorted((tree.stat().st_mtime, tree) for tree in self._trees.iterdir()):
            size = sum(content.stat().st_size for content in self._contents.iterdir())
            if now - used < _DAYS * 86400 and size < 4 * _MOST_BYTES:
                break
            folder = os.open(tree, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            with suppress(BlockingIOError):  # somebody uses it
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_tree(tree)
            os.close(folder)
        for content in self._contents.iterdir():
            found = content.stat()
            if found.st_nlink == 1 and now - found.st_mtime > _UNLINKED_S:
                content.unlink(missing_ok=True)
