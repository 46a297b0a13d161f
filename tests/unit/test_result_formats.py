"""What a result file gives back: every type bit by bit, the metadata, and the whole rows of one that is cut off."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from pyarrow import parquet

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.config.loading import LoadedConfig
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import Kept
from fmu_mesh.results import parquet_file
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.results.parquet_file import ParquetFile
from fmu_mesh.results.parquet_tail import ParquetTail
from fmu_mesh.results.recording import Recording, ResultFile, ResultFormat, with_notes
from fmu_mesh.ros.bags.mcap_file import McapFile
from fmu_mesh.system.schedule import SeriesFile
from fmu_mesh.system.series_files import columns_of, content_of, read_series
from fmu_mesh.variables.model_description import ModelDescription, Variable
from fmu_mesh.variables.value_types import DTYPES, INTEGERS, VariableType, is_float
from tests.fmus.helpers import find_fmu
from tests.helpers import write_config
from tests.planning import parse

Write = Callable[[str], bytes]

CONFIG = "mesh: all\nsimulation: {stop_time: 1.0, step_size: 0.1}\ninstances: {it: {fmu: It.fmu}}\n"
NUMBERS: list[VariableType] = [type_ for type_ in DTYPES if type_ not in ("String", "Binary")]
TYPES: list[VariableType] = [*NUMBERS, "String", "Binary"]
METADATA = {
    "format": 1,
    "mesh": "all",
    "variables": {f"it.{type_}": {"type": type_, "unit": "rad" if is_float(type_) else None} for type_ in TYPES},
}
SET = {"instance": "it", "variable": "u", "value": 3.0, "point": 2}
END = {"end": {"point": 7, "reason": "stopped"}}

FORMATS = pytest.mark.parametrize(("format_", "name"), [(CsvFile, "a.csv"), (ParquetFile, "a.parquet")])
ALL_FORMATS = pytest.mark.parametrize(
    ("format_", "name", "types"),
    [
        (CsvFile, "a.csv", TYPES),
        (ParquetFile, "a.parquet", TYPES),
        (McapFile, "a.mcap", [type_ for type_ in TYPES if type_ != "Binary"]),
    ],
)


def recording(types: Sequence[VariableType] = TYPES) -> Recording:
    """A variable of each type is recorded, with its own name."""
    variables = [
        Variable(type_, number, type_, "output", "discrete", unit="rad" if is_float(type_) else None)
        for number, type_ in enumerate(types)
    ]
    description = ModelDescription("It", "It", "3.0", "co_simulation", "", tuple(variables))
    loaded = LoadedConfig(parse(CONFIG, Path("mesh.yaml")).config, Path("mesh.yaml"))
    return Recording(loaded, {"it": description}, tuple(("it", type_) for type_ in types), metadata=METADATA)


def arrays_recording(types: Sequence[VariableType]) -> Recording:
    """Of each type a matrix of two rows and three columns, and of the first also an array of which an element lacks."""
    variables = [
        Variable(type_, number, type_, "output", "discrete", unit="rad" if is_float(type_) else None, shape=(2, 3))
        for number, type_ in enumerate(types)
    ]
    variables.append(Variable("part", len(types), types[0], "output", "discrete", shape=(3,)))
    names = [name for variable in variables for name in variable.elements]
    description = ModelDescription("It", "It", "3.0", "co_simulation", "", tuple(variables))
    loaded = LoadedConfig(parse(CONFIG, Path("mesh.yaml")).config, Path("mesh.yaml"))
    own = Recording(loaded, {"it": description}, tuple(("it", name) for name in names[:-1]))
    described = {name: {"type": type_, "unit": "rad" if "Float" in name else None} for name, type_ in own.columns}
    return msgspec.structs.replace(own, metadata={**METADATA, "variables": described})


def arrays_of(recording: Recording, rows: int) -> dict[str, NDArray[Any]]:
    """The columns of a recording; each element begins with another value of its type."""
    return {name: np.roll(values_of(type_, rows), place) for place, (name, type_) in enumerate(recording.columns)}


def values_of(type_: VariableType, rows: int) -> NDArray[Any]:
    """Values of a type, the special ones first."""
    match type_:
        case "Float64" | "Float32":
            dtype = np.dtype(DTYPES[type_])
            limits = np.finfo(dtype)
            first = [0.0, -0.0, np.nan, np.inf, -np.inf, limits.max, limits.tiny, limits.smallest_subnormal, 1 / 3]
            return np.resize(np.array(first, dtype), rows)
        case "Boolean":
            return np.resize(np.array([True, False, False]), rows)
        case "String":
            texts = ["", "ä€\N{GRINNING FACE}", 'say "a,b"\nc', "1.0"]
            return np.array([texts[row % 4] for row in range(rows)], object)
        case "Binary":
            texts_of_bytes = [b"", b"\0\xff\n", b"abc"]
            return np.array([texts_of_bytes[row % 3] for row in range(rows)], object)
        case _:
            range_ = INTEGERS[type_]
            return np.resize(np.array([range_[0], range_[-1], 1], DTYPES[type_]), rows)


def times_of(rows: int) -> NDArray[np.float64]:
    return np.arange(rows, dtype=np.float64) * 0.1


def write(file: ResultFile, types: Sequence[VariableType], rows: int, block: int) -> None:
    """Write rows in blocks, each of which the operating system has."""
    columns = [values_of(type_, rows) for type_ in types]
    for first in range(0, rows, block):
        part = slice(first, first + block)
        file.write(times_of(rows)[part], [column[part] for column in columns])
        file.flush()


def same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    return one.tolist() == other.tolist() if one.dtype == object else one.tobytes() == other.tobytes()


def assert_rows(path: Path, rows: int, types: Sequence[VariableType]) -> None:
    """A file has the first rows, bit by bit."""
    result = fmu_mesh.Result.read(path)
    assert same(result.times, times_of(rows))
    assert list(result) == [f"it.{type_}" for type_ in types]
    for type_ in types:
        assert same(result[f"it.{type_}"], values_of(type_, rows)), type_
        assert result.units[f"it.{type_}"] == ("rad" if is_float(type_) else None)


@ALL_FORMATS
@pytest.mark.parametrize("rows", [1, 9, 1000])
def test_values_of_all_types_are_read_as_they_were_written(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType], rows: int
) -> None:
    file = format_.open(tmp_path / name, recording(types))

    write(file, types, rows, block=7)
    file.close()

    assert file.rows == rows
    assert_rows(tmp_path / name, rows, types)
    assert {path.name for path in tmp_path.iterdir()} - {"a.csv.json"} == {name}


@ALL_FORMATS
def test_metadata_and_notes_are_read_back(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType]
) -> None:
    file = format_.open(tmp_path / name, recording(types))

    file.note(SET)
    write(file, types, 10, block=5)
    file.note({**SET, "value": [1, "two"]})
    file.note(END)
    file.close()

    assert fmu_mesh.Result.read(tmp_path / name).metadata == {
        **METADATA,
        "set": [SET, {**SET, "value": [1, "two"]}],
        **END,
    }


@ALL_FORMATS
def test_without_a_row_nothing_changes(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType]
) -> None:
    (tmp_path / name).write_text("the last result")

    file = format_.open(tmp_path / name, recording(types))
    file.note(SET)
    file.flush()
    file.close()

    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "the last result"


@ALL_FORMATS
def test_a_second_run_is_refused_by_the_name_of_the_result(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType]
) -> None:
    first = format_.open(tmp_path / name, recording(types))
    write(first, types, 10, block=5)

    with pytest.raises(ConfigurationError, match="another run is writing the result file") as raised:
        format_.open(tmp_path / name, recording(types))
    with pytest.raises(ConfigurationError, match="another run is writing the result file"):
        fmu_mesh.recover(tmp_path / name)
    first.close()

    assert f"'{tmp_path / name}'" in str(raised.value)
    assert_rows(tmp_path / name, 10, types)


@ALL_FORMATS
def test_the_rows_of_a_run_that_goes_on_can_be_read(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType]
) -> None:
    file = format_.open(tmp_path / name, recording(types))
    write(file, types, 20, block=5)
    file.note(SET)
    file.flush()

    assert_rows(tmp_path / name, 20, types)
    assert fmu_mesh.Result.read(tmp_path / name).metadata["set"] == [SET]
    file.close()


@pytest.mark.parametrize(
    ("format_", "name", "step", "total"), [(ParquetFile, "a.parquet", 1, 3), (McapFile, "a.mcap", 29, 12)]
)
def test_a_file_that_is_cut_off_anywhere_keeps_its_whole_rows(
    tmp_path: Path, format_: ResultFormat, name: str, step: int, total: int
) -> None:
    """A stream of Parquet at every byte, an MCAP at some."""
    types: list[VariableType] = ["Float64", "String"]
    file = format_.open(tmp_path / name, recording(types))
    kept: list[tuple[int, int]] = [(0, 0)]
    for row in range(total):
        part = slice(row, row + 1)
        file.note({**SET, "point": row})
        file.write(times_of(total)[part], [values_of(type_, total)[part] for type_ in types])
        file.flush()
        kept.append((file.kept.size, row + 1))
    whole = format_.growing_file(tmp_path / name).read_bytes()
    file.close()
    path = tmp_path / "cut" / name
    path.parent.mkdir()

    rows = 0
    for size in (*range(0, len(whole), step), len(whole)):
        format_.growing_file(path).write_bytes(whole[:size])
        least = max(rows for end, rows in kept if end <= size)

        if not least:  # its heading may not be complete
            with suppress(ConfigurationError):
                fmu_mesh.recover(path)
            continue
        rows = fmu_mesh.recover(path)

        assert rows >= least
        assert_rows(path, rows, types)
        noted = [entry["point"] for entry in fmu_mesh.Result.read(path).metadata["set"]]
        assert noted == list(range(len(noted)))
        assert len(noted) >= rows
        path.unlink()
    assert rows == total


def test_a_recovered_bag_has_its_index_and_the_sums_are_right(tmp_path: Path) -> None:
    types: list[VariableType] = ["Float64", "Int32"]
    path = tmp_path / "a.mcap"
    file = McapFile.open(path, recording(types))
    write(file, types, 100, block=10)
    whole = path.read_bytes()
    file.close()
    path.write_bytes(whole[:-100])

    rows = fmu_mesh.recover(path)

    with path.open("rb") as bag:
        reader = make_reader(bag, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages())
        records = [record.name for record in reader.iter_metadata()]
    assert summary is not None
    assert summary.statistics is not None
    assert rows in (90, 100)
    assert summary.statistics.message_count == len(messages)
    assert sum(channel.topic != "/clock" for _, channel, _ in messages) == 2 * rows
    assert records == ["fmu_mesh", "fmu_mesh.rows"]
    assert_rows(path, rows, types)


def test_a_recovered_bag_of_every_third_point_has_its_last_rows(tmp_path: Path) -> None:
    types: list[VariableType] = ["Float64", "Int32"]
    path = tmp_path / "a.mcap"
    file = McapFile.open(path, msgspec.structs.replace(recording(types), first=2, every=3))
    times = times_of(62)[2::3]
    file.write(times, [values_of(type_, 20) for type_ in types])
    file.flush()
    whole = path.read_bytes()
    file.close()
    path.write_bytes(whole)

    rows = fmu_mesh.recover(path)

    result = fmu_mesh.Result.read(path)
    assert rows == 20
    assert same(result.times, times)
    for type_ in types:
        assert same(result[f"it.{type_}"], values_of(type_, 20)), type_


@FORMATS
def test_a_complete_file_is_not_changed_by_recover(tmp_path: Path, format_: ResultFormat, name: str) -> None:
    file = format_.open(tmp_path / name, recording())
    write(file, TYPES, 10, block=5)
    file.close()
    before = (tmp_path / name).read_bytes()

    assert fmu_mesh.recover(tmp_path / name) == 10
    assert main(["recover", str(tmp_path / name)]) == 0

    assert (tmp_path / name).read_bytes() == before


@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.mcap"])
def test_what_is_no_result_file_is_left_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / name).write_text("something else\nthat is no result")

    codes = main(["recover", str(tmp_path / name)]), main(["recover", str(tmp_path / f"missing-{name}")])

    errors = capsys.readouterr().err
    assert codes == (2, 2)
    assert "is no result file" in errors
    assert f"missing-{name}' does not exist" in errors
    assert (tmp_path / name).read_text() == "something else\nthat is no result"
    with pytest.raises(ConfigurationError, match="is no result file"):
        fmu_mesh.Result.read(tmp_path / name)


def test_the_json_beside_a_csv_is_valid_after_every_note(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    file = CsvFile.open(path, recording())
    entries: list[dict[str, Any]] = [SET, END, {**SET, "value": "x" * 500}, {"end": {"point": 1}}, SET]
    write(file, TYPES, 3, block=3)

    for count in range(len(entries) + 1):
        text = json.loads((tmp_path / "a.csv.json").read_text())
        assert text == {"set": [], **with_notes(METADATA, entries[:count])}
        if count < len(entries):
            file.note(entries[count])

    file.close()
    assert fmu_mesh.Result.read(path).metadata == with_notes(METADATA, entries)


def test_pandas_and_pyarrow_read_a_parquet_file_with_its_types_and_units(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    file = ParquetFile.open(path, recording())
    write(file, TYPES, 100, block=100)
    file.close()

    frame = pd.read_parquet(path)
    schema = parquet.read_schema(path)
    about = parquet.read_metadata(path).metadata

    assert frame["time"].tolist() == times_of(100).tolist()
    for type_ in NUMBERS:
        assert same(frame[f"it.{type_}"].to_numpy(), values_of(type_, 100)), type_
    assert schema.field("it.Float32").metadata[b"unit"] == b"rad"
    assert schema.field("it.Enumeration").metadata[b"type"] == b"Enumeration"
    assert msgspec.json.decode(about[b"fmu_mesh"]) == METADATA
    assert fmu_mesh.Result.read(path).units["it.Float64"] == "rad"


@pytest.mark.parametrize(
    ("format_", "name", "types"),
    [(CsvFile, "a.csv", TYPES), (ParquetFile, "a.parquet", TYPES), (ParquetFile, "a.parquet", ["Float64"])],
)
@pytest.mark.parametrize("rows", [1, 20])
def test_arrays_are_read_element_by_element_as_they_were_written(
    tmp_path: Path, format_: ResultFormat, name: str, types: list[VariableType], rows: int
) -> None:
    recording = arrays_recording(types)
    columns = arrays_of(recording, rows)
    file = format_.open(tmp_path / name, recording)

    for first in range(0, rows, 7):
        part = slice(first, first + 7)
        file.write(times_of(rows)[part], [column[part] for column in columns.values()])
        file.flush()
    growing = fmu_mesh.Result.read(tmp_path / name)
    file.close()

    whole = fmu_mesh.Result.read(tmp_path / name)
    for result in (growing, whole):
        assert list(result) == list(columns)
        assert all(same(result[name], column) for name, column in columns.items())
        assert result.units == {name: "rad" if "Float" in name else None for name in columns}
    assert whole.compare(growing)


def test_parquet_has_an_array_as_one_column_of_lists(tmp_path: Path) -> None:
    path, recording = tmp_path / "a.parquet", arrays_recording(["Float64", "Int8"])
    columns = arrays_of(recording, 5)
    file = ParquetFile.open(path, recording)
    file.write(times_of(5), list(columns.values()))
    file.close()

    table = parquet.read_table(path)

    assert table.schema.names == ["time", "it.Float64", "it.Int8", "it.part[1]", "it.part[2]"]
    assert table.schema.field("it.Float64").type == pa.list_(pa.field("element", pa.float64(), nullable=False), 6)
    assert table.schema.field("it.Int8").metadata[b"dimensions"] == b"[2,3]"
    rows = np.array(table["it.Int8"].to_pylist(), np.int8)
    assert rows.tolist() == np.stack([columns[f"it.Int8[{i},{j}]"] for i in (1, 2) for j in (1, 2, 3)], 1).tolist()
    encodings = parquet.read_metadata(path).row_group(0).column(1).encodings
    assert "BYTE_STREAM_SPLIT" in encodings


def test_elements_of_lists_are_curves_and_scenarios(tmp_path: Path) -> None:
    path, recording = tmp_path / "a.parquet", arrays_recording(["Float64"])
    file = ParquetFile.open(path, recording)
    columns = {name: np.arange(9.0) + place for place, (name, _) in enumerate(recording.columns)}
    file.write(times_of(9), list(columns.values()))
    file.flush()
    tail = ParquetTail.open(path, ParquetFile.growing_file(path))
    assert tail is not None
    growing = tail.read(["it.part[1]", "it.Float64[2,1]"])
    file.close()

    assert tail.read(["it.Float64[2,1]"]) is None
    again = ParquetTail.open(path, ParquetFile.growing_file(path))
    assert again is not None
    source = SeriesFile(str(path), content_of(path), "time", "it.Float64[2,1]")
    series = read_series(source, Variable("u", 0, "Float64", "input", "continuous"))

    assert list(again.names) == columns_of(path)[1:] == list(columns)
    assert growing is not None
    assert all(same(growing.values[name], columns[name]) for name in ("it.part[1]", "it.Float64[2,1]"))
    whole = again.read(["it.Float64[2,1]"])
    assert whole is not None
    assert whole.values["it.Float64[2,1]"].tolist() == columns["it.Float64[2,1]"].tolist() == series[1]
    tail.close()
    again.close()


def test_a_stream_with_lists_is_recovered(tmp_path: Path) -> None:
    path, recording = tmp_path / "a.parquet", arrays_recording(TYPES)
    columns = arrays_of(recording, 6)
    file = ParquetFile.open(tmp_path / "b.parquet", recording)
    for row in range(6):
        file.write(times_of(6)[row : row + 1], [column[row : row + 1] for column in columns.values()])
        file.flush()
    whole = ParquetFile.growing_file(tmp_path / "b.parquet").read_bytes()
    file.close()
    ParquetFile.growing_file(path).write_bytes(whole[:-100])

    assert fmu_mesh.recover(path) == 5

    result = fmu_mesh.Result.read(path)
    assert all(same(result[name], column[:5]) for name, column in columns.items())


def test_a_file_with_a_column_for_each_element_is_still_read(tmp_path: Path) -> None:
    path = tmp_path / "old.parquet"
    names = ["it.y[1,1]", "it.y[1,2]"]
    fields = [pa.field("time", pa.float64())] + [pa.field(name, pa.float64(), metadata={"unit": "m"}) for name in names]
    values = [pa.array([0.0, 0.1]), pa.array([-0.0, math.inf]), pa.array([math.nan, 2.0])]
    pq.write_table(pa.Table.from_arrays(values, schema=pa.schema(fields)), path)

    result = fmu_mesh.Result.read(path)

    assert list(result) == names
    assert result.units == dict.fromkeys(names, "m")
    assert same(result["it.y[1,1]"], np.array([-0.0, math.inf]))
    assert same(result["it.y[1,2]"], np.array([math.nan, 2.0]))


@pytest.mark.parametrize("dimensions", ["[4]", "[1000000,1000000]", "nonsense", "[-2,-1]"])
def test_lists_of_other_dimensions_are_refused(tmp_path: Path, dimensions: str) -> None:
    path = tmp_path / "wrong.parquet"
    lists = pa.array([[1.0, 2.0]], pa.list_(pa.float64(), 2))
    fields = [pa.field("time", pa.float64()), pa.field("y", lists.type, metadata={"dimensions": dimensions})]
    pq.write_table(pa.Table.from_arrays([pa.array([0.0]), lists], schema=pa.schema(fields)), path)

    with pytest.raises(ConfigurationError, match="is no result file"):
        fmu_mesh.Result.read(path)
    assert ParquetTail.open(path, tmp_path / "none") is None


def test_a_file_of_another_program_may_have_nulls_and_a_name_twice(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    columns = {
        "time": pa.array([0.0, 1.0, 2.0, 3.0]),
        "whole": pa.array([1, 2, None, 4]),
        "flag": pa.array([True, None, False, True]),
        "x": pa.array([1.0, 2.0, 3.0, None]),
    }
    names = [*columns, "x"]
    table = pa.Table.from_arrays([*columns.values(), pa.array([5.0, 6.0, 7.0, 8.0])], names=names)
    pq.write_table(table, path, row_group_size=2)

    result = fmu_mesh.Result.read(path)

    assert np.array_equal(result["whole"], [1, 2, np.nan, 4], equal_nan=True)
    assert result["flag"].tolist() == [True, None, False, True]
    assert result["x"].tolist() == [5.0, 6.0, 7.0, 8.0]


THREADS = """
import os, sys
from pathlib import Path
import pyarrow.parquet
from fmu_mesh import Result
from fmu_mesh.results.parquet_tail import ParquetTail
from fmu_mesh.results.parquet_file import ParquetFile
from fmu_mesh.system.series_files import SeriesFile, content_of, read_series
from fmu_mesh.variables.model_description import Variable

