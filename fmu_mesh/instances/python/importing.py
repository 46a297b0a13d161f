"""The class of a component: imported from a file, from a module, or as the running program has it; and described.

A file is imported anew for each instance, under a name of its own, and so are the modules of its folder (`OwnModules`).
So two instances share no global variables, whether they run in one process or in two.
"""

from __future__ import annotations

import builtins
import hashlib
import importlib
import importlib.util
import inspect
import itertools
import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib.abc import FileLoader, Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, TypeGuard

from msgspec.structs import replace

from ...errors import CallRefused, ConfigurationError, FmuMeshError
from ...text import did_you_mean, listed, short_path
from ...variables.model_description import ModelDescription, Variable
from .component import Component, declared_variables
from .python_section import ClassPlace, importing

__all__ = ["ImportedComponent", "check_arguments", "component_section", "description_of"]

_OWN = Path(__file__).resolve().parents[2]
_TEXT_CHARACTERS = 500
_numbers = itertools.count(1)


class ImportedComponent:
    """The class of a component, imported for one instance.

    ``path`` is the absolute path of its file; `Path()` for a module. `load` raises whatever the code of the user
    raises, which `told` says in words; and `CallRefused` if there is no such class, or it is no component.
    """

    def __init__(self, path: Path, target: ClassPlace) -> None:
        self._target = target
        # Those of its folder; call `forget_names` after each call into the component.
        self.modules = OwnModules(path.parent)
        self._file = path if target.file else None
        self.cls: type[Component] = Component  # known after `load`

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
        token = importing.set(place)
        try:
            if self._file is not None:
                module, data = self._from_file(self._file)
            else:
                module = importlib.import_module(target.module)
                self._file = Path(module.__file__) if module.__file__ is not None else None
                data = self._file.read_bytes() if self._file is not None else b""
        finally:
            importing.reset(token)
        found = getattr(module, target.name, None)
        if found is None:
            classes = [name for name, value in vars(module).items() if _is_component(value) and value is not Component]
            text = f"there is no '{target.name}' in '{place}', which has {listed(classes, nothing='no component')}"
            raise CallRefused(text, hint=did_you_mean(target.name, classes))
        if not _is_component(found):
            what = "function" if callable(found) and not isinstance(found, type) else type(found).__name__
            hint = "Put the decorator `fmu_mesh.component` before it." if what == "function" else None
            if isinstance(found, type):
                what, hint = "class", "Derive it from `fmu_mesh.Component`."
            raise CallRefused(f"'{target.name}' in '{place}' is a {what} and no component", hint=hint)
        self.cls = found
        return description_of(found, hashlib.sha256(data).hexdigest())

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
        spec = spec_from_file_location(name, file, loader=loader)
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


def _is_component(value: object) -> TypeGuard[type[Component]]:
    return isinstance(value, type) and issubclass(value, Component)


def component_section(cls: object) -> tuple[dict[str, str], ModelDescription]:
    """The keys of the section of a class that a program has, and its model description.

    The keys are such as ``{"python": "/home/me/controller.py:Controller"}``. `ConfigurationError`: other processes
    cannot import the class.
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


# --- the description of a class


def description_of(cls: type[Component], content: str) -> ModelDescription:
    """The model description of a component class; `CallRefused` says why it cannot be one.

    ``content`` is the SHA-256 of the file that defines it; processes that disagree about it refuse one another.
    """
    declared = declared_variables(cls)
    if cls.step is Component.step:
        raise CallRefused(f"'{cls.__name__}' has no method `step(self, time, step_size)`")
    hidden = [name for name in declared if hasattr(Component, name)]
    if hidden:
        text = f"the variable '{hidden[0]}' of '{cls.__name__}' has the name of something that every component has"
        raise CallRefused(text, hint="Give it another name.")
    variables = tuple(own.variable(reference) for reference, own in enumerate(declared.values()))
    inputs = [variable.name for variable in variables if variable.causality == "input"]
    initializes = cls.initialize is not Component.initialize
    return ModelDescription(
        model_name=cls.__name__,
        model_identifier=cls.__name__,
        fmi_version="",
        kind="component",
        guid=f"{{{content}:{cls.__name__}}}",
        variables=tuple(_with_dependencies(variable, inputs, initializes=initializes) for variable in variables),
        description=(cls.__doc__ or "").strip().partition("\n")[0] or None,
        generation_tool="Python",
        can_handle_variable_step_size=True,
        can_get_and_set_state=True,
        can_serialize_state=True,
    )


def check_arguments(cls: type[Component], arguments: Mapping[str, Any]) -> None:
    """Check that a component class can be called with these arguments; `CallRefused` says which is wrong."""
    own = cls.__init__ is not object.__init__  # otherwise Python ignores all arguments
    if not own and arguments:
        text = f"'{cls.__name__}' has no `__init__`, which could take the argument '{next(iter(arguments))}'"
        raise CallRefused(text, hint="The values of parameters are `start_values`.")
    if own:
        try:
            inspect.signature(cls.__init__).bind(None, **arguments)
        except TypeError as error:
            raise CallRefused(f"`arguments` do not fit `{cls.__name__}.__init__`: {error}") from error


def _with_dependencies(variable: Variable, inputs: list[str], *, initializes: bool) -> Variable:
    """An output with the inputs that its initial value depends on: all, if it is computed and nothing else is said."""
    if variable.causality != "output":
        return replace(variable, dependencies=())
    if variable.dependencies is None:
        return replace(variable, dependencies=tuple(inputs) if initializes else ())
    unknown = next((name for name in variable.dependencies if name not in inputs), None)
    if unknown is not None:
        hint = did_you_mean(unknown, inputs, f"The inputs are {listed(inputs)}.")
        raise CallRefused(f"'{variable.name}' depends on '{unknown}', which is no input", hint=hint)
    return variable


# --- the modules of the folder of a component, imported for one instance alone

# Python has one table of modules for a process, `sys.modules`. Two components that `import helper` from two folders
# would get one `helper`, and two instances of one component would share its variables. So `helper` of an instance is
# the module `helper@7` in that table, where 7 is the number of the instance:
#
# * `import` in a module of the instance, also within a function, calls `__import__` of the builtins of that module, and
#   these are those of the instance. Relative imports follow from the name of the package.
# * Whoever imports by name from elsewhere, as `importlib.import_module` and `pickle` do, looks into that table first,
#   and asks the finders if the name is not there. The finder of the instance whose code is calling answers, and the
#   name is in the table until the call into the component ends.
#
# Modules that are written in C cannot be imported twice under two names: they are imported as usual, and claimed
# (`fmu_mesh.system.process_sharing`). ADR 66.


class OwnModules(MetaPathFinder):
    """The modules of one instance. It finds them from the start until `close`."""

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)
        self._suffix = f"@{next(_numbers)}"
        self._builtins = {**vars(builtins), "__import__": self._import}
        self._kinds: dict[str, Literal["", "Python", "C"]] = {}
        # The names that were imported by name from elsewhere, in the call into the component that is under way.
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
