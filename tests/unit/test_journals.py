"""Journals: a line that was not written whole is left out, and a damaged one before others is an error."""

from __future__ import annotations

from pathlib import Path

import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.wire.journal import NodeJournal, whole_lines
from fmu_mesh.wire.messages import SetValue

VALUES = [SetValue("slow", "v", float(number), number, None, "", "") for number in range(3)]


def journal(path: Path) -> bytes:
    """The bytes of a journal with three values."""
    own = NodeJournal(str(path))
    for value in VALUES:
        own.keep(value)
    own.close()
    return path.read_bytes()


def test_a_journal_cut_at_any_byte_has_its_whole_lines(tmp_path: Path) -> None:
    data = journal(path := tmp_path / "a.journal")
    for size in range(len(data)):
        path.write_bytes(data[:size])
        assert [*NodeJournal(str(path)).entries()] == VALUES[: data[:size].count(b"\n")]


def test_a_value_after_a_torn_line_replaces_it(tmp_path: Path) -> None:
    data = journal(path := tmp_path / "a.journal")
    path.write_bytes(data[:-3])

    NodeJournal(str(path)).keep(VALUES[0])

    assert [*NodeJournal(str(path)).entries()] == [*VALUES[:2], VALUES[0]]
    assert whole_lines(path).torn == 0


@pytest.mark.parametrize("line", [0, 1, 2])
def test_a_changed_byte_is_never_a_value(tmp_path: Path, line: int) -> None:
    data = bytearray(journal(path := tmp_path / "a.journal"))
    data[data.find(b"slow", len(data) // 3 * line)] ^= 1
    path.write_bytes(data)
    if line == 2:
        assert [*NodeJournal(str(path)).entries()] == VALUES[:2]
    else:
        with pytest.raises(ConfigurationError, match=f"is damaged in line {line + 1}"):
            [*NodeJournal(str(path)).entries()]
