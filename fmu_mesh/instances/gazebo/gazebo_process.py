"""Gazebo classic as a process that steps on command.

Owns the process, its pipes and the deadline of every answer; the protocol is described in
``bridges/gazebo_classic/gazebo_lockstep.cc``. This module does not know the meaning of the numbers.
"""

from __future__ import annotations

import contextlib
import os
import select
import shlex
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Sequence

from ...config.mesh import TimeoutsConfig

__all__ = ["HOW_TO_GET_IT", "PROGRAM_VARIABLE", "GazeboGone", "GazeboProcess", "check_program", "find_program"]

# Which processes meet here: the node and one Gazebo, over pipes (ADR 21). Gazebo ends when its standard input ends, so
# it needs no signal when the node is killed. What it writes to standard error goes to a file: nobody reads it during a
# step, and a full pipe would stop Gazebo. Each command and each answer has a deadline of its own, by `select`: that of
# `timeouts.start` or `timeouts.step`.

PROGRAM_VARIABLE = "FMU_MESH_GAZEBO"
"""The environment variable with the command of the lock-step program, as a shell would split it."""

HOW_TO_GET_IT = f"Build bridges/gazebo_classic and put it on the path, or its command into ${PROGRAM_VARIABLE}."

PROGRAM = "gazebo_lockstep"

_CHECK_S = 60.0
"""How long `fmu-mesh check` waits for a Gazebo without a world."""

_END_S = 5.0
"""How long Gazebo may take to end by itself, and to be gone after it was killed."""
_TAIL = 2000
"""Length in bytes of the end of Gazebo's output, of which an error quotes the last line."""


class GazeboGone(Exception):
    """The process does not exist, does not answer, or has ended; the message says which."""


def find_program() -> list[str]:
    """The command of the lock-step program: ``$FMU_MESH_GAZEBO``, or ``gazebo_lockstep`` on the path."""
    command = shlex.split(os.environ.get(PROGRAM_VARIABLE, "")) or [PROGRAM]
    if shutil.which(command[0]) is None:
        raise GazeboGone(f"there is no '{command[0]}'")
    return command


def check_program() -> None:
    """Check that the lock-step program starts on this host, without a world; `GazeboGone` if not."""
    try:
        done = subprocess.run(
            find_program(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=_environment(),
            timeout=_CHECK_S,
            check=False,
        )
    except OSError as error:
        raise GazeboGone(f"'{find_program()[0]}' does not start: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise GazeboGone(f"it has not answered for {_CHECK_S:g} s") from error
    if not done.stdout.startswith(b"error standard input ended"):
        raise GazeboGone(_ended(done.returncode, done.stderr[-_TAIL:]))


class GazeboProcess:
    """One world in one process: ``joints`` are scoped names, and whether they have no limits, ``links`` scoped names.

    ``timeouts`` say how long it may take to start, and for a step.

    Call sequence: the constructor, which loads the world and leaves its state, as the protocol has it, in ``state``;
    then `set_step_size` and `step`; at the end, and after any exception, which is `GazeboGone`, `close`.
    """

    def __init__(
        self, text: bytes, joints: Sequence[tuple[str, bool]], links: Sequence[str], timeouts: TimeoutsConfig
    ) -> None:
        self._received = b""
        self._limit_s, self._step_s = timeouts.start, timeouts.step
        with contextlib.ExitStack() as stack:
            self._errors = stack.enter_context(tempfile.TemporaryFile())
            self._process = subprocess.Popen(
                find_program(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                env=_environment(),
                start_new_session=True,  # Ctrl-C reaches the node only, which then closes this process
            )
            stack.callback(self.close)
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)
            parts = [f"joint {name} {'free' if free else 'limited'}\n" for name, free in joints]
            parts += [f"link {name}\n" for name in links]
            self._send(b"world %d\n%b%b" % (len(text), text, "".join([*parts, "go\n"]).encode()))
            self._answer()  # the versions of Gazebo and its engine
            self.state = self._numbers()
            self._limit_s = self._step_s
            stack.pop_all()

    def set_step_size(self, step_size: float) -> None:
        """Let every step of the engine take ``step_size`` seconds."""
        self._send(f"step_size {step_size!r}\n".encode())

    def step(self, count: int, efforts: Sequence[float], wrenches: Sequence[float]) -> None:
        """Take ``count`` steps with the efforts of all joints and force and moment of all links; then ``state``."""
        numbers = " ".join(map(repr, (*efforts, *wrenches)))
        self._send(f"step {count} {numbers}\n".encode())
        self.state = self._numbers()

    def close(self) -> None:
        """End the process. Never raises; may be called twice."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it waits for a disk that does not answer (state D)
                self._process.wait(_END_S)
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()

    def _send(self, data: bytes) -> None:
        pipe = self._process.stdin
        if pipe is None or pipe.closed:
            raise GazeboGone("it was ended")
        try:
            end = time.monotonic() + self._limit_s
            while data:
                if not select.select([], [pipe], [], max(0.0, end - time.monotonic()))[1]:
                    raise GazeboGone(f"it has not taken a command for {self._limit_s:g} s")
                data = data[pipe.write(data) or 0 :]
        except OSError as error:
            raise GazeboGone(self._last_words()) from error

    def _numbers(self) -> list[float]:
        return [float(word) for word in self._answer().split()]

    def _answer(self) -> str:
        """The next line."""
        pipe = self._process.stdout
        if pipe is None:
            raise GazeboGone("it was ended")
        end = time.monotonic() + self._limit_s
        while b"\n" not in self._received:
            readable, _, _ = select.select([pipe], [], [], max(0.0, end - time.monotonic()))
            if not readable:
                raise GazeboGone(f"it has not answered for {self._limit_s:g} s")
            data = pipe.read(1 << 16)
            if not data:
                raise GazeboGone(self._last_words())
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        text = line.decode(errors="replace")
        if text.startswith("error "):
            raise GazeboGone(text.removeprefix("error "))
        return text

    def _last_words(self) -> str:
        """The text of an error for a process that has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        size = os.fstat(self._errors.fileno()).st_size
        tail = os.pread(self._errors.fileno(), _TAIL, max(0, size - _TAIL))
        return _ended(self._process.returncode, tail)


def _ended(code: int | None, tail: bytes) -> str:
    """The exit code of a process and the last line of its output, in words."""
    lines = [line.strip() for line in tail.decode(errors="replace").splitlines() if line.strip()]
    words = f"; the last it wrote is: {lines[-1]}" if lines else ""
    return f"its process has ended with {code}{words}"


def _environment() -> dict[str, str]:
    """Environment variables for Gazebo: a server of its own on this host, and no model database."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # In a chroot this folder may not exist, and Gazebo's libraries fail without it.
    own = {name: value for name, value in os.environ.items() if name != "TMPDIR"}
    return {
        **own,
        "GAZEBO_IP": "127.0.0.1",
        "GAZEBO_MASTER_URI": f"http://127.0.0.1:{port}",
        "GAZEBO_MODEL_DATABASE_URI": "",
    }
