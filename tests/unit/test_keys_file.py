"""The values of keys beside a result file: which lines are read again, and which files are refused."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from fmu_mesh.errors import ConfigurationError
from fmu_mesh.results.keys_file import KeysFile, keys_beside, recorded_keys, recorded_values
from fmu_mesh.variables.model_description import Variable

U = Variable(name="u", value_reference=1, type="Float64", causality="input", variability="continuous")
GEAR = Variable(
    name="gear[1].x",
    value_reference=2,
    type="Enumeration",
    causality="input",
    variability="discrete",
    items=(("low", 1), ("high", 2)),
)
KNOWN = {one.name: one for one in (U, GEAR)}
LINES: list[tuple[str, int, float | None, Any]] = [
    ("pump.u", 0, None, 1.5),
    ("pump2.u", 0, None, 9.0),
    ("pump.gear[1].x", 3, 0.25, 2),
    ("pump.u", 7, 0.7, -0.0),
]


def written(folder: Path, *more: bytes) -> Path:
    """The file of a run with these lines, and more that are no lines of ours."""
    file = folder / "first.csv.keys.jsonl"
    file.write_bytes(b"".join(msgspec.json.encode(line) + b"\n" for line in LINES) + b"".join(more))
    return file


def read(file: Path) -> list[tuple[str, int, float | None, Any]]:
    return list(recorded_values(recorded_keys(file), "pump", KNOWN))


def test_each_instance_gets_its_own_lines(tmp_path: Path) -> None:
    own = [("u", 0, None, 1.5), ("gear[1].x", 3, 0.25, 2), ("u", 7, 0.7, -0.0)]

    assert read(written(tmp_path)) == own


@pytest.mark.parametrize(
    "torn", [b'["pump.u",8,0.8,1', b'["pump.u"', b'["pump.u",8,0.8,"\xff', b"[", b'["pump.u",8,0.8,"x"]']
)
def test_a_last_line_that_was_cut_off_is_left_out(torn: bytes, tmp_path: Path) -> None:
    assert len(read(written(tmp_path, torn))) == 3


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b'["pump.u",8,0.8]', "Expected `array` of length 4"),
        (b'["pump.u","8",0.8,1.0]', "Expected `int`"),
        (b'["pump.u",8,0.8,"\xff"]', "line 5"),
        (b'["pump.u",8,0.8,"wet"]', "'wet' is no Float64 value for it"),
        (b'["pump.gear[1].x",8,0.8,3]', "3 is no Enumeration value for it"),
        (b'["pump.k",8,0.8,3.0]', "'pump' has no key for 'k'"),
        (b'["pump.",8,0.8,3.0]', "'pump' has no key for ''"),
    ],
)
def test_a_line_that_is_no_value_is_refused(line: bytes, said: str, tmp_path: Path) -> None:
    file = written(tmp_path, line + b"\n", b'["pump.u",9,0.9,1.0]\n')

    with pytest.raises(ConfigurationError, match=r"line 5 of '.*' is no value of a key") as raised:
        read(file)
    assert said in str(raised.value)


def test_a_file_that_has_changed_since_is_refused(tmp_path: Path) -> None:
    known = recorded_keys(written(tmp_path))
    written(tmp_path, b'["pump.u",8,0.8,1.0]\n')

    with pytest.raises(ConfigurationError, match="has changed since the run was planned"):
        next(recorded_values(known, "pump", KNOWN))


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"'.*first.csv.keys.jsonl' cannot be read: No such file"):
        recorded_keys(tmp_path / "first.csv.keys.jsonl")


def test_a_run_without_rows_leaves_the_earlier_file(tmp_path: Path) -> None:
    file, result = written(tmp_path), tmp_path / "first.csv"
    before = file.read_bytes()

    with closing(KeysFile(result)) as keys:
        assert keys.add(LINES[:1]) is None

    assert file.read_bytes() == before


def test_the_file_is_there_from_the_first_value_on(tmp_path: Path) -> None:
    file, result = written(tmp_path), tmp_path / "first.csv"

    with closing(KeysFile(result)) as keys:
        assert keys.begin() is None
        assert not file.exists()
        assert keys.add(LINES[:2]) == file.name
        assert keys.add(LINES[2:]) is None
        assert len(read(file)) == 3


def test_values_before_the_first_row_come_first(tmp_path: Path) -> None:
    result = tmp_path / "first.csv"

    with closing(KeysFile(result)) as keys:
        keys.add(LINES[:1])
        assert keys.begin() == keys_beside(result).name
        keys.add(LINES[2:])

    assert [line[1] for line in read(keys_beside(result))] == [0, 3, 7]


def test_a_result_in_memory_has_no_file(tmp_path: Path) -> None:
    with closing(KeysFile(tmp_path / "first.arrays")) as keys:
        keys.begin()
        assert keys.add(LINES) is None
    assert not list(tmp_path.iterdir())
