"""JSON for programs on standard output: one value per line, and errors with their fields."""

from __future__ import annotations

import msgspec

from ...errors import ConfigurationError, ErrorReport, Finding, FmuMeshError, Interrupted
from ...printing import write_data
from .flag_words import in_flags

__all__ = ["Failure", "failure_of", "print_failure", "print_json"]


class Failure(ErrorReport, frozen=True):
    """An error with all findings of a configuration."""

    findings: tuple[Finding, ...] = ()


def failure_of(error: BaseException) -> Failure:
    """The fields of an error; what is not one of ours is an internal error, or an interruption."""
    if isinstance(error, KeyboardInterrupt):
        error = Interrupted("interrupted")
    if not isinstance(error, FmuMeshError):
        return Failure(type(error).__name__, str(error), FmuMeshError.exit_code)
    error = error.in_words(in_flags)
    findings = error.findings if isinstance(error, ConfigurationError) else ()
    return Failure(**msgspec.structs.asdict(error.report()), findings=findings)


def print_failure(error: FmuMeshError) -> None:
    """Print an error as `{"exit_code": 2, "error": {…}}`, where there is nothing else to report."""
    print_json({"exit_code": error.exit_code, "error": failure_of(error)})


def print_json(view: object) -> None:
    """Print a value as one line of JSON."""
    write_data(msgspec.json.encode(view) + b"\n")
