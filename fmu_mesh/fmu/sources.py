"""FMUs that bring C sources instead of a binary for this platform: compiled once, into the user's cache.

Owns the cache and the command of the compiler. A compiled library is kept under the hash of all that it was made from,
so it is never out of date, and moved into its place in one step, so that two processes at once do no harm.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

import fmpy
import msgspec
from fmpy.model_description import ModelDescription as FmpyDescription
from fmpy.model_description import read_model_description

from ..errors import LoadFailed
from .archive import Terms, unpack
from .examining import library_names, source_names

__all__ = ["cache_folder", "compile_sources", "extract"]

log = logging.getLogger(__name__)

COMPILE_S: Final = 600.0
"""How long a compiler may take, in s."""

_SHOWN_LINES: Final = 12
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_FLAGS: Final = ("-O2", "-fPIC", "-ffp-contract=off", "-w")
_LINK_FLAGS: Final = ("-shared", "-Wl,--no-undefined", "-lm", "-ldl", "-lpthread")


class _Build(msgspec.Struct, frozen=True):
    """What the compiler has to do.

    Attributes:
        sources: paths in the folder `sources` of the FMU.
    """

    identifier: str
    sources: tuple[str, ...]
    includes: tuple[str, ...]
    options: tuple[str, ...]


def extract(
    path: Path,
    parent: Path,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    tell: Callable[[str], None] = log.info,
) -> Path:
    """Unpack the FMU at ``path`` into a new private folder below ``parent`` and return it, ready to be loaded.

    Without a binary for this platform its sources are compiled, or what was compiled before is used again.

    Raises:
        LoadFailed: the archive is broken or breaks ``terms``, or the sources do not compile; nothing is left behind.
    """
    with unpack(path, parent, terms) as folder:
        names = {file.relative_to(folder).as_posix() for file in folder.glob("binaries/*/*")}
        if not any(name.endswith(fmpy.sharedLibraryExtension) for name in names & _own(names)):
            _add_library(path, folder, tell)
    return folder.with_suffix("")


def compile_sources(path: Path, terms: Terms, tell: Callable[[str], None]) -> None:
    """Compile the sources of the FMU at ``path`` into the cache, if they are not there yet; ``tell`` before it begins.

    Raises:
        LoadFailed: there is no compiler, or they do not compile; the message has the compiler's first lines.
    """
    with tempfile.TemporaryDirectory(prefix="fmu_mesh-") as folder:
        extract(path, Path(folder), terms, tell)


def cache_folder() -> Path:
    """The user's own folder for what can be made again: ``$FMU_MESH_CACHE_DIR``, else below ``$XDG_CACHE_HOME``."""
    if chosen := os.environ.get("FMU_MESH_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fmu_mesh"


def _own(names: set[str]) -> set[str]:
    """Those of ``names`` that are for this platform."""
    folders = {f"binaries/{fmpy.platform}/", f"binaries/{fmpy.platform_tuple}/"}
    return {name for name in names if any(name.startswith(folder) for folder in folders)}


def _add_library(path: Path, folder: Path, tell: Callable[[str], None]) -> None:
    """Put the compiled library of an FMU where its binary would be."""
    names = [file.relative_to(folder).as_posix() for file in folder.glob("sources/**/*") if file.is_file()]
    if not source_names(names):
        return  # loading it says what is missing
    description = read_model_description(str(folder), validate=False)
    build = _build(path, description, names)
    library = _compiled(path, folder / "sources", build, tell)
    target = folder / library_names(build.identifier, description.fmiVersion)[0]
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(library, target)


def _build(path: Path, description: FmpyDescription, names: Sequence[str]) -> _Build:
    """The files and options that a description lists (FMI 2.0, 2.2.3 SourceFiles; FMI 3.0, 2.5.1.4 buildDescription).

    FMI 1.0 has no list, and some tools forget theirs; then all files at the root of `sources` are taken.
    """
    unit = description.coSimulation or description.modelExchange
    identifier = str(unit.modelIdentifier)
    fitting = [one for one in description.buildConfigurations if one.modelIdentifier in (identifier, None)]
    sets = fitting[0].sourceFileSets if fitting else []
    sources = [name for one in sets for name in one.sourceFiles]
    if not sources:
        sources = [name.removeprefix("sources/") for name in source_names(names) if name.count("/") == 1]
    includes = [name for one in sets for name in one.includeDirectories]
    for name in [*sources, *includes]:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts:
            raise LoadFailed(f"'{path}' lists a source outside its own folder: '{name}'.")
    missing = [name for name in sources if f"sources/{name}" not in names]
    if missing:
        raise LoadFailed(f"'{path}' lists the source '{missing[0]}', but does not contain it.")
    defined = [one for file_set in sets for one in file_set.preprocessorDefinitions if not one.optional]
    options = [f"-D{one.name}={one.value}" if one.value else f"-D{one.name}" for one in defined]
    # A library exports the plain names; sources ask for a prefix so that they can be linked statically, too.
    if description.fmiVersion.startswith("2"):
        options += ["-include", str(_HEADERS / "fmi2Functions.h")]
    elif description.fmiVersion.startswith("3"):
        options += ["-DFMI3_OVERRIDE_FUNCTION_PREFIX"]
    languages = {one.language for one in sets if one.language}
    if len(languages) == 1:
        (language,) = languages
        if re.fullmatch(r"C(\+\+)?\d\d", language):
            options.append(f"-std={language.lower().replace('c', 'gnu', 1)}")
    return _Build(identifier, tuple(sources), tuple(includes), tuple(options))


def _compiled(path: Path, sources: Path, build: _Build, tell: Callable[[str], None]) -> Path:
    """The library that was made of these sources, from the cache if it is there."""
    plus = any(not name.endswith(".c") for name in build.sources)
    compiler = _compiler(path, plus=plus)
    own = [*compiler, *_FLAGS, *build.options]
    target = cache_folder() / "sources" / _key(sources, build, own) / f"{build.identifier}{fmpy.sharedLibraryExtension}"
    if target.is_file():
        return target
    tell(f"'{path}' has no binary for this platform ({fmpy.platform}): compiling its sources into '{target.parent}'")
    try:
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="build-", dir=target.parent) as scratch:
            draft = Path(scratch) / target.name
            folders = [sources, *(sources / name for name in build.includes), _HEADERS]
            files = [str(sources / name) for name in build.sources]
            command = [*own, *(f"-I{folder}" for folder in folders), "-o", str(draft), *files, *_LINK_FLAGS]
            _run(path, command, Path(scratch))
            draft.chmod(0o600)
            draft.replace(target)
    except OSError as error:
        raise LoadFailed(
            f"the sources of '{path}' cannot be compiled into '{target.parent}': {error.strerror or error}",
            hint="Set FMU_MESH_CACHE_DIR to a folder that can be written.",
        ) from error
    return target


