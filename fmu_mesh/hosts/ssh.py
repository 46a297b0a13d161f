"""Nodes on other hosts, over the user's own ssh: one connection to each host, with a helper behind it.

Owns what happens on the host of the launcher: ssh, the handshake with the helper, and the sockets of the run, which ssh
mirrors, so that all processes of a run find each other at the paths that they compute anyway. A socket of a process of
this host, or of a third one, is in the folder of the run there (`-R`), and one of a process there is here (`-L`).
"""

# Threads: for each host one, `host NAME`, which begins, and then takes what the helper sends, and one that reads what
# ssh writes to standard error. They post to the launcher's thread, which starts nodes, signals them, and ends all. A
# lock is held while a frame is written; the program between (`ssh_relay`) takes it at once, unless models are sent.
#
# What may go wrong: ssh or the helper ends: standard output ends, and the exit code and the last line say why. It is
# stopped, or the network is cut: no answer to the signs of life for `timeouts.link`. Then both programs are killed,
# and with them go the sockets here, which the others notice. ADR 85.

from __future__ import annotations

import hashlib
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, TypeVar

import msgspec
from msgspec.structs import replace

from .. import __version__
from ..awake import AwakeClock
from ..config.instance_sections import PhysicsSection
from ..errors import ConfigurationError, FmuMeshError, MeshLost
from ..files import beside
from ..installing import program
from ..run.child import how_it_ended
from ..run.process import launch_of
from ..run.run_plan import RunPlan, encoded, in_parts
from ..system.plan import MASTER, NodePlan
from ..wire.runtime import rows_socket, socket_endpoint
from . import helper_frames as frames
from . import ssh_relay
from .cache import JOURNALS
from .content import Content
from .remote_process import LOST, RemoteProcess

__all__ = ["SshHosts"]

T = TypeVar("T")
Post = Callable[[Callable[[], None]], None]
"""Calls a function on the launcher's thread."""

_CONNECT_S: Final = 10
_LEAVE_S: Final = 6.0
"""How long a helper may take to end, with ssh."""
_AGAIN_S: Final = 1.0
"""How long after one try to connect to a lost host the next one begins, at least."""
_FORWARD_S: Final = 30.0
_PIECE_BYTES: Final = 1 << 18
_CONTROL_BYTES: Final = 90  # the longest path of a control socket: ssh adds 17 bytes to it

_OPTIONS: Final = (
    "IgnoreUnknown=ForkAfterAuthentication,StdinNull,SessionType",  # of versions before 8.7
    *("BatchMode=yes", f"ConnectTimeout={_CONNECT_S}", "Compression=no", "ControlPersist=no", "LogLevel=INFO"),
    *("RequestTTY=no", "RemoteCommand=none", "PermitLocalCommand=no", "ForwardAgent=no", "ForwardX11=no"),
    *("ForkAfterAuthentication=no", "StdinNull=no", "SessionType=default"),
)
_TOO_EARLY: Final = re.compile(r"channel \d+: open failed: |connect_?\w* to \S+ port -2 failed")
"""A process has dialled before the other one was there; it does so again."""

_BY_HAND: Final = "Connect once by hand: `ssh {ssh}`."
_HINTS: Final = {
    "REMOTE HOST IDENTIFICATION HAS CHANGED": "Its host key has changed. If that is right, remove the old one with "
    f"`ssh-keygen -R`. {_BY_HAND}",
    "Host key verification failed": f"Its host key is not known here. {_BY_HAND}",
    "Permission denied": "`ssh -o BatchMode=yes {ssh} true` has to work: nobody can be asked for a password. A key "
    "with a passphrase needs an agent: `ssh-add`.",
    "Could not resolve hostname": "Is `ssh: {ssh}` right? It is [user@]host, or a name of ~/.ssh/config.",
    "kex_exchange_identification": "Its sshd may refuse so many connections at once: see `MaxStartups` there.",
    "Connection refused": "Does an sshd run there?",
    "No module named": "There is no fmu_mesh for `{python}` there, or a part is missing. Install fmu-mesh {version}.",
}


