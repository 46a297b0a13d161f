"""The program between a launcher and its ssh: `python -ISP ssh_relay.py ssh ...`. It needs only the standard library.

It passes on the frames of the launcher whole, and a sign of life each second, also while the launcher is stopped by
Ctrl-Z; ssh answers to the launcher directly. It has a session of its own, and ends with the launcher, and so does ssh.
"""

# One thread. The launcher may end or be killed: then standard input ends. ssh may end or be killed: its standard input
# breaks, or it is seen within a second. ssh may be stopped, or its network be cut: then writing to it would block, so
# that is never waited for alone; the launcher, which hears nothing any more, kills both.

from __future__ import annotations

import os
import select
import struct
import subprocess
import sys
import time
from contextlib import suppress

_BEAT = bytes(4)
"""A frame without content."""
_BEAT_S = 1.0
_MOST_WAITING = 1 << 20
_PIECE = 1 << 16
_LEAVE_S = 4.0
"""How long the helper may take to end the nodes after its standard input has ended, until ssh is asked to end."""


def main() -> int:
    """Relay, until one side ends; returns the exit code of ssh."""
    ssh = subprocess.Popen(sys.argv[1:], stdin=subprocess.PIPE)
    assert ssh.stdin is not None
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for own in (1, 2):  # who reads them sees the end of ssh
        os.dup2(nowhere, own)
    with suppress(BrokenPipeError):
        _relay(ssh)
    with suppress(OSError):
        ssh.stdin.close()
    for end in (ssh.terminate, ssh.kill):
        with suppress(subprocess.TimeoutExpired):
            return _code(ssh.wait(_LEAVE_S))
        end()
    return _code(ssh.wait())


def _relay(ssh: subprocess.Popen[bytes]) -> None:
    assert ssh.stdin is not None
    sink, incoming, waiting = ssh.stdin.fileno(), bytearray(), bytearray()
    os.set_blocking(sink, False)
    beat_at = time.monotonic()
    while ssh.poll() is None:
        sources, sinks = [0] if len(waiting) < _MOST_WAITING else [], [sink] if waiting else []
        readable, writable, _ = select.select(sources, sinks, [], max(0.0, beat_at - time.monotonic()))
        if readable:
            if not (data := os.read(0, _PIECE)):
                with suppress(BlockingIOError):  # the last word of the launcher
                    os.write(sink, waiting)
                return
            incoming += data
            while len(incoming) >= len(_BEAT):
                end = len(_BEAT) + struct.unpack_from("<I", incoming)[0]
                if len(incoming) < end:
                    break
                waiting += incoming[:end]
                del incoming[:end]
        if writable:
            with suppress(BlockingIOError):
                del waiting[: os.write(sink, waiting[:_PIECE])]
        if time.monotonic() >= beat_at:
            beat_at = time.monotonic() + _BEAT_S
            if not waiting:  # otherwise frames go, or nothing can
                waiting += _BEAT


def _code(code: int) -> int:
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    raise SystemExit(main())
