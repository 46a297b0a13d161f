"""The shared library of an FMU, loaded so that the FMU uses its own functions first (ADR 65).

Owns how the library and those beside it are loaded, and what the loaded ones say about themselves. A function that the
library does not have is no error until it is called: then its status is `MISSING`.
"""

from __future__ import annotations

import ctypes
import inspect
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from copy import copy
from functools import partial, wraps
from pathlib import Path
from types import UnionType
from typing import Any, Final, NamedTuple, Self, get_args

import numpy as np
from fmpy import freeLibrary

from .archive.shared_library import SYMBOL, SharedLibrary, read_shared_library

__all__ = ["MISSING", "Argument", "FmuLibrary", "absent", "arguments_of", "calling", "count_of"]

MISSING: Final = 999
"""Our own status of a function that the library of an FMU does not have."""

_NOT_MADE: Final = "Failed to instantiate model"  # in the words of FMPy
_ABSENT: Final = ctypes.CFUNCTYPE(ctypes.c_int)
_DEEP_BINDING: Final = getattr(os, "RTLD_DEEPBIND", 0)
_POINTER: Final[Any] = ctypes.POINTER(ctypes.c_int).__base__
_FUNCTION: Final[Any] = ctypes.CFUNCTYPE(None).__base__
_RTLD_DI_LINKMAP: Final = 2
_DT_NEEDED: Final = 1
_DT_STRTAB: Final = 5
_DT_SYMTAB: Final = 6
_DT_STRSZ: Final = 10


class _LinkMap(ctypes.Structure):
    """`struct link_map` of <link.h>: a library as the dynamic linker has it."""

    _fields_ = [
        ("address", ctypes.c_size_t),
        ("name", ctypes.c_void_p),
        ("dynamic", ctypes.c_size_t),
        ("next", ctypes.c_void_p),
        ("previous", ctypes.c_void_p),
    ]

    def needed(self) -> list[bytes]:
        """The names of the libraries that it needs."""
        names = self._table(_DT_STRTAB)
        return [ctypes.string_at(names + value) for tag, value in self._tags() if tag == _DT_NEEDED]

    def imports(self) -> set[bytes]:
        """The symbols that others have to define."""
        tags = dict(self._tags())
        place, symbols_place = self._table(_DT_STRTAB), self._table(_DT_SYMTAB)
        names = ctypes.string_at(place, tags[_DT_STRSZ])
        # Their number stands nowhere; the table of names follows them, in the files of some linkers after others.
        size = max(0, place - symbols_place) // SYMBOL.itemsize * SYMBOL.itemsize
        symbols = np.frombuffer(ctypes.string_at(symbols_place, size), SYMBOL)
        used = symbols["name"][(symbols["section"] == 0) & (symbols["name"] < len(names))]
        return {names[start : names.index(b"\0", start)] for start in used.tolist()}

    def _tags(self) -> Iterator[tuple[int, int]]:
        """The entries of the dynamic section."""
        for place in itertools.count(self.dynamic, 16):
            tag, value = (ctypes.c_uint64 * 2).from_address(place)
            if tag == 0:
                return
            yield tag, value

    def _table(self, tag: int) -> int:
        """The address of a table: in the libraries that glibc has loaded it stands there, elsewhere the offset."""
        place = dict(self._tags())[tag]
        return place if place > self.address else place + self.address


class _Library(ctypes.CDLL):
    """A library, or with the name None the process with all libraries that it started with."""

    def close(self) -> None:
        """Unload it, if it was loaded as often as closed."""
        freeLibrary(self._handle)

    @property
    def entry(self) -> _LinkMap:
        """It in the list of all libraries of the process."""
        found = ctypes.c_void_p()
        _PROCESS.dlinfo(ctypes.c_void_p(self._handle), _RTLD_DI_LINKMAP, ctypes.byref(found))
        return _LinkMap.from_address(found.value or 0)


_PROCESS: Final = _Library(None)