def threads():
    return len(os.listdir("/proc/self/task"))

path, before = Path(sys.argv[1]), threads()
assert Result.read(path).compare(Result.read(path))
assert ParquetFile.keep_whole_rows(path, (0, 0)) == 200_000
tail = ParquetTail.open(path, path.with_suffix(".none"))
assert tail.read(["it.Float64"]) is not None
file = SeriesFile(str(path), content_of(path), "time", "it.Float64")
assert len(read_series(file, Variable("u", 0, "Float64", "input", "continuous"))[0]) == 200_000
assert threads() == before, os.listdir("/proc/self/task")
"""


def test_reading_parquet_starts_no_thread(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    types: list[VariableType] = ["Float64", "Int32"]
    file = ParquetFile.open(path, recording(types))
    file.write(times_of(200_000), [np.full(200_000, 0.5), np.arange(200_000, dtype=np.int32)])
    file.close()

    # A thread of pyarrow that waits for the lock of Python at the end of the interpreter ends the process with 134.
    subprocess.run([sys.executable, "-c", THREADS, path], check=True, timeout=300)


def test_row_groups_are_bounded_and_small_batches_become_large_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet_file, "_GROUP_ROWS", 5000)
    path, types = tmp_path / "a.parquet", ["Float64", "String"]
    file = ParquetFile.open(path, recording(types))  # type: ignore[arg-type]  # literals

    write(file, types, 12_000, block=3)  # type: ignore[arg-type]  # literals
    file.close()

    content = parquet.read_metadata(path)
    assert [content.row_group(number).num_rows for number in range(content.num_row_groups)] == [5000, 5000, 2000]
    assert_rows(path, 12_000, types)  # type: ignore[arg-type]  # literals


def test_a_draft_that_cannot_be_written_costs_no_row(tmp_path: Path) -> None:
    path, in_the_way = tmp_path / "a.parquet", tmp_path / "a.unfinished.parquet"
    file = ParquetFile.open(path, recording())
    in_the_way.mkdir()

    with pytest.raises(IsADirectoryError):
        write(file, TYPES, 10, block=5)
    in_the_way.rmdir()
    file.write(times_of(10)[5:], [values_of(type_, 10)[5:] for type_ in TYPES])
    file.close()

    assert_rows(path, 10, TYPES)


def test_long_texts_are_written_in_batches_of_bounded_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet_file, "_BLOCK_BYTES", 1000)
    path = tmp_path / "a.parquet"
    file = ParquetFile.open(path, recording(["Binary"]))
    values = np.array([bytes(size) for size in (10, 2000, 600, 600, 0, 0, 10)], object)

    file.write(times_of(7), [values])

    with pa.ipc.open_stream(ParquetFile.growing_file(path)) as stream:
        sizes = [batch.num_rows for batch in stream]
    file.close()
    assert sizes == [1, 1, 1, 4]
    assert fmu_mesh.Result.read(path)["it.Binary"].tolist() == values.tolist()


def test_a_missing_package_is_told_by_check_and_by_reading(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    config = write_config(tmp_path, record={"file": "pair.parquet"})

    codes = main(["check", str(config)]), main(["plot", str(tmp_path / "a.parquet")])

    told = "results in .parquet need the library pyarrow. "
    told += f"Install it with `{sys.executable} -m pip install 'pyarrow>=17'`."
    assert codes == (2, 2)
    assert capsys.readouterr().err.count(told) == 2


def test_a_draft_that_a_killed_run_has_left_is_replaced(tmp_path: Path) -> None:
    path, types = tmp_path / "a.parquet", TYPES
    file = ParquetFile.open(path, recording(types))
    write(file, types, 30, block=10)
    for beside in ("a.parquet.arrows", "a.unfinished.parquet"):
        (tmp_path / "killed").mkdir(exist_ok=True)
        (tmp_path / "killed" / beside).write_bytes((tmp_path / beside).read_bytes())
    file.close()

    rows = ParquetFile.keep_whole_rows(tmp_path / "killed" / "a.parquet", Kept(10, 1))

    assert rows == 30
    assert_rows(tmp_path / "killed" / "a.parquet", 30, types)
    assert [path.name for path in (tmp_path / "killed").iterdir()] == ["a.parquet"]


@pytest.mark.parametrize("name", ["result.parquet", "result.csv"])
def test_a_run_of_all_types_gives_the_same_from_file_and_memory(tmp_path: Path, name: str) -> None:
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=2.0)
    mesh.add("it", fmu=find_fmu("AllTypes3", tmp_path))
    memory = mesh.run(record="memory", processes=False)

    mesh.run(output=tmp_path / name, processes=False)

    result = fmu_mesh.Result.read(tmp_path / name)
    assert list(result) == list(memory)
    assert same(result.times, memory.times)
    for column in memory:
        if name.endswith(".csv"):
            assert result[column].tolist() == memory[column].tolist()
        else:
            assert same(result[column], memory[column]), column
            assert result.units[column] == memory.units[column]
