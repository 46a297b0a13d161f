"""Which attempt of a run this is: a run that loses a process may start again."""

from __future__ import annotations

import msgspec

__all__ = ["Attempt"]


class Attempt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An attempt of a run, as one of its processes knows it.

    Attributes:
        number: 1 for the first one.
        most: how many there may be; 1: the run never starts again.
        replays_to: the last point that was seen in those before, or of the run that is resumed; up to it, the run is
            as it was.
        journal: the file with what this process was given from outside; empty: there is none.
        plays_to: the point up to which it plays its rows, and at which it loads its states; 0: it plays none.
        rows: the file with these rows.
    """

    number: int = 1
    most: int = 1
    replays_to: int = 0
    journal: str = ""
    plays_to: int = 0
    rows: str = ""

    @property
    def may_be_followed(self) -> bool:
        """Whether there is another one if a process is lost."""
        return self.number < self.most

    def __str__(self) -> str:
        if self.number > 1:
            return f"attempt {self.number} of {self.most}, from point {self.replays_to}"
        return f"resumed, from point {self.replays_to}" if self.replays_to else ""
