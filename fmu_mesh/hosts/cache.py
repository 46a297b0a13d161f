"""The cache of a host for the files of models that launchers on other hosts have sent.

It has each content once, by its SHA-256, and trees of links to contents, so that a model whose files are there is not
sent again. What was not used for long is removed, and the oldest of what is too much; nothing that a helper uses.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from ..files import cache_folder, remove_tree, sha256_of

__all__ = ["JOURNALS", "Cache"]

JOURNALS: Final = "journals"
"""The folder in the cache with what nodes got from outside, for the next attempt of their run."""
_MOST_BYTES: Final = 1 << 34
_UNUSED_S: Final = 30 * 86400.0
_UNLINKED_S: Final = 3600.0
"""So old is a content of no tree that no helper makes one of it."""


class Cache:
    """The cache, for one helper.

    Attributes:
        folder: where it is.
        trees: where its trees are.
    """

    def __init__(self) -> None:
        self.folder = cache_folder() / "hosts"
        self.trees, self._contents = self.folder / "trees", self.folder / "contents"
        self._held: list[int] = []

    def missing(self, trees: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
        """The contents that have to be sent.

        Raises:
            OSError: there can be no cache.
        """
        for own in (self._contents, self.trees):
            own.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._forget_drafts()  # of an older process of this number
        contents = dict.fromkeys(sha for own in trees.values() for sha in own.values())
        for sha in contents:
            with suppress(FileNotFoundError):
                if sha256_of(file := self._contents / sha) != sha:  # it is damaged
                    file.unlink()
        missing = tuple(sha for sha in contents if not (self._contents / sha).is_file())
        for name, tree in trees.items():
            if not {*missing}.isdisjoint(tree.values()):
                remove_tree(self.trees / name)
        return missing

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
                    raise OSError(errno.EIO, "it has changed on the way", str(draft))
            draft.chmod(0o400)
            draft.replace(self._contents / content)

    def make(self, trees: Mapping[str, Mapping[str, str]]) -> None:
        """Make the trees that are not here yet; then remove what is old, or too much.

        Raises:
            OSError: there is no room.
        """
        for name, tree in trees.items():
            draft = self.trees / f"{name}.{os.getpid()}"
            for place, content in tree.items() if not self._hold(name) else ():
                (file := draft / place).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                os.link(self._contents / content, file)
            with suppress(OSError):  # it is here; or another helper was faster
                draft.rename(self.trees / name)
            self._hold(name)
        self._bound()

    def mark(self, terms: str) -> Path:
        """A file that is there for an hour after somebody has made it, to know what was checked."""
        return self._contents / f"checked-{hashlib.sha256(terms.encode()).hexdigest()}"

    def journals(self, name: str, *, are_new: bool) -> Path | None:
        """The folder for the journals of a run (ADR 87), which outlives this process; None without a name.

        Raises:
            OSError: there is no room.
        """
        (folder := self.folder / JOURNALS).mkdir(mode=0o700, parents=True, exist_ok=True)
        for other in folder.iterdir():  # that of a run whose end nobody could tell
            if (other.name == name and are_new) or time.time() - other.stat().st_mtime > _UNUSED_S:
                remove_tree(other)
        if not name:
            return None
        (own := folder / name).mkdir(mode=0o700, exist_ok=True)
        os.utime(own)
        return own

    def close(self) -> None:
        """Hold no tree any more, and remove what is not finished."""
        while self._held:
            os.close(self._held.pop())
        self._forget_drafts()

    def _forget_drafts(self) -> None:
        for folder in (self._contents, self.trees):
            for draft in folder.glob(f"*.{os.getpid()}"):
                draft.unlink() if draft.is_file() else remove_tree(draft)

    def _hold(self, name: str) -> bool:
        """Keep a tree from being removed while this process runs; whether it is here."""
        with suppress(FileNotFoundError):
            tree = os.open(self.trees / name, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(tree, fcntl.LOCK_SH)
            self._held.append(tree)
            os.utime(self.trees / name)
            return True
        return False

    def _bound(self) -> None:
        now = time.time()
        for used, tree in sorted((tree.stat().st_mtime, tree) for tree in self.trees.iterdir()):
            contents = [content.stat() for content in self._contents.iterdir()]
            size = sum(content.st_size for content in contents if content.st_nlink > 1)
            if now - used < _UNUSED_S and size < _MOST_BYTES:
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
