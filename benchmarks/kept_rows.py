"""The rows of a result: how many a file has by now, and how they differ from those of another result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Differences", "GrowingFile", "differences", "first_difference", "other_values"]


class GrowingFile:
    """The rows of a CSV file that grows, and may be begun again or cut; only what is new is read.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at, self._lines, self._number = 0, 0, 0

    @property
    def rows(self) -> int:
        """How many whole rows there are by now, without the header."""
        try:
            with self.path.open("rb") as file:
                facts = Path(f"/proc/self/fd/{file.fileno()}").stat()
                if facts.st_ino != self._number or facts.st_size < self._at:
                    self._at, self._lines, self._number = 0, 0, facts.st_ino
                file.seek(self._at)
                new = file.read()
        except FileNotFoundError:
            return 0
        self._at += len(new)
        self._lines += new.count(b"\n")
        return max(0, self._lines - 1)

    def recounted(self) -> int:
        """As `rows`, from its first byte: between two looks it may have been cut, and have grown again."""
        self._number = 0
        return self.rows


@dataclass(frozen=True)
class Differences:
    """What is wrong with a result: rows without a time of the undisturbed result, or with one twice, or other bytes."""

    lost: int = 0
    doubled: int = 0
    other: bool = False


def differences(expected: bytes, found: bytes) -> Differences:
    """Compare two results row by row; the first column of a row is its time."""
    if expected == found:
        return Differences()
    wanted, times = ([row.split(b",")[0] for row in content.splitlines()[1:]] for content in (expected, found))
    return Differences(len({*wanted} - {*times}), len(times) - len({*times}), other=True)


def first_difference(expected: bytes, found: bytes) -> str:
    """In words, where two results differ first."""
    wanted, got = expected.splitlines(), found.splitlines()
    for number, (one, other) in enumerate(zip(wanted, got, strict=False), 1):
        if one != other:
            return f"line {number} is {other[:200].decode()}, not {one[:200].decode()}"
    return f"{len(got)} lines, not {len(wanted)}"


def other_values(expected: Mapping[str, Mapping[str, bytes]], found: Mapping[str, Mapping[str, bytes]]) -> list[str]:
    """In words, which results have other values than those of the undisturbed run."""
    told = []
    for name, values in expected.items():
        wrong = [own for own in values if found[name].get(own) != values[own]]
        if wrong:
            rows, others = (len(one[name]["time"]) // 8 for one in (expected, found))
            told.append(f"{name} has {others} rows of {rows}, and other values of {', '.join(wrong)}")
    return told
