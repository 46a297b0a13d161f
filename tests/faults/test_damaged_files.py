"""Files that are damaged, of another kind, or no files: one readable error, and nothing else."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError, Finding, FmuMeshError
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.results.formats import followed
from fmu_mesh.results.parquet_file import ParquetFile
from fmu_mesh.ros.bags.bag import Bag
from fmu_mesh.ros.bags.mcap_file import McapFile
from fmu_mesh.sweeps.sweep_folder import SweepFolder
from fmu_mesh.system.schedule import SeriesFile
from fmu_mesh.system.series_files import SeriesRefused, columns_of, content_of, read_series
from fmu_mesh.variables.model_description import Variable
from fmu_mesh.variables.value_types import VariableType
from tests.helpers import FMUS
from tests.unit.test_result_formats import END, SET, TYPES, recording, write

READABLE: list[VariableType] = [type_ for type_ in TYPES if type_ != "Binary"]
INPUT = Variable("u", 0, "Float64", "input", "continuous")
CONFIG = """
mesh: small
simulation: {stop_time: 1.0, step_size: 0.1}
instances: {gain: {fmu: Gain.fmu}}
"""


def read_result(path: Path) -> None:
    """All that is done with a result file."""
    result = fmu_mesh.Result.read(path)
    assert result.compare(result)
    assert [*result.units, result.metadata, result.summary]


def recover(path: Path) -> None:
    fmu_mesh.recover(path)


def read_table(path: Path) -> None:
    """All that is done with a table of a scenario."""
    names = columns_of(path)
    read_series(SeriesFile(str(path), content_of(path), names[0], names[-1]), INPUT)


def play_bag(path: Path) -> None:
    with Bag(path) as bag:
        assert bag.topics
        [*bag.samples([], "log")]


def follow(path: Path) -> None:
    """What the dashboard reads while a run goes on."""
    if (tail := followed(path)) is not None:
        tail.read(tail.names[:1])
        tail.close()


def read_sweep(path: Path) -> None:
    folder = SweepFolder(path.parent)
    folder.rows()
    folder.wanted()


def result_file(format_: type[CsvFile | ParquetFile | McapFile], path: Path, types: list[VariableType]) -> None:
    """A complete result file with values of all types, metadata and notes."""
    file = format_.open(path, recording(types))
    write(file, types, 40, 7)
    file.note(SET)
    file.note(END)
    file.close()


def damaged(data: bytes, count: int) -> Iterator[bytes]:
    """The data with bytes cut off, changed, put in, taken out or doubled; always the same ones."""
    chance = random.Random(len(data))  # noqa: S311  no secret
    for _ in range(count):
        bad = bytearray(data)
        for _ in range(chance.choice((1, 1, 2, 8))):
            at, length = chance.randrange(len(bad) + 1), chance.choice((1, 2, 8, 64))
            match chance.randrange(5):
                case 0:
                    del bad[at:]
                case 1:
                    bad[at : at + 1] = bytes([chance.randrange(256)])
                case 2:
                    bad[at:at] = chance.choice((b'"', b",", b"\n", b"\xff", b"\0" * 9, b"[" * 2000, b"1e999", b"-"))
                case 3:
                    del bad[at : at + length]
                case _:
                    bad[at:at] = bad[at : at + length]
        yield bytes(bad)


@pytest.mark.parametrize(
    ("format_", "name", "beside", "count"),
    [
        (CsvFile, "a.csv", "a.csv", 100),
        (CsvFile, "a.csv", "a.csv.json", 60),
        (ParquetFile, "a.parquet", "a.parquet", 200),
        (ParquetFile, "a.parquet", "a.parquet.arrows", 100),
        (McapFile, "a.mcap", "a.mcap", 30),
    ],
)
def test_a_damaged_result_file_gives_nothing_but_our_errors(
    tmp_path: Path, format_: type[CsvFile | ParquetFile | McapFile], name: str, beside: str, count: int
) -> None:
    path, damage = tmp_path / name, tmp_path / beside
    result_file(format_, path, READABLE)
    if beside.endswith(".arrows"):
        file = ParquetFile.open(path, recording(READABLE))
        write(file, READABLE, 40, 7)
        file.flush()
        shutil.copy(damage, tmp_path / "copy")
        file.close()
        path.unlink()
        (tmp_path / "copy").rename(damage)
    data = damage.read_bytes()
    readers: list[Callable[[Path], None]] = [read_result, recover, follow]
    readers += [play_bag] if name.endswith("mcap") else [read_table]

    for bad in damaged(data, count):
        for reader in readers:
            damage.write_bytes(bad)
            with suppress(FmuMeshError, SeriesRefused):
                reader(path)
            if beside != name:
                path.unlink(missing_ok=True) if beside.endswith(".arrows") else None


def test_a_damaged_sweep_gives_nothing_but_our_errors(tmp_path: Path) -> None:
    texts = {
        "sweep.json": b'{"version": "1.0", "mesh": "m", "file": "m.yaml", "data": {"a": [1, 2]}, "names": ["x"]}',
        "rows.jsonl": b'{"id": "a", "exit_code": 0, "message": "", "values": [1.0, NaN], "seconds": 0.1}\n' * 3,
    }
    for name, text in texts.items():
        for bad in damaged(text, 150):
            (tmp_path / name).write_bytes(bad)
            with suppress(FmuMeshError):
                read_sweep(tmp_path / name)


@pytest.mark.parametrize(
    "text",
    [
        b"time,a.x\n0.0,1.0\n0.1,\xff\n",
        b'time,a.s\n0.0,"open\n0.1,"b"\n0.2,"c"\n',
        b"time,a.x\n0.0,1.0,2.0\n",
        b'time,"a.x\n0.0,1.0\n',
    ],
)
def test_a_damaged_csv_is_refused_with_its_name(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text)

    with pytest.raises(ConfigurationError, match=r"a\.csv' is no result file"):
        fmu_mesh.Result.read(path)


def test_a_csv_of_excel_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b'\xef\xbb\xbftime,a.x,a.flag,a.s\r\n0.0,1.5,true,"one, two"\r\n0.1,2.5,false,"three"\r\n')

    result = fmu_mesh.Result.read(path)

    assert result.times.tolist() == [0.0, 0.1]
    assert result["a.x"].tolist() == [1.5, 2.5]
    assert result["a.flag"].tolist() == [True, False]
    assert result["a.s"].tolist() == ["one, two", "three"]


@pytest.mark.parametrize(
    "command",
    [
        "check pipe.yaml",
        "launch pipe.yaml",
        "plot pipe.csv",
        "compare pipe.csv pipe.csv",
        "compare pipe.parquet pipe.parquet",
        "compare pipe.mcap pipe.mcap",
        "recover pipe.csv",
        "rerun pipe.csv",
        "inspect pipe.fmu",
        "inspect pipe.ssp",
        "convert pipe.ssp a.yaml",
        "play pipe.mcap",
        "check table.yaml",
        "check scenario.yaml",
        "check fmu.yaml",
        "plot beside.csv --output a.png",
    ],
)
def test_a_pipe_in_the_place_of_a_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("pipe.yaml", "pipe.csv", "pipe.parquet", "pipe.mcap", "pipe.fmu", "pipe.ssp", "beside.csv.json"):
        os.mkfifo(name)
    Path("beside.csv").write_text("time,a.x\n0.0,1.0\n", encoding="utf-8")
    text = CONFIG.replace("Gain.fmu", str(FMUS / "Gain.fmu"))
    Path("table.yaml").write_text(text + "scenario: {values: {gain.u: {file: pipe.csv}}}\n", encoding="utf-8")
    Path("scenario.yaml").write_text(text + "scenario: pipe.yaml\n", encoding="utf-8")
    Path("fmu.yaml").write_text(text.replace(str(FMUS / "Gain.fmu"), "pipe.fmu"), encoding="utf-8")

    code = main(command.split())

    assert code == (0 if "beside" in command else 2), capsys.readouterr().err


def test_of_50000_findings_20_and_a_number_are_shown() -> None:
    findings = tuple(Finding("a.yaml", f"x[{number}]", "a", "b", None, number) for number in range(50_000))

    lines = str(ConfigurationError("a.yaml: 50000 problems", findings=findings)).splitlines()

    assert len(lines) == 22
    assert lines[-1].strip() == "and 49,980 more"
