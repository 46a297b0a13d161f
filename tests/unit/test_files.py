"""Files that one process writes alone: what is at the path until the first bytes, and what stays the same then."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import open_alone

OLD, NEW = b"an older result, longer than the new one", b"new"


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_stays_until_the_first_bytes_and_remains_the_same_file(tmp_path: Path) -> None:
    path, other, link = tmp_path / "a.csv", tmp_path / "hard", tmp_path / "soft"
    path.write_bytes(OLD)
    path.chmod(0o640)
    other.hardlink_to(path)
    link.symlink_to(path)
    before = path.stat()

    with open_alone(link) as file:
        assert path.read_bytes() == OLD
        file.write(NEW)
        assert path.read_bytes() == NEW

    after = path.stat()
    assert (after.st_ino, after.st_mode, other.read_bytes()) == (before.st_ino, before.st_mode, NEW)
    assert link.is_symlink()
    assert names_in(tmp_path) == ["a.csv", "hard", "soft"]


def test_a_new_file_has_its_name_from_the_first_bytes_on(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.csv"

    with open_alone(path) as file:
        assert names_in(path.parent) == ["a.csv.starting"]
        file.write(NEW)
        assert names_in(path.parent) == ["a.csv"]
        assert file.size == len(NEW)

    assert path.read_bytes() == NEW
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


@pytest.mark.parametrize("older", [None, OLD])
def test_without_a_byte_nothing_changes(tmp_path: Path, older: bytes | None) -> None:
    path = tmp_path / "a.csv"
    if older is not None:
        path.write_bytes(older)

    open_alone(path).close()

    assert names_in(tmp_path) == (["a.csv"] if older is not None else [])
    assert older is None or path.read_bytes() == older


def test_a_link_that_leads_nowhere_leads_to_the_new_file(tmp_path: Path) -> None:
    link, target = tmp_path / "link.csv", tmp_path / "target.csv"
    link.symlink_to(target)

    with open_alone(link) as file:
        file.write(NEW)

    assert link.is_symlink()
    assert target.read_bytes() == NEW
    assert names_in(tmp_path) == ["link.csv", "target.csv"]


@pytest.mark.parametrize("older", [None, OLD])
@pytest.mark.parametrize("content", [None, NEW])
def test_a_second_writer_is_refused_and_changes_nothing(
    tmp_path: Path, older: bytes | None, content: bytes | None
) -> None:
    path = tmp_path / "a.csv"
    if older is not None:
        path.write_bytes(older)
    with open_alone(path) as first:
        if content is not None:
            first.write(content)
        names = names_in(tmp_path)

        with pytest.raises(ConfigurationError, match="another run is writing the result file"):
            open_alone(path)

        assert names_in(tmp_path) == names
    open_alone(path).close()


@pytest.mark.parametrize("older", [None, OLD])
def test_what_a_killed_run_left_is_used_or_removed_by_the_next(tmp_path: Path, older: bytes | None) -> None:
    path = tmp_path / "a.csv"
    (tmp_path / "a.csv.starting").touch()
    if older is not None:
        path.write_bytes(older)

    with open_alone(path) as file:
        file.write(NEW)

    assert path.read_bytes() == NEW
    assert names_in(tmp_path) == ["a.csv"]


def test_of_many_that_begin_at_once_one_writes_the_file(tmp_path: Path) -> None:
    path, count = tmp_path / "a.csv", 8
    start, refused = threading.Barrier(count, timeout=30.0), threading.Barrier(count, timeout=30.0)
    winners: list[int] = []

    def run(number: int) -> None:
        for _ in range(50):
            start.wait()
            try:
                file = open_alone(path)
            except ConfigurationError:
                refused.wait()
            else:
                winners.append(number)
                refused.wait()
                with file:
                    if number % 2:
                        file.write(b"%d" % number)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(winners) == 50
    writers = [number for number in winners if number % 2]
    assert path.read_bytes() == b"%d" % writers[-1]
    assert names_in(tmp_path) == ["a.csv"]


def test_a_device_and_a_pipe_are_just_written(tmp_path: Path) -> None:
    with open_alone(Path("/dev/null")) as first, open_alone(Path("/dev/null")) as second:
        assert (first.write(NEW), second.write(NEW)) == (3, 3)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()

    with open_alone(pipe) as file:
        file.write(NEW)

    reader.join()
    assert read == [NEW]
    assert names_in(tmp_path) == ["pipe"]


def test_after_a_write_that_failed_nothing_is_written_any_more() -> None:
    with open_alone(Path("/dev/full")) as file:
        for _ in range(2):
            with pytest.raises(OSError, match="No space left"):
                file.write(NEW)
        assert file.size == 0
