"""What tests that run real processes share: a private place, the processes started there, and a look at what is left.

Nothing here waits by the clock: every wait is for a condition, and has a deadline that is only met when a test fails.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, TypeVar

import msgspec
import psutil
import yaml
import zenoh

from fmu_mesh.run.state_file import STATE
from fmu_mesh.wire.runtime import MeshNote

__all__ = [
    "BY_STREAMS",
    "BY_ZENOH",
    "DEADLINE_S",
    "FAILING",
    "FMUS",
    "NUMBERS_OF_ZENOH",
    "PAIR",
    "Launched",
    "Place",
    "assert_readable",
    "braked",
    "examples",
    "free_port",
    "on_a_busy_machine",
    "row_count",
    "rows_of",
    "wait_until",
    "write_config",
]

FMUS = Path(__file__).resolve().parents[1] / "fmus"

PAIR: Mapping[str, Mapping[str, Any]] = {
    "pendulum": {"fmu": "DampedPendulum"},
    "delay": {"fmu": "TransportDelay", "start_values": {"d": 0.1}},
}
"""The instances that `write_config` writes by default."""

BY_STREAMS: Mapping[str, bool] = {"shared_memory": False}
BY_ZENOH: Mapping[str, bool] = {"shared_memory": False, "row_streams": False}
"""The section `zenoh` of a mesh whose processes use the ways between hosts."""

DEADLINE_S = 100.0
"""Longer than anything takes on a busy machine, shorter than the timeout of a test."""

NUMBERS_OF_ZENOH = 1 << 16
"""So many keys a session of Zenoh 1.10 can declare until it gives a number a second time."""

_LOOK_S = 0.01

_HOLDING = """
import os, signal, sys

held = False

def hold(event, arguments):
    global held
    if event == "socket.gethostname" and not held:
        with open("/proc/self/cmdline", "rb") as file:
            held = file.read().strip(b"\\0").decode() == "fmu-mesh TITLE"
        if held:
            os.kill(os.getpid(), signal.SIGSTOP)

sys.addaudithook(hold)
"""
"""A process of a run asks for the name of its host before it opens a session."""

Value = TypeVar("Value")


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A free port of the loopback device."""
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


FAILING = """
import fmu_mesh

class Failing(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, time, step_size):
        if time > 0.5:
            raise ValueError("the tank is empty")
"""
"""A component whose step at more than 0.5 s fails."""


