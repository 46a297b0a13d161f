"""What a shared library says about itself, read from its file without loading it.

Owns the reading of ELF. Who may share a process, which library is missing on this host and which functions of the
process an FMU may call are questions for the callers.
"""

from __future__ import annotations

import hashlib
import posixpath
import re
import struct
from io import BytesIO
from typing import Any, Final

import msgspec
import numpy as np

from .archive import OpenFmu

__all__ = ["SYMBOL", "SharedLibrary", "libraries_beside", "read_shared_library"]

_GNU_UNIQUE: Final = 10
"""The binding STB_GNU_UNIQUE."""
_WRITABLE: Final = 2
"""The flag PF_W of a segment."""
SYMBOL: Final = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)
"""`Elf64_Sym`."""


class SharedLibrary(msgspec.Struct, frozen=True):
    """A library as the dynamic linker sees it."""

    sha256: str = ""  # of its content
    soname: str = ""  # the name that a process knows it by; empty if it has none: then that is the name of its file
    needed: tuple[str, ...] = ()  # the names of the libraries that it needs
    run_paths: tuple[str, ...] = ()  # the folders that it looks for them in, as written (`$ORIGIN` is its own folder)
    # the symbols that exist once in a process, whoever loads them and however (STB_GNU_UNIQUE): the bytes of a
    # constant, None for a variable
    unique: dict[str, bytes | None] = {}
    machine: bytes = b""  # two bytes of its header that tell processors apart: the class and the machine
    versions: frozenset[str] = frozenset()  # the versions of its symbols, such as `GLIBC_2.38` for the library of C
    needed_versions: dict[str, frozenset[str]] = {}  # the versions that it needs, by the names of libraries

    def folders(self, own: str) -> list[str]:
        """The run paths of a library that lies in the folder ``own`` (ld.so(8), $ORIGIN)."""
        return [posixpath.normpath(re.sub(r"\$(ORIGIN|\{ORIGIN\})", lambda _: own, path)) for path in self.run_paths]


def libraries_beside(fmu: OpenFmu, library: str) -> dict[str, SharedLibrary]:
    """The libraries in the folder of the library that is loaded, itself included, by the names of their files."""
    folder = library.rpartition("/")[0]
    names = sorted(name for name in fmu.contents().names if name.rpartition("/")[0] == folder)
    found = {name.rpartition("/")[2]: read_shared_library(fmu.read_binary(name)) for name in names}
    return {name: facts for name, facts in found.items() if facts is not None}


def read_shared_library(content: bytes) -> SharedLibrary | None:
    """Read the dynamic section of a library of 64 bits; None if it is none, is damaged or is static."""
    # It takes 30 ms to import, and most runs need none of this.
    from elftools.common.exceptions import ELFError  # noqa: PLC0415 see above
    from elftools.elf.elffile import ELFFile  # noqa: PLC0415 see above

    try:
        elf = ELFFile(BytesIO(content))
        dynamic: Any = next(elf.iter_segments("PT_DYNAMIC"), None)
        if dynamic is None or elf.elfclass != 64 or not elf.little_endian:
            return None
        tags = list(dynamic.iter_tags())
        unique = _unique(content, elf, dynamic)
        versions, needed_versions = _versions(elf)
    # Files of other people: pyelftools raises what the damage provokes.
    except (ELFError, ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError, struct.error):
        return None
    return SharedLibrary(
        sha256=hashlib.sha256(content).hexdigest(),
        soname=next((tag.soname for tag in tags if tag.entry.d_tag == "DT_SONAME"), ""),
        needed=tuple(tag.needed for tag in tags if tag.entry.d_tag == "DT_NEEDED"),
        run_paths=tuple(
            folder
            for tag in tags
            if tag.entry.d_tag in ("DT_RPATH", "DT_RUNPATH")
            for folder in (tag.rpath if tag.entry.d_tag == "DT_RPATH" else tag.runpath).split(":")
        ),
        unique=unique,
        machine=content[4:20:14],
        versions=versions,
        needed_versions=needed_versions,
    )


def _versions(elf: Any) -> tuple[frozenset[str], dict[str, frozenset[str]]]:  # noqa: ANN401 as in `_unique`
    """The versions of symbols that a library has, and those that it cannot do without (VER_FLG_WEAK is 2)."""
    own, needed = elf.get_section_by_name(".gnu.version_d"), elf.get_section_by_name(".gnu.version_r")
    return (
        frozenset(one.name for _, names in (own.iter_versions() if own else ()) for one in names),
        {
            library.name: frozenset(one.name for one in names if not one.entry.vna_flags & 2)
            for library, names in (needed.iter_versions() if needed else ())
        },
    )


def _unique(content: bytes, elf: Any, dynamic: Any) -> dict[str, bytes | None]:  # noqa: ANN401 its type has no tags
    """The symbols that are unique in a process, with the bytes of constants; pyelftools takes 100 us for one symbol."""
    _, place = dynamic.get_table_offset("DT_SYMTAB")
    _, names = dynamic.get_table_offset("DT_STRTAB")
    table = np.frombuffer(content, SYMBOL, dynamic.num_symbols(), place)
    constants = [part.header for part in elf.iter_segments("PT_LOAD") if not part.header.p_flags & _WRITABLE]
    found: dict[str, bytes | None] = {}
    for name, _, _, _, value, size in table[(table["info"] >> 4 == _GNU_UNIQUE) & (table["section"] != 0)].tolist():
        text = content[names + name : content.index(b"\0", names + name)].decode(errors="replace")
        within = (one for one in constants if one.p_vaddr <= value < one.p_vaddr + one.p_filesz)
        start = next((one.p_offset + value - one.p_vaddr for one in within), None)
        found[text] = content[start : start + size] if start is not None else None
    return found
