"""What instances leave for the next instances of the same models in this process, such as extracted and loaded FMUs.

Used where one process runs a mesh again and again (`fmu_mesh.run.repeated`). Knows no kind of instance.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Protocol, cast

__all__ = ["KeptModel", "KeptModels", "SharedModels"]


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

    def reset_from_now_on(self) -> None:
        """Somebody has states of the instances: they belong to these, and to no others made in their place."""
        self.resets = True

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

    def made(self, name: str, model: KeptModel) -> None:
        """A model was made for the instance ``name``, because none was kept."""

    def close(self) -> None:
        """Free all models; those that are still in use are not kept."""
        self.is_closed = True
        for model in self._models.values():
            model.close()
        self._models.clear()


class SharedModel(KeptModel, Protocol):
    """A model that others like it can share the files with."""

    @property
    def has_files(self) -> bool:
        """Whether its files are still there."""
        ...

    def sharing(self) -> KeptModel:
        """Another one with the same files; of one library, a process has one copy."""
        ...


class SharedModels(KeptModels):
    """Any number of models for each instance name, which share files and library (FMI 2.0, 2.1.1; FMI 3.0, 2.2.1)."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._made: dict[str, SharedModel] = {}
        self._free: dict[str, list[KeptModel]] = {}

    def take(self, name: str, key: Hashable) -> KeptModel | None:
        """A free model of the instance ``name``, or one more; the caller owns it from now on."""
        if free := self._free.get(name):
            return free.pop()
        made = self._made.get(name)
        if made is not None and made.key == key and made.has_files:
            return made.sharing()
        self.loads += 1
        return None

    def keep(self, name: str, model: KeptModel) -> None:
        """Keep a model for the next instance ``name``."""
        self._free.setdefault(name, []).append(model)

    def made(self, name: str, model: KeptModel) -> None:
        """A model was made for the instance ``name``: the next ones share its files."""
        self._made[name] = cast("SharedModel", model)

    def close(self) -> None:
        """Free all models that are free."""
        for models in self._free.values():
            for model in models:
                model.close()
        self._free.clear()
