"""The stream of a Parquet file is read batch by batch, each once, and what it has become afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.results.parquet_file import ParquetFile
from fmu_mesh.results.parquet_tail import ParquetTail
from fmu_mesh.results.recording import Recording
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.planning import parse

CONFIG = "mesh: m\nsimulation: {stop_time: 1.0, step_size: 0.1}\ninstances: {a: {fmu: A.fmu}}\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "result.parquet"


def _begun(path: Path) -> ParquetFile:
    """A file with a number, a truth value and a text."""
    types = {"x": "Float64", "flag": "Boolean", "s": "String"}
    variables = tuple(
        Variable(name, number, type_, "output", "discrete")  # type: ignore[arg-type]  # literals
        for number, (name, type_) in enumerate(types.items())
    )
    loaded = LoadedConfig(parse(CONFIG, Path("mesh.yaml")).config, Path("mesh.yaml"))
    description = ModelDescription("A", "A", "3.0", "co_simulation", "", variables)
    return ParquetFile.open(path, Recording(loaded, {"a": description}, tuple(("a", name) for name in types)))


def _add(file: ParquetFile, first: int, count: int) -> None:
    """Rows whose values tell which they are; the operating system has them then."""
    numbers = np.arange(first, first + count)
    file.write((numbers * 0.1).astype(np.float64), [numbers * 2.0, numbers % 2 == 0, np.array(["t"] * count, object)])
    file.flush()


def _opened(path: Path) -> ParquetTail:
    tail = ParquetTail.open(path, ParquetFile.growing_file(path))
    assert tail is not None
    return tail


def _numbers(tail: ParquetTail) -> list[float]:
    """The values of `a.x` that are new, halved."""
    rows = tail.read(["a.x"])
    if rows is None:
        return []
    numbers: list[float] = (rows.values["a.x"] / 2).tolist()
    assert rows.times.tolist() == [number * 0.1 for number in numbers]
    return numbers


def test_rows_come_once_while_the_file_grows_and_none_is_missing(path: Path) -> None:
    file = _begun(path)
    _add(file, 0, 2)
    tail = _opened(path)

    assert tail.names == ["a.x", "a.flag"]
    assert [_numbers(tail), _numbers(tail)] == [[0, 1], []]
    _add(file, 2, 1)
    _add(file, 3, 2)
    assert tail.behind > 0
    assert [_numbers(tail), _numbers(tail), _numbers(tail)] == [[2], [3, 4], []]
    _add(file, 5, 1)
    file.close()
    assert not tail.replaced
    assert [_numbers(tail), _numbers(tail), _numbers(tail)] == [[5], [], []]
    assert not tail.replaced
    tail.close()


def test_after_a_skip_only_new_rows_come(path: Path) -> None:
    file = _begun(path)
    _add(file, 0, 5)
    tail = _opened(path)

    tail.skip()
    _add(file, 5, 1)

    assert _numbers(tail) == [5]
    tail.close()
    file.close()


def test_a_complete_file_is_read_from_its_first_row_on(path: Path) -> None:
    file = _begun(path)
    _add(file, 0, 5)
    file.close()
    tail = _opened(path)

    rows = tail.read(["a.flag", "a.x"])

    assert rows is not None
    assert rows.values["a.flag"].tolist() == [True, False, True, False, True]
    assert rows.values["a.x"].tolist() == [0, 2, 4, 6, 8]
    assert (_numbers(tail), tail.replaced) == ([], False)
    tail.close()


def test_a_batch_that_is_cut_off_comes_when_it_is_complete(path: Path) -> None:
    file = _begun(path)
    _add(file, 0, 2)
    _add(file, 2, 3)
    stream = ParquetFile.growing_file(path)
    whole = stream.read_bytes()
    other = path.with_name("other.parquet")
    growing = ParquetFile.growing_file(other)

    for cut in range(len(whole)):
        growing.write_bytes(whole[:cut])
        tail = ParquetTail.open(other, growing)
        before = (_numbers(tail) + _numbers(tail)) if tail is not None else []
        with growing.open("ab") as rest:
            rest.write(whole[cut:])
        tail = tail or _opened(other)
        after = _numbers(tail) + _numbers(tail)
        assert [*before, *after] == [0, 1, 2, 3, 4], cut
        tail.close()
    file.close()


def test_the_next_run_is_another_file_from_its_beginning_on(path: Path) -> None:
    file = _begun(path)
    _add(file, 0, 2)
    file.close()
    tail = _opened(path)

    again = _begun(path)
    before = tail.replaced
    _add(again, 0, 1)
    other = _opened(path)

    assert not before
    assert tail.replaced
    assert _numbers(other) == [0]
    other.close()
    tail.close()
    again.close()


@pytest.mark.parametrize("content", [b"", b"time", b"\xff\xff\xff\xff" * 8])
def test_what_is_no_result_file_is_not_read(path: Path, content: bytes) -> None:
    assert ParquetTail.open(path, ParquetFile.growing_file(path)) is None
    path.write_bytes(content)
    assert ParquetTail.open(path, ParquetFile.growing_file(path)) is None
    ParquetFile.growing_file(path).write_bytes(content)
    assert ParquetTail.open(path, ParquetFile.growing_file(path)) is None
