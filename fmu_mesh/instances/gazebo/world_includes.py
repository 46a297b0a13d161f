"""The file of an SDF world, with the models that it includes in the place of each `<include>`.

Owns where models are looked for: in the folder of the including file, in the folders of `GAZEBO_MODEL_PATH`, and in
`~/.gazebo/models`. Nothing is downloaded. A light and the ground plane need no file. What the elements mean is
`fmu_mesh.instances.gazebo.gazebo_world`.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from lxml import etree

from ...archives.safe_xml import safe_xml
from ...errors import LoadFailed
from ...files import exists, is_file, opened
from ...text import listed

__all__ = ["MODELS", "Element", "WorldFile", "folders_of"]

Element = Any
"""An element of lxml, which ships no types."""

MODELS = "GAZEBO_MODEL_PATH"
"""The environment variable with the folders of models, separated by colons."""

_MAXIMUM_BYTES = 16 * 1024 * 1024
"""Of the world and all that it includes: a model that includes another one ten times may do so at every level."""

_NEWEST = "1.7"
"""The version of SDF that Gazebo classic 11 reads."""

_SAME = {"1.5", "1.6"}
"""Versions in which joints and frames mean the same."""

_OF_VERSION = ".//joint | .//frame | .//*[@relative_to or @attached_to or @expressed_in]"
"""Elements whose meaning depends on the version of a file, of which a world has one."""

_DEEPEST = 100
"""How many models may be around one that is included."""

_VERSION = re.compile(r"/(\d+|tip)$")

_GROUND = """
<model name="ground_plane">
  <static>true</static>
  <link name="link">
    <collision name="collision">
      <geometry><plane><normal>0 0 1</normal><size>100 100</size></plane></geometry>
      <surface><friction><ode><mu>100</mu><mu2>50</mu2></ode></friction></surface>
    </collision>
  </link>
</model>
"""
"""Has the same effect on the motion as Gazebo's own model of this name."""


class WorldFile:
    """A world and what it includes; `LoadFailed` if a file is missing or cannot be read.

    Attributes:
        source: the bytes of the file.
        sha256: of all files that were read.
        root: the element of the file, without any `<include>`.
        world: that of the world.
        files: the files of models and plugins that are not in the file of the element around them.
        notes: in words, what is not as the file says.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._left, self._sha256, self.source = path, _MAXIMUM_BYTES, hashlib.sha256(), b""
        self.files: dict[Element, Path] = {}
        self.notes: list[str] = []
        try:
            self.root = self._parsed(path)
            worlds = self.root.findall("world")
            if self.root.tag != "sdf" or len(worlds) != 1:
                hint = f"Gazebo classic 11 reads SDF up to {_NEWEST}."
                raise LoadFailed(f"'{path}' is no SDF file with one world", hint=hint)
            (self.world,) = worlds
            missing = list(self._resolve(self.world, path))
        except OSError as error:
            reason = f"'{error.filename or path}' cannot be read as an SDF world: {error.strerror}"
            raise LoadFailed(reason) from error
        self.sha256 = self._sha256.hexdigest()
        if missing:
            models = f"a model ({missing[0]})" if len(missing) == 1 else f"models ({', '.join(missing)})"
            raise LoadFailed(
                f"'{path}' includes {models}, not found in {listed([*map(str, folders_of(MODELS, path))])}",
                hint=f"Nothing is downloaded for a run: add the folder with the models to {MODELS}, or replace each "
                "<include> by its model, as `gz sdf -p WORLD` prints it.",
            )

    def _parsed(self, path: Path) -> Element:
        with opened(path) as file:
            data = file.read(self._left + 1)
        self._left -= len(data)
        if self._left < 0:
            raise LoadFailed(f"'{self._path}' and what it includes have more than {_MAXIMUM_BYTES} bytes")
        self._sha256.update(data)
        self.source = self.source or data
        return safe_xml(data, f"'{path}'")

    def _resolve(self, parent: Element, file: Path) -> Iterator[str]:
        """Replace the includes in a world or a model, which is in ``file``; yields each URI that is not found."""
        for child in [*parent]:
            if child.tag == "model":
                yield from self._resolve(child, file)
            elif child.tag == "include":
                uri = child.findtext("uri", "").strip()
                model = self._included(uri, parent, file)
                if model is None:
                    yield uri or "without a uri"
                    continue
                parent.replace(child, model)
                if model.tag == "model":
                    self._override(model, child, file)
                    yield from self._resolve(model, self.files.get(model, file))

    def _included(self, uri: str, parent: Element, file: Path) -> Element | None:
        """The model with a URI; a comment for a light, and None if it is not found."""
        name = _VERSION.sub("", unquote(uri).rstrip("/")).rpartition("/")[2].casefold().replace(" ", "_")
        if name == "sun":
            self.notes.append(f"left out, as a light moves nothing: the included '{uri}'")
            return etree.Comment("a light")
        if name == "ground_plane":
            self.notes.append(f"a static plane stands for the included '{uri}'")
            return etree.fromstring(_GROUND)
        path = self._model_file(uri, file)
        if path is None:
            return None
        if len([*parent.iterancestors()]) > _DEEPEST:  # so deep is a model that includes itself
            raise LoadFailed(f"'{file}' includes '{path}' inside more than {_DEEPEST} other models")
        root = self._parsed(path)
        model = root.find("model")
        if root.tag != "sdf" or model is None:
            raise LoadFailed(f"'{path}', which '{file}' includes, is no SDF file with a model")
        version, own = root.get("version"), self.root.get("version")
        if version != own and not {version, own} <= _SAME and model.xpath(_OF_VERSION):
            raise LoadFailed(
                f"'{path}' is SDF {version}, and '{self._path}', which includes it, is SDF {own}: joints and frames "
                "may mean something else",
                hint=f"`gz sdf -p FILE` prints a file in SDF {_NEWEST}: write both in that version.",
            )
        self.files[model] = path
        return model

    def _override(self, model: Element, include: Element, file: Path) -> None:
        """Let a model have what its `<include>`, which is in ``file``, says of it."""
        model.set("name", include.findtext("name", "").strip() or model.get("name", ""))
        for part in include.xpath("pose | static | plugin"):
            for old in model.findall(part.tag) if part.tag != "plugin" else ():
                model.remove(old)
            model.append(part)
            self.files[part] = file

    def _model_file(self, uri: str, beside: Path) -> Path | None:
        """The file of an included model; None if there is none on this host."""
        scheme, _, name = uri.rpartition("://")
        if scheme not in {"", "model", "file"} or not name:
            return None
        places = [folder.absolute() / name for folder in folders_of(MODELS, beside)]  # an absolute name stays as it is
        place = next((place for place in places if exists(place)), None)
        if place is None or is_file(place):
            return place
        manifest, model = place / "model.config", "model.sdf"
        if is_file(manifest):
            named = [(own.get("version", ""), own.text or model) for own in self._parsed(manifest).findall("sdf")]
            model = max((own for own in named if own[0] <= _NEWEST), default=("", model))[1].strip()
        return place / model if is_file(place / model) else None


def folders_of(variable: str, file: Path) -> list[Path]:
    """Where Gazebo looks for files, such as `GAZEBO_RESOURCE_PATH`; before that, the folder of the file."""
    named = [Path(folder) for folder in os.environ.get(variable, "").split(":") if folder]
    if variable == MODELS:
        named.append(Path("~/.gazebo/models").expanduser())
    return [*dict.fromkeys((file.parent, *named))]
