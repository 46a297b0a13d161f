"""Builds the library of C that steps a mesh, and the program that runs FMUs for Windows; puts both into the wheel.

The libraries for Linux on x86_64 and on aarch64 are kept in the repository and in the source distribution, so that
nobody needs a compiler. They are built by the C compiler of the Python package ziglang, in the version that
`pyproject.toml` pins. So the same sources give the same bytes on every machine, and everybody can compare.

A library contains the SHA-256 of each of its sources (`fmu_mesh/rings/library.py` compares them when it loads it).
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import platform_tags

__all__ = [
    "HOST",
    "SOURCES",
    "TARGETS",
    "BuildError",
    "WheelHook",
    "build",
    "library_path",
    "manifest",
    "require_compiler",
]

ROOT: Final = Path(__file__).resolve().parent
PACKAGE: Final = ROOT / "fmu_mesh"

SOURCES: Final = (
    "rings/burst.c",
    "rings/streams.c",
    "rings/hosted.c",
    "rings/model_exchange.c",
    "rings/outside.c",
    "rings/burst.h",
    "rings/counters.h",
    "rings/outside.h",
    "rings/windows_host.h",
    "results/csv_rows.c",
    "instances/fmi/messages.c",
)
"""The files of the library, below the package. A header stands here, too, so that its SHA-256 counts."""

HOST_SOURCES: Final = (
    "rings/burst.c",
    "rings/model_exchange.c",
    "rings/windows_host.c",
    "rings/burst.h",
    "rings/counters.h",
    "rings/windows_host.h",
)
"""The files of the program that runs an FMU for Windows under Wine."""

HOST: Final = "windows-x86_64"
"""The platform of this program."""

TARGETS: Final = {
    "linux-x86_64": "x86_64-linux-gnu.2.17",
    "linux-aarch64": "aarch64-linux-gnu.2.17",
    HOST: "x86_64-windows-gnu",
}
"""What ziglang calls a platform. With glibc 2.17 the library runs on all Linux systems since 2014, except musl's."""

WHEELS: Final = {"linux-x86_64": "manylinux_2_17_x86_64", "linux-aarch64": "manylinux_2_17_aarch64"}
"""What the name of a wheel calls a platform whose library it has."""

FLAGS: Final = (
    "-std=c11",
    "-O2",
    "-mcpu=baseline",  # not the processor of this machine
    "-ffp-contract=off",  # a fused multiply-add would make the floats depend on the processor
    "-fvisibility=hidden",
    "-s",  # no names of folders
    "-Wall",
    "-Wextra",
    "-Watomic-implicit-seq-cst",  # an access of an atomic names its memory order
    "-Werror",
)
LIBRARY_FLAGS: Final = ("-fPIC", "-shared", "-Wl,--build-id=none", "-Wl,--no-undefined")


class BuildError(Exception):
    """The library cannot be built, or is not what it should be; the message says what to do."""


def library_path(platform: str) -> Path:
    """Where the library for a platform lies, or the program for `HOST`."""
    return PACKAGE / "rings" / f"burst-{platform}.{'exe' if platform == HOST else 'so'}"


def sources_of(platform: str) -> tuple[str, ...]:
    """What is built for a platform."""
    return HOST_SOURCES if platform == HOST else SOURCES


def manifest(platform: str = "linux-x86_64") -> str:
    """The sources that the library contains: a line for each file, as `sha256sum` writes it."""
    digests = {name: hashlib.sha256((PACKAGE / name).read_bytes()).hexdigest() for name in sources_of(platform)}
    return "".join(f"{digest}  {name}\n" for name, digest in digests.items())


def require_compiler() -> None:
    """Check that the compiler is there, in the version that `pyproject.toml` pins.

    Raises:
        BuildError: it is missing, or another version is installed.
    """
    pinned = {*re.findall(r'"ziglang==([\d.]+)"', (ROOT / "pyproject.toml").read_text(encoding="utf-8"))}
    try:
        installed = importlib.metadata.version("ziglang")
    except importlib.metadata.PackageNotFoundError:
        installed = "none"
    if {installed} != pinned:
        needed = ", ".join(sorted(pinned))
        raise BuildError(
            f"the library is built by ziglang {needed}; installed: {installed}. `make library` installs it"
        )


def build(platform: str) -> bytes:
    """Build the library for a platform, which need not be this one.

    Args:
        platform: one of `TARGETS`.

    Raises:
        BuildError: the compiler is missing, or refuses a source.
    """
    require_compiler()
    with tempfile.TemporaryDirectory(prefix="fmu_mesh_library_") as name:
        folder = Path(name)
        for source in sources_of(platform):
            (folder / source).parent.mkdir(parents=True, exist_ok=True)
            (folder / source).write_bytes((PACKAGE / source).read_bytes())
        lines = "".join(f'  "{line}\\n"\n' for line in manifest(platform).splitlines())
        visible = '__attribute__((visibility("default"), used))'
        (folder / "sources.c").write_text(f"{visible} const char fmu_mesh_sources[] =\n{lines};\n", encoding="utf-8")
        code = [source for source in sources_of(platform) if source.endswith(".c")]
        flags = FLAGS if platform == HOST else (*FLAGS, *LIBRARY_FLAGS)
        command = [sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[platform], *flags, "-o", "library.so"]
        command += [*code, "sources.c"]
        # Only these variables: some of the others, such as CPATH, change what a compiler does.
        # With a cache of the compiler, a build for Windows takes a second and not a minute.
        cache = os.environ.get("ZIG_GLOBAL_CACHE_DIR", f"{name}/global")
        variables = {"HOME": name, "ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": f"{name}/local"}
        done = subprocess.run(
            command, cwd=name, env=variables, capture_output=True, text=True, check=False, timeout=600
        )
        if done.returncode != 0:
            raise BuildError(f"{shlex.join(command)}\n{done.stderr.strip()}")
        return (folder / "library.so").read_bytes()


class WheelHook(BuildHookInterface[Any]):
    """Puts the library of its platform into a wheel: of this one, or that which `_PYTHON_HOST_PLATFORM` names.

    A wheel for another system has no library and is for all systems: there, a mesh runs without it.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it builds a wheel; an editable installation uses the library of the clone.

        Raises:
            BuildError: the library is missing, or was built from other sources.
        """
        tags = {*platform_tags()}
        platform = next((name for name, tag in WHEELS.items() if tag in tags), None)
        if version != "standard" or platform is None:
            return
        for built in (platform, *([HOST] if platform == "linux-x86_64" else ())):
            library = library_path(built)
            if not library.is_file() or manifest(built).encode() not in library.read_bytes():
                raise BuildError(f"{library} is missing, or was built from other sources: make library")
            build_data["force_include"][str(library)] = library.relative_to(ROOT).as_posix()
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{WHEELS[platform]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Build the libraries and the program, or compare those that are there."""
    parser = argparse.ArgumentParser(description="Build the library of C that steps a mesh.")
    parser.add_argument("--platform", choices=TARGETS, help="what to build for (default: all)")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a library has other bytes")
    options = parser.parse_args(arguments)
    for platform in [options.platform] if options.platform else TARGETS:
        path = library_path(platform)
        try:
            built = build(platform)
        except BuildError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
        if not options.check:
            # A new file: a process that has loaded the old one keeps it.
            draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
            draft.write_bytes(built)
            draft.replace(path)
        elif not path.is_file() or path.read_bytes() != built:
            print(f"error: {path} is not what its sources give: make library", file=sys.stderr)
            return 1
        print(f"{path.relative_to(ROOT)} ({len(built)} bytes, SHA-256 {hashlib.sha256(built).hexdigest()})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
