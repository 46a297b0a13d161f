"""What an FMU uses of which a process has only one (`fmu_mesh.system.process_sharing`), read from its libraries.

Owns the reasons. Each instance loads copies of the libraries of its FMU, under names of its own
(`fmu_mesh.instances.fmi.archive.library_names`). What remains are libraries of which there are no copies, symbols that
C++ declares unique, and the interpreter of Python.
"""

from __future__ import annotations

import hashlib
import posixpath
import re
from typing import Final

from .... import files
from ....system.process_sharing import BOTH_USE_PYTHON, Claims
from .archive import OpenFmu
from .library_names import OF_THE_PROCESS, can_be_renamed
from .shared_library import SharedLibrary, read_shared_library

__all__ = ["claims_of"]

_OF_CPP: Final = re.compile(r"_ZGV|_Z(T[VTIS])?Z?NK?(S[absiodt]|9__gnu_cxx)|_Z(T[VTIS])?S")
"""What the standard library of C++ leaves in each library that uses it; and guards, which stand beside a variable."""
_PYTHON: Final = (b"Py_Initialize", b"PyImport_Import")


def claims_of(fmu: OpenFmu, library: str) -> Claims:
    """What an FMU claims whose own library has the name ``library`` in it."""
    claims: dict[str, str] = {}
    libraries = _Libraries(fmu)
    waiting = [library]
    for path in waiting:  # grows
        facts, content = libraries.read(path)
        if any(name in content for name in _PYTHON):
            claims[BOTH_USE_PYTHON] = ""
        for symbol, constant in facts.unique.items():
            if not _OF_CPP.match(symbol):
                why = f"both have the C++ variable '{symbol}', of which a process has one (STB_GNU_UNIQUE)"
                claims[why] = _sha256(constant) if constant is not None else ""
        for name, found in libraries.asked_by(path).items():
            if found is not None and found not in waiting:
                waiting.append(found)
            if not OF_THE_PROCESS.fullmatch(name):
                is_renamed = libraries.is_copied(found) and (name not in facts.needed or can_be_renamed(name, content))
                content_of = "the system" if found is None else "a copy of its own" if is_renamed else ""
                claims[f"both load a library '{name}', of which a process has one"] = content_of
    return claims


class _Libraries:
    """The libraries of an FMU, each read once."""

    def __init__(self, fmu: OpenFmu) -> None:
        self._fmu = fmu
        self._names = fmu.contents().names
        self._read: dict[str, tuple[SharedLibrary, bytes]] = {}

    def read(self, path: str) -> tuple[SharedLibrary, bytes]:
        """What a library says about itself, and its bytes; nothing of a file that is none."""
        if path not in self._read:
            content = self._fmu.read_binary(path)
            facts = read_shared_library(content)
            self._read[path] = (facts, content) if facts is not None else (SharedLibrary(), b"")
        return self._read[path]

    def is_copied(self, path: str | None) -> bool:
        """Whether each instance has a copy of a library: it is in an archive, or among the binaries of a folder."""
        return path is not None and (path.startswith("binaries/") or not files.is_folder(self._fmu.path))

    def asked_by(self, path: str) -> dict[str, str | None]:
        """The libraries that one needs or may open, by name: where in the FMU; None: on this host."""
        facts, content = self.read(path)
        folder = posixpath.dirname(path)
        found = {
            name: next(
                (file for place in [*facts.folders(folder), folder] if (file := f"{place}/{name}") in self._names), None
            )
            for name in facts.needed
            if "/" not in name  # otherwise it is a path
        }
        beside = (one for one in self._names if posixpath.dirname(one) == folder and ".so" in one and one != path)
        named = {name: one for one in beside if (name := posixpath.basename(one)).encode() in content}
        return {**named, **found}


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
