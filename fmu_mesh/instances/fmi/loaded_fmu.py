"""An extracted FMU with its library, loaded: instances are made with it one after another.

Owns the files, the library and the instance as FMPy has it; `FmuInstance` calls them.
"""

from __future__ import annotations

import ctypes
import re
import shutil
from collections.abc import Callable, Hashable, Mapping
from contextlib import chdir, suppress
from pathlib import Path
from typing import Any, NamedTuple

from fmpy.fmi1 import FMICallException

from ...config.mesh import TimeoutsConfig
from ...variables.model_description import ModelDescription
from ..call_guard import call_named
from ..process_end import process_ends
from ..process_state import FOLDER
from .archive.examining import library_name
from .archive.sources import extract
from .calls import FmpyCalls, cffi_function, pointer
from .component_library import ComponentLibrary
from .fmu_library import FmuLibrary, calling
from .fmu_values import FATAL, ValueFunctions
from .step_options import Terms
from .wine_library import WineLibrary

__all__ = ["FmuFunctions", "LoadedFmu"]

_CHANGING = re.compile(
    rb"(?:_*|g_|_gfortran_)"
    rb"(?:f?chdir|setlocale|uselocale|umask|(?:un)?setenv|clearenv|putenv|(?:sysv_|bsd_|s)?signal|sigaction|sigset"
    rb"|sigignore|sighold|sigblock|sigsetmask|sigprocmask|pthread_sigmask"
    rb"|feenableexcept|feholdexcept|fesetenv|fesetmode|feupdateenv)(?:_i[48])?(?:_sub)?(?:_int)?"
    rb"|_ZNSt6locale6globalE.*|_ZNSt10filesystem12current_pathERKN.*"
)
"""Functions of C, GLib, Fortran and C++ that change the state of their process. Not `fesetround`: the floating-point
mode is checked after each step anyway, but for its traps."""


class FmuFunctions(NamedTuple):
    """The functions of one version of FMI and one kind of FMU."""

    library: type[Any]  # FMPy's class for them
    values: ValueFunctions  # those that get and set values
    free: str  # FMPy's method that frees an instance
    needed: tuple[str, ...]  # the functions, without their prefix, that every run needs
    # FMI functions whose name does not follow from the name of FMPy's method, by that name
    names: Mapping[str, str] = {}


class FmuToLoad(NamedTuple):
    """What is loaded; see `FmuInstance`, and `StepOptions` for ``deep_binding``."""

    path: Path
    name: str
    description: ModelDescription
    terms: Terms
    functions: FmuFunctions
    deep_binding: bool
    timeouts: TimeoutsConfig

    @property
    def key(self) -> Hashable:
        """Two FMUs with the same key are the same, for instances of one name."""
        own = self.description
        made = own.guid, own.model_identifier, self.functions.library, own.guest_memory
        return self.path, self.terms, made, self.deep_binding


class _Files:
    """An extracted FMU with its library, and the models that use them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.used_by: list[LoadedFmu] = []
        self._loaded: Any = None  # FMPy's object of the first of them
        self._stays = False
        self._changes_process: bool | None = None

    def loaded(self, model: LoadedFmu, load: Callable[[], Any]) -> Any:  # noqa: ANN401 FMPy is untyped
        """FMPy's object for a model; only that for the first one is loaded."""
        if self._loaded is None:
            self._loaded = load()
            return self._loaded
        return self._loaded.for_another(id(model))

    @property
    def changes_process(self) -> bool:
        """See `LoadedFmu`."""
        if self._changes_process is None:
            self._changes_process = any(_CHANGING.fullmatch(name) for name in self._loaded.dll.imports)
        return self._changes_process

    def leave(self, model: LoadedFmu) -> None:
        """A model is closed: the last one unloads the library and removes the files, if none has returned fatal."""
        self._stays |= model.is_lost
        if model in self.used_by:
            self.used_by.remove(model)
        if self.used_by:
            return
        if self._loaded is not None and (self._loaded.dll.host or (not self._stays and not process_ends())):
            with suppress(FMICallException, OSError):
                self._loaded.freeLibrary()
        self._loaded = None
        shutil.rmtree(self.folder, ignore_errors=True)


