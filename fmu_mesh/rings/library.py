"""Finds the library of C that steps a mesh, and refuses one that was built from other sources.

The library for Linux is beside this module: in a clone for each processor, in a wheel for its own. `build_library.py`,
at the root of a clone, builds it. It contains the SHA-256 of each of its sources, and the sources that are beside it
must be these.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import sys
from ctypes import CFUNCTYPE, PYFUNCTYPE, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint32, c_void_p
from functools import partial
from pathlib import Path
from typing import Final

from ..errors import ConfigurationError

__all__ = ["LIBRARY_VARIABLE", "LibraryFunctions", "host_program", "library_missed", "load_library", "why_no_library"]

LIBRARY_VARIABLE: Final = "FMU_MESH_LIBRARY"
"""An environment variable: `none` runs without the library, `shipped` with that of the package also on a platform where
it is off by default; a path is that of another library."""

TRIED_ON: Final = ("linux-x86_64",)
"""The platforms whose library is used by default: those on which all tests have run."""

_SHIPPED_FOR: Final = ("linux-x86_64", "linux-aarch64")
"""The platforms whose library is in the package; it needs glibc."""

_SOURCE: Final = re.compile(rb"[0-9a-f]{64}  [\w./]+")
_PACKAGE: Final = Path(__file__).resolve().parents[1]


_CALLED: Final = (
    "PyEval_SaveThread",
    "PyEval_RestoreThread",
    "PyLong_FromLongLong",
    "PyObject_CallFunctionObjArgs",
    "Py_IncRef",
    "Py_DecRef",
)
"""What the library calls of Python, in the order of `Interpreter` in `burst.c`."""


class LibraryFunctions:
    """The functions of the library at ``path``. Those that may take long release the interpreter's lock."""

    def __init__(self, path: str) -> None:
        quick, slow = ctypes.PyDLL(path), ctypes.CDLL(path)
        address = c_void_p
        functions = (ctypes.cast(getattr(ctypes.pythonapi, name), address) for name in _CALLED)
        self._interpreter = (address * len(_CALLED))(*functions)
        run = PYFUNCTYPE(c_int64, address, address, address, c_int64)(("run_with_python", quick))
        self.run = partial(run, ctypes.addressof(self._interpreter))  # releases the lock itself
        self.sleep_for = CFUNCTYPE(c_int64, address, c_uint32, address, c_int64, c_int64, address)(("sleep_for", slow))
        self.member_step = CFUNCTYPE(c_int64, address, c_int64)(("member_step", slow))
        self.member_is_finite = PYFUNCTYPE(c_int64, address, c_int64)(("member_is_finite", quick))
        self.host_ask = CFUNCTYPE(c_int64, address)(("host_ask", slow))
        self.outside_put = CFUNCTYPE(c_int, address, address, c_size_t, address)(("outside_put", quick))
        self.outside_take = CFUNCTYPE(c_int, address, address, c_size_t, address)(("outside_take", quick))
        self.outside_do_step = CFUNCTYPE(c_int, address, c_double, c_double, c_int)(("outside_do_step", slow))
        self.outside_await = CFUNCTYPE(c_int, address)(("outside_await", slow))
        self.outside_pass = PYFUNCTYPE(None, address, c_uint32)(("outside_pass", quick))
        self.outside_close = PYFUNCTYPE(None, address, c_char_p)(("outside_close", quick))
        self.equations_restart = CFUNCTYPE(c_int64, address)(("equations_restart", slow))
        self.equations_solve = CFUNCTYPE(c_int64, address, c_double)(("equations_solve", slow))
        by_cvode = CFUNCTYPE(ctypes.c_int, c_double, address, address, address)
        self.equations_derivatives = by_cvode(("equations_derivatives", slow))
        self.equations_indicators = by_cvode(("equations_indicators", slow))
        self.copies_work = CFUNCTYPE(c_int64, address, c_int64)(("copies_work", slow))
        self.copies_serve = CFUNCTYPE(None, address)(("copies_serve", slow))
        self.attend = PYFUNCTYPE(None, address)(("node_attend", quick))
        self.attended = PYFUNCTYPE(None, address)(("node_attended", quick))
        self.ring_bell = PYFUNCTYPE(None, address)(("ring_bell", quick))
        self.bell_seen = PYFUNCTYPE(c_uint32, address)(("bell_seen", quick))
        self.counter_raise = PYFUNCTYPE(None, address, address, c_int64)(("counter_raise", quick))
        self.counter_value = PYFUNCTYPE(c_int64, address)(("counter_value", quick))
        self.stream_open = PYFUNCTYPE(None, address, c_int64)(("stream_open", quick))
        self.stream_hold = CFUNCTYPE(None, address)(("stream_hold", slow))
        self.stream_beat = PYFUNCTYPE(None, address)(("stream_beat", quick))
        self.streams_write = PYFUNCTYPE(None, address, c_int64)(("streams_write", quick))
        self.streams_serve = CFUNCTYPE(None, address, c_int64)(("streams_serve", slow))
        self.streams_listen = PYFUNCTYPE(None, address, c_int64, c_int64)(("streams_listen", quick))
        self.grant_withdraw = PYFUNCTYPE(c_int64, address, address, c_int64)(("grant_withdraw", quick))


