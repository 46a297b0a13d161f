"""The one exception tree of fmu_mesh.

```
FmuMeshError                     1   an internal error
├── ConfigurationError           2   a file, an option or a command is wrong; carries all findings
├── CallRefused                  2   a program called the library wrongly; also a ValueError
├── FmuError                     3   an FMU failed
│   ├── LoadFailed                   it cannot be extracted, loaded or instantiated
│   ├── InitializationFailed         a call in or around Initialization Mode failed
│   │   └── LoopNotConverged         an algebraic loop has no consistent values at the start
│   └── StepFailed                   fmi2DoStep, or a get or set at a point, failed
├── MeshLost                     4   a node, the master or the recorder is gone or silent
│   ├── DeadlineExceeded             a wait met its deadline
│   ├── FrameGap                     a point is missing, or came twice with other values
│   └── ProtocolBroken               a registered peer sent what the protocol forbids, such as a grant beyond the window
├── MessageRefused               1   what came over the wire is not understood; it is counted, and the run goes on
├── Interrupted                130   a person or the parent process asked to end
└── TerminationRequested         0   an FMU asked to end the simulation: an orderly end, no failure
```

Errors carry fields (instance, variable, point, time) and say what to do next. This module knows nothing of the
modules that raise them.
"""

from __future__ import annotations

from typing import ClassVar

import msgspec

__all__ = [
    "CallRefused",
    "ConfigurationError",
    "DeadlineExceeded",
    "ErrorReport",
    "Finding",
    "FmuError",
    "FmuMeshError",
    "FrameGap",
    "InitializationFailed",
    "Interrupted",
    "LoadFailed",
    "LoopNotConverged",
    "MeshLost",
    "MessageRefused",
    "ProtocolBroken",
    "StepFailed",
    "TerminationRequested",
]


class ErrorReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An error as it crosses a process boundary: what `FmuMeshError` carries, and its exit code."""

    kind: str
    message: str
    exit_code: int
    instance: str | None = None
    variable: str | None = None
    point: int | None = None
    time: float | None = None
    hint: str | None = None


class FmuMeshError(Exception):
    """Base of all errors that fmu_mesh raises on purpose.

    Args:
        message: what happened, one or two sentences.
        instance: the instance it happened to.
        variable: the variable it is about.
        point: the communication point index it happened at.
        time: the simulation time of that point in s.
        hint: what the reader can do next.

    Attributes:
        told: whether somebody else tells the reader already.
    """

    exit_code: ClassVar[int] = 1

    def __init__(  # noqa: PLR0913  each is a field of its own that the reader of an error needs
        self,
        message: str,
        *,
        instance: str | None = None,
        variable: str | None = None,
        point: int | None = None,
        time: float | None = None,
        hint: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.instance = instance
        self.variable = variable
        self.point = point
        self.time = time
        self.hint = hint
        self.told = False

    def __str__(self) -> str:
        where = []
        if self.instance is not None:
            name = f"{self.instance}.{self.variable}" if self.variable is not None else self.instance
            where.append(f"instance {name}")
        elif self.variable is not None:
            where.append(f"variable {self.variable}")
        if self.point is not None:
            where.append(f"point {self.point}")
        if self.time is not None:
            where.append(f"t = {self.time:.12g} s")
        text = f"{', '.join(where)}: {self.message}" if where else self.message
        return f"{text.rstrip('.')}. {self.hint}" if self.hint else text

    def report(self) -> ErrorReport:
        """This error in a form that can be sent to another process."""
        return ErrorReport(
            kind=type(self).__name__,
            message=self.message,
            exit_code=self.exit_code,
            instance=self.instance,
            variable=self.variable,
            point=self.point,
            time=self.time,
            hint=self.hint,
        )


class Finding(msgspec.Struct, frozen=True):
    """One thing that is wrong with a configuration.

    Attributes:
        file: the file it stands in.
        path: the place in the file, such as `connections[2].to`; empty for the file as a whole.
        found: what stands there.
        expected: what would be right; empty where what was found says it.
        suggestion: the nearest right name, if there is one.
        line: the line in the file, counted from 1, if known.
    """

    file: str
    path: str
    found: str
    expected: str
    suggestion: str | None = None
    line: int | None = None

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line is not None else self.file
        text = f"{place}: {self.path}: " if self.path else f"{place}: "
        text += f"{self.found}; expected {self.expected}" if self.expected else self.found
        return f"{text}. Did you mean '{self.suggestion}'?" if self.suggestion else text


class ConfigurationError(FmuMeshError):
    """A file, an option or a command is wrong. Carries every finding, not only the first.

    A single finding may be the message; others are listed below it.
    """

    exit_code = 2

    def __init__(self, message: str, *, findings: tuple[Finding, ...] = (), hint: str | None = None) -> None:
        super().__init__(message, hint=hint)
        self.findings = findings

    def __str__(self) -> str:
        listed = [str(finding) for finding in self.findings if str(finding) != self.message]
        return "\n".join([super().__str__(), *(f"  - {finding}" for finding in listed)])


class CallRefused(FmuMeshError, ValueError):
    """A program called the library in the wrong mode, or with a wrong name, type or time. The call changed nothing."""

    exit_code = 2


class FmuError(FmuMeshError):
    """An FMU failed."""

    exit_code = 3


class LoadFailed(FmuError):
    """An FMU cannot be extracted, loaded or instantiated."""


class InitializationFailed(FmuError):
    """A call in or around Initialization Mode failed (FMI 2.0, 4.2.1 and 2.1.6)."""


class LoopNotConverged(InitializationFailed):
    """Outputs that depend on each other came to no consistent values at the start; names them and the residuals."""


class StepFailed(FmuError):
    """`fmi2DoStep`, or a get or set at a point, failed; only closing the instance is allowed now."""


class MeshLost(FmuMeshError):
    """A node, the master or the recorder is gone or silent."""

    exit_code = 4


class DeadlineExceeded(MeshLost):
    """A wait met its deadline."""


class FrameGap(MeshLost):
    """A point is missing from a sequence of frames, or came twice with other values."""


class ProtocolBroken(MeshLost):
    """A registered peer sent what the protocol forbids (design, invariant 7); names both ends."""


class MessageRefused(FmuMeshError):
    """What came over the wire is malformed, or comes from nobody who may send it. Ends no run."""


class Interrupted(FmuMeshError):
    """A person, or the parent process, asked to end."""

    exit_code = 130


class TerminationRequested(FmuMeshError):
    """An FMU asked to end the simulation during the step from `point` (FMI 2.0, 4.2.3; FMI 3.0, 4.2.1).

    That is no failure: all instances go on to this point, and the run ends there with exit code 0.
    """

    exit_code = 0


_BY_KIND: dict[str, type[FmuMeshError]] = {
    kind.__name__: kind
    for kind in (
        FmuError,
        LoadFailed,
        InitializationFailed,
        LoopNotConverged,
        StepFailed,
        MeshLost,
        DeadlineExceeded,
        FrameGap,
        ProtocolBroken,
        Interrupted,
        TerminationRequested,
    )
}


def from_report(report: ErrorReport) -> FmuMeshError:
    """The error that another process reported, as an exception of the same kind."""
    if report.kind == ConfigurationError.__name__:
        return ConfigurationError(report.message, hint=report.hint)
    return _BY_KIND.get(report.kind, FmuMeshError)(
        report.message,
        instance=report.instance,
        variable=report.variable,
        point=report.point,
        time=report.time,
        hint=report.hint,
    )
