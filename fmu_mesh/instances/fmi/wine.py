"""Wine, which runs Windows code on Linux: where it is, its private prefix, and the environment of a program under it.

Owns the prefix in the user's cache: what Windows code sees as drive C. It is made once for each version of Wine, and
`~/.wine` is never touched. Nobody starts or ends Wine's server: its first program starts it, all programs in the prefix
share it, and it ends by itself when the last of them has ended (at once in Debian, otherwise within 3 s).
"""

# Who meets here (ADR 99): any number of processes may ask for the prefix at once, also those of several runs. One makes
# it, under a lock and with another name, and renames it when it is complete; so nobody ever uses one that is half made.
# The Wine of a maker that was killed goes on: the next maker ends it, and then removes its draft (a server whose folder
# is gone never ends). `flock` has no deadline: a thread waits for it.
# Given up: a prefix for each run. It takes ten seconds.

from __future__ import annotations

import fcntl
import functools
import logging
import os
import re
import shutil
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PureWindowsPath
from typing import Final

from ... import files
from ...errors import LoadFailed

__all__ = ["INSTALL_WINE", "windows_path", "windows_uri", "wine_environment", "wine_program", "wine_version"]

log = logging.getLogger(__name__)

INSTALL_WINE: Final = "`apt install wine` lets it run under Wine"
"""What to do about an FMU that has only binaries for Windows."""

_PREPARE_S: Final = 300.0
"""How long the prefix may take; usually 10 s."""

_OVERRIDES: Final = "mscoree,mshtml=d;winemenubuilder.exe=d"
"""No question about .NET (mono) and HTML (gecko), and nothing in the menus of a desktop."""
_NO_SESSION: Final = ";services.exe,explorer.exe=d"
"""No services and no desktop: only the server and the program run, and it starts in a tenth of the time."""

_DROPPED: Final = re.compile(r"WINE.*|DISPLAY|WAYLAND_DISPLAY|XDG_.*|DBUS_.*|LD_.*|LANG|LANGUAGE|LC_.*")
"""Variables that lead out of the prefix, to a desktop, or to other numbers; the FMU gets all others, as a native one
does: some look for the server of their licenses in one."""


def wine_program() -> Path | None:
    """The program that runs a 64-bit Windows program, given as its first argument; None if Wine is not installed."""
    found = shutil.which("wine64") or shutil.which("wine")
    return Path(found) if found else None


def wine_environment(tell: Callable[[str], None] = log.info) -> dict[str, str]:
    """The variables for `wine_program`; makes the prefix if it does not exist, and calls ``tell`` before.

    Raises:
        LoadFailed: Wine is not installed, or the prefix cannot be made.
    """
    if (program := wine_program()) is None:
        raise LoadFailed("Wine, which runs Windows FMUs, is not installed.", hint=f"{INSTALL_WINE}.")
    prefix = files.cache_folder() / "wine" / re.sub(r"[^\w.]+", "-", _version()).strip("-")
    if not prefix.is_dir():
        try:
            prefix.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with prefix.with_name(f"{prefix.name}.lock").open("wb") as lock:
                _wait_for(lock.fileno(), prefix)
                if not prefix.is_dir():
                    tell(f"preparing Wine in '{prefix}', once")
                    _make(program, prefix)
        except (OSError, subprocess.TimeoutExpired) as error:
            why = error.strerror if isinstance(error, OSError) else f"it took longer than {_PREPARE_S:g} s"
            raise LoadFailed(
                f"Wine cannot be prepared in '{prefix}': {why}.",
                hint="Set FMU_MESH_CACHE_DIR to a folder that can be written.",
            ) from error
    return _environment(prefix, _OVERRIDES + _NO_SESSION)


def wine_version() -> str:
    """Wine and its version, for people and for the metadata of results: `Wine 8.0`; `Wine` where there is none.

    Raises:
        LoadFailed: the program that is installed does not tell it.
    """
    return "Wine" if wine_program() is None else f"Wine {_version().removeprefix('wine-').split()[0]}"


def windows_path(path: Path) -> str:
    r"""The path as Windows code under Wine sees it: `/tmp/a` is `Z:\tmp\a`."""
    return str(PureWindowsPath(f"Z:{path.absolute()}"))


