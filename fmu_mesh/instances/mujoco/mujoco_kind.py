"""Worlds of the physics engine MuJoCo as a kind of instances. It is imported when a world is described or opened."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from ...config.mesh import LimitsConfig
from ...variables.model_description import ModelDescription
from ..child_question import ask_description_of, described
from ..contract import Instance, Kind, LogMessage, Opening, Showing
from .mujoco_section import MujocoConfig

__all__ = ["KIND_OF_MUJOCO"]


class MujocoKind(Kind[MujocoConfig]):
    """Worlds that MuJoCo computes."""

    section = MujocoConfig
    expected = "a MuJoCo model (MJCF or URDF)"
    can_be_shown = True

    def describe(
        self,
        path: Path,
        section: MujocoConfig,
        limits: LimitsConfig,  # noqa: ARG002  for FMUs
        tell: Callable[[str], None],  # noqa: ARG002  loading a model is fast
    ) -> ModelDescription:
        """Load the model in a child process; its joints, bodies, sensors and actuators are the variables."""
        return ask_description_of(f"MuJoCo, which loads '{path}',", __name__, (str(path), section))

    def content(self, path: Path) -> str:
        """A SHA-256 of the model and of all files that it includes."""
        from .mujoco_files import world_content  # noqa: PLC0415  only where there is a world

        return world_content(path)

    def check_showing(self, showing: Showing) -> None:
        """Check that there is a screen, or what a film needs. Call it before MuJoCo is imported."""
        from .rendering import check_film, check_window  # noqa: PLC0415  as above

        if showing.view:
            check_window()
        if showing.video is not None:
            check_film(showing.video)

    def open(self, opening: Opening[MujocoConfig]) -> Instance:
        """Load the world, and start a film or a window if one is asked for."""
        from .mujoco_instance import MujocoInstance  # noqa: PLC0415  as above
        from .rendering import Film, Picture, Window  # noqa: PLC0415  as above

        picture: Picture | None = Window() if opening.showing.view else None
        if opening.showing.video is not None:
            picture = Film(opening.showing.video, opening.name)

        def log(status: str, text: str, step: int) -> None:
            opening.log(LogMessage(opening.name, status, "engine", text, step))

        return MujocoInstance(opening.path, opening.name, opening.section, log, picture)


def answer_to(request: str) -> bytes:
    """In the child process: the description of a model, or why there is none."""
    from .mujoco_world import load_world  # noqa: PLC0415  as above

    path, section = msgspec.json.decode(request, type=tuple[str, MujocoConfig])
    return described(lambda: load_world(Path(path), section).description)


KIND_OF_MUJOCO = MujocoKind()
"""What the entry point `mujoco` names."""
