"""FMUs with C sources and no library for this platform: their sources are compiled once, into the user's cache.

Owns the cache and the command line of the compiler. The name of a compiled library contains the hash of everything it
was made from, so it is never out of date. It is moved to its place in one step, so that two processes can do this at
the same time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import posixpath
import re
import shlex
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Final, Literal

import fmpy
import msgspec
from fmpy.model_description import ModelDescription as FmpyDescription
from msgspec.structs import replace

from .... import files
from ....archives.archive_entries import reading
from ....errors import LoadFailed
from ....installing import version_of_library
from ....variables.model_description import Kind, ModelDescription
from ..step_options import Terms
from ..webassembly import compiling
from ..wine import wine_environment
from .archive import OpenFmu, in_new_folder, opened
from .examining import examine, library_folders, library_name, source_names
from .library_names import rename_libraries
from .reading import description_of, parsed

__all__ = ["describe", "extract", "find_compiler", "needs_compiler", "prepare"]

log = logging.getLogger(__name__)

COMPILE_S: Final = 600.0
"""How long a compiler may take, in s."""

_SHOWN_LINES: Final = 12
_HEADER_SUFFIXES: Final = (".h", ".hh", ".hpp", ".hxx", ".inc")
_MAKES: Final = b"fmi2Instantiate"
_SUFFIX = str(fmpy.sharedLibraryExtension)
_PLATFORM: Final = library_folders("2.0")[0]
_HEADERS = Path(fmpy.__file__).parent / "c-code"
_OWN_HEADERS = Path(__file__).parent / "headers"
"""The headers of FMI 1.0."""
_FLAGS: Final = ("-O2", "-fPIC", "-ffp-contract=off")
# C takes a function without a declaration for one that returns int: it compiles, and computes something else. Nothing
# disables warnings here (-w), because that would make these two harmless again; old C has the other two.
_FLAGS_OF_C: Final = (
    "-std=gnu17",
    "-Werror=implicit-function-declaration",
    "-Werror=int-conversion",
    "-Wno-error=incompatible-pointer-types",
    "-Wno-error=implicit-int",
)
_OWN_VARIABLES: Final = "-fno-gnu-unique"
"""For g++: variables of templates and inline functions belong to the FMU, as they do with clang++, without a flag."""
# -Bsymbolic: calls go to the FMU's own functions, even if the C library or Python has one with the same name.
_LINK_FLAGS: Final = ("-shared", "-Wl,--no-undefined", "-Wl,-Bsymbolic", "-lm", "-ldl", "-lpthread")


_prepared: dict[tuple[Path, Terms, str, str, int | None], Path] = {}
"""The folders of FMUs that `prepare` has extracted."""
_linked: set[Path] = set()
"""Those whose files this process uses, as they are also those of other processes."""


class _Build(msgspec.Struct, frozen=True):
    """What to compile and how."""

    fmi_version: str
    identifier: str
    sources: tuple[str, ...]  # paths relative to the folder `sources` of the FMU
    includes: tuple[str, ...]
    options: tuple[str, ...]
    is_guest: bool  # whether for WebAssembly


def extract(
    path: Path,
    parent: Path,
    terms: Terms = Terms(),  # noqa: B008 a frozen Struct
    tell: Callable[[str], None] = log.info,
    model: ModelDescription | None = None,
) -> Path:
    """Unpack the FMU at ``path`` into a new private folder below ``parent``; returns the folder, ready to be loaded.

    If it has no library for this platform, its sources are compiled, or the library of an earlier compilation is used.
    ``model`` says for which kind; without it, the library is for co-simulation if the FMU has that. After `LoadFailed`
    nothing is left behind.
    """
    if model is not None and (prepared := _prepared.get(_key_of(path, terms, model))) is not None:
        folder = _copied(path, prepared, parent)
    else:
        with opened(path, terms) as fmu:
            folder = in_new_folder(path, parent, lambda _: fmu.unpacked_size(), partial(_fill, fmu, tell, model))
    rename_libraries(folder)
    return folder


def prepare(path: Path, parent: Path, terms: Terms, model: ModelDescription) -> None:
    """Extract an FMU as `extract`, for each later `extract` in this process and in those that it forks: they copy it.

    Each has a folder of its own, because an FMU may write to its files.
    """
    key = _key_of(path, terms, model)
    if key not in _prepared:
        _prepared[key] = extract(path, parent, terms, model=model)


def _key_of(path: Path, terms: Terms, model: ModelDescription) -> tuple[Path, Terms, str, str, int | None]:
    return path, terms, model.model_identifier, model.kind, model.guest_memory


def _copied(path: Path, prepared: Path, parent: Path) -> Path:
    """A new private folder for the files of an FMU that was extracted before.

    The first one of a process shares all files but the resources, which an FMU may write to. A process that loads the
    same file twice has its variables once, so further ones are copies.
    """
    links = prepared not in _linked
    _linked.add(prepared)
    resources = prepared / "resources"

    def copy(source: str, target: str) -> None:
        if links and resources not in Path(source).parents:
            with suppress(OSError):  # it is on another file system, or this one has no links
                os.link(source, target)
                return
        files.cloned(source, target)

    def fill(folder: Path) -> None:
        shutil.copytree(prepared, folder, symlinks=True, dirs_exist_ok=True, copy_function=copy)

    def size(place: Path) -> int:
        can_link = links and place.stat().st_dev == prepared.stat().st_dev
        return sum(one.lstat().st_size for one in (resources if can_link else prepared).rglob("*"))

    return in_new_folder(path, parent, size, fill)


def describe(
    path: Path,
    terms: Terms,
    kind: Literal["auto"] | Kind,
    tell: Callable[[str], None],
    guest_memory: int | None = None,
) -> ModelDescription:
    """Read the model description of an FMU and get it ready to run, while its archive is open once.

    If it has no library for this platform, or is to run in a sandbox of WebAssembly with so many bytes of
    ``guest_memory``, its sources are compiled into the cache, or Wine is prepared; ``tell`` is called before that.
    Its SHA-256 is known afterwards, so that `content_of` does not read it again. If its sources do not compile,
    `LoadFailed` has the first lines of the compiler.
    """
    with opened(path, terms) as fmu:
        fmu.content_sha256()
        model = _model_of(fmu, kind, guest_memory)
        if model.library is None:
            with tempfile.TemporaryDirectory(prefix="fmu_mesh-") as folder, reading(path):
                _fill(fmu, tell, model, Path(folder))
        elif model.runs == "wine":
            wine_environment(tell)
        elif model.runs == "wasm":
            version_of_library("wasmtime")
    return model


def needs_compiler(path: Path, terms: Terms, kind: Literal["auto"] | Kind, guest_memory: int | None = None) -> bool:
    """Whether `describe` would compile what nobody has compiled before; nothing is."""
    with opened(path, terms) as fmu:
        model = _model_of(fmu, kind, guest_memory)
        if model.library is not None:
            return False
        with tempfile.TemporaryDirectory(prefix="fmu_mesh-") as name, reading(path):
            folder = Path(name)
            fmu.unpack_into(folder)
            build = _build_of(fmu, folder, model)
            return build is not None and not _command(path, folder / "sources", build)[1].is_file()


def _model_of(fmu: OpenFmu, kind: Literal["auto"] | Kind, guest_memory: int | None) -> ModelDescription:
    model = description_of(fmu, kind, in_sandbox=guest_memory is not None)
    return model if guest_memory is None else compiling.as_guest(fmu.path, model, guest_memory)


def _fill(fmu: OpenFmu, tell: Callable[[str], None], model: ModelDescription | None, folder: Path) -> None:
    """Unpack an FMU into an empty folder, and give it the library that it lacks."""
    fmu.unpack_into(folder)
    if model is None:
        platforms = (*library_folders("2.0"), *library_folders("3.0"))
        is_complete = any(any(folder.glob(f"binaries/{name}/*{_SUFFIX}")) for name in platforms)
    else:
        is_complete = model.library is not None
    if not is_complete:
        _add_library(fmu, folder, model, tell)
    elif model is not None:
        # A link with the name that FMI requires; other libraries of the FMU may refer to the original name.
        named = folder / library_name(model.model_identifier, model.fmi_version, [model.library], model.runs)
        if not named.exists():
            named.symlink_to(PurePosixPath(model.library or "").name)


def _add_library(fmu: OpenFmu, folder: Path, model: ModelDescription | None, tell: Callable[[str], None]) -> None:
    """Copy the compiled library of an FMU to where FMI expects it."""
    if (build := _build_of(fmu, folder, model)) is None:
        if model is not None and model.guest_memory is not None:
            raise LoadFailed(
                f"'{fmu.path}' has neither sources nor a component, and `sandbox: wasm` needs one of them."
            )
        return  # the error of loading it says what is missing
    library = _compiled(fmu.path, folder / "sources", build, tell)
    target = folder / library_name(build.identifier, build.fmi_version)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(library, target)


def _build_of(fmu: OpenFmu, folder: Path, model: ModelDescription | None) -> _Build | None:
    """What to compile of an FMU that is unpacked; None if it has no sources."""
    names = [file.relative_to(folder).as_posix() for file in folder.glob("sources/**/*") if file.is_file()]
    if not source_names(names):
        return None
    path, (contents, root, _) = fmu.path, examine(fmu)
    description = parsed(path, contents)
    kind = model.kind if model is not None else "co_simulation" if description.coSimulation else "model_exchange"
    build = _build(path, description, names, kind, _listed_files(root, kind))
    return build if model is None or model.guest_memory is None else replace(build, is_guest=True)


def _listed_files(root: ET.Element, kind: str) -> list[str]:
    """The source files that FMI 2.0 lists for a kind, or for the other kind with the same model identifier.

    FMPy keeps only one of the two lists.
    """
    own, other = ("CoSimulation", "ModelExchange")[:: 1 if kind == "co_simulation" else -1]
    units = [unit for name in (own, other) for unit in root.findall(name)]
    identifiers = [unit.get("modelIdentifier") for unit in units]
    lists = [unit.findall("SourceFiles/File") for unit in units if unit.get("modelIdentifier") == identifiers[0]]
    return [str(entry.get("name")) for entry in next(filter(None, lists), [])]


def _build(path: Path, description: FmpyDescription, names: Sequence[str], kind: str, listed: list[str]) -> _Build:
    """The files and options that a description lists (FMI 2.0, 2.2.3 SourceFiles; FMI 3.0, 2.5.1.4 buildDescription).

    FMI 1.0 has no list, and some tools omit it; then all files directly in `sources` are compiled.
    """
    unit = description.coSimulation if kind == "co_simulation" else description.modelExchange
    identifier = str(unit.modelIdentifier)
    fitting = [one for one in description.buildConfigurations if one.modelIdentifier in (identifier, None)]
    sets = fitting[0].sourceFileSets if fitting else []
    sources = [_inside(path, name) for name in listed or [name for one in sets for name in one.sourceFiles]]
    # OpenModelica also lists `./`, and a folder cannot be compiled.
    folders = {str(folder) for name in names for folder in PurePosixPath(name.removeprefix("sources/")).parents}
    sources = [name for name in dict.fromkeys(sources) if name not in folders]
    if not sources:
        sources = [name.removeprefix("sources/") for name in source_names(names) if name.count("/") == 1]
    includes = [_inside(path, name) for one in sets for name in one.includeDirectories]
    missing = [name for name in sources if f"sources/{name}" not in names]
    if missing:
        raise LoadFailed(f"'{path}' lists the source '{missing[0]}', but does not contain it.")
    defined = [one for file_set in sets for one in file_set.preprocessorDefinitions if not one.optional]
    options = [f"-D{one.name}={one.value}" if one.value else f"-D{one.name}" for one in defined]
    # A shared library exports the names without the prefix that static linking would need; for FMI 2.0 see `_prefixed`.
    if description.fmiVersion.startswith("3"):
        options += ["-DFMI3_OVERRIDE_FUNCTION_PREFIX"]
    languages = {one.language for one in sets if one.language}
    if len(languages) == 1:
        (language,) = languages
        if re.fullmatch(r"C(\+\+)?\d\d", language):
            options.append(f"-std={language.lower().replace('c', 'gnu', 1)}")
    return _Build(
        str(description.fmiVersion), identifier, tuple(sources), tuple(includes), tuple(options), is_guest=False
    )


def _inside(path: Path, name: str) -> str:
    """A listed path relative to the folder `sources`, normalized: `./a.c` becomes `a.c`."""
    plain = posixpath.normpath(name)
    if plain == ".." or plain.startswith(("/", "../")):
        raise LoadFailed(f"'{path}' lists a source outside its own folder: '{name}'.")
    return plain


def _compiled(path: Path, sources: Path, build: _Build, tell: Callable[[str], None]) -> Path:
    """The library of these sources: that in the cache, or a new one."""
    own, target = _command(path, sources, build)
    if target.is_file():
        return target
    why = "runs in a sandbox" if build.is_guest else f"has no binary for this platform ({_PLATFORM})"
    tell(f"'{path}' {why}: compiling its sources into '{target.parent}'")
    try:
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="build-", dir=target.parent) as scratch:
            draft = Path(scratch) / target.name
            folders = [sources, *(sources / name for name in build.includes), _OWN_HEADERS, _HEADERS]
            searched = [f"-I{folder}" for folder in folders] + _other_folders(sources)
            inputs = [str(sources / name) for name in build.sources]
            if build.is_guest:
                run = partial(_run, path, folder=Path(scratch))
                compiling.make_library(build.fmi_version, build.identifier, [*own, *searched, *inputs], draft, run)
                draft.chmod(0o600)
                draft.replace(target)
                return target
            command = [*own, *searched, "-o", str(draft), *inputs, *_LINK_FLAGS]
            _run(path, command, Path(scratch))
            if prefixed := _prefixed(draft.read_bytes()):
                _run(path, [*command, *prefixed], Path(scratch))
            draft.chmod(0o600)
            draft.replace(target)
    except OSError as error:
        raise LoadFailed(
            f"the sources of '{path}' cannot be compiled into '{target.parent}': {error.strerror or error}",
            hint=files.CACHE_HINT,
        ) from error
    return target


def _command(path: Path, sources: Path, build: _Build) -> tuple[list[str], Path]:
    """How sources are compiled, without their names, and where in the cache their library is."""
    plus = any(not name.endswith(".c") for name in build.sources)
    if build.is_guest:
        own = [*compiling.compiler(plus=plus), *(() if plus else _FLAGS_OF_C), *build.options]
    else:
        try:
            compiler = find_compiler(plus=plus)
        except LoadFailed as error:
            text = f"'{path}' has no binary for this platform ({_PLATFORM}) but sources, and {error.message}."
            raise LoadFailed(text, hint=error.hint) from None
        own = [*compiler, *_FLAGS, *(_flags_of_cpp(compiler) if plus else _FLAGS_OF_C), *build.options]
    target = (
        files.cache_folder()
        / "sources"
        / _key(sources, build, own)
        / f"{build.identifier}{fmpy.sharedLibraryExtension}"
    )
    return own, target


def _other_folders(sources: Path) -> list[str]:
    """The options for all folders below `sources` that have headers, which some tools list nowhere.

    Their headers must not replace those of the system in `#include <...>`.
    """
    headers = (file for file in sources.rglob("*") if file.suffix in _HEADER_SUFFIXES)
    folders = {str(file.parent) for file in headers if file.parent != sources}
    found = sorted(folders, key=lambda folder: (folder.count("/"), folder))
    return [option for folder in found for option in ("-iquote", folder, "-idirafter", folder)]


def _prefixed(library: bytes) -> list[str]:
    """The options that also give the functions of a library of FMI 2.0 their plain names (FMI 2.0, 2.1.1).

    A header in front of the sources could do this as well. But it would include headers of the system, and a source may
    define in its first line what these headers have to offer, such as `_GNU_SOURCE`.
    """
    names = set(re.findall(rb"(?<=\0)\w*fmi2[A-Z]\w+(?=\0)", library))
    prefix = next((name.removesuffix(_MAKES) for name in names if name.endswith(_MAKES)), b"")
    if not prefix or _MAKES in names:
        return []
    own = sorted(name.decode() for name in names if name.startswith(prefix + b"fmi2"))
    return [f"-Wl,--defsym={name.removeprefix(prefix.decode())}={name}" for name in own]


def _flags_of_cpp(compiler: Sequence[str]) -> list[str]:
    asked = [*compiler, _OWN_VARIABLES, "-x", "c++", "-E", os.devnull]
    done = subprocess.run(asked, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=COMPILE_S)
    return [_OWN_VARIABLES] if done.returncode == 0 else []


def _run(path: Path, command: Sequence[str], folder: Path) -> None:
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | compiling.environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            timeout=COMPILE_S,
        )
    except subprocess.TimeoutExpired as error:
        raise LoadFailed(f"the sources of '{path}' were not compiled within {COMPILE_S:g} s.") from error
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").replace(f"{folder}/", "").splitlines()
        errors = [line.strip() for line in lines if re.search(r"\berror: |undefined", line)]
        said = " | ".join(errors) or " | ".join(lines)
        hint = "Export it with a binary for this platform."
        if "-Wimplicit-function-declaration" in said.replace("-Werror=", "-W"):
            hint = f"C would take a function without a declaration for one that returns int. {hint}"
        raise LoadFailed(
            f"the sources of '{path}' do not compile: {said[: _SHOWN_LINES * 80] or 'the compiler gave no message'}",
            hint=hint,
        )


def find_compiler(*, plus: bool) -> list[str]:
    """The command of the compiler of C, or of C++: ``$CC`` (``$CXX``), or the first one found; or `LoadFailed`."""
    own = shlex.split(os.environ.get("CXX" if plus else "CC", ""))
    candidates = [own] if own else [[name] for name in (("c++", "g++", "clang++") if plus else ("cc", "gcc", "clang"))]
    for candidate in candidates:
        if found := shutil.which(candidate[0]):
            return [found, *candidate[1:]]
    raise LoadFailed(
        f"there is no compiler (looked for {', '.join(candidate[0] for candidate in candidates)})",
        hint=f"Install one, name it in ${'CXX' if plus else 'CC'}, or export the FMU with a binary for this platform.",
    )


def _key(sources: Path, build: _Build, command: Sequence[str]) -> str:
    """The hash of everything that a library is made from."""
    digest = hashlib.sha256(msgspec.json.encode([build, command, fmpy.__version__, fmpy.platform_tuple]))
    for folder in (sources, _OWN_HEADERS, *((compiling.FOLDER,) if build.is_guest else ())):
        for file in sorted(folder.rglob("*")):
            if file.is_file() and file.suffix != ".pyc":
                content = file.read_bytes()
                digest.update(f"\0{file.relative_to(folder).as_posix()}\0{len(content)}\0".encode())
                digest.update(content)
    return digest.hexdigest()[:32]
