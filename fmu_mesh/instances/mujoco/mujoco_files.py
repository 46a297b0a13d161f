"""Which files a MuJoCo model is made of, and what is in all of them; needs no MuJoCo.

Owns how MJCF and URDF refer to other files: included and attached models, meshes, textures, height fields, skins. If a
reference can mean several files that exist, all of them count, so that none is missed.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from ...files import sha256_of

__all__ = ["world_content"]


def world_content(path: Path) -> str:
    """A SHA-256 of the model at ``path`` and of all files that it refers to, wherever they lie."""
    files: dict[Path, ET.Element | None] = {}
    names: dict[Path, set[str]] = {path.resolve(): {""}}
    while waiting := [file for file in names if file not in files]:
        files.update((file, _model(file)) for file in waiting)
        models = [(file, root) for file, root in files.items() if root is not None]
        folders = {file.parent for file, _ in models}
        folders |= {folder / own for folder in folders for _, root in models for own in _asset_folders(root)}
        for reference in sorted({name for _, root in models for name in _references(root)}):
            for candidate in _candidates(reference, folders):
                names.setdefault(candidate, set()).add(reference)
    found = sorted(f"{sha256_of(file)} {sorted(names[file])}" for file in files)
    return hashlib.sha256("\n".join(found).encode(errors="surrogateescape")).hexdigest()


def _model(file: Path) -> ET.Element | None:
    """The root element of a model; None for a mesh, an image and whatever else is no XML."""
    try:
        return ET.parse(file).getroot()  # noqa: S314  a file of the user's own; it is run as a simulation anyway
    except (ET.ParseError, LookupError, ValueError):  # no XML, or in an encoding that is not known
        return None


def _asset_folders(root: ET.Element) -> Iterator[str]:
    for compiler in root.iter("compiler"):
        yield from (compiler.get(name, "") for name in ("assetdir", "meshdir", "texturedir"))


def _references(root: ET.Element) -> Iterator[str]:
    """The values of `file`, `filename` of URDF, and `fileright` and the others of a texture."""
    for element in root.iter():
        yield from (value for name, value in element.attrib.items() if name.startswith("file") and value)


def _candidates(reference: str, folders: set[Path]) -> Iterator[Path]:
    """The files that a reference can mean; `strippath` leaves the last part of it only."""
    plain = PurePosixPath(reference.partition("://")[2] or reference)
    for folder in folders:
        for name in (plain, plain.name):
            if (candidate := (folder / name).resolve()).is_file():
                yield candidate
