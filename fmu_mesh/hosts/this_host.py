"""What this host can run, and why not: the list of `fmu-mesh doctor`.

A check is a function that a run asks as well, so that its words are the same. Nothing large is started.
"""

# Threads: each check has one of its own, one after the other, because a folder of a network that is gone blocks who
# looks into it, and no signal ends that. What has not answered in time is left behind with its daemon thread, which
# ends with the process. All at once was given up: imports of several threads wait for each other. ADR 102.

from __future__ import annotations

import os
import platform
import resource
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Final, Literal

import msgspec

from .. import __version__
from ..errors import ConfigurationError, FmuMeshError
from ..files import CACHE_HINT, cache_folder, exists, is_folder
from ..installing import PROGRAMS, USERS, program, version_of_library
from ..rings.library import load_library, why_no_library
from ..run.limits import RUN_MIB, address_space_problem, available_bytes
from ..web_server import listening
from ..wire.runtime import runtime_folder

__all__ = ["CheckState", "HostCheck", "HostReport", "report_of_this_host"]

_CHECK_S: Final = 10.0
_FEW_FILES: Final = 1024

CheckState = Literal["ok", "limited", "missing", "failed", "unknown"]
"""`limited`: works, with less; `missing`: what needs it cannot run; `failed`: no mesh can; `unknown`: no answer."""


class HostCheck(msgspec.Struct, frozen=True):
    """One thing that was looked for."""

    name: str
    state: CheckState
    found: str  # what is there, or why it is not
    hint: str | None = None  # what to do


class HostReport(msgspec.Struct, frozen=True):
    """What `fmu-mesh doctor --json` prints."""

    version: str  # of fmu_mesh
    exit_code: int  # 1 if no mesh can run here
    checks: tuple[HostCheck, ...]  # what each mesh needs first


_Check = Callable[[], str | tuple[str, str | None]]
"""Returns what is there, or, where a mesh runs with less, also what to do; raises an error otherwise."""


def report_of_this_host(check_s: float = _CHECK_S) -> HostReport:
    """Look at everything; ``check_s`` is the deadline of each check in s."""
    needed = [_answer(name, check, check_s, "failed") for name, check in _NEEDED.items()]
    others = _OTHERS
    with suppress(FmuMeshError, ImportError):  # then something that every mesh needs has failed
        from ..instances.registry import host_checks  # noqa: PLC0415  it needs numpy

        others = {**host_checks(), **_OTHERS}
    found = [_answer(name, check, check_s, "missing") for name, check in others.items()]
    return HostReport(__version__, int(any(one.state == "failed" for one in needed)), (*needed, *found))


def _answer(name: str, check: _Check, check_s: float, otherwise: CheckState) -> HostCheck:
    answers = [HostCheck(name, "unknown", f"no answer within {check_s:g} s")]

    def ask() -> None:
        try:
            found = check()
            said = (found,) if isinstance(found, str) else found
            answers.append(HostCheck(name, "ok" if len(said) == 1 else "limited", *said))
        except FmuMeshError as error:
            answers.append(HostCheck(name, otherwise, error.message, error.hint))
        except Exception as error:  # noqa: BLE001  a broken package must not hide what the other checks find
            answers.append(HostCheck(name, otherwise, f"{type(error).__name__}: {error}"))

    asking = threading.Thread(target=ask, name=f"check of {name}", daemon=True)
    asking.start()
    asking.join(check_s)
    return answers[-1]


def _system() -> str:
    system = [f"{sys.platform}-{platform.machine()}", " ".join(platform.libc_ver()).strip() or "without glibc"]
    return ", ".join([*system, f"processors: {len(os.sched_getaffinity(0))}", f"load: {os.getloadavg()[0]:.1f}"])


def _engine(library: str) -> str:
    version = version_of_library(library)
    import_module(library.removeprefix("eclipse-"))  # its part in C may not fit this host
    return version


def _library_of_c() -> str | tuple[str, str | None]:
    why = why_no_library()
    return (why, None) if why is not None else f"used: {load_library()}"


def _memory() -> str:
    if (problem := address_space_problem(RUN_MIB)) is not None:
        raise problem
    return f"{(available_bytes() or 0) / 1e9:.1f} GB for models and rings"


def _limits() -> str | tuple[str, str | None]:
    files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    threads, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    said = f"{files} open files of a process, {threads} threads of this user".replace("-1 ", "any number of ")
    few = 0 <= files < _FEW_FILES
    return (said, f"Many nodes need more open files: `ulimit -n {most}`.") if few else said


def _cache() -> str:
    folder = cache_folder()
    place = next(own for own in (folder, *folder.parents) if exists(own))
    if not (is_folder(place) and os.access(place, os.W_OK | os.X_OK)):
        raise ConfigurationError(f"the cache folder '{folder}' cannot be written", hint=CACHE_HINT)
    return str(folder)


def _sandbox() -> str:
    from ..run.sandbox import why_no_bubblewrap  # noqa: PLC0415  as above

    if (why := why_no_bubblewrap()) is not None:
        raise ConfigurationError(why[0], hint=f"Use {why[1]}.")
    return "bubblewrap makes one"


def _ros() -> str:
    from ..ros_wire.rclpy_profile import HOW_TO_GET_ROS  # noqa: PLC0415  as above

    if find_spec("rclpy") is None:
        raise ConfigurationError("nodes of ROS need the ROS package 'rclpy'", hint=HOW_TO_GET_ROS)
    return f"rclpy; ROS_DISTRO: {os.environ.get('ROS_DISTRO', 'not set')}"


def _port() -> str | tuple[str, str | None]:
    from .processes import PORT  # noqa: PLC0415  as above

    try:
        listening("127.0.0.1", PORT, "a router").close()
    except ConfigurationError as error:
        return error.message, "If it is no router, let yours listen at another one."
    return f"{PORT} of 127.0.0.1 is free"


_NEEDED: Final[dict[str, _Check]] = {
    "System": _system,
    "Python": lambda: f"{platform.python_version()}, {sys.executable}",
    **{name: partial(_engine, name) for name in ("eclipse-zenoh", "fmpy", "numpy")},
    "Library of C": _library_of_c,
    "Runtime folder": lambda: str(runtime_folder()),
    "Memory": _memory,
    "Limits": _limits,
}
_OTHERS: Final[dict[str, _Check]] = {
    "Cache folder": _cache,
    "Sandbox": _sandbox,
    "ROS": _ros,
    "Default port": _port,
    **{name: partial(program, name) for name in PROGRAMS},
    **{library: partial(version_of_library, library) for library in USERS},
}
