"""Whether a contestant's values are those of the reference: with ``==`` on every float."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from benchmarks.task import Outcome, System

__all__ = ["Reference", "compare"]


@dataclass(frozen=True)
class Reference:
    """The outputs of all instances at every point, and the value of each connected input in Initialization Mode."""

    rows: list[list[float]]
    initial_inputs: tuple[float | None, ...]


def compare(system: System, reference: Reference, outcome: Outcome, points: int) -> str:
    """In words how an outcome compares with the reference, with ``==`` on every float."""
    names = [member.column for member in system.members]
    if outcome.result_file is not None:
        return _compare_file(names, reference, Path(outcome.result_file), system.step_size, points)
    if not outcome.last:
        return "nothing to see"
    for name, expected in zip(names, reference.rows[points], strict=True):
        if outcome.last[name] != expected:
            return f"DIFFERS: {name} is {outcome.last[name]!r} at the end, not {expected!r}"
    return "last values equal"


def _compare_file(names: list[str], reference: Reference, file: Path, step_size: float, points: int) -> str:
    with file.open(newline="") as lines:
        rows = csv.reader(lines)
        header = next(rows)
        columns = [header.index(name) for name in names]
        count = 0
        for point, row in enumerate(rows):
            count += 1
            if point > points or float(row[0]) != point * step_size:
                return f"DIFFERS: row {point} has time {row[0]}"
            for name, column, expected in zip(names, columns, reference.rows[point], strict=True):
                if float(row[column]) != expected:
                    return f"DIFFERS: {name} is {row[column]} at point {point}, not {expected!r}"
    return "all points equal" if count == points + 1 else f"DIFFERS: {count} rows, not {points + 1}"
