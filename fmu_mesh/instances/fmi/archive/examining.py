"""The checks of an FMU before FMPy reads it: whether its XML is safe and valid, and whether it can run here.

An FMU that cannot run is refused here, and the error says why. Problems that do not keep it from running are returned
to `reading`, which keeps them in the description. FMPy gets only XML that has passed `safe_xml`, because it resolves
entities, and `repair`.
"""

from __future__ import annotations

import platform
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import fmpy
from lxml import etree

from ....archives.safe_xml import safe_xml
from ....errors import LoadFailed
from ....variables.model_description import Runs
from ..wine import INSTALL_WINE, wine_program
from .archive import Contents, OpenFmu
from .repairing import repair

__all__ = ["examine", "find_library", "library_folders", "library_name", "names_here", "source_names"]

_SHOWN: Final = 3
_SUFFIXES: Final[dict[Runs, str]] = {"native": str(fmpy.sharedLibraryExtension), "wine": ".dll", "wasm": ".wasm"}

_ARM: Final = "aarch64-linux"
_PROCESSORS: Final = {62: "x86_64", 183: "aarch64"}
"""What ELF calls them."""


def examine(fmu: OpenFmu) -> tuple[Contents, Any, tuple[str, ...]]:
    """Read the descriptions of an FMU; `LoadFailed` if they must not be parsed, or if it cannot run anywhere.

    Returns what is in it, with the XML repaired and in UTF-8; the root of the model description, as lxml has it; and
    the problems that were found.
    """
    path, contents = fmu.path, fmu.contents()
    if "modelDescription.xml" not in contents.names:
        kind = "a folder" if path.is_dir() else "a ZIP archive"
        raise LoadFailed(
            f"'{path}' is {kind}, but has no modelDescription.xml at its root, so it is no FMU.",
            hint=_what_it_is(path, contents.names),
        )
    roots = {name: safe_xml(data, f"the {name} of '{path}'") for name, data in contents.xml.items()}
    root = roots["modelDescription.xml"]
    version, tag = (root.get("fmiVersion") or "").strip(), etree.QName(root).localname
    if re.match(r"3\.\d+(\.\d+)?-", version):
        raise LoadFailed(
            f"'{path}' is for FMI {version}, a preliminary version of the standard, which is not supported.",
            hint="Export it for FMI 3.0.",
        )
    # Patch versions are in no attribute of FMI 1.0 and 2.0, but some tools write them.
    version = re.sub(r"^([12])(\.0(\.\d+)?)?$|^3$", rf"{version[:1]}.0", version)
    if tag != "fmiModelDescription" or not re.fullmatch(r"1\.0|2\.0|3\.0(\.\d+)?", version):
        shown = f"FMI '{version}'" if tag == "fmiModelDescription" else f"a <{tag}>"
        raise LoadFailed(f"the modelDescription.xml of '{path}' is for {shown}; supported are FMI 1.0, 2.0 and 3.0.")
    problems: list[str] = []
    for name, one in roots.items():
        is_model = name == "modelDescription.xml"
        repairs = repair(one, version[0] if is_model else "build", version if is_model else "3.0")
        if illegal := list(repairs.illegal):
            rest = f", and {len(illegal) - _SHOWN} more" if len(illegal) > _SHOWN else ""
            text = f"the {name} of '{path}' has illegal values: {'; '.join(illegal[:_SHOWN])}{rest}."
            raise LoadFailed(text, hint="Report it to the maker of its tool, or correct the file.")
        problems += repairs.problems
    xml = {name: etree.tostring(one, encoding="UTF-8", xml_declaration=True) for name, one in roots.items()}
    return Contents(contents.names, xml), root, tuple(problems)


def _what_it_is(path: Path, names: Collection[str]) -> str:
    """What an archive is instead of an FMU, and what to do."""
    if any(name.lower().endswith(".ssd") and "/" not in name for name in names):
        fmu = next((name for name in sorted(names) if name.lower().endswith(".fmu")), "resources/model.fmu")
        return f"It is a package of SSP: name an FMU in it, as '{path}/{fmu}'."
    return "An FMU that was zipped inside a folder of its own must be zipped again without that folder."


def library_folders(fmi_version: str, runs: Runs = "native") -> tuple[str, ...]:
    """What FMUs call a platform, the name of the standard first (FMI 1.0, 2.3; 2.0, 2.3; 3.0, 2.5.1).

    For ARM, FMI 2.0 takes the name of FMI 3.0. OpenModelica writes that of Debian, or on ARM itself `linux64`.
    """
    if runs == "wasm":
        return ("wasm32-wasip2",)  # of the draft FMI-LS-WASM for FMI 3.0
    if runs == "wine":
        return ("x86_64-windows" if fmi_version.startswith("3") else "win64",)
    if fmpy.platform_tuple == _ARM and not fmi_version.startswith("3"):
        return _ARM, f"{_ARM}-gnu", "linux64"
    return (fmpy.platform_tuple if fmi_version.startswith("3") else fmpy.platform,)


