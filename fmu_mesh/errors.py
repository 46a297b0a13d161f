"""The one exception tree of fmu_mesh.

```
FmuMeshError                     1   an internal error
├── ConfigurationError           2   a file, an option or a command is wrong; carries all findings
│   ├── NotInOneProcess              instances of the mesh cannot share one process
│   └── LibraryMissing               an optional library is not installed; also a LoadFailed
├── CallRefused                  2   a program called the library wrongly; also a ValueError
│   └── UnknownName                  there is no such name; also a KeyError
├── FmuError                     3   an FMU failed
│   ├── LoadFailed                   it cannot be extracted, loaded or instantiated
│   ├── InitializationFailed         a call in or around Initialization Mode failed
│   │   └── LoopNotConverged         an algebraic loop has no consistent values at the start
│   ├── StepFailed                   fmi2DoStep, or a get or set at a point, failed
│   ├── NotFinite                    an output is NaN or infinite
│   └── NotDeterministic             after a restart, a recorded value is another than before
├── MeshLost                     4   a node, the master or the recorder has ended or does not answer
│   ├── DeadlineExceeded             what a process waited for did not come in time
│   ├── FrameGap                     a point is missing, or came twice with other values
│   └── ProtocolBroken               a registered peer sent what the protocol forbids, such as a grant beyond the window
├── MessageRefused               1   a received message is malformed; it is counted, and the run goes on
├── Interrupted                130   a person or the parent process asked to end
│   ├── KeyboardInterrupted          Ctrl-C in a program; also a KeyboardInterrupt
│   └── RunReset                     a reset has ended the run, and the next one begins in the same processes
└── TerminationRequested         0   an FMU asked to end the simulation: an orderly end, no failure
```

Errors carry fields (instance, variable, point, time) and say what to do next. This module does not know the modules
that raise them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Self

import msgspec

from .printing import paragraph, printable

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
    "KeyboardInterrupted",
    "LibraryMissing",
    "LoadFailed",
    "LoopNotConverged",
    "MeshLost",
    "MessageRefused",
    "NotDeterministic",
    "NotFinite",
    "NotInOneProcess",
    "ProtocolBroken",
    "RunReset",
    "StepFailed",
    "TerminationRequested",
    "UnknownName",
]


_SHOWN_FINDINGS = 20


class ErrorReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An error as one process sends it to another: the fields of `FmuMeshError`, its class and its exit code."""

    kind: str
    message: str
    exit_code: int
    instance: str | None = None
    variable: str | None = None
    point: int | None = None
    time: float | None = None
    hint: str | None = None
    host: str | None = None


