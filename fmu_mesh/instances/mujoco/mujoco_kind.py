"""Worlds of the physics engine MuJoCo as a kind of instances. It is imported when a world is described or opened.

Owns how MJCF and URDF refer to other files: included and attached models, meshes, textures, height fields, skins. If a
reference can mean several files that exist, all of them count, so that none is missed.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

import msgspec

from ...config.mesh import LimitsConfig
from ...files import sha256_of
from ...variables.model_description import ModelDescription
from ..child_question import ask_description_of, described
from ..contract import Instance, Kind, Opening, Showing
from .mujoco_section import MujocoConfig

__all__ = ["KIND_OF_MUJOCO"]


class MujocoKind(Kind[MujocoConfig]):
    """Worlds that MuJoCo computes."""

    section = MujocoConfig
    expected = "a MuJoCo model (MJCF or URDF)"
    can_be_shown = True

    def describe(
        self, path: Path, section: MujocoConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """Load the model in a child process; its joints, bodies, sensors and actuators are the variables."""
        return ask_description_of(f"MuJoCo, which loads '{path}',", __name__, (str(path), section))

    def content(self, path: Path) -> str:
        """A SHA-256 of the model at ``path`` and of all files that it refers to, wherever they lie."""
        found = sorted(f"{sha256_of(file)} {sorted(names)}" for file, names in _names(path).items())
        return hashlib.sha256("\n".join(found).encode(errors="surrogateescape")).hexdigest()

    def files(self, path: Path) -> Sequence[Path]:
        """The model, and all files that it refers to."""
        return [path, *_names(path)]

    def check_showing(self, showing: Showing) -> None:
        """Check that there is a screen, or what a film needs. Call it before MuJoCo is imported."""
        from .rendering import check_film, check_window  # noqa: PLC0415  only where there is a world

        if showing.view:
            check_window()
        if showing.video is not None:
            check_film(showing.video)

    def host_checks(self) -> Mapping[str, Callable[[], str]]:
        """Look for what draws films."""
        from .rendering import choose_backend  # noqa: PLC0415  as above

        return {"OpenGL": choose_backend}

    def open(self, opening: Opening[MujocoConfig]) -> Instance:
        """Load the world, and start a film or a window if one is asked for."""
        from .mujoco_instance import MujocoInstance  # noqa: PLC0415  as above
        from .rendering import Film, Picture, Window  # noqa: PLC0415  as above

        picture: Picture | None = Window() if opening.showing.view else None
        if opening.showing.video is not None:
            picture = Film(opening.showing.video, opening.name)
        return MujocoInstance(opening.path, opening.name, opening.section, opening.log, picture)


def answer_to(request: str) -> bytes:
    """In the child process: the description of a model, or why there is none."""
    from .mujoco_world import load_world  # noqa: PLC0415  as above

    path, section = msgspec.json.decode(request, type=tuple[str, MujocoConfig])
    return described(lambda: load_world(Path(path), section).description)


def _names(path: Path) -> dict[Path, set[str]]:
    """The model at ``path`` and all files that it refers to, and by which names."""
    files: dict[Path, ET.Element | None] = {}
    names: dict[Path, set[str]] = {path.resolve(): {""}}
    while waiting := [file for file in names if file not in files]:
        files.update((file, _model(file)) for file in waiting)
        models = [(file, root) for file, root in files.items() if root is not None]
        folders = {file.parent for file, _ in models}
        compilers = [compiler for _, root in models for compiler in root.iter("compiler")]
        assets = {one.get(key, "") for one in compilers for key in ("assetdir", "meshdir", "texturedir")}
        folders |= {folder / own for folder in folders for own in assets}
        for reference in sorted({name for _, root in models for name in _references(root)}):
            for candidate in _candidates(reference, folders):
                names.setdefault(candidate, set()).add(reference)
    return names


def _model(file: Path) -> ET.Element | None:
    """The root element of a model; None for a mesh, an image and whatever else is no XML."""
    try:
        return ET.parse(file).getroot()  # noqa: S314  a file of the user's own; it is run as a simulation anyway
    except (ET.ParseError, LookupError, ValueError):  # no XML, or in an encoding that is not known
        return None


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


KIND_OF_MUJOCO = MujocoKind()  # what the entry point `mujoco` names
