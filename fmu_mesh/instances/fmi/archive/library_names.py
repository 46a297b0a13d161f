"""Libraries of which a process has one: renamed in the files of an instance, or claimed by it (ADR 66).

The dynamic linker looks for a needed library by its name, and takes what the process has loaded first under it, from
whatever folder and with whatever flags. So the second of two FMUs with a `libhelper.so` would compute with that of the
first, and two instances of one FMU would share its variables. The files of an instance are its own copies: in them, the
name is replaced by another one of the same length. Nothing else in a file moves. What remains is claimed
(`fmu_mesh.system.process_sharing`): libraries of which there are no copies, symbols that C++ declares unique, and the
interpreter of Python.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import posixpath
import re
import secrets
from pathlib import Path
from typing import Final

from .... import files
from ....system.process_sharing import BOTH_USE_PYTHON, Claims
from .archive import OpenFmu
from .shared_library import SharedLibrary, read_shared_library

__all__ = ["claims_of", "rename_libraries"]

_OF_THE_PROCESS: Final = re.compile(
    r"(ld-linux.*|lib(c|m|dl|rt|pthread|util|stdc\+\+|gcc_s|gfortran|quadmath|gomp))\.so.*"
)
"""Libraries of the compiler: a process has one of each, and each later version takes the place of an earlier one."""

_OF_CPP: Final = re.compile(r"_ZGV|_Z(T[VTIS])?Z?NK?(S[absiodt]|9__gnu_cxx)|_Z(T[VTIS])?S")
"""What the standard library of C++ leaves in each library that uses it; and guards, which stand beside a variable."""
_PYTHON: Final = (b"Py_Initialize", b"PyImport_Import")

_RTLD_NOLOAD: Final = 4
_libc: Final = ctypes.CDLL(None)
_dlopen: Final = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int)(("dlopen", _libc))


def rename_libraries(folder: Path) -> None:
    """Rename the libraries below ``folder`` whose names are taken in this process, also where others name them.

    Their old names stay, for an FMU that opens a library by its path.
    """
    # Links lead into an FMU that is a folder of the user, and are not followed.
    found = [Path(parent, name) for parent, _, names in os.walk(folder) for name in names if ".so" in name]
    new = {
        file.name: secrets.token_hex(len(file.name))[: len(file.name)]
        for file in found
        if not _OF_THE_PROCESS.fullmatch(file.name) and _is_loaded(file.name)
    }
    if not new:
        return
    for file in found:
        if file.is_symlink() or not (content := file.read_bytes()).startswith(b"\x7fELF"):
            continue
        for old, own in new.items():
            content = content.replace(_whole(old), _whole(own))
        file.unlink()  # other processes may use the same file
        file.write_bytes(content)
    for file in found:
        if file.name in new:
            file.with_name(new[file.name]).symlink_to(file.name)


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
                claims[why] = hashlib.sha256(constant).hexdigest() if constant is not None else ""
        for name, found in libraries.asked_by(path).items():
            if found is not None and found not in waiting:
                waiting.append(found)
            if not _OF_THE_PROCESS.fullmatch(name):
                is_renamed = libraries.is_copied(found) and (name not in facts.needed or _whole(name) in content)
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


def _whole(name: str) -> bytes:
    return b"\0" + name.encode() + b"\0"


def _is_loaded(name: str) -> bool:
    handle = _dlopen(name.encode(), os.RTLD_LAZY | _RTLD_NOLOAD)
    if handle:
        _libc.dlclose(ctypes.c_void_p(handle))
    return bool(handle)
