"""How this package was installed, and what installs a library that is missing.

The project is on no package index. So a hint names the library that is missing, never ours: whoever took our name
there would run code on the machines of our users.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote
from typing import Final
from urllib.parse import unquote, urlsplit

import msgspec

from .errors import ConfigurationError, LibraryMissing

__all__ = ["PROGRAMS", "USERS", "importing", "installed_from", "program", "require", "version_of_library"]

USERS: Final[Mapping[str, str]] = {
    "anywidget": "live cells",
    "cryptography": "certificates",
    "distributed": "clusters of Dask",
    "foxglove-sdk": "connections of Foxglove",
    "gymnasium": "environments of Gymnasium",
    "imageio": "films",
    "matplotlib": "plots",
    "mcap": "recordings into .mcap",
    "mujoco": "worlds of MuJoCo",
    "nicegui": "dashboards",
    "onnxruntime": "ONNX models",
    "pandas": "data frames",
    "pyarrow": "results in .parquet",
    "rosbags": "bags of ROS",
    "scipy": "samplers other than random",
    "wasmtime": "FMUs in WebAssembly",
    "xxhash": "topics of rmw_zenoh",
    "ziglang": "FMUs in WebAssembly",
}
"""The optional libraries, and what needs each, a plural."""

PROGRAMS: Final[Mapping[str, tuple[str, str]]] = {
    "sbatch": (
        "jobs of Slurm",
        "Install the programs of Slurm (Debian, Ubuntu: apt install slurm-client), or run this on a login host.",
    ),
    "ssh": ("nodes on other hosts", "Install it, on Debian with `apt install openssh-client`."),
    "wine": ("FMUs that have only Windows binaries", "Install it, on Debian with `apt install wine`."),
    "zenoh-bridge-ros2dds": ("meshes beside ROS on DDS", "Start it where ROS is; `ros.connect` says where that is."),
}
"""Programs of the system: what needs each, a plural, and what to do without it."""

_OURS = "fmu-mesh"
_BOUND = re.compile(r"(>=|<|==)\s*([\d.]+)")


@contextmanager
def importing(library: str, user: str | None = None) -> Iterator[None]:
    """Import modules of an optional library in this block; ``user``, a plural, is what needs it, if not `USERS`.

    Raises:
        LibraryMissing: it cannot be imported; says how to install it here.
    """
    try:
        yield
    except ImportError as error:
        raise _missing(library, user) from error


def require(module: str) -> None:
    """Check that a library is installed, without importing it, which may be slow.

    Raises:
        LibraryMissing: it is not.
    """
    if importlib.util.find_spec(module) is None:
        raise _missing(module)


def program(name: str) -> str:
    """Where one of `PROGRAMS` is; `ConfigurationError` if it is nowhere."""
    if (found := shutil.which(name)) is None:
        user, hint = PROGRAMS[name]
        raise ConfigurationError(f"{user} need the program {name}", hint=hint)
    return found


def version_of_library(library: str) -> str:
    """The version of a library, which is not imported; `LibraryMissing` if there is none that we work with."""
    from importlib import metadata  # noqa: PLC0415  it takes 17 ms, and only errors and `doctor` need it

    try:
        version = metadata.version(library)
    except metadata.PackageNotFoundError as error:
        raise _missing(library) from error
    requirement = _requirement(library)
    for sign, bound in _BOUND.findall(requirement):
        own, wanted = _numbers(version), _numbers(bound)
        if not {">=": own >= wanted, "<": own < wanted, "==": own == wanted}[sign]:
            raise _missing(library, but=f": {requirement}, and {version} is installed")
    return version


def installed_from() -> str | None:
    """The clone or the wheel that was installed, quoted for a shell; None if it is not here."""
    from importlib import metadata  # noqa: PLC0415  as above

    with suppress(metadata.PackageNotFoundError, msgspec.DecodeError, ValueError, KeyError, TypeError):
        origin = metadata.distribution(_OURS).read_text("direct_url.json")
        place = urlsplit(msgspec.json.decode(origin or "")["url"])
        if place.scheme == "file" and Path(path := unquote(place.path)).exists():
            return quote(path)
    return None


def _missing(library: str, user: str | None = None, but: str = "") -> LibraryMissing:
    text = f"{user or USERS.get(library, 'all meshes')} need the library {library}{but}"
    return LibraryMissing(text, hint=f"Install it with `{_command_for(library)}`.")


def _command_for(library: str) -> str:
    what = quote(_requirement(library))
    if Path(sys.prefix, "pipx_metadata.json").exists():
        return f"pipx inject {quote(Path(sys.prefix).name)} {what}"
    if importlib.util.find_spec("pip") is not None:
        return f"{quote(sys.executable)} -m pip install {what}"
    return f"uv pip install --python {quote(sys.executable)} {what}"  # a tool of uv, and any other environment of it


def _requirement(library: str) -> str:
    """The library with the versions that we work with: `pyarrow>=17`."""
    from importlib import metadata  # noqa: PLC0415  as above

    with suppress(metadata.PackageNotFoundError):
        for line in metadata.requires(_OURS) or ():
            requirement = line.partition(";")[0].strip()
            if re.split(r"[^\w.-]", requirement, maxsplit=1)[0] == library:
                return requirement
    return library


def _numbers(version: str) -> list[int]:
    """Of a version such as `1.10.2rc1`: 1, 10 and 2."""
    return [*map(int, re.findall(r"\d+", re.split(r"[^\d.]", version, maxsplit=1)[0]))]