class FmuMeshError(Exception):
    """Base of all errors that fmu_mesh raises on purpose.

    Args:
        message: what happened, in one or two sentences.
        instance: name of the instance that failed.
        variable: name of the variable that the error is about.
        point: index of the communication point at which it happened.
        time: simulation time of that point in s.
        hint: what the reader can do next.

    Attributes:
        host: the host of `deploy.hosts` on which the instance runs; None: that of `launch`.
        reported: True if another process has already shown this error.
        result: what was recorded before, if this error ended a run of the library: a `fmu_mesh.Result`.

    Example:
        Every exception says in its message what to do next, and the command would end with its exit code:

        >>> import fmu_mesh
        >>> try:
        ...     fmu_mesh.FMIAdapter("fmus/Gain.fmu", step_size=0.0)
        ... except fmu_mesh.FmuMeshError as error:
        ...     print(type(error).__name__, error.exit_code, error.instance)
        ...     print(error)
        CallRefused 2 Gain@...
        instance Gain@...: the step size is 0.0 s; expected one above 0.

    The layer that catches an error often knows more than the one that raised it. It adds what it knows (`at`,
    `with_hint`) and raises the same error again.
    """

    exit_code: ClassVar[int] = 1
    _message_has_variable: ClassVar[bool] = False

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
        self.message: str = message
        self.instance = instance
        self.variable = variable
        self.point = point
        self.time = time
        self.hint = hint
        self.host: str | None = None
        self.reported: bool = False
        self.result: Any = None

    def __str__(self) -> str:
        where = []
        if self.instance is not None:
            variable = self.variable if not self._message_has_variable else None
            where.append(f"instance {self.instance}" + (f".{variable}" if variable is not None else ""))
            where[0] += f" on {self.host}" if self.host is not None else ""
        elif self.variable is not None:
            where.append(f"variable {self.variable}")
        if self.point is not None:
            where.append(f"point {self.point}")
        if self.time is not None:
            where.append(f"t = {self.time:.12g} s")
        text = f"{', '.join(where)}: {self.message}" if where else self.message
        return paragraph(f"{text.rstrip('.')}. {self.hint}" if self.hint else text)

    def at(self, point: int, time: float) -> Self:
        """Set the communication point and its time in s; returns this error."""
        self.point, self.time = point, time
        return self

    def on(self, host: str | None) -> Self:
        """Set the host; returns this error."""
        self.host = host
        return self

    def saying(self, message: str) -> Self:
        """Replace the message; returns this error."""
        self.message = message
        return self

    def with_hint(self, hint: str | None) -> Self:
        """Append a sentence to the hint; returns this error."""
        self.hint = f"{self.hint} {hint}" if self.hint and hint else self.hint or hint
        return self

    def instead_of_hint(self, hint: str) -> Self:
        """Replace the hint; returns this error."""
        self.hint = hint
        return self

    def in_words(self, words: Callable[[str], str]) -> Self:
        """Say it in the words of whoever reads it, such as flags for options; returns this error."""
        self.message, self.hint = words(self.message), words(self.hint) if self.hint else self.hint
        return self

    def with_result(self, result: object) -> Self:
        """Set what was recorded before; returns this error."""
        self.result = result
        return self

    def already_reported(self) -> Self:
        """Note that another process has shown this error, so that this one does not; returns this error."""
        self.reported = True
        return self

    def report(self) -> ErrorReport:
        """Convert this error to a value that can be sent to another process."""
        fields = ErrorReport.__struct_fields__[1:]  # all but the kind have the names of our attributes
        return ErrorReport(type(self).__name__, **{name: getattr(self, name) for name in fields})


