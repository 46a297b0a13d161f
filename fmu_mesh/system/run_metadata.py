"""What a result file says about its run besides the rows: enough to run it again.

Owns the names of these entries. The formats store them as they are (`fmu_mesh.recorder`), `Result.metadata` returns
them, and `fmu-mesh rerun` starts from them.
"""

from __future__ import annotations

import os
import platform
import socket
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from .. import __version__
from ..config.instance_sections import KIND
from ..config.loading import LoadedConfig
from ..variables.value_conversion import to_plain
from ..variables.value_types import PlainValue
from .records import RecordPlan
from .series_files import content_of
from .system import ResolvedSystem

__all__ = [
    "ModelOrigin",
    "RecordedVariable",
    "RunMetadata",
    "configuration_of",
    "machine",
    "machine_difference",
    "metadata_of",
    "scenario_files",
    "versions",
]

_FORMAT = 1
_FEATURES: Final = ("asimd", "avx", "avx2", "avx512f", "fma", "fma4", "sve")
"""Features of a processor for which mathematical libraries have functions of their own, with other last digits."""

_CPUINFO_BYTES: Final = 8192
"""The first processor; a host can have hundreds."""

_PACKAGES = {"fmpy": "fmpy", "zenoh": "eclipse-zenoh", "numpy": "numpy"}


class ModelOrigin(msgspec.Struct, frozen=True):
    """Which model an instance has.

    Attributes:
        path: its file, absolute.
        sha256: the SHA-256 of its content; empty for a model without files.
        guid: the GUID or instantiation token of its model description.
        computed_by: what computes it, as `fmu-mesh check` shows it: `FMI 3.0 model exchange, auto 1e-06`. Empty in
            files of older versions.
    """

    path: str
    sha256: str
    guid: str
    computed_by: str = ""


class RecordedVariable(msgspec.Struct, frozen=True):
    """What the model description says about the variable of a column.

    Attributes:
        type: its type, such as `Float64`.
        declared_type: its type as the model description names it, such as `Real`.
    """

    type: str
    declared_type: str | None
    causality: str
    variability: str
    unit: str | None
    description: str


class RunMetadata(msgspec.Struct, frozen=True):
    """What a result file says about its run.

    Attributes:
        format: the version of these entries.
        versions: versions of fmu_mesh, of the packages that take part in the numbers, of Python and of the system, and
            the `machine`.
        mesh: name of the mesh.
        digest: the digest of the mesh: version, configuration and models.
        configuration: the values of a configuration file: that of the run, with everything that options replaced.
        file: the configuration file of the run, absolute; relative paths in `configuration` refer to its folder.
        section: which of the sections of `record` the file belongs to, counted from 0.
        first: point of the first row.
        every: number of points from row to row.
        models: the models by instance.
        files: the SHA-256 of each file of the scenario, by absolute path.
        start_values: the start values that were set, by instance and variable.
        start_time: time of point 0 in s.
        step_size: base communication step size in s.
        stop_time: time of the last point in s; None: the run had no end.
        variables: the recorded variables by column.
        started: when the run was started, in UTC, after ISO 8601.
        host: name of the host that wrote the file.
        state: the state file with which the run began, absolute; empty: it began at point 0.
        replaced: the instances that began anew there.
    """

    format: int
    versions: dict[str, str]
    mesh: str
    digest: str
    configuration: dict[str, Any]
    file: str
    section: int
    first: int
    every: int
    models: dict[str, ModelOrigin]
    files: dict[str, str]
    start_values: dict[str, dict[str, PlainValue]]
    start_time: float
    step_size: float
    stop_time: float | None
    variables: dict[str, RecordedVariable]
    started: str
    host: str
    state: str = ""
    replaced: tuple[str, ...] = ()


