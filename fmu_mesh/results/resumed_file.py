"""A result file of a run that starts again: its rows are compared with those that are there, and others follow them.

Knows no format but by its contract, and not why the run starts again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigurationError, NotDeterministic
from ..files import Kept, is_file
from ..text import shown
from .formats import required_format, result_pieces
from .recording import Columns, Recording, ResultFile, Resumable

__all__ = ["opened_again"]


def opened_again(path: Path, recording: Recording, rows: int) -> ResultFile:
    """Open a result file that has ``rows`` rows of this run; of a format that cannot go on, it begins again.

    The errors are those of `ResultFormat.open`.
    """
    format_: Any = required_format(path)
    file: ResultFile = format_.open(path, recording)
    if not rows or not is_file(path) or not hasattr(file, "resume"):
        return file
    return ResumedFile(file, recording, rows, rounds=getattr(format_, "rounds", False))


class ResumedFile:
    """A `ResultFile` around that of a format: until it has its first new row, the file stays as it is.

    Args:
        file: it, open.
        rows: number of rows in it.
        rounds: whether a value in it may be rounded to 32 bits.
    """

    def __init__(self, file: ResultFile, recording: Recording, rows: int, *, rounds: bool) -> None:
        self._file, self._recording, self._rows, self._rounds = file, recording, rows, rounds
        self._there = Kept(rows, file.path.stat().st_size)
        self._compared = 0
        self._begun = False
        self._notes: list[Mapping[str, Any]] = []
        types = dict(recording.columns)
        self._pieces: Iterator[Columns] = result_pieces(file.path, types)
        self._piece = Columns(np.zeros(0), {})
        self._used = 0

    @property
    def path(self) -> Path:
        """See `ResultFile`."""
        return self._file.path

    @property
    def rows(self) -> int:
        """See `ResultFile`."""
        return self._file.rows if self._begun else self._rows

    @property
    def kept(self) -> Kept:
        """See `ResultFile`."""
        return self._file.kept if self._begun else self._there

    def write(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> None:
        """Compare the rows that are there, and append the others.

        Raises:
            NotDeterministic: a value is another one; nothing has changed.
        """
        count, done = min(len(times), self._rows - self._compared), 0
        while done < count:
            done += self._compare(times[done:count], [column[done:count] for column in columns])
        if count < len(times):
            if not self._begun:
                self._pieces = iter(())
                cast("Resumable", self._file).resume(self._rows)
                self._begun = True
                for entry in self._notes:
                    self._file.note(entry)
            self._file.write(times[count:], [column[count:] for column in columns])

    def note(self, entry: Mapping[str, Any]) -> None:
        """See `ResultFile`."""
        if self._begun:
            self._file.note(entry)
        else:
            self._notes.append(entry)

    def flush(self) -> None:
        """See `ResultFile`."""
        if self._begun:
            self._file.flush()

    def close(self) -> None:
        """See `ResultFile`."""
        self._pieces = iter(())
        self._file.close()

    def _compare(self, times: NDArray[np.float64], columns: Sequence[NDArray[Any]]) -> int:
        """Compare rows up to the end of a piece of the file; returns their number."""
        while self._used == len(self._piece.times):
            self._piece, self._used = next(self._pieces, None) or self._too_short(), 0
        count = min(len(times), len(self._piece.times) - self._used)
        rows = slice(self._used, self._used + count)
        differences = []
        for place, (name, _) in enumerate(self._recording.columns):
            before, after = self._piece.values[name][rows], columns[place][:count]
            if len(wrong := np.flatnonzero(~self._same(before, after))):
                differences.append((int(wrong[0]), place, before[wrong[0]], after[wrong[0]]))
        if differences:
            row, place, before, after = min(differences, key=lambda own: own[:2])
            raise self._difference(self._compared + row, float(times[row]), place, before, after)
        self._used, self._compared = self._used + count, self._compared + count
        return count

    def _same(self, before: NDArray[Any], after: NDArray[Any]) -> NDArray[np.bool_]:
        """Where two columns have the same values, and the same sign of zero; NaN is NaN."""
        same: NDArray[np.bool_] = np.asarray(before == after, np.bool_)
        if after.dtype.kind == "f":
            same &= np.signbit(before) == np.signbit(after)
            same |= np.isnan(before) & np.isnan(after)
            if self._rounds:
                with np.errstate(over="ignore"):
                    same |= after.astype(np.float32) == before
        return same

    def _difference(self, row: int, time: float, place: int, before: object, after: object) -> NotDeterministic:
        instance, variable = self._recording.recorded[place]
        point = self._recording.first + row * self._recording.every
        was, now = (shown(own.item() if isinstance(own, np.generic) else own) for own in (before, after))
        text = f"'{instance}' is not deterministic: point {point}, {instance}.{variable} was {was} before the restart"
        return NotDeterministic(
            f"{text} and {now} after it",
            instance=instance,
            variable=variable,
            point=point,
            time=time,
            hint="Does it read the clock, or random numbers without a fixed seed? Such a run cannot be restarted.",
        )

    def _too_short(self) -> Columns:
        text = f"the result file '{self.path}' has lost rows while the run was restarted"
        raise ConfigurationError(text, hint="Nothing else may write it.")