class Finding(msgspec.Struct, frozen=True):
    """One error in a configuration.

    Example:
        >>> print(Finding("mesh.yaml", "simulation.algorithm", "'jacob'", "jacobi or gauss_seidel", "jacobi", line=3))
        mesh.yaml:3: simulation.algorithm: 'jacob'; expected jacobi or gauss_seidel. Did you mean 'jacobi'?

    Attributes:
        file: the file that has the error.
        path: the place in the file, such as `connections[2].to`; empty if the whole file is meant.
        found: what the file has there.
        expected: what it should have; empty if `found` already says so.
        suggestion: the nearest valid name, if there is one.
        line: number of the line, counted from 1; None if it is not known.
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
        return printable(f"{text}. Did you mean '{self.suggestion}'?" if self.suggestion else text)


class ConfigurationError(FmuMeshError):
    """A file, an option or a command is wrong. Carries all findings, not only the first.

    If there is one finding, it may be the message itself. Other findings are listed below the message, the first 20.

    Attributes:
        findings: all of them.
        plan: the plan of the run, if it is right and only this host lacks something, such as a package.
    """

    exit_code = 2

    def __init__(
        self, message: str, *, findings: tuple[Finding, ...] = (), hint: str | None = None, plan: object = None
    ) -> None:
        super().__init__(message, hint=hint)
        self.findings = findings
        self.plan: Any = plan

    def in_words(self, words: Callable[[str], str]) -> Self:
        """As for all errors; also the findings."""
        self.findings = tuple(
            msgspec.structs.replace(
                one, **{name: words(getattr(one, name)) for name in ("file", "path", "found", "expected")}
            )
            for one in self.findings
        )
        return super().in_words(words)

    def __str__(self) -> str:
        listed = [f"  - {text}" for finding in self.findings if (text := str(finding)) != self.message]
        listed[_SHOWN_FINDINGS:] = [f"  and {len(listed) - _SHOWN_FINDINGS:,} more"] * (len(listed) > _SHOWN_FINDINGS)
        return "\n".join([super().__str__(), *listed])


class NotInOneProcess(ConfigurationError):
    """Instances of the mesh cannot share one process: together they would compute other numbers than apart."""


class CallRefused(FmuMeshError, ValueError):
    """The library was called in the wrong mode, or with a wrong name, type or time. The call had no effect."""

    exit_code = 2


class UnknownName(CallRefused, KeyError):
    """There is no variable, instance or mesh with this name; suggests the nearest one."""


class FmuError(FmuMeshError):
    """An FMU failed."""

    exit_code = 3


class LoadFailed(FmuError):
    """An FMU cannot be extracted, loaded or instantiated."""


class LibraryMissing(ConfigurationError, LoadFailed):
    """An optional library is not installed. The message has the command that installs it here."""


class InitializationFailed(FmuError):
    """A call in or around Initialization Mode failed (FMI 2.0, 4.2.1 and 2.1.6)."""


class LoopNotConverged(InitializationFailed):
    """The iteration of an algebraic loop at the start did not converge; names the outputs and the residuals."""


class StepFailed(FmuError):
    """`fmi2DoStep`, or a get or set at a point, failed. Afterwards the instance can only be closed."""


class NotFinite(FmuError):
    """An output is NaN or infinite at `point`: the run ends with the point before, which all instances reach.

    The message has the input that was not finite, if there is one, and its source.
    """

    _message_has_variable = True

    @property
    def last_point(self) -> int | None:
        """The last point of the run; None if it ends at once."""
        return self.point - 1 if self.point else None


class NotDeterministic(FmuError):
    """After a restart, a recorded value is another than before at the same `point`; the file stays as it was."""

    _message_has_variable = True


class MeshLost(FmuMeshError):
    """A node, the master or the recorder has ended or does not answer."""

    exit_code = 4


class DeadlineExceeded(MeshLost):
    """What a process waited for did not come before the deadline."""


class FrameGap(MeshLost):
    """A point is missing from a sequence of frames, or arrived twice with different values."""


class ProtocolBroken(MeshLost):
    """A registered peer sent what the protocol forbids (design, invariant 7); names both ends."""


class MessageRefused(FmuMeshError):
    """A received message is malformed, or its sender may not send it. The run goes on."""


class Interrupted(FmuMeshError):
    """A person or the parent process asked this process to end."""

    exit_code = 130


class KeyboardInterrupted(Interrupted, KeyboardInterrupt):
    """Ctrl-C, or "interrupt kernel" in a notebook, has ended a run; names the last point."""


class RunReset(Interrupted):
    """A command has reset the mesh: this run ends at `point`, and the same processes begin the next one."""


class StepPending(Exception):
    """A step that waits for a program is not done yet: the engine leaves, and takes the same step again.

    It is none of our errors: nobody beyond the engine sees it.
    """


class TerminationRequested(FmuMeshError):
    """An FMU asked to end the simulation during the step from `point` (FMI 2.0, 4.2.3; FMI 3.0, 4.2.1).

    This is not a failure: all other instances step to the same point, and the run ends there with exit code 0.
    """

    exit_code = 0

    @property
    def last_point(self) -> int | None:
        """The last point of the run."""
        return self.point


_BY_KIND: dict[str, type[FmuMeshError]] = {
    kind.__name__: kind
    for kind in (
        FmuError,
        LoadFailed,
        InitializationFailed,
        LoopNotConverged,
        StepFailed,
        NotDeterministic,
        NotFinite,
        MeshLost,
        DeadlineExceeded,
        FrameGap,
        ProtocolBroken,
        Interrupted,
        TerminationRequested,
    )
}


def from_report(report: ErrorReport) -> FmuMeshError:
    """Convert the report of another process back to an exception of the same class."""
    for kind in (ConfigurationError, NotInOneProcess):
        if report.kind == kind.__name__:
            return kind(report.message, hint=report.hint)
    error = _BY_KIND.get(report.kind, FmuMeshError)(
        report.message,
        instance=report.instance,
        variable=report.variable,
        point=report.point,
        time=report.time,
        hint=report.hint,
    )
    return error.on(report.host)
