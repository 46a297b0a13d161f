"""Frames between a launcher and its helper: what is read, whatever comes before and however it is cut."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import msgspec
import pytest

from fmu_mesh.hosts import helper_frames as frames
from fmu_mesh.hosts import ssh_relay
from tests.helpers import DEADLINE_S

BEAT = bytes(4)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    os.close(reading)


def test_what_a_profile_prints_before_the_magic_word_is_skipped(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    reader = frames.FrameReader(reading, frames.MAGIC)
    os.write(writing, b"Welcome\x00fmu_mesh\n" * 1000 + frames.MAGIC[:5])
    os.write(writing, frames.MAGIC + frames.framed(frames.Alive()) + BEAT)
    os.close(writing)

    first, second, third = reader.next(), reader.next(), reader.next()

    assert first is not None
    assert msgspec.msgpack.decode(first, type=frames.FromHelper) == frames.Alive()
    assert (second, third) == (b"", None)


def test_a_frame_that_comes_in_pieces_is_read_whole(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    piece = frames.FilePiece("name", bytes(range(256)) * 10, last=True)
    data = frames.framed(piece)
    reader = frames.FrameReader(reading)
    for place in range(0, len(data), 100):
        os.write(writing, data[place : place + 100])
    os.close(writing)

    content = reader.next()

    assert content is not None
    assert msgspec.msgpack.decode(content, type=frames.ToHelper) == piece
    assert reader.next() is None


def test_silence_ends_at_its_limit(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    reader = frames.FrameReader(reading)

    with closing(os.fdopen(writing, "wb")), pytest.raises(TimeoutError):
        reader.next(limit_s=0.1)


def relayed(*command: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-ISP", ssh_relay.__file__, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def test_the_relay_passes_whole_frames_and_signs_of_life() -> None:
    with relayed("cat") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        reader = frames.FrameReader(process.stdout.fileno())
        sent = [frames.framed(frames.FilePiece(str(size), bytes(size), last=False)) for size in (0, 70_000, 3_000_000)]
        half = frames.framed(frames.Alive())

        assert reader.next(DEADLINE_S) == b""  # before anything was sent
        process.stdin.write(b"".join(sent) + half[:3])
        process.stdin.flush()
        received = list(iter(lambda: reader.next(DEADLINE_S), b""))
        process.stdin.write(half[3:])
        process.stdin.flush()
        while not (last := reader.next(DEADLINE_S)):
            assert last == b""
        process.stdin.close()

        assert [struct.pack("<I", len(content or b"")) + (content or b"") for content in received] == sent
        assert last == half[4:]
        assert process.wait(DEADLINE_S) == 0


@pytest.mark.parametrize(("script", "code"), [("exit 7", 7), ("kill -9 $$", 137)])
def test_the_relay_ends_as_the_program_behind_it(script: str, code: int) -> None:
    with relayed("sh", "-c", script) as process:
        assert process.wait(DEADLINE_S) == code
        assert process.stdin is not None
        process.stdin.close()
