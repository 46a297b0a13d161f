"""Result formats: found by the ending of the file, among all that installed packages offer."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh import plugins
from fmu_mesh.cli.main import main
from fmu_mesh.errors import ConfigurationError
from fmu_mesh.files import Kept
from fmu_mesh.results.csv_file import CsvFile
from fmu_mesh.results.formats import result_endings, result_format
from fmu_mesh.results.parquet_file import ParquetFile
from fmu_mesh.results.record_files import rows_left
from fmu_mesh.results.recording import ResultFile, ResultFormat
from fmu_mesh.ros.bags.mcap_file import McapFile
from tests.helpers import write_config

Offer = Callable[..., None]

FORMATS: list[ResultFormat] = [CsvFile, McapFile, ParquetFile]
OPENED: list[type[ResultFile]] = [CsvFile, McapFile, ParquetFile]
"""The type checker sees here that all keep the contract."""


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """Installs a package that offers a format under an ending."""

    def install(package: str, ending: str, target: str, group: str = "fmu_mesh.recorders") -> None:
        folder = tmp_path / package
        information = folder / f"{package}-1.0.dist-info"
        information.mkdir(parents=True)
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (information / "entry_points.txt").write_text(f"[{group}]\n{ending} = {target}\n")
        monkeypatch.syspath_prepend(folder)

    return install


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a.csv", CsvFile),
        ("a.CSV", CsvFile),
        ("a", CsvFile),
        ("a.txt", CsvFile),
        ("a.2", CsvFile),
        ("a.mcap", McapFile),
        ("a.parquet", ParquetFile),
    ],
)
def test_the_ending_of_its_name_chooses_the_format_of_a_result_file(name: str, expected: ResultFormat) -> None:
    assert result_format(f"/results/{name}") is expected


def test_a_format_of_another_package_is_found_by_its_ending(offer: Offer) -> None:
    offer("tables", "table", "fmu_mesh.results.csv_file:CsvFile")

    assert result_format("a.table") is CsvFile
    assert result_endings() == [".csv", ".mcap", ".parquet", ".table"]


def test_only_our_own_entry_points_are_read_for_a_format_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    def scan(**_: str) -> None:
        raise AssertionError("all distributions are read")

    monkeypatch.setattr(metadata, "entry_points", scan)

    assert result_format("a.csv") is CsvFile
    with pytest.raises(AssertionError):
        result_format("a.table")


def test_an_ending_that_nobody_offers_is_finding_that_lists_what_is_installed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], offer: Offer
) -> None:
    offer("tables", "table", "fmu_mesh.results.csv_file:CsvFile")
    config = write_config(tmp_path, record={"file": "pair.feather"})

    codes = main(["check", str(config)]), main(["launch", str(config), "--output", "pair.json"])

    errors = capsys.readouterr().err
    assert codes == (2, 2)
    expected = "expected a name ending in .csv or .mcap or .parquet or .table"
    assert f"'pair.feather', a format that is not written; {expected}" in errors
    assert "--output pair.json: " in errors


def test_two_packages_with_one_ending_are_both_named(offer: Offer) -> None:
    offer("tables", "table", "fmu_mesh.results.csv_file:CsvFile")
    offer("more-tables", "table", "fmu_mesh.results.csv_file:CsvFile")

    with pytest.raises(ConfigurationError, match=r"the packages 'more-tables', 'tables' both offer 'table'"):
        result_format("a.table")


def test_a_package_that_cannot_be_imported_is_named_with_the_cause(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], offer: Offer
) -> None:
    offer("tables", "table", "no_such_module:Table")
    config = write_config(tmp_path, record={"file": "pair.table"})

    assert main(["check", str(config)]) == 2

    error = capsys.readouterr().err
    assert "'table' of the package 'tables' cannot be imported from 'no_such_module:Table'" in error
    assert "ModuleNotFoundError: No module named 'no_such_module'" in error


def test_a_format_of_ours_cannot_be_replaced(offer: Offer) -> None:
    offer("tables", "csv", "no_such_module:Table")

    assert result_format("a.csv") is CsvFile


def test_installation_that_is_older_than_its_source_says_how_to_install_again() -> None:
    with pytest.raises(ConfigurationError, match="older than its source") as raised:
        plugins.plugin("fmu_mesh.not_yet", "csv")

    assert raised.value.hint == f"Install it again, as you did before, from {Path(__file__).parents[2]}."


def test_a_package_that_reads_a_file_at_once_is_still_understood(tmp_path: Path, offer: Offer) -> None:
    offer("tables", "table", "table_of_a_package:Table")
    (tmp_path / "tables" / "table_of_a_package.py").write_text(
        "import numpy as np\nfrom fmu_mesh.results.recording import Columns\n\n"
        "class Table:\n    def read(path):\n        return Columns(np.zeros(1), {'a.x': np.ones(1)})\n"
    )

    with pytest.warns(DeprecationWarning, match=r"Table.*becomes pieces\(path, types\)"):
        result = fmu_mesh.Result.read(tmp_path / "some.table")

    assert result["a.x"].tolist() == [1.0]


@pytest.mark.parametrize(("noted", "rows"), [((2, 3), 2), ((2, 1000), 0), (None, 0)])
def test_rows_of_killed_process_count_only_in_file_that_it_has_written(
    tmp_path: Path, noted: tuple[int, int] | None, rows: int
) -> None:
    result = tmp_path / "a.csv"
    result.write_bytes(b"abc")
    if noted is not None:
        (tmp_path / "recorded").write_bytes(struct.pack("<qq", *noted))

    assert rows_left([str(result)], tmp_path) == ((str(result), rows),)

    assert result.read_bytes() == b"abc"


def test_a_device_keeps_no_rows(tmp_path: Path) -> None:
    (tmp_path / "recorded").write_bytes(struct.pack("<qq", 2, 3))

    assert rows_left([os.devnull], tmp_path) == ((os.devnull, 0),)


def test_no_more_rows_follow_the_known_rows_than_are_reported(tmp_path: Path) -> None:
    """The writer was killed after it wrote more than it had noted, perhaps within a row."""
    path = tmp_path / "killed"
    whole = b"time,a.x\n0.0,1.0\n0.5,2.0\n"
    path.write_bytes(whole + b"1.0,")

    assert CsvFile.keep_whole_rows(path, Kept(2, len(whole))) == 2

    assert path.read_bytes() == whole
