"""Makes FMUs out of kept ones: with another description, other files, or entries that no tool would write."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.fmus.helpers import FMUS

__all__ = ["repacked", "unpacked", "without_binaries"]

Entry = str | zipfile.ZipInfo


def repacked(
    target: Path,
    *,
    source: Path = FMUS / "Gain.fmu",
    description: Callable[[str], str] = lambda text: text,
    keep: Callable[[str], bool] = lambda _name: True,
    add: Mapping[Entry, bytes] = {},
) -> Path:
    """Write ``target``: the FMU ``source`` with another description, some of its files, and some more."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            if keep(name):
                data = old.read(name)
                new.writestr(name, description(data.decode()) if name == "modelDescription.xml" else data)
        for entry, data in add.items():
            new.writestr(entry, data)
    return target


def without_binaries(target: Path, *, source: Path = FMUS / "Gain.fmu") -> Path:
    """Write ``target``: the FMU ``source`` with its sources only."""
    return repacked(target, source=source, keep=lambda name: not name.startswith("binaries/"))


def unpacked(folder: Path, *, source: Path = FMUS / "Gain.fmu") -> Path:
    """Unpack the FMU ``source`` into ``folder``, as a person would."""
    with zipfile.ZipFile(source) as archive:
        archive.extractall(folder)
    return folder
