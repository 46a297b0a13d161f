"""Importing the class of a component: from a file, from an installed module, or as the program that is running has it.

A file is imported anew for each instance, under a name of its own, and so are the modules of its folder
(`fmu_mesh.instances.python.own_modules`). So two instances share no global variables, whether they run in one process
or in two.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.abc import FileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, TypeGuard

from ...errors import CallRefused, ConfigurationError, FmuMeshError
from ...text import listed, nearest, short_path
from ...variables.model_description import ModelDescription
from .component import Component
from .component_description import description_of
from .own_modules import OwnModules
from .python_section import ClassPlace, importing

__all__ = ["ImportedComponent", "component_section"]

_OWN = Path(__file__).resolve().parents[2]
_TEXT_CHARACTERS = 500


class ImportedComponent:
    """The class of a component, imported for one instance.

    ``path`` is the absolute path of its file; `Path()` for a module.

    Raises:
        Exception: whatever the code of the user raises; `told` says it in words.
        CallRefused: there is no such class, or it is no component.

    Attributes:
        cls: the class; call `load` first.
        description: its model description.
        modules: those of its folder; call `forget_names` after each call into the component.
    """

    def __init__(self, path: Path, target: ClassPlace) -> None:
        self._path = path
        self._target = target
        self.modules = OwnModules(path.parent)
        self._file = path if target.file else None
        self.cls: type[Component] = Component
        self.description: ModelDescription | None = None

    @property
    def file(self) -> str | None:
        """The file of the class; None while that is not known."""
        return str(self._file) if self._file is not None else None

    def load(self) -> ModelDescription:
        """Import the class; returns its description. See the class for what is raised."""
        target = self._target
        place = target.file or target.module
        if not target.name.isidentifier():
            wanted = f"`{place}:Controller`, if the class is called Controller"
            raise CallRefused(f"'{place}' names no class at the top of the module, expected {wanted}")
        with _marked(place):
            if self._file is not None:
                module, data = self._from_file(self._file)
            else:
                module = importlib.import_module(target.module)
                self._file = Path(module.__file__) if module.__file__ is not None else None
                data = self._file.read_bytes() if self._file is not None else b""
        found = getattr(module, target.name, None)
        if found is None:
            classes = [name for name, value in vars(module).items() if _is_component(value) and value is not Component]
            suggestion = nearest(target.name, classes)
            hint = f"Did you mean '{suggestion}'?" if suggestion else None
            has = listed(classes, nothing="no component")
            raise CallRefused(f"there is no '{target.name}' in '{place}', which has {has}", hint=hint)
        if not _is_component(found):
            what = "function" if callable(found) and not isinstance(found, type) else type(found).__name__
            hint = "Put the decorator `fmu_mesh.component` before it." if what == "function" else None
            if isinstance(found, type):
                what, hint = "class", "Derive it from `fmu_mesh.Component`."
            raise CallRefused(f"'{target.name}' in '{place}' is a {what} and no component", hint=hint)
        self.cls = found
        self.description = description_of(found, hashlib.sha256(data).hexdigest())
        return self.description

    def told(self, error: BaseException) -> str:
        """An exception of the code of the user in one line, with the file and the line: `controller.py:12: ...`."""
        words = error.message if isinstance(error, FmuMeshError) else f"{type(error).__name__}: {error}"
        text = " ".join(words.split())[:_TEXT_CHARACTERS].removesuffix(": ").removesuffix(":")
        if isinstance(error, SyntaxError) and error.filename is not None:
            return f"{short_path(error.filename)}:{error.lineno}: {type(error).__name__}: {error.msg}"
        lines = [(Path(frame.f_code.co_filename), line) for frame, line in traceback.walk_tb(error.__traceback__)]
        foreign = [place for place in lines if _OWN not in place[0].parents and not str(place[0]).startswith("<")]
        own = [place for place in foreign if self._file is not None and place[0] == self._file] or foreign
        if not own:
            return text
        file, line = own[-1]
        deeper = f" ({foreign[-1][0].name}:{foreign[-1][1]})" if foreign[-1][0] != file else ""
        return f"{short_path(file)}:{line}: {text}{deeper}"

    def close(self) -> None:
        """Forget the module, and those of its folder."""
        self.modules.close()

    def _from_file(self, file: Path) -> tuple[ModuleType, bytes]:
        name = self.modules.name_of(file.stem.replace(".", "_"))
        loader = _SourceFile(name, str(file))
        spec = importlib.util.spec_from_file_location(name, file, loader=loader)
        assert spec is not None
        module = self.modules.adopted(importlib.util.module_from_spec(spec))
        sys.modules[name] = module
        loader.exec_module(module)
        return module, loader.data


class _SourceFile(FileLoader):
    """Loads a module from the bytes of its file, which `data` keeps: their hash is that of what runs.

    No byte code is read, because its age is compared in whole seconds.
    """

    data = b""

    def get_source(self, fullname: str) -> str:
        """The text of the file, in the encoding that it declares."""
        self.data = self.get_data(self.get_filename(fullname))
        return importlib.util.decode_source(self.data)


@contextmanager
def _marked(place: str) -> Iterator[None]:
    token = importing.set(place)
    try:
        yield
    finally:
        importing.reset(token)


def _is_component(value: object) -> TypeGuard[type[Component]]:
    return isinstance(value, type) and issubclass(value, Component)


def component_section(cls: object) -> tuple[dict[str, str], ModelDescription]:
    """The keys of the section of a class that a program has, and its model description.

    Example:
        ``component_section(Controller)[0]`` is ``{"python": "/home/me/controller.py:Controller"}``

    Raises:
        ConfigurationError: other processes cannot import the class; says what to do.
    """
    if not _is_component(cls):
        name = getattr(cls, "__name__", repr(cls))
        hint = "Derive a class from it, or put the decorator `fmu_mesh.component` before the function."
        raise ConfigurationError(f"{name} is no `fmu_mesh.Component`", hint=hint)
    module: Any = sys.modules.get(cls.__module__)
    if "." in cls.__qualname__:
        raise _cannot_import(cls, "it is defined within a function or a class", "Define it at the top of its file.")
    file = Path(getattr(module, "__file__", None) or "<none>").absolute()
    if not file.is_file() or vars(module).get(cls.__name__) is not cls:
        reason = "no file has it, because a notebook or an interactive session defined it"
        raise _cannot_import(cls, reason, "Write it to a file and import it from there.")
    spec = module.__spec__
    name = spec.name if spec is not None else cls.__module__
    from importlib.metadata import packages_distributions  # noqa: PLC0415 slow, and only this needs it

    package = name.partition(".")[0]
    place = name if package != name and package in packages_distributions() else str(file)
    description = description_of(cls, hashlib.sha256(file.read_bytes()).hexdigest())
    return {"python": f"{place}:{cls.__name__}"}, description


def _cannot_import(cls: type, reason: str, hint: str) -> ConfigurationError:
    return ConfigurationError(f"other processes cannot import the component '{cls.__qualname__}': {reason}", hint=hint)