def _run(path: Path, command: Sequence[str], folder: Path) -> None:
    try:
        done = subprocess.run(
            command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=COMPILE_S
        )
    except subprocess.TimeoutExpired as error:
        raise LoadFailed(f"the sources of '{path}' were not compiled within {COMPILE_S:g} s.") from error
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").replace(f"{folder}/", "").splitlines()
        said = " | ".join(line.strip() for line in lines if "error" in line or "undefined" in line) or " | ".join(lines)
        raise LoadFailed(
            f"the sources of '{path}' do not compile: {said[: _SHOWN_LINES * 80] or 'the compiler gave no message'}",
            hint="Export it with a binary for this platform.",
        )


def _compiler(path: Path, *, plus: bool) -> list[str]:
    """The command of the C (``plus``: C++) compiler: ``$CC`` (``$CXX``), or the first that there is.

    Raises:
        LoadFailed: there is none.
    """
    own = shlex.split(os.environ.get("CXX" if plus else "CC", ""))
    candidates = [own] if own else [[name] for name in (("c++", "g++", "clang++") if plus else ("cc", "gcc", "clang"))]
    for candidate in candidates:
        if found := shutil.which(candidate[0]):
            return [found, *candidate[1:]]
    raise LoadFailed(
        f"'{path}' has no binary for this platform ({fmpy.platform}) but sources, and there is no compiler "
        f"(looked for {', '.join(candidate[0] for candidate in candidates)}).",
        hint=f"Install one, name it in ${'CXX' if plus else 'CC'}, or export the FMU with a binary for this platform.",
    )


def _key(sources: Path, build: _Build, command: Sequence[str]) -> str:
    """A hash of everything that a library is made from."""
    digest = hashlib.sha256(msgspec.json.encode([build, command, fmpy.__version__, fmpy.platform_tuple]))
    for file in sorted(sources.rglob("*")):
        if file.is_file():
            content = file.read_bytes()
            digest.update(f"\0{file.relative_to(sources).as_posix()}\0{len(content)}\0".encode())
            digest.update(content)
    return digest.hexdigest()[:32]
