"""What a contestant is asked to do, and what it answers. Standard library only: every environment imports it.

All systems of the benchmark are rows of instances with one connected input and one output each: instance ``i`` is fed
by instance ``i - 1``, or in a star by the first one. In a cycle the last one feeds the first one, else nobody does.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Literal, Self

__all__ = ["Member", "Outcome", "System", "Task"]

Algorithm = Literal["jacobi", "gauss_seidel"]


@dataclass(frozen=True)
class Member:
    """One instance.

    Attributes:
        fmu: file name in the project's folder `fmus`, without `.fmu`.
        input: name of the connected input.
        output: name of the output that is read.
        start_values: Real start values by name, in SI units.
    """

    name: str
    fmu: str
    input: str
    output: str
    start_values: dict[str, float] = field(default_factory=dict)

    @property
    def column(self) -> str:
        """Name of the output in results."""
        return f"{self.name}.{self.output}"


@dataclass(frozen=True)
class System:
    """A system structure; `step_size` is in s."""

    kind: Literal["chain", "cycle", "star"]
    algorithm: Algorithm
    step_size: float
    members: tuple[Member, ...]

    def source_of(self, index: int) -> int | None:
        """Index of the instance that feeds instance ``index``."""
        if index > 0:
            return 0 if self.kind == "star" else index - 1
        return len(self.members) - 1 if self.kind == "cycle" else None

    def stages(self) -> list[list[int]]:
        """Instances that may step at the same time, stage by stage: the order of one communication step."""
        everybody = list(range(len(self.members)))
        return [everybody] if self.algorithm == "jacobi" else [[index] for index in everybody]


@dataclass(frozen=True)
class Task:
    """One run of one contestant.

    Attributes:
        points: communication steps to take.
        options: what distinguishes variants of one contestant.
        initial_inputs: value of each connected input in Initialization Mode; None where nothing is connected.
    """

    system: System
    points: int
    options: dict[str, str] = field(default_factory=dict)
    initial_inputs: tuple[float | None, ...] = ()

    @property
    def stop_time(self) -> float:
        """Time of the last communication point in s."""
        return self.points * self.system.step_size

    def to_json(self) -> str:
        """As text, for `from_json`."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The task that `to_json` wrote."""
        raw = json.loads(text)
        system = raw["system"]
        members = tuple(Member(**member) for member in system.pop("members"))
        return cls(System(members=members, **system), raw["points"], raw["options"], tuple(raw["initial_inputs"]))


@dataclass(frozen=True)
class Outcome:
    """What a contestant answers.

    Attributes:
        seconds: wall-clock time from the first to the last communication point.
        last: value of each output at the last point, as far as the contestant shows it.
        versions: what it ran with.
        result_file: CSV file with every point, if there is one.
    """

    seconds: float
    last: dict[str, float] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    result_file: str | None = None