def load_library(*, to_step: bool = True) -> str | None:
    """The path of the library for this platform; None if there is none, or if the system refuses to load it.

    It may be off by default because nobody knows whether its rings are right on this processor; who does not ask it
    ``to_step`` gets it.

    Raises:
        ConfigurationError: the library was built from other sources than those beside it, or the environment names one
            that cannot be loaded.
    """
    return _found(to_step=to_step)[0]


def why_no_library() -> str | None:
    """Why `load_library` gives None, what this costs and what to do, in words; None if there is a library.

    It goes on from "the library of C is".
    """
    why = _found(to_step=True)[1]
    if why is None:
        return None
    return (
        f"not used: {why}. Steps are slower. Results are the same, except with `solver: {{name: auto}}`. "
        "See 'The library of C' in docs/installation.md."
    )


def library_missed() -> bool:
    """Whether there is no library, although there could be one here, and nobody has chosen to run without it."""
    could_be = _here() in _SHIPPED_FOR and platform.libc_ver()[0] == "glibc"
    return could_be and os.environ.get(LIBRARY_VARIABLE) != "none" and load_library() is None


def _here() -> str:
    return f"{sys.platform}-{platform.machine()}"


def _found(*, to_step: bool) -> tuple[str | None, str | None]:
    chosen = os.environ.get(LIBRARY_VARIABLE)
    if chosen == "none":
        return None, f"the environment variable {LIBRARY_VARIABLE} is none"
    here = _here()
    if chosen and chosen != "shipped":
        path = Path(chosen).resolve()
    elif here not in _SHIPPED_FOR:
        return None, f"it is for {' and '.join(_SHIPPED_FOR)}, and this is {here}"
    elif not chosen and to_step and here not in TRIED_ON:
        return None, f"it has not run on real {here}, so it is used only with {LIBRARY_VARIABLE}=shipped"
    else:
        path = Path(__file__).with_name(f"burst-{here}.so")
    try:
        loaded = ctypes.CDLL(str(path))
    except OSError as error:
        if chosen:
            raise ConfigurationError(f"{LIBRARY_VARIABLE} names a library that cannot be loaded: {error}") from error
        return None, f"it cannot be loaded: {error}"
    _check_sources(path, _sources_of(loaded, path))
    return str(path), None


def host_program() -> Path:
    """The program that runs an FMU for Windows under Wine.

    Raises:
        ConfigurationError: it is missing, or was built from other sources than those beside it.
    """
    path = Path(__file__).with_name("burst-windows-x86_64.exe")
    if not path.is_file():
        raise _unusable(f"{path} is missing")
    _check_sources(path, "\n".join(line.decode() for line in _SOURCE.findall(path.read_bytes())))
    return path


def _check_sources(path: Path, sources: str) -> None:
    for line in sources.splitlines():
        digest, _, name = line.partition("  ")
        source = _PACKAGE / name
        if source.is_file() and hashlib.sha256(source.read_bytes()).hexdigest() != digest:
            raise _unusable(f"{path} was built from another version of {source}")


def _sources_of(loaded: ctypes.CDLL, path: Path) -> str:
    """What the library was built from: a line for each file, as `sha256sum` writes it."""
    try:
        first = ctypes.c_char.in_dll(loaded, "fmu_mesh_sources")
    except ValueError as error:
        raise _unusable(f"{path} does not say what it was built from") from error
    return ctypes.string_at(ctypes.addressof(first)).decode()


def _unusable(message: str) -> ConfigurationError:
    return ConfigurationError(
        message, hint="In a clone, `make library` builds it; an installation has to be installed again."
    )
