"""The modules of the folder of a component, imported for one instance alone.

Python has one table of modules for a process, `sys.modules`. Two components that `import helper` from two folders would
get one `helper`, and two instances of one component would share its variables. So `helper` of an instance is the module
`helper@7` in that table, where 7 is the number of the instance:

* `import` in a module of the instance, also within a function, calls `__import__` of the builtins of that module, and
  these are those of the instance. Relative imports follow from the name of the package.
* Whoever imports by name from elsewhere, as `importlib.import_module` and `pickle` do, looks into that table first, and
  asks the finders if the name is not there. The finder of the instance whose code is calling answers, and the name is
  in the table until the call into the component ends.

Modules that are written in C cannot be imported twice under two names: they are imported as usual, and claimed
(`fmu_mesh.system.process_sharing`).
"""

from __future__ import annotations

import builtins
import importlib
import inspect
import itertools
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Literal

__all__ = ["OwnModules"]

_numbers = itertools.count(1)


class OwnModules(MetaPathFinder):
    """The modules of one instance. It finds them from the start until `close`.

    Attributes:
        lent: the names that were imported by name from elsewhere, in the call into the component that is under way.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)
        self._suffix = f"@{next(_numbers)}"
        self._builtins = {**vars(builtins), "__import__": self._import}
        self._kinds: dict[str, Literal["", "Python", "C"]] = {}
        self.lent: list[str] = []
        sys.meta_path.insert(0, self)

    def name_of(self, module: str) -> str:
        """The name in `sys.modules` of a module that the component knows as ``module``."""
        top, dot, rest = module.partition(".")
        return f"{top}{self._suffix}{dot}{rest}"

    def adopted(self, module: ModuleType) -> ModuleType:
        """A module, not yet executed, whose imports are those of the instance."""
        vars(module)["__builtins__"] = self._builtins
        return module

    def forget_names(self) -> None:
        """After a call into the component: what was imported by name from elsewhere is nobody else's."""
        while self.lent:
            sys.modules.pop(self.lent.pop(), None)

    def mention(self, words: re.Pattern[bytes]) -> bool:
        """Whether one of the words is in the source of a module that is imported."""
        files = [getattr(sys.modules[name], "__file__", None) for name in self._imported()]
        return any(words.search(Path(file).read_bytes()) for file in files if file is not None)

    def _imported(self) -> list[str]:
        return [name for name in sys.modules if name.partition(".")[0].endswith(self._suffix)]

    def close(self) -> None:
        """Forget all modules of the instance. May be called twice."""
        self.forget_names()
        if self in sys.meta_path:
            sys.meta_path.remove(self)
        for name in self._imported():
            del sys.modules[name]

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Find a module under its name in `sys.modules`, or under its own name for code of the instance."""
        top, _, rest = fullname.partition(".")
        if top.endswith(self._suffix):
            known_as = fullname if rest else top.removesuffix(self._suffix)
            spec = PathFinder.find_spec(known_as, path if rest else [self._folder], target)
            return self._adopting(fullname, spec) if spec is not None else None
        kind = self._kind(top)
        if not kind or not self._is_calling():
            return None
        if kind == "C":
            return PathFinder.find_spec(fullname, path or [self._folder], target)
        self.lent.append(fullname)
        return ModuleSpec(fullname, _Imported(importlib.import_module(self.name_of(fullname))))

    def _import(
        self,
        name: str,
        globals: Mapping[str, object] | None = None,  # noqa: A002  as the builtin has it
        locals: Mapping[str, object] | None = None,  # noqa: A002  as above
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """`__import__` of the builtins, for the modules of the instance."""
        if level or self._kind(name.partition(".")[0]) != "Python":
            return builtins.__import__(name, globals, locals, fromlist or (), level)
        module = builtins.__import__(self.name_of(name), globals, locals, fromlist or (), 0)
        if isinstance(fromlist, list) and name not in sys.modules:  # from C: it looks for the name afterwards
            sys.modules[name] = sys.modules[self.name_of(name)]
            self.lent.append(name)
        return module

    def _kind(self, top: str) -> Literal["", "Python", "C"]:
        """What a module of the folder is written in; empty if there is none, or one is installed: that comes first."""
        if top not in self._kinds:
            spec = PathFinder.find_spec(top, [self._folder])
            is_python = spec is None or spec.loader is None or isinstance(spec.loader, SourceFileLoader)
            kind: Literal["Python", "C"] = "Python" if is_python else "C"
            self._kinds[top] = kind if spec is not None and not _is_installed(top) else ""
        return self._kinds[top]

    def _is_calling(self) -> bool:
        """Whether the code of a component that is calling, the innermost one, belongs to this instance."""
        frame = inspect.currentframe()
        while frame is not None:
            own = frame.f_globals.get("__builtins__")
            finder = getattr(own.get("__import__"), "__self__", None) if isinstance(own, dict) else None
            if isinstance(finder, OwnModules):
                return finder is self
            frame = frame.f_back
        return False

    def _adopting(self, fullname: str, spec: ModuleSpec) -> ModuleSpec | None:
        """The spec of a module under another name, and with the imports of the instance."""
        places = spec.submodule_search_locations
        if spec.loader is None and places is not None:  # a package without `__init__.py`
            package = ModuleSpec(fullname, None, is_package=True)
            assert package.submodule_search_locations is not None
            package.submodule_search_locations.extend(places)
            return package
        if not isinstance(spec.loader, SourceFileLoader):
            return spec
        loader = _Adopting(self, fullname, spec.loader.path)
        return spec_from_file_location(fullname, spec.loader.path, loader=loader, submodule_search_locations=places)


class _Adopting(SourceFileLoader):
    def __init__(self, own: OwnModules, fullname: str, path: str) -> None:
        super().__init__(fullname, path)
        self._own = own

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(self._own.adopted(module))


class _Imported(Loader):
    """Loads a module that is imported already."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module
        self._spec = module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["__spec__"] = self._spec  # the import system has replaced it


def _is_installed(top: str) -> bool:
    """Whether a module is found where the processes of a run look, too.

    These do not have the folder of the program that runs here, nor the working directory.
    """
    program = getattr(sys.modules.get("__main__"), "__file__", None)
    only_here = {Path.cwd(), *([Path(program).resolve().parent] if program else [])}
    path = [entry for entry in sys.path if Path(entry).resolve() not in only_here]
    finders = [finder for finder in sys.meta_path if not isinstance(finder, OwnModules)]
    return any(finder.find_spec(top, path if finder is PathFinder else None) is not None for finder in finders)
