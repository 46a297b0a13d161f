"""Who sends a value to a mesh, as its metadata and its readers see it."""

from __future__ import annotations

import os
import pwd
import socket
import sys
from pathlib import Path

__all__ = ["this_program"]

_OURS = ("fmu-mesh", "__main__.py")


def this_program() -> str:
    """This process in words: `anna@lab fmu-mesh set (pid 4711)`, or `anna@lab steer.py (pid 4711)`."""
    try:
        user = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container may have users without names
        user = str(os.getuid())
    program, command = Path(sys.argv[0] if sys.argv else "").name, sys.argv[1:2]
    if program in _OURS:
        program = " ".join(["fmu-mesh", *command])
    return f"{user}@{socket.gethostname()} {program or 'python'} (pid {os.getpid()})"
