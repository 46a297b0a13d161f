"""Names of their own for the libraries that an FMU brings, where a process has loaded others under these names.

The dynamic linker looks for a needed library by its name, and takes what the process has loaded first under it, from
whatever folder and with whatever flags. So the second of two FMUs with a `libhelper.so` would compute with that of the
first, and two instances of one FMU would share its variables. The files of an instance are its own copies: in them, the
name is replaced by another one of the same length. Nothing else in a file moves.
"""

from __future__ import annotations

import ctypes
import os
import re
import secrets
from pathlib import Path
from typing import Final

__all__ = ["OF_THE_PROCESS", "can_be_renamed", "rename_libraries"]

OF_THE_PROCESS: Final = re.compile(
    r"(ld-linux.*|lib(c|m|dl|rt|pthread|util|stdc\+\+|gcc_s|gfortran|quadmath|gomp))\.so.*"
)
"""Libraries of the compiler: a process has one of each, and each later version takes the place of an earlier one."""

_RTLD_NOLOAD: Final = 4
_libc: Final = ctypes.CDLL(None)
_dlopen: Final = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int)(("dlopen", _libc))


def rename_libraries(folder: Path) -> None:
    """Rename the libraries below ``folder`` whose names are taken in this process, also where others name them.

    Their old names stay, for an FMU that opens a library by its path.
    """
    # Links lead into an FMU that is a folder of the user, and are not followed.
    files = [Path(parent, name) for parent, _, names in os.walk(folder) for name in names if ".so" in name]
    new = {
        file.name: secrets.token_hex(len(file.name))[: len(file.name)]
        for file in files
        if not OF_THE_PROCESS.fullmatch(file.name) and _is_loaded(file.name)
    }
    if not new:
        return
    for file in files:
        if file.is_symlink() or not (content := file.read_bytes()).startswith(b"\x7fELF"):
            continue
        for old, own in new.items():
            content = content.replace(_whole(old), _whole(own))
        file.unlink()  # other processes may use the same file
        file.write_bytes(content)
    for file in files:
        if file.name in new:
            file.with_name(new[file.name]).symlink_to(file.name)


def can_be_renamed(name: str, content: bytes) -> bool:
    """Whether a library that needs another one by its ``name`` has that name as a text of its own."""
    return _whole(name) in content


def _whole(name: str) -> bytes:
    return b"\0" + name.encode() + b"\0"


def _is_loaded(name: str) -> bool:
    handle = _dlopen(name.encode(), os.RTLD_LAZY | _RTLD_NOLOAD)
    if handle:
        _libc.dlclose(ctypes.c_void_p(handle))
    return bool(handle)
