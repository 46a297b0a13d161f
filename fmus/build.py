"""Builds the example FMUs from their C sources.

Owns the way from a model's folder to a ``.fmu`` file. It needs a C compiler and the FMI headers that FMPy
ships, and knows nothing about running FMUs.

A model's folder holds ``modelDescription.xml`` and the C files that its ``SourceFiles`` lists; what is
not there comes from the skeleton. With one compiler, the same sources give the same archive byte for byte.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import uuid
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

__all__ = ["WINDOWS_FROM_LINUX", "BuildError", "Platform", "build", "find_compiler", "this_platform"]

HERE = Path(__file__).resolve().parent
SKELETON = HERE / "src" / "skeleton"
FMI_HEADERS = {
    "1": ("fmi1Functions.h",),
    "2": ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    "3": ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
GUID_PLACEHOLDER = "@GUID@"

# -ffp-contract=off: a fused multiply-add would make the numbers depend on the processor the build was for.
COMPILE_FLAGS = ("-O2", "-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fvisibility=hidden")


class BuildError(Exception):
    """An FMU could not be built; the message says what to do."""


@dataclass(frozen=True)
class Platform:
    """What FMI 2.0, 2.3 and FMI 3.0, 2.5.1.4 call a platform, and how to link a shared library there.

    Attributes:
        compiler: what builds for it on another platform; empty: `find_compiler`.
    """

    name: str
    name_in_fmi3: str
    suffix: str
    link_flags: tuple[str, ...]
    compiler: tuple[str, ...] = ()


LINUX = Platform(
    "linux64", "x86_64-linux", ".so", ("-fPIC", "-shared", "-s", "-Wl,--build-id=none", "-Wl,--no-undefined")
)
ARM = Platform("aarch64-linux", "aarch64-linux", ".so", LINUX.link_flags)
ARM_FROM_X86 = replace(
    ARM, compiler=(sys.executable, "-m", "ziglang", "cc", "-target", "aarch64-linux-gnu.2.17", "-mcpu=baseline")
)
"""By the compiler that also builds the library of the mesh (`make library` installs it)."""
MACOS = Platform("darwin64", "x86_64-darwin", ".dylib", ("-fPIC", "-dynamiclib", "-Wl,-x"))
WINDOWS = Platform("win64", "x86_64-windows", ".dll", ("-shared", "-s", "-static-libgcc"))
ZIG = (sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu", "-mcpu=baseline")
WINDOWS_FROM_LINUX = Platform("win64", "x86_64-windows", ".dll", ("-shared", "-s"), ZIG)
"""By the compiler that also builds the library of the mesh (`make library` installs it)."""


def build(model_dir: Path, output_dir: Path, platform: Platform | None = None) -> Path:
    """Build the FMU of the model in ``model_dir``.

    Args:
        model_dir: the folder with ``modelDescription.xml`` and the model's C files.
        output_dir: where ``<modelIdentifier>.fmu`` goes; made if missing.
        platform: of its library; without one, it is this platform, and the sources are in the FMU, too.

    Returns:
        The path of the FMU.

    Raises:
        BuildError: no compiler, no headers, a missing source file, or a compiler message.
    """
    description = model_dir / "modelDescription.xml"
    if not description.is_file():
        raise BuildError(f"{description} is missing: a model's folder holds its modelDescription.xml and C files")
    template = description.read_text(encoding="utf-8")
    version, identifier, source_names = read_code_names(template, description)
    sources = collect_sources(model_dir, source_names)
    guid = guid_of(template, sources)
    sources["fmu_guid.h"] = f'#define FMU_GUID "{guid}"\n'.encode()
    sources |= fmi_headers(version)

    members = {f"sources/{name}": content for name, content in sources.items()} if platform is None else {}
    platform = platform or this_platform()
    library = compile_library(identifier, source_names, sources, platform)
    members["modelDescription.xml"] = template.replace(GUID_PLACEHOLDER, guid).encode()
    platform_name = platform.name_in_fmi3 if version == "3" else platform.name
    members[f"binaries/{platform_name}/{identifier}{platform.suffix}"] = library
    return write_archive(output_dir / f"{identifier}.fmu", members)


def find_compiler() -> list[str]:
    """Return the command of the C compiler: ``$CC`` or the first of cc, gcc and clang.

    Raises:
        BuildError: there is none.
    """
    command = shlex.split(os.environ.get("CC", ""))
    candidates = [command] if command else [["cc"], ["gcc"], ["clang"]]
    for candidate in candidates:
        if shutil.which(candidate[0]):
            return candidate
    names = ", ".join(candidate[0] for candidate in candidates)
    raise BuildError(f"no C compiler found (looked for {names}): install gcc or clang, or set CC")


def read_code_names(template: str, path: Path) -> tuple[str, str, list[str]]:
    """Return the FMI version, the model identifier and the C files, in the order of ``SourceFiles``.

    FMI 1.0 and 3.0 list no files in the description; there it is all C files of the model's folder.
    """
    try:
        root = ET.fromstring(template)  # noqa: S314 - our own file
    except ET.ParseError as error:
        raise BuildError(f"{path} is not well-formed XML: {error}") from error
    version = (root.get("fmiVersion") or "2")[0]
    units = [root] if version == "1" else root.findall("CoSimulation") + root.findall("ModelExchange")
    identifier = next((name for unit in units if (name := unit.get("modelIdentifier"))), None)
    if identifier is None:
        raise BuildError(f"{path} has no CoSimulation element with a modelIdentifier")
    names = [name for file in units[0].findall("SourceFiles/File") if (name := file.get("name"))]
    if version != "2":
        names = sorted(file.name for file in path.parent.glob("*.c"))
    if not names:
        raise BuildError(f"{path} lists no SourceFiles")
    return version, identifier, names


def collect_sources(model_dir: Path, source_names: Sequence[str]) -> dict[str, bytes]:
    """Return the content of the C files and of the project's headers, by file name."""
    sources = {}
    for name in source_names:
        found = [path for path in (model_dir / name, SKELETON / name) if path.is_file()]
        if not found:
            raise BuildError(f"{name} is neither in {model_dir} nor in {SKELETON}")
        sources[name] = read_source(found[0])
    for folder in (SKELETON, model_dir.parent, model_dir):
        sources |= {header.name: read_source(header) for header in sorted(folder.glob("*.h"))}
    return sources


