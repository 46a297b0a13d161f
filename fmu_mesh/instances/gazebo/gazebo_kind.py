"""Worlds of the simulator Gazebo classic 11 as a kind of instances."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ...config.mesh import LimitsConfig
from ...errors import LoadFailed
from ...variables.model_description import ModelDescription
from ..contract import Instance, Kind, Opening
from .gazebo_section import GazeboClassicConfig

__all__ = ["KIND_OF_GAZEBO_CLASSIC"]


class GazeboClassicKind(Kind[GazeboClassicConfig]):
    """Worlds that Gazebo classic computes, in a process of its own."""

    section = GazeboClassicConfig
    expected = "an SDF world for Gazebo classic 11"

    def describe(
        self, path: Path, section: GazeboClassicConfig, limits: LimitsConfig, tell: Callable[[str], None]
    ) -> ModelDescription:
        """Read the world; its joints and links are the variables. Gazebo is not needed for that."""
        from .gazebo_world import load_gazebo_world  # noqa: PLC0415  only where there is a world

        return load_gazebo_world(path, section).description

    def content(self, path: Path) -> str:
        """The SHA-256 of the file and of the models that it includes."""
        from .world_includes import WorldFile  # noqa: PLC0415  as above

        return WorldFile(path).sha256

    def check_engine(self) -> None:
        """Check that Gazebo classic runs on this host."""
        from .gazebo_process import check_program  # noqa: PLC0415  as above

        _asked(check_program)

    def host_checks(self) -> Mapping[str, Callable[[], str]]:
        """Look for the lock-step program; it is not started."""
        from .gazebo_process import find_program  # noqa: PLC0415  as above

        return {"Gazebo classic": lambda: shlex.join(_asked(find_program))}

    def open(self, opening: Opening[GazeboClassicConfig]) -> Instance:
        """Start Gazebo with the world."""
        from .gazebo_classic import GazeboClassicInstance  # noqa: PLC0415  as above

        return GazeboClassicInstance(opening.path, opening.name, opening.section, opening.timeouts)


def _asked(ask: Callable[[], Any]) -> Any:  # noqa: ANN401  what `ask` returns
    from .gazebo_process import HOW_TO_GET_IT, GazeboGone  # noqa: PLC0415  as above

    try:
        return ask()
    except GazeboGone as error:
        raise LoadFailed(f"Gazebo classic does not run on this host: {error}", hint=HOW_TO_GET_IT) from error


KIND_OF_GAZEBO_CLASSIC = GazeboClassicKind()  # what the entry point `gazebo_classic` names
