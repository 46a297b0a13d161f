"""How this package was installed, and what installs a library that is missing.

The project is on no package index. So a hint names the library that is missing, never ours: whoever took our name
there would run code on the machines of our users.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shlex import quote
from urllib.parse import unquote, urlsplit

import msgspec

from .errors import LibraryMissing

__all__ = ["importing", "installed_from", "library_missing", "require"]

_OURS = "fmu-mesh"


@contextmanager
def importing(library: str, user: str) -> Iterator[None]:
    """Import modules of an optional library in this block; ``user``, a plural, is what needs it.

    Raises:
        LibraryMissing: it cannot be imported; says how to install it here.
    """
    try:
        yield
    except ImportError as error:
        raise library_missing(library, user) from error


def require(module: str, user: str) -> None:
    """Check that a library is installed, without importing it, which may be slow.

    Raises:
        LibraryMissing: it is not.
    """
    if importlib.util.find_spec(module) is None:
        raise library_missing(module, user)


def library_missing(library: str, user: str) -> LibraryMissing:
    """The error of a missing library."""
    return LibraryMissing(f"{user} need the library {library}", hint=f"Install it with `{_command_for(library)}`.")


def installed_from() -> str | None:
    """The clone or the wheel that was installed, quoted for a shell; None if it is not here."""
    from importlib import metadata  # noqa: PLC0415  it takes 17 ms, and only errors need it

    with suppress(metadata.PackageNotFoundError, msgspec.DecodeError, ValueError, KeyError, TypeError):
        origin = metadata.distribution(_OURS).read_text("direct_url.json")
        place = urlsplit(msgspec.json.decode(origin or "")["url"])
        if place.scheme == "file" and Path(path := unquote(place.path)).exists():
            return quote(path)
    return None


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
