"""What a shared library says about itself, read from its file without loading it.

Owns the reading of ELF. Who may share a process, which library is missing on this host and which functions of the
process an FMU may call are questions for the callers.
"""

from __future__ import annotations

import hashlib
import struct
from io import BytesIO
from typing import IO, Any, Final, NamedTuple

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
    """A library as the dynamic linker sees it.

    Attributes:
        sha256: of its content.
        soname: the name that a process knows it by; empty if it has none: then that is the name of its file.
        needed: the names of the libraries that it needs.
        run_paths: the folders that it looks for them in, as written (`$ORIGIN` is its own folder).
        imports: the functions and variables that others have to define.
        unique: the symbols that exist once in a process, whoever loads them and however (STB_GNU_UNIQUE): the bytes
            of a constant, None for a variable.
        machine: two bytes of its header that tell processors apart: the class and the machine.
        versions: the versions of its symbols, such as `GLIBC_2.38` for the library of C.
        needed_versions: the versions that it needs, by the names of libraries.
    """

    sha256: str = ""
    soname: str = ""
    needed: tuple[str, ...] = ()
    run_paths: tuple[str, ...] = ()
    imports: frozenset[str] = frozenset()
    unique: dict[str, bytes | None] = {}
    machine: bytes = b""
    versions: frozenset[str] = frozenset()
    needed_versions: dict[str, frozenset[str]] = {}


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

    file = BytesIO(content)
    try:
        elf = ELFFile(file)
        dynamic: Any = next(elf.iter_segments("PT_DYNAMIC"), None)
        if dynamic is None or elf.elfclass != 64 or not elf.little_endian:
            return None
        tags = list(dynamic.iter_tags())
        symbols = _symbols(file, dynamic)
        versions, needed_versions = _versions(elf)
        constants = [part.header for part in elf.iter_segments("PT_LOAD") if not part.header.p_flags & _WRITABLE]
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
        imports=frozenset(symbol.name for symbol in symbols if symbol.undefined and symbol.name),
        unique={
            symbol.name: _constant(symbol, constants, content)
            for symbol in symbols
            if symbol.binding == _GNU_UNIQUE and not symbol.undefined
        },
        machine=content[4:20:14],
        versions=versions,
        needed_versions=needed_versions,
    )


def _versions(elf: Any) -> tuple[frozenset[str], dict[str, frozenset[str]]]:  # noqa: ANN401 as in `_symbols`
    """The versions of symbols that a library has, and those that it cannot do without (VER_FLG_WEAK is 2)."""
    own, needed = elf.get_section_by_name(".gnu.version_d"), elf.get_section_by_name(".gnu.version_r")
    return (
        frozenset(one.name for _, names in (own.iter_versions() if own else ()) for one in names),
        {
            library.name: frozenset(one.name for one in names if not one.entry.vna_flags & 2)
            for library, names in (needed.iter_versions() if needed else ())
        },
    )


class _Symbol(NamedTuple):
    name: str
    binding: int
    undefined: bool
    value: int
    size: int


def _symbols(file: IO[bytes], dynamic: Any) -> list[_Symbol]:  # noqa: ANN401 its type has no tags
    """The dynamic symbols; pyelftools takes 100 us for one of them."""
    _, place = dynamic.get_table_offset("DT_SYMTAB")
    _, names_place = dynamic.get_table_offset("DT_STRTAB")
    count, names_size = dynamic.num_symbols(), next(dynamic.iter_tags("DT_STRSZ")).entry.d_val
    file.seek(place)
    table = np.frombuffer(file.read(count * SYMBOL.itemsize), SYMBOL)
    file.seek(names_place)
    names = file.read(names_size)
    return [
        _Symbol(names[start : names.index(b"\0", start)].decode(errors="replace"), info >> 4, section == 0, value, size)
        for start, info, _, section, value, size in table.tolist()
    ]


def _constant(symbol: _Symbol, segments: list[Any], content: bytes) -> bytes | None:
    """The bytes of a symbol, if it is in one of these segments."""
    for segment in segments:
        start = symbol.value - segment.p_vaddr
        if 0 <= start < segment.p_filesz:
            return content[segment.p_offset + start : segment.p_offset + start + symbol.size]
    return None
