"""The rows of links that come by a row stream, and the errors of a stream that brings what is no part of the run."""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import FmuMeshError, FrameGap, ProtocolBroken
from ..rings.native import StreamState
from ..rings.row_streams import RowsEnd
from ..system.plan import Link
from .frames import SourceRows

__all__ = ["incoming_rows", "why_not"]


def incoming_rows(link: Link, mirror: SourceRows, last_point: int) -> RowsEnd:
    """The end of a link where its rows come to this mirror."""
    return RowsEnd(link.index, mirror.ring, mirror.counter, mirror.ring.layout, last_point // link.step_points + 1)


def why_not(peer: str, state: StreamState, about: int, row: int, links: Iterable[Link]) -> FmuMeshError | None:
    """The error for a stream that has ended because of what it brought; None if it was only cut."""
    link = next((own for own in links if own.index == about), None)
    source = f"'{link.source}'" if link is not None else "a counter"
    point = row * link.step_points if link is not None else None
    instance = link.source if link is not None else None
    match state:
        case StreamState.GAP:
            return FrameGap(
                f"rows of {source} before point {point} never came from '{peer}'", instance=instance, point=point
            )
        case StreamState.TWICE:
            return FrameGap(
                f"the values of {source} came twice from '{peer}' and differ",
                instance=instance,
                point=point,
                hint="Two processes publish as this instance: end one of them.",
            )
        case StreamState.LATE:
            return FmuMeshError(
                f"rows of {source} were overwritten before they were sent to '{peer}'", instance=instance
            )
        case StreamState.REFUSED:
            return ProtocolBroken(
                f"the row stream from '{peer}' has something that is no part of this run ({about}, {row})",
                instance=instance,
                hint="Do all processes run the same version of fmu_mesh and the same configuration?",
            )
        case _:
            return None