class LoadedFmu:
    """One FMU with a library and a folder of its own, below ``folder``; `LoadFailed` if it cannot be extracted.

    With the files of another one it has the same library.
    """

    def __init__(self, fmu: FmuToLoad, folder: Path | _Files) -> None:
        self.key = fmu.key
        self.path = fmu.path
        self.calls: Any = None  # FMPy's object, once it is loaded
        self.has_instance = False
        self.component = 0  # the address of the instance, as long as there is one
        self.pointer = pointer(0)  # the same for functions called through cffi
        self.is_lost = False  # whether it has returned fatal
        self._fmu = fmu
        self._files = files = (
            _Files(extract(fmu.path, folder, fmu.terms, model=fmu.description)) if isinstance(folder, Path) else folder
        )
        self._folder = files.folder
        files.used_by.append(self)

    @property
    def has_files(self) -> bool:
        """See `SharedModel`."""
        return bool(self._files.used_by)

    def sharing(self) -> LoadedFmu:
        """See `SharedModel`."""
        return LoadedFmu(self._fmu, self._files)

    def load(self) -> None:
        """Load the library, if it is not loaded."""
        if self.calls is not None:
            return
        functions = self._fmu.functions
        self.calls = FmpyCalls(self._files.loaded(self, self._load), functions.values.prefix, functions.names)
        self._free_name = name = functions.names.get(functions.free, functions.free)
        # In FMI 1.0, the names of functions begin with the model identifier (FMI 1.0 CS, 3.1).
        symbol = name if functions.values.prefix != "fmi" else f"{self._fmu.description.model_identifier}_{name}"
        self._free = cffi_function(getattr(self.calls.dll, symbol), "void (*)(void *)")

    def _load(self) -> Any:  # noqa: ANN401 FMPy is untyped
        functions, description = self._fmu.functions, self._fmu.description
        names = [description.library]
        path = self._folder / library_name(
            description.model_identifier, description.fmi_version, names, description.runs
        )
        with FOLDER, chdir(path.parent):  # libraries may name others relative to it
            library: FmuLibrary | WineLibrary | ComponentLibrary
            if description.runs == "wine":
                library = WineLibrary(path, functions.library, self._fmu.name)
            elif description.runs == "wasm":
                library = ComponentLibrary(path, functions.library, description.kind, description.guest_memory)
            else:
                library = FmuLibrary(path, deep_binding=self._fmu.deep_binding)
            if description.guest_memory is not None and description.runs == "native":
                memory, limits = ctypes.c_int64(description.guest_memory), self._fmu.timeouts
                library.fmu_mesh_guest_limits(memory, ctypes.c_double(limits.call), ctypes.c_double(limits.step))
            return calling(functions.library)(
                library=library,
                environment=id(self),
                guid=description.guid,
                modelIdentifier=description.model_identifier,
                unzipDirectory=str(self._folder),
                libraryPath=str(path),
                instanceName=self._fmu.name,
            )

    @property
    def changes_process(self) -> bool:
        """See `ChangesProcess`; known once there is an instance, which may have loaded more libraries."""
        return self._files.changes_process

    def instantiate(self, **arguments: object) -> None:
        """Make an instance with these arguments for FMPy, if none is there that was reset.

        Without arguments they are those of the last one, for a version of FMI that `FmuLibrary` knows them of.
        """
        if not self.has_instance:
            if arguments:
                self.calls.instantiate(loggingOn=False, **arguments)
            else:
                self.calls.instantiate_again()
            if (component := self.calls.component or 0) != self.component:
                self.component, self.pointer = component, pointer(component)
            self.has_instance = bool(self.component)
            if not self.has_instance:
                raise RuntimeError(f"{self._fmu.functions.names['instantiate']} returned no instance")

    def reset(self) -> bool:
        """Reset the instance, so that it is as a new one; False if the FMU refuses, or this version of FMI cannot."""
        try:
            self.calls.reset()
        except (AttributeError, OSError):
            return False
        except FMICallException as error:
            if error.status == FATAL:
                self.lose()
            return False
        return True

    def lose(self) -> None:
        """The FMU has returned fatal: nothing of it is called any more, and its library stays as it is."""
        self.is_lost, self.has_instance = True, False

    def free(self) -> None:
        """Free the instance; the library stays."""
        if self.has_instance:
            self.has_instance = False
            call_named(self._free_name, self._free, self.pointer)

    def close(self) -> None:
        """Free the instance, unload the library and remove the files. Never raises; may be called twice.

        A process that ends anyway unloads nothing: the FMU may have left a thread or a timer, which needs the library.
        """
        self.free()
        self.calls = None
        self._files.leave(self)

    def remove_files(self) -> None:
        """From any thread, when the process is about to be ended: remove the extracted files."""
        shutil.rmtree(self._folder, ignore_errors=True)
