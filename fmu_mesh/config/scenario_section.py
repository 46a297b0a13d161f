"""What the section `scenario` of a configuration may say, and the file that it may name.

Owns the keys. What the names in them mean, and the files with values, are `fmu_mesh.system.scenario`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta, inspect

from fmu_mesh.config.base import Base
from fmu_mesh.config.findings import Findings
from fmu_mesh.files import beside

__all__ = ["ScenarioConfig", "ScenarioEvent", "ScenarioSource", "ScenarioValues"]

PlainInput = bool | int | float | str | list[Any]
"""A value as in a file; an array as nested lists."""


class ScenarioValues(Base, frozen=True, kw_only=True):
    """The values of one variable over time: here, in a table, or in the messages of a bag."""

    times: Annotated[list[float] | None, Meta(description="Times of `values` in s, in ascending order.")] = None
    values: Annotated[list[PlainInput] | None, Meta(description="The value from each of `times` on.")] = None
    file: Annotated[
        str | None,
        Meta(
            description="A table (.csv, .parquet) or a bag (.mcap, or the folder of a `ros2 bag`) with the values, "
            "relative to this file."
        ),
    ] = None
    column: Annotated[
        str | None, Meta(description="The column of the table; default: the name of the variable, or the only column.")
    ] = None
    time: Annotated[str | None, Meta(description="The column with the times in s; default: time.")] = None
    topic: Annotated[
        str | None, Meta(description="The topic of the bag, and the field of its messages: /cmd:linear.x.")
    ] = None
    start: Annotated[
        float | None,
        Meta(description="Simulation time in s of the first message of the bag that is used; default: its stamp."),
    ] = None
    stamps: Annotated[
        Literal["header", "log"] | None,
        Meta(
            description="header: header stamps where messages have them (default); log: the times of their recording."
        ),
    ] = None
    interpolation: Annotated[
        Literal["hold", "linear", "auto"],
        Meta(
            description="hold: constant from each time on; linear: a line between two times, for Real inputs; auto: "
            "linear for continuous Real inputs, and hold for all others."
        ),
    ] = "hold"
    unit: Annotated[
        str | None, Meta(description="Unit of the values; they are converted to the unit of the variable.")
    ] = None


class ScenarioEvent(Base, frozen=True, kw_only=True):
    """Values of variables from one time on."""

    at: Annotated[float, Meta(description="Time in s.")]
    set: Annotated[dict[str, PlainInput], Meta(description="Values by `instance.variable`.")]


class ScenarioConfig(Base, frozen=True, kw_only=True):
    """Values that inputs and tunable parameters get while the mesh runs."""

    values: Annotated[
        dict[str, PlainInput | ScenarioValues],
        Meta(description="By `instance.variable`: a constant, or values over time."),
    ] = {}
    events: Annotated[list[ScenarioEvent], Meta(description="What changes at single times.")] = []

    @property
    def empty(self) -> bool:
        """Whether nothing is set."""
        return not self.values and not self.events


class ScenarioSource(NamedTuple):
    """A scenario, and where it stands.

    Attributes:
        config: what it says.
        prefix: in front of each of its paths in the file: `scenario.` in a configuration, nothing in a file of its own.
        file: the file that it stands in; relative paths in it refer to the folder of this file.
        lines: line numbers, counted from 1, by path in the file.
        overrides: the option that replaced a value, by path in the file.
        wrong: the places in a file of its own for which there are findings already.
    """

    config: ScenarioConfig
    prefix: str
    file: Path
    lines: dict[str, int]
    overrides: dict[str, str]
    wrong: frozenset[str] = frozenset()

    def findings(self) -> Findings:
        """An empty collection of findings about this file."""
        made = Findings(str(self.file), self.lines, self.overrides)
        made.explain(self.wrong)
        return made

    def resolve(self, relative: str) -> Path:
        """The absolute path for a path in the file."""
        return beside(self.file, relative)


def scenario_type() -> inspect.Type:
    """The type of a file with a scenario, as msgspec sees it."""
    return inspect.type_info(ScenarioConfig)