def examples(most: int) -> int:
    """How many random examples a test takes: ``most`` where `FMU_MESH_EXAMPLES` asks for all of them, else a third."""
    return most if "FMU_MESH_EXAMPLES" in os.environ else -(-most // 3)


def wait_until(condition: Callable[[], Value | None], what: str, deadline_s: float = DEADLINE_S) -> Value:
    """Return the first true value of ``condition``; fail after ``deadline_s`` seconds, saying ``what`` did not come."""
    never = threading.Event()
    end = time.monotonic() + deadline_s
    while True:
        if value := condition():
            return value
        assert time.monotonic() < end, f"not within {deadline_s:g} s: {what}"
        never.wait(_LOOK_S)


def on_a_busy_machine(seconds: float) -> float:
    """What takes ``seconds`` on an idle machine may take this long now: as many times as processes want to run."""
    return seconds * max(1.0, os.getloadavg()[0])


def write_config(
    folder: Path,
    *,
    instances: Mapping[str, Mapping[str, Any]] | None = None,
    connections: Sequence[str] = ("pendulum.a -> delay.x",),
    name: str = "pair",
    stop_time: float = 1.0,
    **sections: Mapping[str, Any],
) -> Path:
    """Write ``<name>.yaml``, by default a pendulum and a delay with a step size of 1 ms; returns its path.

    Args:
        folder: where the file goes, and the result file ``<name>.csv`` beside it.
        instances: by name; ``fmu`` may be the name of a kept FMU such as ``Gain``.
        connections: in the short form.
        name: of the mesh.
        stop_time: in s.
        sections: more of the file; what is in ``simulation`` comes on top of the default.
    """
    kept = {path.stem: str(path) for path in FMUS.glob("*.fmu")}
    members = {own_name: dict(member) for own_name, member in (PAIR if instances is None else instances).items()}
    for member in members.values():
        if "fmu" in member:
            member["fmu"] = kept.get(member["fmu"], member["fmu"])
    content = {
        "mesh": name,
        "record": {"file": f"{name}.csv"},
        **sections,
        "simulation": {"stop_time": stop_time, "step_size": 0.001, **sections.get("simulation", {})},
        "instances": members,
        "connections": list(connections),
    }
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


_BRAKE = """
import time
import fmu_mesh

class Brake(fmu_mesh.Component):
    y = fmu_mesh.Output(start=0.0)

    def step(self, now, step_size):
        time.sleep(2e-5)
        self.y = now
"""


def braked(folder: Path) -> Mapping[str, Mapping[str, Any]]:
    """A pendulum, a delay, and an instance that sleeps in each step, for `write_config`.

    They run as fast as possible, and still write only some ten thousand rows per second. So whatever the machine does
    until a test ends the run, its result is small enough to be read.
    """
    (folder / "brake.py").write_text(_BRAKE, encoding="utf-8")
    return {**PAIR, "brake": {"python": "brake.py:Brake"}}


def row_count(file: Path) -> int:
    """Rows that a result file has by now, without the header; 0 if there is no file yet."""
    try:
        return max(0, file.read_bytes().count(b"\n") - 1)
    except FileNotFoundError:
        return 0


def rows_of(file: Path) -> list[tuple[float, ...]]:
    """The rows of a result file that holds numbers only; a row that is not complete fails the test."""
    text = file.read_text(encoding="utf-8")
    assert text.endswith("\n"), f"the last row is not complete: {text[-80:]!r}"
    header, *lines = csv.reader(text.splitlines())
    rows = [tuple(map(float, line)) for line in lines]
    assert {len(row) for row in rows} <= {len(header)}
    return rows


def assert_readable(message: str) -> None:
    """What a person is told when a run fails: one paragraph, without a trace of how the program is built."""
    lines = message.splitlines()
    assert len(lines) == 1, message
    assert lines[0].startswith("fmu-mesh: "), message
    for sign in ("Traceback", "Error(", "None,", "  ", "..", ";;", ": :", "''"):
        assert sign not in message, f"{sign!r} in: {message}"
    assert not re.search(r"<\D", message), f"an object in: {message}"  # versions may be below a number
    assert message[-1] not in ":;,", message


class Place:
    """A private runtime folder and folder for temporary files, and everything that was started there.

    Use it as a context manager; what still runs at the end is killed.

    Attributes:
        folder: for the test's own files; its path is short, because that of a socket in it is limited.
        environment: of all that is started there.
    """

    def __init__(self) -> None:
        # The default folder for temporary files may be too long.
        self.folder = Path(tempfile.mkdtemp(prefix="fm-", dir="/tmp"))
        self._runtime = self.folder / "run"
        self._temporary = self.folder / "tmp"
        self._temporary.mkdir()
        self.environment = os.environ | {
            "FMU_MESH_RUNTIME_DIR": str(self._runtime),
            "TMPDIR": str(self._temporary),
            "COLUMNS": "1000",
        }
        self._started: list[Launched] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self.processes():
            with suppress(psutil.NoSuchProcess):
                process.kill()
        for launched in self._started:
            launched.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def start(self, *arguments: str | Path, prefix: Sequence[str] = ()) -> Launched:
        """Start ``fmu-mesh`` with these arguments as a process of its own; ``prefix`` is a command that starts it."""
        return self.start_command([*prefix, sys.executable, "-m", "fmu_mesh", *map(str, arguments)])

    def start_command(self, command: Sequence[str]) -> Launched:
        """Start any command here as a process of its own."""
        launched = Launched(command, self.environment, self.folder)
        self._started.append(launched)
        return launched

    def run(self, *arguments: str | Path, deadline_s: float = DEADLINE_S) -> Launched:
        """Start ``fmu-mesh`` with these arguments and wait for its end."""
        launched = self.start(*arguments)
        launched.wait(deadline_s)
        return launched

    def hold(self, title: str) -> None:
        """From now on, a process such as `node pendulum` stops itself (SIGSTOP) before it meets the others."""
        folder = self.folder / "site"
        folder.mkdir()
        (folder / "sitecustomize.py").write_text(_HOLDING.replace("TITLE", title))
        self.environment = {**self.environment, "PYTHONPATH": str(folder)}

    def note(self) -> MeshNote:
        """The note of the one mesh that runs here, as soon as it is there."""
        [file] = wait_until(lambda: list(self._runtime.glob("*/mesh.json")), "the note of a running mesh")
        return msgspec.json.decode(file.read_bytes(), type=MeshNote)

    def session(self) -> zenoh.Session:
        """A session as any program would open it, in the one mesh that runs here, as soon as it is there."""
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps(self.note().endpoints))
        return zenoh.open(config)

    def processes(self, role: str | None = None) -> list[psutil.Process]:
        """All processes that run here, or those with a role: `master`, `gateway`, `node`, or `fork` for the server.

        Children of children are included: they inherit the environment of this place.
        """
        here = []
        for process in psutil.process_iter():
            try:
                if process.environ().get("FMU_MESH_RUNTIME_DIR") == str(self._runtime):
                    here.append(process)
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
        return [process for process in here if role is None or _title(process)[:1] == [role]]

    def left(self) -> list[str]:
        """In words what is there: processes, and files, folders and sockets of runs."""
        found = [f"process {process.pid}: {' '.join(_command(process))}" for process in self.processes()]
        return [*found, *(str(path) for folder in (self._runtime, self._temporary) for path in _within(folder))]

    def assert_nothing_left(self, within_s: float = 0.0) -> None:
        """Nothing may be left, ``within_s`` seconds from now."""
        with suppress(AssertionError):  # the one below says what is left
            wait_until(lambda: not self.left(), "an empty place", within_s)
        left = self.left()
        assert not left, "\n".join(left)

    def story(self) -> str:
        """What has been started here, how it ended, what it wrote, and where it is if it still runs."""
        stories = [launched.story() for launched in self._started]
        return "\n".join([*stories, *(_stacks(process.pid) for process in self.processes())])

    def extracted(self) -> list[Path]:
        """The folders of extracted FMUs."""
        return [path.parent for path in _within(self.folder) if path.name == "modelDescription.xml"]

    def checkpoints(self) -> list[int]:
        """The points of all checkpoints, in ascending order, without those that are being written."""
        return sorted(int(path.stem) for path in _within(self.folder) if path.suffix == STATE and path.stem.isdecimal())

    def sockets(self) -> list[Path]:
        """The sockets of processes that listen for others."""
        return [path for path in _within(self.folder) if path.suffix == ".sock"]


