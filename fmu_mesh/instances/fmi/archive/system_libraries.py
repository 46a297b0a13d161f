"""The libraries of the system that the library of an FMU needs: which of them this host does not have.

Looks as the dynamic linker does (ld.so(8)), but nothing is loaded and no code of the FMU runs. Owns the names of Debian
packages. It takes some 50 ms, so it is for those who ask before a run, and for the error of a run that could not load.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

from ..step_options import Terms
from .archive import opened
from .shared_library import SharedLibrary, libraries_beside, read_shared_library

__all__ = ["missing_libraries"]

_CACHE: Final = Path("/etc/ld.so.cache")
_FOLDERS: Final = (
    *("/lib64", "/usr/lib64", "/lib", "/usr/lib", f"/lib/{os.uname().machine}-linux-gnu"),
    f"{sys.base_prefix}/lib",
)
"""The usual ones, that of Debian, and that of Python: its libraries are loaded already."""

_PACKAGES: Final = {"libz.so.1": "zlib1g", "libGLU.so.1": "libglu1-mesa", "libxml2.so.2": "libxml2"}
_BY_RULE: Final = re.compile(
    r"(lib(?:gfortran|quadmath|gomp|atomic|lapack|blas|openblas|stdc\+\+|gcc_s|gmp|expat|ssl|curl|GL|X11))\.so\.(\d+)"
)
"""Libraries whose package has their name and number."""


def missing_libraries(path: Path, library: str, terms: Terms = Terms()) -> tuple[str, ...]:  # noqa: B008 a frozen Struct
    """What the library of an FMU needs and this host does not have: whole libraries, or newer versions of them.

    ``library`` is the name of the file in it, as `ModelDescription.library` has it.
    """
    with opened(path, terms) as fmu:
        beside = libraries_beside(fmu, library)
        names = fmu.contents().names
    folder, _, own = library.rpartition("/")
    beside |= {facts.soname: facts for facts in beside.values()}
    found: dict[str, None] = {}
    reached, waiting = set[str](), [own]
    while waiting:
        name = waiting.pop()
        user = beside.get(name)
        if user is None or name in reached:
            continue
        reached.add(name)
        for needed in user.needed:
            if needed in beside:
                waiting.append(needed)
            elif not any(f"{one}/{needed}" in names for one in user.folders(folder)):
                found |= dict.fromkeys(_lacks(f"{folder}/{name}", user, needed))
    return tuple(found)


def _lacks(shown: str, user: SharedLibrary, needed: str) -> Iterator[str]:
    """What is missing of a library of the system that ``user`` needs: all of it, or some of its versions."""
    there = next(_of_system(needed, user), None)
    hint = f"; on Debian and Ubuntu it is in the package {package}" if (package := _package(needed)) else ""
    if there is None:
        yield f"this system has no {needed}, which '{shown}' needs{hint}"
    elif (versions := user.needed_versions.get(needed)) and (own := _versions_of(there)) and not versions <= own:
        newer = ", ".join(sorted(versions - own))
        yield f"{needed} of this system is too old: it has no {newer}, which '{shown}' needs"


def _package(library: str) -> str | None:
    """The package of Debian and Ubuntu with a library, if it is one of the usual ones."""
    if python := re.match(r"libpython3\.\d+", library):
        return python[0]
    if usual := _BY_RULE.fullmatch(library):
        name = usual[1].lower().replace("_", "-")
        return f"{name}-{usual[2]}" if name[-1].isdigit() else f"{name}{usual[2]}"
    return _PACKAGES.get(library)


@cache
def _versions_of(path: Path) -> frozenset[str]:
    """The versions of a library of the system; empty if it has none."""
    facts = read_shared_library(path.read_bytes())
    return facts.versions if facts is not None else frozenset()


def _of_system(name: str, user: SharedLibrary) -> Iterator[Path]:
    """The files of this name, and for the same processor, that the dynamic linker may find."""
    folders = [*os.environ.get("LD_LIBRARY_PATH", "").split(":"), *user.run_paths, *_FOLDERS]
    paths = [Path(folder, name) for folder in folders if folder.startswith("/")]
    # The cache is a table of numbers and then of texts, each with a zero at its end: the names and the paths.
    texts = _CACHE.read_bytes().split(b"\0") if _CACHE.is_file() else []
    paths += [Path(os.fsdecode(text)) for text in texts if text.startswith(b"/") and text.endswith(f"/{name}".encode())]
    paths += [Path(name)] if name.startswith("/") else []
    for path in paths:
        if path.is_file():
            with path.open("rb") as file:
                if file.read(20)[4:20:14] == user.machine:
                    yield path
