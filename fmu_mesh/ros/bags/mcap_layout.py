"""Where the columns of a run are in its MCAP: what its metadata records say.

`fmu_mesh` has the metadata of the run as JSON under `metadata`, and a `RecordedMcap` under `recording`; each
`fmu_mesh.note` has what was noted later, under `entry`; `fmu_mesh.rows` at the end has the number of rows.
"""

from __future__ import annotations

from typing import Final

import msgspec

from ...ros_wire.definitions import Distribution
from ...variables.value_types import VariableType

__all__ = ["NOTE", "RECORDING", "ROWS", "RecordedColumn", "RecordedMcap", "TopicColumns"]

RECORDING: Final = "fmu_mesh"
NOTE: Final = "fmu_mesh.note"
ROWS: Final = "fmu_mesh.rows"


class RecordedColumn(msgspec.Struct, frozen=True):
    """One column of a recording: `instance.variable`, its type, and its unit."""

    name: str
    type: VariableType
    unit: str | None = None


class TopicColumns(msgspec.Struct, frozen=True):
    """The columns of one topic.

    Attributes:
        steps: it has a message in every row with the first point after a multiple of one of these; if there are none,
            in the first row.
        fields: the columns that each field has, by its path; of an array those of all elements.
    """

    name: str
    steps: tuple[int, ...]
    fields: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def is_due(self, before: int, point: int) -> bool:
        """Whether it has a message in the row of ``point``, which follows that of the point ``before``, or -1."""
        return any(point // step > before // step for step in self.steps) if self.steps else before < 0


class RecordedMcap(msgspec.Struct, frozen=True):
    """Where the columns of a run are in its MCAP.

    Attributes:
        start_time: time of point 0 in s.
        distribution: of ROS; it defines the message types.
        topics: all of them; also those without columns, such as `/clock`.
        first: point of the first row.
        every: number of points from row to row.
    """

    start_time: float
    step_size: float
    distribution: Distribution
    columns: tuple[RecordedColumn, ...]
    topics: tuple[TopicColumns, ...]
    first: int = 0
    every: int = 1

    def due(self, row: int) -> set[str]:
        """The topics that have a message in a row."""
        point = self.first + row * self.every
        return {topic.name for topic in self.topics if topic.is_due(point - self.every if row else -1, point)}