def _within(folder: Path) -> Iterator[Path]:
    """All that is in a folder; unlike `Path.rglob`, this bears with folders that are removed while it looks."""
    for parent, folders, files in os.walk(folder):
        yield from (Path(parent, name) for name in sorted(folders + files))


class Launched:
    """One ``fmu-mesh`` command as a process, with what it has written so far.

    Attributes:
        ended_after_s: how long `wait` has waited.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], folder: Path) -> None:
        self._command = command
        self._popen = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._popen.stdout is not None
        assert self._popen.stderr is not None
        self._output: list[str] = []
        self._errors: list[str] = []
        self._readers = [
            threading.Thread(target=_read, args=(self._popen.stdout, self._output), daemon=True),
            threading.Thread(target=_read, args=(self._popen.stderr, self._errors), daemon=True),
        ]
        for reader in self._readers:
            reader.start()
        self.ended_after_s = 0.0

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._popen.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self._popen.poll() is None

    @property
    def output(self) -> str:
        """What it has written to standard output."""
        return "".join(self._output)

    @property
    def errors(self) -> str:
        """What it has written to standard error."""
        return "".join(self._errors)

    @property
    def message(self) -> str:
        """The error that it ended with: what it wrote in its own name, which must be one readable paragraph."""
        told = ("mesh '", "fmu-mesh: warning: ")
        message = "".join(line for line in self._errors if not line.startswith(told)).strip()
        assert "Traceback" not in message, message
        message = message[max(message.find("fmu-mesh: "), 0) :]
        assert_readable(message)
        return message

    def story(self) -> str:
        """Its command, how it ended, and what it wrote."""
        end = "runs" if self.running else f"ended with {self._popen.returncode}"
        return f"$ fmu-mesh {' '.join(self._command[3:])}  ({end})\n{self.output}{self.errors}"

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._popen.send_signal(number)

    def wait(self, deadline_s: float = DEADLINE_S) -> int:
        """Wait for its end and return its exit code; fail after ``deadline_s`` seconds."""
        started = time.monotonic()
        try:
            code = self._popen.wait(deadline_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(
                f"it still runs after {deadline_s:g} s; it wrote:\n{self.output}{self.errors}"
            ) from None
        self.ended_after_s = time.monotonic() - started
        self._join()
        return code

    def wait_for_error_line(self, text: str) -> str:
        """The first line on standard error with ``text`` in it, as soon as it is there."""
        return wait_until(lambda: next((line for line in self._errors if text in line), None), f"'{text}'")

    def child(self, role: str) -> psutil.Process:
        """The process of the master, the gateway, the server (``fork``), or of a node by its name, once it runs."""
        return wait_until(lambda: self._child(role), f"the process of {role}")

    def close(self) -> None:
        """Kill it if it still runs, and close the pipes."""
        if self.running:
            self._popen.kill()
        self._popen.wait(DEADLINE_S)
        self._join()

    def _child(self, role: str) -> psutil.Process | None:
        for process in psutil.Process(self.pid).children(recursive=True):
            title = _title(process)
            if title[:1] == [role] or title[:2] == ["node", role]:
                return process
        return None

    def _join(self) -> None:
        for reader in self._readers:
            reader.join(DEADLINE_S)
        for pipe in (self._popen.stdout, self._popen.stderr):
            if pipe is not None:
                pipe.close()


def _stacks(pid: int) -> str:
    """Where all threads of a Python process are, for a test that hangs."""
    command = [str(Path(sys.executable).with_name("py-spy")), "dump", "--pid", str(pid)]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=30, check=False).stdout
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"process {pid}: {error}"


def _title(process: psutil.Process) -> list[str]:
    """The words of the title of a process of a run, as in `fmu-mesh node pendulum`, without the first one."""
    words = " ".join(_command(process)).split()
    return words[1:] if words[:1] == ["fmu-mesh"] else []


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except (psutil.NoSuchProcess, psutil.AccessDenied):
        return []


def _read(pipe: IO[str], lines: list[str]) -> None:
    lines.extend(pipe)
