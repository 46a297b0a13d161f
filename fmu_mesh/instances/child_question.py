"""Asking a child process about a model: whatever a user wrote may hang or crash there while a run is planned.

Owns the process and its deadline; a kind of instances knows the request and the answer.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from shlex import quote

import msgspec

from .. import __version__
from ..errors import LoadFailed
from ..installing import installed_from
from ..variables.model_description import ModelDescription

__all__ = ["ask_description_of", "check_version", "described", "run_child"]

# Which processes meet here: the one that plans a run, and one child that imports or loads what a user wrote (ADR 56).
# The child may hang, crash, print, leave threads and processes, or lose its parent.
#
# * It ends with us, however we end: a thread of it reads a pipe that only we can write to (its standard input).
#   PDEATHSIG would follow our thread, not our process.
# * It has a session of its own: Ctrl-C reaches us only, and `killpg` also ends what it has started.
# * It answers on a copy of its standard output. What its code prints goes to standard error, and the end of that into
#   the error.
# * It leaves by `os._exit`: threads and destructors of foreign code must not turn an answer into a hang.

_DEADLINE_S = 60.0
_KILLED_S = 10.0
_SHOWN_CHARACTERS = 300

_Answer = ModelDescription | tuple[str, str | None]
"""A description, or why there is none and what to do."""


def ask_description_of(what: str, module: str, request: object, python: str = sys.executable) -> ModelDescription:
    """What ``answer_to`` of a module answers to a request in a child process; ``what`` happens there, as errors say it.

    `LoadFailed` says why there is no description, also if the process ended without an answer.
    """
    try:
        text = msgspec.json.encode(request).decode()
    except UnicodeEncodeError as error:
        raise LoadFailed("its path is no UTF-8", hint="Rename the folder.") from error
    output, ending = run_child([python, "-Pm", __package__, module, text])
    try:
        answer: _Answer = msgspec.msgpack.decode(output, type=_Answer)
    except msgspec.DecodeError:
        raise LoadFailed(f"{what} {ending}") from None
    if isinstance(answer, tuple):
        raise LoadFailed(answer[0], hint=answer[1])
    return answer


def described(describe: Callable[[], ModelDescription]) -> bytes:
    """In the child process: the answer to `ask_description_of`."""
    try:
        return msgspec.msgpack.encode(describe())
    except LoadFailed as error:
        return msgspec.msgpack.encode((error.message, error.hint))


def run_child(command: Sequence[str]) -> tuple[bytes, str]:
    """The output of a command, which ends with this process, and in words how it ended."""
    reading, writing = os.pipe()
    try:
        child = subprocess.Popen(
            command, stdin=reading, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
    except OSError as error:
        os.close(writing)
        raise LoadFailed(f"the Python '{command[0]}' cannot be started: {error.strerror}") from error
    finally:
        os.close(reading)
    try:
        output, errors = child.communicate(timeout=_DEADLINE_S)
    except subprocess.TimeoutExpired as late:
        return b"", f"did not end within {_DEADLINE_S:g} s{_last_words(late.stderr or b'')}"
    else:
        code = child.returncode
        how = f"with exit code {code}" if code >= 0 else f"by signal {-code}"
        return output, f"ended the process {how}{_last_words(errors)}"
    finally:
        with suppress(ProcessLookupError):  # it and what it has started
            os.killpg(child.pid, signal.SIGKILL)
        os.close(writing)
        child.wait(_KILLED_S)
        for pipe in (child.stdout, child.stderr):
            if pipe is not None:
                pipe.close()


def check_version(python: str) -> None:
    """Check that a Python has our version; `LoadFailed` if not."""
    output, _ = run_child([python, "-Pc", "import fmu_mesh; print(fmu_mesh.__version__)"])
    version = output.decode(errors="replace").strip()
    if version != __version__:
        has = f"has fmu-mesh {version}" if version else "has no fmu-mesh"
        place = installed_from()
        how = f"{quote(python)} -m pip install {place}" if place else f"from a clone of version {__version__}"
        hint = f"Install fmu-mesh {__version__} there: {how}"
        raise LoadFailed(f"the Python '{python}' {has}", hint=hint)


def _last_words(errors: bytes) -> str:
    text = " ".join(errors.decode(errors="replace").split())
    return f"; it wrote: {text[-_SHOWN_CHARACTERS:]}" if text else ""
