"""Compares the result of a run with the rows of the reference: every column and every bit."""

from __future__ import annotations

import csv
import struct
from collections.abc import Sequence
from pathlib import Path

from tests.ssp.reference_run import Row
from tests.ssp.reference_system import End, Value, name_of

__all__ = ["differences"]


def differences(result: Path, outputs: Sequence[End], rows: Sequence[Row]) -> list[str]:
    """What differs between a result file and the rows of the reference, in words; for each column the first point.

    A file that records all outputs has numbers only, so that those of type String are missing.

    Args:
        result: the CSV file that `fmu-mesh launch` has written.
        outputs: the columns of the reference after the time.
        rows: its rows.
    """
    with result.open(newline="", encoding="utf-8") as file:
        header, *lines = csv.reader(file)
    names = ["time", *(f"{name_of(path)}.{name}" for path, name in outputs)]
    found = [f"{name} is not expected" for name in header if name not in names]
    if len(lines) != len(rows):
        found.append(f"{len(lines)} rows; the reference has {len(rows)}")
    for number, name in enumerate(names):
        if name not in header:
            if not isinstance(rows[0][number], str):
                found.append(f"{name} is missing")
            continue
        column = header.index(name)
        for point, (line, row) in enumerate(zip(lines, rows, strict=False)):
            if not _same(line[column], row[number]):
                found.append(f"{name} at point {point} is {line[column]}; the reference has {row[number]}")
                break
    return found


def _same(cell: str, value: Value) -> bool:
    match value:
        case bool():
            return cell == str(value).lower()
        case int():
            return int(cell) == value
        case float():
            return struct.pack("<d", float(cell)) == struct.pack("<d", value)
        case _:
            return cell == value
