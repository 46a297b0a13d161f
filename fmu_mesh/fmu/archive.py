"""Extracting an FMU into a private folder, and removing it again.

Owns the safety of the archive's paths. The folder is made by whoever starts a run and handed in, so that it is removed
even when the process that used it was killed.
"""

from __future__ import annotations

import shutil
import stat
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from ..errors import LoadFailed

__all__ = ["extract"]


def extract(path: Path, parent: Path) -> Path:
    """Extract the FMU at ``path`` into a new folder below ``parent`` and return it.

    Raises:
        LoadFailed: the archive is broken, or an entry would be written outside the folder; nothing is left behind.
    """
    parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{path.stem[:40]}-", dir=parent))
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                _check(path, entry)
            archive.extractall(folder)
    except (OSError, zipfile.BadZipFile, RuntimeError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise LoadFailed(f"'{path}' cannot be extracted: {error}") from error
    except LoadFailed:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _check(path: Path, entry: zipfile.ZipInfo) -> None:
    parts = PurePosixPath(entry.filename)
    if parts.is_absolute() or ".." in parts.parts or "\\" in entry.filename or ":" in entry.filename:
        raise LoadFailed(f"'{path}' has an entry outside its own folder: '{entry.filename}'.")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise LoadFailed(f"'{path}' has a symbolic link inside: '{entry.filename}'.")
