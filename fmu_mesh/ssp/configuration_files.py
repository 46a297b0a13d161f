"""A configuration file of any format: YAML, a package of SSP, or an SDF world. All become the same plain values."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from .. import files
from ..config.loading import PlainConfig, read_file
from ..errors import ConfigurationError
from .package import ARCHIVE, DEFAULT, beginning

__all__ = ["named_package", "names_package", "names_world", "read_configuration"]

_YAML: Final = (".yaml", ".yml", ".json")
_PACKAGES: Final = (".ssp", ".ssd")
_WORLDS: Final = (".world", ".sdf")
_PARTS: Final = (".ssv", ".ssm", ".ssb")


def read_configuration(path: Path, ssd: str | None = None, ssv: Sequence[str | Path] = ()) -> PlainConfig:
    """Read the values of a configuration; what they mean is not checked yet.

    Example:
        >>> read_configuration(Path("configs/pendulum_delay.yaml")).data["mesh"]
        'pendulum_delay'

    Args:
        path: a YAML file; an .ssp file, a folder that was one, an .ssd file, or an .ssd inside an .ssp; or a .world or
            .sdf file with a world of Gazebo classic.
        ssd: which description of a package: the name of its file, or the name that it has; None: the default one.
        ssv: files with values that replace those of a package: in it, or else on the disk.

    Raises:
        ConfigurationError: it cannot be read, or it is neither YAML nor a package.
    """
    if (package := named_package(path, ssd)) is not None:
        from .system_reading import read_system  # noqa: PLC0415  it imports FMPy, which is slow

        return read_system(*package, ssv)
    if ssd is not None or ssv:
        option = "`ssd=...`" if ssd is not None else "`ssv=...`"
        raise ConfigurationError(f"{option} chooses a variant of a package of SSP, and '{path}' is no package")
    archive = files.archive_on_the_way(path)
    if path.suffix.lower() in _PARTS or (archive is not None and names_package(archive)):
        hint = "Name the package: the .ssp, its folder, or an .ssd in it."
        raise ConfigurationError(f"'{path}' is a part of a package of SSP", hint=hint)
    if names_world(path):
        from .fmi_world_reading import read_fmi_world  # noqa: PLC0415  only where there is a world

        return read_fmi_world(path)
    return read_file(path)


def named_package(path: Path, ssd: str | None = None) -> tuple[Path, str | None] | None:
    """The package that a path names, and which description of it; None if it is no package.

    Example:
        >>> named_package(Path("configs/pendulum_delay.yaml")) is None
        True

    Raises:
        ConfigurationError: the path is that of a description, and another one is chosen.
    """
    is_description = path.suffix.lower() == ".ssd" and not files.is_folder(path)
    if is_description and ssd is not None:
        hint = f"Name the package, '{path.parent}', or leave `ssd=...` out."
        raise ConfigurationError(f"'{path}' is one description, and `ssd=...` chooses one", hint=hint)
    if is_description and (archive := files.archive_on_the_way(path)) is not None:
        return archive, path.relative_to(archive).as_posix()
    return (path, ssd) if names_package(path) else None


def names_package(path: Path) -> bool:
    """Whether a path is that of a package of SSP: by its suffix, or by what is in it if it has another one."""
    if path.suffix.lower() in _PACKAGES or files.is_file(path / DEFAULT):
        return True
    if files.is_folder(path):
        return any(path.glob("*.ssd"))
    if path.suffix.lower() in _YAML or not files.is_file(path):
        return False
    if beginning(path) != ARCHIVE:
        return False
    try:
        with zipfile.ZipFile(path) as archive:  # only its list of files is read here
            return any(name.lower().endswith(".ssd") and "/" not in name for name in archive.namelist())
    except (OSError, ValueError, zipfile.BadZipFile):
        return False  # whoever reads it says why


def names_world(path: Path) -> bool:
    """Whether a path is that of a world of Gazebo, by its suffix."""
    return path.suffix.lower() in _WORLDS