def windows_uri(path: Path) -> str:
    """The path as a URI for Windows code under Wine: `/tmp/a` is `file:///Z:/tmp/a`."""
    return PureWindowsPath(f"Z:{path.absolute()}").as_uri()


@functools.cache
def _version() -> str:
    """The version in Wine's own words: `wine-8.0 (Debian 8.0~repack-4)`."""
    program = wine_program() or "wine"
    try:
        asked = [str(program), "--version"]
        done = subprocess.run(asked, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=60)
        said = done.stdout.strip() or done.stderr.strip() or "nothing"
    except (OSError, subprocess.TimeoutExpired) as error:
        said = str(error)
    if not said.startswith("wine-"):
        raise LoadFailed(f"'{program}' does not tell its version; it says: {said[:200]}", hint="Install Wine again.")
    return said


def _environment(prefix: Path, overrides: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not _DROPPED.fullmatch(name)}
    return kept | {
        "WINEPREFIX": str(prefix),
        "WINEARCH": "win64",
        "WINEDEBUG": "-all",
        "WINEDLLOVERRIDES": overrides,
        "HOME": "/nonexistent",  # the folders of a user, such as Documents, would be those of the real one
        "TMPDIR": str(prefix),  # for the socket of the server: all programs must find the same one
        "LC_ALL": "C.UTF-8",  # the names of files are UTF-8, and a number has a point
    }


def _wait_for(lock: int, prefix: Path) -> None:
    """Take the lock of a prefix, as soon as nobody else makes it."""
    held = threading.Event()

    def wait() -> None:
        with suppress(OSError):  # the file system has no locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        held.set()

    threading.Thread(target=wait, name="waits for Wine's prefix", daemon=True).start()
    if not held.wait(_PREPARE_S):
        raise LoadFailed(f"another process has been preparing '{prefix}' for {_PREPARE_S:g} s.", hint="End it.")


def _make(program: Path, prefix: Path) -> None:
    """Make the prefix under another name, and rename it at the end."""
    draft = prefix.with_name(f"{prefix.name}.{os.getpid()}.draft")
    if (server := shutil.which("wineserver")) is None:
        raise LoadFailed("'wineserver', which belongs to Wine, is not on the PATH.", hint=f"{INSTALL_WINE}.")

    def run(*command: str) -> str:
        # Wine's services inherit the output, so the end of a pipe would be that of all of them.
        with (draft / "output").open("w+b") as output:
            subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=_environment(draft, _OVERRIDES),
                check=False,
                timeout=_PREPARE_S,
            )
            output.seek(0)
            return output.read().decode(errors="replace")

    for left in prefix.parent.glob(f"{prefix.name}.*.draft"):
        subprocess.run(
            [server, "--kill"], env=_environment(left, _OVERRIDES), capture_output=True, check=False, timeout=_PREPARE_S
        )
        shutil.rmtree(left, ignore_errors=True)
    draft.mkdir(mode=0o700)
    said = run(str(program), "wineboot", "--init")
    variables = run(str(program), "cmd", "/c", "set")
    run(server, "--wait")  # it writes the registry at its end
    if not (draft / "system.reg").is_file():
        raise LoadFailed(f"Wine cannot make a prefix; it says: {said.strip()[-500:] or 'nothing'}")
    if found := re.search(r"WINEDLLDIR0=.*?[Zz]:(\\.*?)\s*\n", variables):
        _link_libraries(draft / "drive_c/windows/system32", Path(found[1].replace("\\", "/")))
    # This version of Wine has just made it; without this line it would look at every start.
    (draft / ".update-timestamp").write_text("disable\n", encoding="ascii")
    (draft / "output").unlink()
    draft.rename(prefix)


def _link_libraries(own: Path, installed: Path) -> None:
    """Replace the copies of Wine's own libraries, of some 700 MB, by links to those that are installed."""
    for file in (installed / "x86_64-windows").glob("*"):
        copy = own / file.name
        if copy.is_file() and copy.stat().st_size == file.stat().st_size:
            copy.unlink()
            copy.symlink_to(file)