def library_name(identifier: str, fmi_version: str, names: Iterable[str | None] = (), runs: Runs = "native") -> str:
    """The path of the library for a platform inside an FMU, in the first folder for it that ``names`` has."""
    there = {name.rpartition("/")[0] for name in names if name is not None}
    folders = [f"binaries/{folder}" for folder in library_folders(fmi_version, runs)]
    return f"{next((folder for folder in folders if folder in there), folders[0])}/{identifier}{_SUFFIXES[runs]}"


def names_here(fmu: OpenFmu, names: Iterable[str], fmi_version: str) -> frozenset[str]:
    """The names of the files of an FMU, with each library for another processor in a folder that says so.

    For `linux64` only says that it has 64 bits, and FMUs that were exported on ARM have it, too.
    """
    own, found = "|".join(library_folders(fmi_version)), set[str]()
    for name in names:
        if (library := re.fullmatch(rf"(binaries/(?:{own}))(/[^/]*{_SUFFIXES['native']})", name)) is not None:
            begin = fmu.read_begin(name, 20)
            processor = _PROCESSORS.get(int.from_bytes(begin[18:], "little")) if begin.startswith(b"\x7fELF") else None
            if processor not in {None, platform.machine()}:
                found.add(f"{library[1]} (for {processor}){library[2]}")
                continue
        found.add(name)
    return frozenset(found)


def source_names(names: Iterable[str]) -> list[str]:
    """The C and C++ sources among the files of an FMU."""
    return sorted(name for name in names if re.fullmatch(r"sources/.*\.(c|cc|cpp|cxx)", name))


def find_library(
    path: Path, names: Collection[str], identifiers: Sequence[str], fmi_version: str, *, in_sandbox: bool = False
) -> str | None:
    """Find the library of an FMU for this platform: the one with the required name, or else the only one.

    ``identifiers`` are the model identifier of the kind to use, and that of the other kind if there is one. None: the
    library has to be compiled from sources. Without both, it is a component of WebAssembly, or that for Windows, if
    Wine is installed; ``in_sandbox`` of WebAssembly, only sources or a component count. `LoadFailed`: there is none
    that can run here, or there are several.
    """
    identifier = identifiers[0]
    if "/" in identifier or "\\" in identifier or identifier.startswith("."):
        raise LoadFailed(f"'{path}' has the model identifier '{identifier}', which cannot be the name of a library.")
    wanted = library_name(identifier, fmi_version, names)
    if not in_sandbox and (found := _library(path, names, identifiers, fmi_version, "native")) is not None:
        return found
    if identifier and source_names(names):
        return None
    component = _library(path, names, identifiers, fmi_version, "wasm") if fmi_version.startswith("3") else None
    if component is not None or in_sandbox:
        return component
    what = f"'{path}' has no '{wanted}'" if identifier else _WITHOUT_IDENTIFIER.format(path)
    if known := [name for one in identifiers[1:] if (name := library_name(one, fmi_version, names)) in names]:
        raise LoadFailed(
            f"{what}; it has only '{known[0]}', the library of its other kind.",
            hint="Leave `kind` to the other one, or export it with both libraries.",
        )
    runs_windows = fmpy.platform_tuple == "x86_64-linux"
    windows = _library(path, names, identifiers, fmi_version, "wine") if runs_windows else None
    if windows is not None and wine_program() is not None:
        return windows
    if not identifier:
        raise LoadFailed(f"{what}, nor a library for this platform.", hint="Report it to the maker of its tool.")
    platforms = sorted({name.split("/")[1] for name in names if re.fullmatch(r"binaries/[^/]+/.+", name)})
    ways = "Export it for this platform, or with its sources"
    if windows is not None:
        ways += f"; {INSTALL_WINE}"
    elif runs_windows and {"win32", "x86-windows"} & set(platforms):
        ways += ", or for 64-bit Windows, to run under Wine: libraries for 32-bit Windows are not supported yet"
    raise LoadFailed(
        f"'{path}' has no binary for this platform ({wanted.split('/')[1]}); it has: "
        f"{', '.join(platforms) or 'no platform at all'}.",
        hint=f"{ways}.",
    )


def _library(
    path: Path, names: Collection[str], identifiers: Sequence[str], fmi_version: str, runs: Runs
) -> str | None:
    """The library of an FMU for one platform; `LoadFailed` if there are several, none of them with a known name."""
    wanted, *known = [library_name(one, fmi_version, names, runs) for one in identifiers]
    if identifiers[0] and wanted in names:
        return wanted
    folder, suffix = wanted.rpartition("/")[0], _SUFFIXES[runs]
    there = sorted(name for name in names if name.rpartition("/")[0] == folder and name.endswith(suffix))
    others = [name for name in there if name not in known]
    if len(others) > 1:
        what = f"'{path}' has no '{wanted}'" if identifiers[0] else _WITHOUT_IDENTIFIER.format(path)
        raise LoadFailed(
            f"{what}; it has {' and '.join(map(repr, others))}, and it is not clear which of them to load.",
            hint="The library must have the name of the model identifier (FMI 2.0, 2.3).",
        )
    return others[0] if others else None


_WITHOUT_IDENTIFIER: Final = "'{}' has no model identifier to find its library by"