def metadata_of(
    loaded: LoadedConfig,
    system: ResolvedSystem,
    record: RecordPlan,
    *,
    digest: str = "",
    contents: Mapping[str, str] = {},
) -> RunMetadata:
    """What a result file of this run says about it; ``contents`` has the SHA-256 of the model of each instance."""
    variables = {}
    for instance, name in record.variables:
        of = system.instances[instance].description.variable_of(name)
        assert of is not None  # the system is valid
        origin = of.causality, of.variability, of.unit, of.description or ""
        variables[f"{instance}.{name}"] = RecordedVariable(of.type, of.declared_type, *origin)
    grid = system.grid
    return RunMetadata(
        format=_FORMAT,
        versions=versions(),
        mesh=loaded.config.mesh,
        digest=digest,
        configuration=configuration_of(loaded),
        file=str(loaded.file.absolute()),
        section=system.records.index(record),
        first=record.first,
        every=record.every,
        models={
            name: ModelOrigin(
                own.fmu,
                contents.get(name, ""),
                own.description.guid,
                loaded.config.instances[name].summary(own.description),
            )
            for name, own in system.instances.items()
        },
        files=scenario_files(loaded, system),
        start_values={
            name: {variable: to_plain(value) for variable, value in own.start_values.items()}
            for name, own in system.instances.items()
        },
        start_time=grid.start_time,
        step_size=grid.step_size,
        stop_time=grid.stop_time,
        variables=variables,
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        host=socket.gethostname(),
        state=system.begins_with,
        replaced=system.replaced,
    )


def scenario_files(loaded: LoadedConfig, system: ResolvedSystem) -> dict[str, str]:
    """The SHA-256 of the file of the scenario, and of the files with its values, by absolute path."""
    files = dict(system.scenario_files)
    if isinstance(loaded.config.scenario, str):
        path = loaded.resolve(loaded.config.scenario)
        files[str(path)] = content_of(path)
    return files


def configuration_of(loaded: LoadedConfig) -> dict[str, Any]:
    """The values of a configuration file that says what this configuration says, with every key; JSON can hold them."""
    data: dict[str, Any] = msgspec.to_builtins(loaded.config, enc_hook=str)
    for section in (*data["instances"].values(), *data["connections"]):
        section.pop(KIND, None)  # it follows from the keys
    finite: dict[str, Any] = _finite(data)
    return finite


def _finite(value: Any) -> Any:  # noqa: ANN401  anything that a configuration can hold
    """The value with NaN and infinities as the text that start values may have (FMI 3.0, 2.4.8)."""
    match value:
        case float():
            return to_plain(value)
        case dict():
            return {key: _finite(inner) for key, inner in value.items()}
        case list():
            return [_finite(inner) for inner in value]
        case _:
            return value


@cache
def versions() -> dict[str, str]:
    """The versions of fmu_mesh, of the packages that take part in the numbers, of Python and of the system; `machine`.

    The first call imports what reads metadata of packages, which takes some milliseconds.
    """
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415 see above

    found = {"fmu_mesh": __version__}
    for name, package in _PACKAGES.items():
        try:
            found[name] = version(package)
        except PackageNotFoundError:
            found[name] = "unknown"  # built into something else
    return {**found, "python": platform.python_version(), "platform": platform.platform(), **machine()}


@cache
def machine() -> dict[str, str]:
    """What the last digits of results depend on: the features of the processor, the C library, and BLAS of numpy."""
    words: set[str] = set()
    with suppress(OSError), Path("/proc/cpuinfo").open(encoding="utf-8", errors="replace") as file:
        words.update(file.read(_CPUINFO_BYTES).split())
    libc = "unknown"
    with suppress(ValueError, OSError):  # a C library that is not that of GNU
        libc = os.confstr("CS_GNU_LIBC_VERSION") or libc
    configuration: Any = np.show_config(mode="dicts")
    blas = configuration.get("Build Dependencies", {}).get("blas", {})
    return {
        "processor": " ".join(feature for feature in _FEATURES if feature in words),
        "libc": libc,
        "blas": f"{blas.get('name', 'unknown')} {blas.get('version', '')}".strip(),
    }


def machine_difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """In words why two machines (`machine`) may calculate other last digits; empty if no reason is known."""
    keys = [key for key in machine() if key in here and key in there and here[key] != there[key]]
    return ", ".join(f"{key} '{here[key]}' and '{there[key]}'" for key in keys)
