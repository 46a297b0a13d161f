"""What instances leave for the next instances of the same models in this process, such as extracted and loaded FMUs.

Used where one process runs a mesh again and again (`fmu_mesh.run.repeated`). Knows no kind of instance.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Protocol

__all__ = ["KeptModel", "KeptModels"]


class KeptModel(Protocol):
    """What is kept of a model: its files, its library, or an instance that can be reset."""

    @property
    def key(self) -> Hashable:
        """What the model was made from: it can be used again where the same is needed."""
        ...

    def close(self) -> None:
        """Free all of it. Never raises; may be called twice."""
        ...


class KeptModels:
    """At most one model for each instance name, so two instances of one FMU never share a library.

    They keep files in ``folder``, an existing private one. With ``resets``, an instance is kept and reset for the next
    run, where its model can be reset.
    """

    def __init__(self, folder: Path, *, resets: bool = False) -> None:
        self.folder = folder
        self.resets = resets
        self.loads = 0  # how many models were not kept, and so are loaded
        self.is_closed = False
        self._models: dict[str, KeptModel] = {}

    def take(self, name: str, key: Hashable) -> KeptModel | None:
        """What was kept of the instance ``name``, if it was made from the same; the caller owns it from now on."""
        found = self._models.pop(name, None)
        if found is not None and found.key != key:
            found.close()
            found = None
        self.loads += found is None
        return found

    def keep(self, name: str, model: KeptModel) -> None:
        """Keep a model for the next instance ``name``; not after `close`."""
        self._models[name] = model

    def close(self) -> None:
        """Free all models; those that are still in use are not kept."""
        self.is_closed = True
        for model in self._models.values():
            model.close()
        self._models.clear()
