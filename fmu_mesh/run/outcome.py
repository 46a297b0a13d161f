"""How a run ended, as a value: the same for a run in one process, in many, and with a manually started master."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec

from ..errors import ErrorReport, FmuMeshError
from ..system.defect import Defect
from ..system.plan import Plan
from ..wire.time_profile import MeshProfile

__all__ = ["Outcome", "last_recorded", "outcome_at"]


class Outcome(msgspec.Struct, frozen=True, tag="end"):
    """How a run ended; the master also sends it to its launcher, as the last event.

    Attributes:
        state: `done`, or `failed` if there is an error.
        point: the last point that all instances reached.
        time: the simulation time of that point in s.
        seconds: wall-clock time from the first grant to the last point in s.
        rows: number of rows in the first result file.
        file: the first result file; None if nothing was recorded.
        error: why the run failed.
        ended_by: what ended the simulation before its last point although nothing failed.
        profile: where the time went, if that was asked for.
        signal: name of the signal by which the process of the master was asked to end, if it was.
        files: each result file, and the number of its rows.
        warnings: what is wrong although nothing failed: a value that grows without a limit, or how an FMU has ended.
        first: the point at which the run began.
        defects: what came in each connection, compared with what was assumed, if that was asked for.
    """

    state: Literal["done", "failed"]
    point: int
    time: float
    seconds: float
    rows: int
    file: str | None
    error: ErrorReport | None = None
    ended_by: ErrorReport | None = None
    profile: MeshProfile | None = None
    signal: str | None = None
    files: tuple[tuple[str, int], ...] = ()
    warnings: tuple[str, ...] = ()
    first: int = 0
    defects: dict[str, Defect] = {}


def last_recorded(plan: Plan, files: Sequence[tuple[str, int]]) -> int:
    """The last point with a row in one of the files, which may be after the last progress; 0 if there is none."""
    counted = zip(plan.system.records, files, strict=False)
    return max((record.point_of(rows - 1) for record, (_, rows) in counted if rows), default=0)


def outcome_at(  # noqa: PLR0913  each is a field of its own
    plan: Plan,
    point: int,
    files: Sequence[tuple[str, int]] = (),
    error: FmuMeshError | None = None,
    ended_by: FmuMeshError | None = None,
    *,
    seconds: float = 0.0,
    warnings: Sequence[str] = (),
) -> Outcome:
    """The outcome of a run of ``plan`` whose last point is ``point``; failed if there is an error."""
    return Outcome(
        state="done" if error is None else "failed",
        point=point,
        time=plan.grid.time(point),
        seconds=seconds,
        rows=files[0][1] if files else 0,
        file=plan.system.result_file,
        error=error.report() if error is not None else None,
        ended_by=ended_by.report() if ended_by is not None else None,
        files=tuple(files),
        warnings=tuple(warnings),
        first=plan.grid.first_point,
    )