class FmuLibrary(_Library):
    """The library of one FMU; `OSError` if it cannot be loaded."""

    host = None  # this process calls its functions itself

    def __init__(self, path: Path, *, deep_binding: bool) -> None:
        self.missing: set[str] = set()  # the functions that were asked for and that it does not have
        self._folder = f"{path.parents[2]}/".encode()
        # A sanitizer ends a process that binds deeply.
        mode = _DEEP_BINDING if deep_binding and not hasattr(_PROCESS, "__asan_init") else 0
        with _loaded_before(path, mode):
            super().__init__(str(path), mode)
            if mode and any(name.startswith(b"libpython") for name in self.entry.needed()):
                # Modules of a second Python would use functions of this one, so there may be no second one.
                self.close()
                super().__init__(str(path), 0)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 as in ctypes
        try:
            return super().__getattr__(name)
        except AttributeError:
            if "fmi" not in name:
                raise
        self.missing.add(name)
        function = absent()
        setattr(self, name, function)  # whoever has its address needs it for as long as the library
        return function

    @property
    def imports(self) -> set[bytes]:
        """The functions and variables that the loaded libraries of the FMU use and do not define themselves."""
        own = [one for one in _entries() if one.name and ctypes.string_at(one.name).startswith(self._folder)]
        return set[bytes]().union(*(one.imports() for one in own))


def absent() -> Any:  # noqa: ANN401 as in ctypes
    """A function in the place of one that a library does not have."""
    return _ABSENT(lambda: MISSING)


class Argument(NamedTuple):
    """One argument of a function of FMI."""

    name: str
    type: Any  # of ctypes
    items: Any  # the type of what it points to; None if it is no pointer

    @classmethod
    def of(cls, known: inspect.Parameter) -> Argument:
        """As FMPy has it."""
        own = known.annotation
        type_ = get_args(own)[0] if isinstance(own, UnionType) else own
        is_pointer = issubclass(type_, _POINTER)
        return cls(known.name, type_, type_._type_ if is_pointer else None)

    @property
    def passed(self) -> Any:  # noqa: ANN401 as above
        """The type of ctypes that our functions get it in."""
        is_address = self.items is not None or issubclass(self.type, _FUNCTION)
        return ctypes.c_void_p if is_address else self.type


def arguments_of(fmpy_class: type[Any], name: str) -> tuple[list[Argument], Any]:
    """Those of the function that FMPy's class calls by this name, and the type of its result as FMPy has it."""
    known = inspect.signature(getattr(fmpy_class, name))
    return [Argument.of(one) for one in list(known.parameters.values())[1:]], known.return_annotation


def count_of(arguments: Sequence[Argument], values: Sequence[Any], index: int) -> int:
    """How many items an argument points to: the next number of that type says it, or else the one before (FMI)."""
    own = arguments[index]
    if own.items is ctypes.c_void_p:  # a state
        return 1
    sizes = [place for place, one in enumerate(arguments) if one.type is ctypes.c_size_t]
    if own.name == "dvUnknown":  # of FMI 2.0, after the known ones
        return int(values[sizes[0]])
    return next((int(values[place]) for place in (*(s for s in sizes if s > index), *sizes[::-1])), 1)


class _LoadedBefore:
    """Goes before FMPy's class of an FMU, which would load the library itself."""

    made_by: Callable[[], object]  # what FMPy has called last to make an instance

    _loadFunctions: Callable[[], None]  # noqa: N815 FMPy's name

    def __init__(self, library: Any, environment: int, **keywords: Any) -> None:  # noqa: ANN401 of either kind; FMPy's own
        self.dll = library
        self.environment = environment
        vars(self).update(keywords, fmiCallLogger=None, component=None, callbacks=None, _functions={})
        self._loadFunctions()

    def freeLibrary(self) -> None:  # noqa: N802 FMPy's name
        """Unload the library."""
        self.dll.close()

    def for_another(self, environment: int) -> Self:
        """The same library for another instance with an environment of its own: functions are looked up once."""
        other = copy(self)
        vars(other).update(environment=environment, component=None)
        return other

    def instantiate_again(self) -> None:
        """As FMPy's `instantiate` of FMI 2.0 the last time; there, to make the arguments takes most of the time."""
        self.component = self.made_by()
        if self.component is None:
            raise RuntimeError(_NOT_MADE)