class SshHosts:
    """The hosts of a run that are reached by ssh.

    Args:
        run: the plan, with the name of the run.
        folder: of the run on this host.
        post: calls a function on the launcher's thread.
        tell: takes the name of a host, and what there is to say about it; from any thread.
    """

    def __init__(self, run: RunPlan, folder: Path, post: Post, tell: Callable[[str, str], None]) -> None:
        program("ssh")
        items = [item for node in run.plan.nodes.values() if node.host in run.plan.hosts for item in node.instances]
        if run.showing and (away := [item.name for item in items if isinstance(item.section, PhysicsSection)]):
            raise ConfigurationError(f"the world of '{away[0]}' cannot be shown: it is not on the host of `launch`")
        self._hosts: dict[str, _Host] = {}
        for name in (name for name, config in run.plan.hosts.items() if config.ssh is not None):
            self._hosts[name] = _Host(name, run, folder / f"ssh{len(self._hosts)}", post, partial(tell, name))
        for host in self._hosts.values():
            host.begin()

    def are_ready(self) -> bool:
        """Whether nodes can be started on all hosts.

        Raises:
            FmuMeshError: why that will never be.
        """
        for host in self._hosts.values():
            if host.failure is not None:
                host.begin_again(host.failure)
        return all(host.is_ready for host in self._hosts.values())

    def start(self, node: NodePlan) -> RemoteProcess | None:
        """Start a node, if it belongs to one of these hosts."""
        return self._hosts[node.host].start(node.node) if node.host in self._hosts else None

    def why(self, node: NodePlan) -> str | None:
        """How the process of a node has ended, if that is because its host was lost."""
        return self._hosts[node.host].lost if node.host in self._hosts else None

    def close(self, *, goes_on: bool) -> None:
        """End all connections; the helpers end what is left there, but for journals if the run ``goes_on``."""
        for host in self._hosts.values():
            host.leave(forgets=not goes_on)
        for host in self._hosts.values():
            host.close()