def read_source(path: Path) -> bytes:
    """Return a file with Unix line ends, so that a checkout on Windows gives the same GUID."""
    return path.read_bytes().replace(b"\r\n", b"\n")


def fmi_headers(version: str = "2") -> dict[str, bytes]:
    """Return the headers of an FMI version by name; they are FMPy's, under the 2-clause BSD licence in their text."""
    package = importlib.util.find_spec("fmpy")
    if package is None or package.origin is None:
        raise BuildError("FMPy is missing, and with it the FMI headers: pip install fmpy")
    folder = Path(package.origin).parent / "c-code"
    missing = [name for name in FMI_HEADERS[version] if not (folder / name).is_file()]
    if missing:
        raise BuildError(f"FMPy in {folder.parent} has no {', '.join(missing)}: use another release of FMPy")
    return {name: read_source(folder / name) for name in FMI_HEADERS[version]}


def guid_of(template: str, sources: dict[str, bytes]) -> str:
    """Return a GUID that changes with every byte of the description and of the project's sources."""
    digest = hashlib.sha256(template.encode())
    for name, content in sorted(sources.items()):
        digest.update(f"\0{name}\0{len(content)}\0".encode())
        digest.update(content)
    return f"{{{uuid.UUID(bytes=digest.digest()[:16], version=5)}}}"


def this_platform() -> Platform:
    """Return the platform of this Python, which the compiler is taken to build for."""
    if sys.maxsize <= 2**32:
        raise BuildError("only 64-bit platforms are known")
    if sys.platform == "darwin":
        return MACOS
    if sys.platform == "win32":
        return WINDOWS
    return ARM if os.uname().machine == "aarch64" else LINUX


def compile_library(
    identifier: str, source_names: Sequence[str], sources: dict[str, bytes], platform: Platform
) -> bytes:
    """Compile the C files to a shared library and return its bytes."""
    compiler = platform.compiler or find_compiler()
    with tempfile.TemporaryDirectory(prefix="fmu_build_") as folder:
        for name, content in sources.items():
            Path(folder, name).write_bytes(content)
        library = Path(folder, identifier + platform.suffix)
        command = [*compiler, *COMPILE_FLAGS, *platform.link_flags, "-o", library.name, *source_names, "-lm"]
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            raise BuildError(f"{identifier}: {shlex.join(command)}\n{result.stderr.strip()}")
        return library.read_bytes()


def write_archive(path: Path, members: dict[str, bytes]) -> Path:
    """Write the archive with sorted entries and one fixed time, and put it in place in one move."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    with zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in sorted(members.items()):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(entry, content)
    draft.replace(path)
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Build the models named on the command line, or all of the source folder."""
    parser = argparse.ArgumentParser(description="Build the example FMUs.")
    parser.add_argument("models", nargs="*", help="names of model folders (default: all)")
    parser.add_argument("--source", type=Path, default=HERE / "src", help="folder of the model folders")
    parser.add_argument("--output", type=Path, default=HERE, help="folder for the .fmu files")
    parser.add_argument("--arm", action="store_true", help="for Linux on ARM only, without sources; needs ziglang")
    options = parser.parse_args(arguments)
    try:
        for model_dir in model_dirs(options.source, options.models):
            path = build(model_dir, options.output, ARM_FROM_X86 if options.arm else None)
            print(f"{path} ({path.stat().st_size} bytes)")
    except BuildError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def model_dirs(source: Path, names: Sequence[str]) -> list[Path]:
    """Return the folders of the named models, or of all models in ``source``."""
    found = {path.parent.name: path.parent for path in sorted(source.glob("*/modelDescription.xml"))}
    if not found:
        raise BuildError(f"{source} has no folder with a modelDescription.xml")
    unknown = [name for name in names if name not in found]
    if unknown:
        raise BuildError(f"no model {', '.join(unknown)} in {source}; there are {', '.join(found)}")
    return [found[name] for name in names or found]


if __name__ == "__main__":
    sys.exit(main())