def calling(fmpy_class: type[Any]) -> type[Any]:
    """FMPy's class for the functions of an FMU, as one that takes ``library``, and ``environment`` for FMI 3.0."""
    functions = inspect.getmembers(fmpy_class, inspect.isfunction)
    ours = {name: _with_environment(one) for name, one in functions if name.startswith("fmi3Instantiate")}
    ours |= {name: _remembered(one) for name, one in functions if name == "fmi2Instantiate"}
    return type(fmpy_class.__name__, (_LoadedBefore, fmpy_class), ours)


def _with_environment(function: Callable[..., object]) -> Callable[..., object]:
    """A function of FMPy, which gives no environment to an instance, as one that does."""
    place = list(inspect.signature(function).parameters).index("instanceEnvironment")

    @wraps(function)  # FMPy finds the types of C in the signature
    def called(self: _LoadedBefore, *given: object) -> object:
        return function(self, *given[: place - 1], self.environment, *given[place:])

    return called


def _remembered(function: Callable[..., object]) -> Callable[..., object]:
    """A function of FMPy that makes an instance, which can be called again as the last time."""

    @wraps(function)  # as above
    def called(self: _LoadedBefore, *given: object) -> object:
        self.made_by = partial(getattr(self.dll, function.__name__), *given)
        return function(self, *given)

    return called


@contextmanager
def _loaded_before(path: Path, mode: int) -> Iterator[None]:
    """Meanwhile, those libraries beside ``path`` are loaded that it needs and does not find by itself."""
    beside = {one.name: one for one in path.parent.iterdir() if ".so" in one.name and not one.samefile(path)}
    facts = {name: read_shared_library(one.read_bytes()) or SharedLibrary() for name, one in beside.items()}
    own = read_shared_library(path.read_bytes()) if beside else None
    with ExitStack() as stack:
        for needed, name in _not_found(own, facts, path.parent).items() if own is not None else ():
            with suppress(OSError):  # loading what needs it says why it cannot be loaded
                library = _Library(str(beside[name]), mode)
                stack.callback(library.close)
                if not facts[name].soname:
                    stack.enter_context(_named(library, needed))
        yield


def _not_found(library: SharedLibrary, beside: dict[str, SharedLibrary], folder: Path) -> dict[str, str]:
    """What a library needs of those beside it, and finds by no run path; each after those that it needs itself.

    Returns:
        The names of the files, by the names that are needed.
    """
    found: dict[str, str] = {}
    files = {facts.soname or name: name for name, facts in beside.items()}
    seen = set[str]()

    def visit(library: SharedLibrary) -> None:
        runs = library.folders(str(folder))
        for needed in library.needed:
            plain = needed.rpartition("/")[2]
            name = files.get(plain, plain)
            if name in beside and name not in seen:
                seen.add(name)
                visit(beside[name])
            if name in beside and not any(Path(run, needed).exists() for run in runs):
                found.setdefault(needed, name)

    visit(library)
    return found


@contextmanager
def _named(library: _Library, name: str) -> Iterator[None]:
    """Meanwhile, the dynamic linker takes a library without a SONAME for the one that is needed as ``name``."""
    entry, text = library.entry, ctypes.create_string_buffer(name.encode())
    before, entry.name = entry.name, ctypes.addressof(text)
    try:
        yield
    finally:
        entry.name = before


def _entries() -> Iterator[_LinkMap]:
    """All libraries of the process."""
    entry: _LinkMap | None = _PROCESS.entry
    while entry is not None:
        yield entry
        entry = _LinkMap.from_address(entry.next) if entry.next else None
