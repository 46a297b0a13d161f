"""A far network between two hosts on this machine: `far_link.c` between a TUN device of each.

It needs no `tc netem`, which not every kernel has.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.contestants.entry import compiled

__all__ = ["FarLink", "far_link", "why_not"]

_SOURCE = Path(__file__).with_suffix(".c")
_TUN = Path("/dev/net/tun")
_TOOLS = ("unshare", "nsenter", "ip")
_SPACES = ("--net", "--pid", "--mount", "--uts", "--ipc")
_SEED = 38
_DEADLINE_S = 10
_QUEUE = 10_000
"""Packets for which a device has room, more than TCP sends at once."""


@dataclass(frozen=True)
class FarLink:
    """What a network does to packets.

    Attributes:
        round_trip_ms: the delay of both ways together.
        loss_percent: how many packets never arrive.
        kbit_per_s: of each way; 0: no limit.
    """

    round_trip_ms: float
    loss_percent: float = 0.0
    kbit_per_s: float = 0.0

    def __str__(self) -> str:
        losses = f", {self.loss_percent:g} % loss" if self.loss_percent else ""
        return f"{self.round_trip_ms:g} ms{losses}" + (f", {self.kbit_per_s:g} kbit/s" if self.kbit_per_s else "")


def why_not() -> str:
    """Why this machine cannot have two hosts with such a link; empty if it can."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"there is no command {' and no '.join(missing)}"
    if not os.access(_TUN, os.R_OK | os.W_OK):
        return f"{_TUN} is not there, or may not be used"
    command = ["unshare", *_SPACES, "--fork", "true"]
    tried = subprocess.run(command, check=False, capture_output=True, text=True)
    return f"namespaces are not allowed: {tried.stderr.strip()}" if tried.returncode else ""


@contextmanager
def far_link(pids: Sequence[int], link: FarLink) -> Iterator[None]:
    """The link between the networks of two processes; they have 10.77.0.1 and 10.77.0.2 at the device `wire`.

    Raises:
        RuntimeError: there is no C compiler.
    """
    program, _ = compiled(_SOURCE)
    numbers = (500 * link.round_trip_ms, 10_000 * link.loss_percent, 1000 * link.kbit_per_s, _SEED)
    command = [str(program), *map(str, pids), *(f"{number:.0f}" for number in numbers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            if not process.stdout.readline():
                msg = "the far link did not start; its reason is above"
                raise RuntimeError(msg)
            for number, pid in enumerate(pids, 1):
                entered = ["nsenter", f"--target={pid}", "--net", "ip"]
                for words in (f"addr add 10.77.0.{number}/24 dev wire", f"link set wire up txqueuelen {_QUEUE}"):
                    subprocess.run([*entered, *words.split()], check=True, timeout=_DEADLINE_S)
            yield
        finally:
            process.kill()