class _Host:
    """The connection to one host.

    Attributes:
        is_ready: whether nodes can be started there.
        failure: why they cannot.
        lost: how the connection has ended, once nodes were started.
    """

    def __init__(self, name: str, run: RunPlan, control: Path, post: Post, tell: Callable[[str], None]) -> None:
        self.is_ready = False
        self.failure: FmuMeshError | None = None
        self.lost: str | None = None
        self._name, self._config, self._run, self._control = name, run.plan.hosts[name], run, control
        self._ssh, self._post, self._tell = self._config.ssh or "", post, tell
        self._link_s = self._limit_s = run.loaded.config.timeouts.link
        self._nodes = {key: node for key, node in run.plan.nodes.items() if node.host == name}
        results = [Path(record.file) for record in run.plan.system.records]
        more = [beside(run.config_file, own) for own in (run.loaded.config.zenoh.config,) if own is not None]
        self._zenoh = next(map(str, more), None)
        self._content = Content(name, [*self._nodes.values()], more, results)
        self._processes: dict[str, RemoteProcess] = {}
        self._clock = AwakeClock()
        self._tried_at, self._until = 0.0, self._clock() + run.loaded.config.timeouts.start
        self._writing = threading.Lock()
        self._sockets: list[Path] = []
        self._told = ""
        self._said: deque[str] = deque(maxlen=20)
        self._leaving = self._is_silent = self._is_unreachable = False
        if len(os.fsencode(control)) > _CONTROL_BYTES:
            text = f"'{control}' is too long for a control socket of ssh ({_CONTROL_BYTES} bytes)"
            raise ConfigurationError(text, hint="Set FMU_MESH_RUNTIME_DIR to a shorter path.")

    def begin(self) -> None:
        """Connect; `is_ready` or `failure` follows."""
        self._tried_at = self._clock()
        alive_s = math.ceil(self._link_s / 3)
        more = "ClearAllForwardings=yes", f"ServerAliveInterval={alive_s}", "ServerAliveCountMax=3", "ControlMaster=yes"
        options = [word for option in (*_OPTIONS, *more) for word in ("-o", option)]
        helper = f"exec {self._config.python} -Pu -m {__package__}.helper {self._run.mesh} {self._link_s:g}"
        ssh = ["ssh", "-T", "-S", str(self._control), *options, self._ssh, helper]
        self._relay = subprocess.Popen(
            [sys.executable, "-ISP", ssh_relay.__file__, *ssh],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        assert self._relay.stdout is not None
        self._frames = frames.FrameReader(self._relay.stdout.fileno(), frames.MAGIC)
        jobs = (self._follow, f"host {self._name}"), (self._listen, f"ssh to {self._name}")
        self._threads = [threading.Thread(target=job, name=name, daemon=True) for job, name in jobs]
        for thread in self._threads:
            thread.start()

    def begin_again(self, failure: FmuMeshError) -> None:
        """Connect again after a ``failure``, if the host was lost, and it is time for that.

        Raises:
            FmuMeshError: the failure; after a restart, only when `timeouts.start` is over.
        """
        now, limit = self._clock(), f"{self._run.loaded.config.timeouts.start:g} s"
        if not self._run.restarts or not self._is_unreachable:
            raise failure
        if now > self._until:
            text = f"{self._name} was lost, and was not back within {limit}: {failure.message}"
            raise MeshLost(text, hint=failure.hint)
        if now - self._tried_at > _AGAIN_S:
            if failure.message != self._told:
                self._told = failure.message
                self._tell(f"{failure.message}; this is tried again for {limit}, the limit of `timeouts.start`")
            self.close()
            self.failure = self.lost = None
            self._leaving = self._is_silent = self._is_unreachable = False
            self._said.clear()
            for file in (self._control, *self._sockets):
                file.unlink(missing_ok=True)
            self.begin()

    def start(self, node: str) -> RemoteProcess:
        """Start a node."""
        self._processes[node] = made = RemoteProcess(lambda number: self._say(frames.SignalNode(node, number)))
        self._say(frames.StartNode(node, self._nodes[node].interpreter))
        if self.lost is not None:  # its thread may have ended all others before
            made.end(LOST)
        return made

    def leave(self, *, forgets: bool = False) -> None:
        """Let the helper end; it ``forgets`` the journals if no other attempt follows."""
        if forgets:
            self._say(frames.Forget())
        self._leaving = True
        assert self._relay.stdin is not None
        with suppress(OSError):
            self._relay.stdin.close()

    def close(self) -> None:
        """Wait for the end, and close what is open."""
        with suppress(subprocess.TimeoutExpired):
            self._relay.wait(_LEAVE_S if self.is_ready and self.lost is None else 0.0)
        self._kill()
        for thread in self._threads:
            thread.join(1.0)
        for pipe in filter(None, (self._relay.stdin, self._relay.stdout, self._relay.stderr)):
            pipe.close()

    def _kill(self) -> int:  # the exit code; in state D it ends later
        with suppress(ProcessLookupError, subprocess.TimeoutExpired):
            os.killpg(self._relay.pid, signal.SIGKILL)
            self._relay.wait(_LEAVE_S)
        return -signal.SIGKILL if (code := self._relay.poll()) is None else code

    # --- the thread of the host

    def _follow(self) -> None:
        try:
            self._shake_hands()
            self.is_ready = True
            self._post(lambda: None)
            while (message := self._next(self._link_s)) is not None:
                self._take(message)
        except EOFError:
            pass
        except TimeoutError:
            self._is_silent = True
        except (OSError, msgspec.MsgspecError) as error:
            self._said.append(str(error))
        except FmuMeshError as error:
            self.failure = error
        finally:
            if not self._leaving:
                self._lose()
            for process in [*self._processes.values()]:
                process.end(LOST)
            self._post(lambda: None)

    def _take(self, message: frames.FromHelper) -> None:
        match message:
            case frames.Line("", data, _):
                self._tell(data.decode(errors="replace").rstrip())
            case frames.Line(node, data, error):
                self._processes[node].take(data, error=error)
            case frames.Ended(node, code) if node:
                self._processes[node].end(code)
            case frames.CannotGoOn(text):
                self._said.append(text)

    def _lose(self) -> None:
        """The connection has ended, or has to end: say why."""
        if not self._is_silent:
            self.leave()
            with suppress(subprocess.TimeoutExpired):
                self._relay.wait(_LEAVE_S)
        code = self._kill()  # that of ssh, and 128 more than the number of a signal; below 0: its own
        self._threads[1].join(1.0)
        who = "the relay to ssh" if code < 0 else "ssh"
        how = f"{who} {how_it_ended(code if not 128 < code < 255 else 128 - code)}"
        if self._is_silent:
            limit = "link" if self._limit_s == self._link_s else "start"
            how = f"silent for {self._limit_s:g} s, the limit of `timeouts.{limit}`"
        elif self.failure is not None:
            how = self.failure.message
        elif self._said:
            how += f": {self._said[-1]}"
        elif code == 255:  # of ssh, which has words where a connection breaks
            how += ": a signal has ended the helper there"
        self.lost = f"is gone: the ssh connection to {self._name} was lost ({how})"
        if self.failure is None and not self.is_ready:
            self._is_unreachable = True
            self.failure = self._in_words(code, how)

    def _in_words(self, code: int, how: str) -> FmuMeshError:
        """Why nothing could be started there."""
        text = f"no node can be started on {self._name} with `ssh {self._ssh}`: {how}"
        said, hint = "\n".join(self._said), None
        if code in (126, 127):  # of a shell that cannot start a command
            hint = f"Is `{self._config.python}` the path of a Python on {self._name}?"
        for words, what in _HINTS.items():
            if words in said:
                hint = what.format(ssh=self._ssh, python=self._config.python, version=__version__)
                break
        return ConfigurationError(text, hint=hint)

    def _next(self, limit_s: float) -> frames.FromHelper | None:
        self._limit_s = limit_s
        content = self._frames.next(limit_s)
        return msgspec.msgpack.decode(content, type=frames.FromHelper) if content is not None else None

    def _heard(self, kind: type[T], limit_s: float) -> T:
        """The next frame of a kind."""
        while True:
            match self._next(limit_s):
                case frames.CannotGoOn(text, hint):
                    raise ConfigurationError(f"{self._name} cannot take part: {text}", hint=hint or None)
                case None:
                    raise EOFError
                case message if isinstance(message, kind):
                    return message

    def _say(self, message: frames.ToHelper) -> None:
        """From any thread: send a frame; one that cannot be sent is lost with the connection."""
        assert self._relay.stdin is not None
        data = memoryview(frames.framed(message))
        with self._writing, suppress(OSError, ValueError):
            while data:
                data = data[self._relay.stdin.write(data) or 0 :]

    def _shake_hands(self) -> None:
        """Send what the nodes need, and mirror the sockets."""
        hello = self._heard(frames.HelperHello, self._run.loaded.config.timeouts.start)
        self._compare(hello)
        self._say(frames.OfferTrees(self._content.trees))
        missing = self._heard(frames.Missing, self._link_s)
        for content in missing.contents:
            with self._content.files[content].open("rb") as file:
                while True:
                    data = file.read(_PIECE_BYTES)
                    self._say(frames.FilePiece(content, data, last := len(data) < _PIECE_BYTES))
                    if last:
                        break
        plans, launch = {}, launch_of(self._run.run) or ""
        rows = (self._config.address or hello.address or None) if self._config.rows == "tcp" else None
        for name in self._nodes:
            own = self._run.node(name)
            zenoh = replace(own.zenoh, config=self._zenoh, rows_address=rows)
            plan, journal = own.plan, own.plan.attempt.journal
            if journal:  # in the cache, because the folder of the run there ends with the helper
                journal = str(Path(hello.cache).parent / JOURNALS / launch / Path(journal).name)
                plan = replace(plan, attempt=replace(plan.attempt, journal=journal))
            there = replace(own, run=hello.run, launch=launch, helper=hello.pid, zenoh=zenoh, plan=plan)
            plans[name] = self._content.moved(encoded(there), hello.cache)
        terms = [(item.fmu, item.section) for node in self._nodes.values() for item in node.instances]
        checked = encoded((terms, [*self._content.trees], self._run.loaded.config.limits))
        digest = hashlib.sha256(checked).hexdigest()
        journals, is_first = launch if self._run.max_restarts else "", not self._run.restarts
        self._say(frames.Prepare(in_parts(plans), tuple(plans), digest, journals, is_first))
        try:
            self._mirror(Path(missing.folder))
        except ConfigurationError:
            self._heard(frames.Ready, self._link_s)  # a helper that has failed says why, and that is why
            raise
        ready = self._heard(frames.Ready, self._link_s)
        for instance, found, expected in ready.problems:  # the first one
            raise ConfigurationError(f"{self._name} cannot run '{instance}': {found}", hint=expected or None)

    def _compare(self, hello: frames.HelperHello) -> None:
        """Say how that host differs from this one.

        Raises:
            ConfigurationError: it has another version of fmu_mesh.
        """
        if hello.version != __version__:
            text = f"{self._name} has fmu_mesh {hello.version}, here {__version__}"
            raise ConfigurationError(text, hint=f"Install the same version there, for `{self._config.python}`.")
        there, here = (hello.python, hello.libc, hello.machine), frames.this_system()
        compared = zip(("Python", "the C library", "the processor"), there, here, strict=True)
        others = [f"{name} is {its} there, and {own} here" for name, its, own in compared if its != own]
        if others:
            self._tell("; ".join(others))

    def _mirror(self, there: Path) -> None:
        """Let ssh make the sockets that this host and the other one need of each other.

        Raises:
            ConfigurationError: its sshd forbids it.
        """
        here, inside = self._control.parent, self._nodes
        peers = {peer for node in inside.values() for peer in node.peers()} - inside.keys()
        by_ssh = self._config.rows == "sockets" and self._run.loaded.config.row_streams
        probe = here / f"{self._control.name}.probe"
        options, self._sockets = ["-L", f"{probe}:{there / frames.PROBE}"], [probe]
        for option, names in (("-R", [MASTER, *sorted(peers)]), ("-L", [*inside])):
            for name in names:
                zenoh = Path(socket_endpoint(here, name).partition("/")[2])
                for own in (zenoh, rows_socket(here, name)) if by_ssh else (zenoh,):
                    other = there / own.name
                    options += [option, f"{other}:{own}" if option == "-R" else f"{own}:{other}"]
                    self._sockets += [own] if option == "-L" else []
        # The file of the user might forward more.
        command = ["ssh", "-F", os.devnull, "-S", str(self._control), "-O", "forward", *options]
        try:
            done = subprocess.run(
                [*command, self._ssh], stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=_FORWARD_S
            )
        except subprocess.TimeoutExpired as error:
            raise MeshLost(f"{self._name} has not made the sockets within {_FORWARD_S:g} s") from error
        said = " ".join(done.stderr.decode(errors="replace").split())
        if done.returncode == 0:
            with socket.socket(socket.AF_UNIX) as tried:
                tried.settimeout(_FORWARD_S)
                tried.connect(str(probe))
                if tried.recv(1):
                    return
        hint = "`AllowStreamLocalForwarding yes` in its sshd_config allows it. Without `ssh`, TLS is the way."
        text = f"the sshd of {self._name} forwards no Unix sockets"
        raise ConfigurationError(f"{text}: {said}" if said else text, hint=hint)

    # --- the thread that reads what ssh writes

    def _listen(self) -> None:
        for line in self._relay.stderr or ():
            text = line.decode(errors="replace").rstrip()
            if text and not _TOO_EARLY.match(text):
                self._said.append(text)
                if self.is_ready and not self._leaving:
                    self._tell(text)
