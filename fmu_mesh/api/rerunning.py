"""`rerun`: a run again, from nothing but its result file.

The metadata of the file have the configuration, the hashes of the models, and every value that another program has set
while the mesh ran. Each value is set again while the mesh is paused at the point at which its instance took it then. So
every float is the same as before, however long each process takes.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from .. import __version__
from ..config.call_options import takes
from ..config.loading import PlainConfig
from ..errors import ConfigurationError, Finding, FmuMeshError
from ..run.allowed_code import check_owner
from ..run.options import RerunOptions, StartOptions
from ..run.run_plan import RunPlan
from ..system.run_metadata import RunMetadata, machine, machine_difference, scenario_files
from ..text import listed
from ..wire.messages import SetValue
from .mesh_builder import Mesh
from .result import Result
from .run_handle import Run

__all__ = ["ALONE", "PlannedRerun", "on_this_host", "planned_rerun", "rerun"]

log = logging.getLogger("fmu_mesh.run")

_SET = "set"
ALONE: Mapping[str, Any] = {
    "zenoh": {"mode": "peer", "listen": [], "connect": [], "rows_address": None, "config": None},
    "ros": None,
    "security": None,
    "runtime": {},
    "recovery": {},
}
"""What a rerun has of its own: nobody else reaches it or sends anything to it."""


def on_this_host(data: Mapping[str, Any]) -> dict[str, Any]:
    """The sections of a configuration by which all of it runs here, whatever hosts it names."""
    instances = data.get("instances")
    if not isinstance(instances, dict):
        return {}
    here = {
        name: {key: value for key, value in own.items() if key != "host"} if isinstance(own, dict) else own
        for name, own in instances.items()
    }
    return {"instances": here, "deploy": {}}


class PlannedRerun(NamedTuple):
    """A rerun before it is started."""

    plan: RunPlan
    values: Sequence[SetValue]  # what is set in it, in the order of the points
    last_point: int | None  # the point at which it is stopped; None: it runs to its end
    first: Result  # that of the first run

    @takes(StartOptions)
    def run(self, options: StartOptions) -> Result:
        """Run it; the error of a run that ended early has the `result` up to then."""
        with Run.start(self.plan, **options.given()) as run:
            self.drive(run)
            return run.wait()

    def drive(self, run: Run) -> None:
        """Set the values in the run, which is paused at its first point, and stop it where the first one has ended."""
        if self.plan.paused:
            try:
                run.replay(self.values, self.last_point)
            except FmuMeshError:
                run.close()
                raise


@takes(RerunOptions)
def rerun(result: str | Path, options: RerunOptions) -> Result:
    """Run again what a result file has recorded: same configuration, models and values that were set from outside.

    The rows are the same in every float, unless versions or machines calculate differently; `Result.compare` tells.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.Mesh("steered", step_size=0.01, stop_time=1.0)
        >>> mesh.add("gain", fmu="fmus/Gain.fmu")
        >>> with mesh.start(output="results/steered.csv", paused=True) as run:
        ...     answer = run.step(10)
        ...     answer = run.set("gain.u", 3.0)
        ...     answer = run.resume()
        ...     first = run.wait()
        >>> [(value["variable"], value["point"]) for value in first.metadata["set"]]
        [('u', 10)]
        >>> again = fmu_mesh.rerun("results/steered.csv", output="results/again.csv")
        >>> again["gain.y"].tolist() == first["gain.y"].tolist()
        True

    Args:
        result: the result file; a CSV needs the `.json` file beside it.
        options: see `RerunOptions`; by default, `output` is `NAME.rerun` with the same ending, beside the first one.

    Returns:
        The result of the new run.

    Raises:
        ConfigurationError: the file does not say how it was made, or a model has changed; names each.
        FmuMeshError: the run ended early, and not where the first one has.
    """
    how = {name: value for name, value in options.given().items() if name in StartOptions.__struct_fields__}
    return planned_rerun(result, **options.given()).run(**how)


@takes(RerunOptions)
def planned_rerun(result: str | Path, options: RerunOptions) -> PlannedRerun:
    """Plan a rerun; arguments and errors are those of `rerun`."""
    allow_code, on_notice = options.allow_code, options.on_notice or log.info
    path = Path(result)
    first = Result.read(path)
    metadata, values = _metadata_of(path, first)
    keys = first.metadata.get("keys")
    if not allow_code:
        check_owner(path, f"'{path}'")
    output = Path(options.output) if options.output is not None else path.with_name(f"{path.stem}.rerun{path.suffix}")
    if output.absolute() == path.absolute():
        raise ConfigurationError(f"'{output}' is the result itself", hint="Give another file with `output=...`.")
    data = {**metadata.configuration, **on_this_host(metadata.configuration), **ALONE}
    sections = data.get("record") or {}
    section = sections[metadata.section] if isinstance(sections, list) else sections
    data["record"] = {**section, "file": str(output.absolute())}
    last_row, last_point = _last_points(metadata, first)
    # An instance may have been ahead of the rows that were left, or at its last point, and in a rerun the mesh ends
    # there before it gets its value. No row depends on these values.
    values = [value for value in values if value.point < last_row]
    mesh = Mesh.from_configuration(PlainConfig(data, Path(metadata.file), foreign=f"the result '{path}'"))
    plan = mesh.plan(
        real_time_factor=0.0,
        paused=bool(values) or last_point is not None,
        keys_from=path.parent / keys if keys is not None else os.devnull,
        state=metadata.state or None,
        replaced=metadata.replaced,
        allow_code=allow_code,
        on_notice=on_notice,
    )
    _check_models(path, metadata, plan)
    if (version := metadata.versions.get("fmu_mesh")) != __version__:
        on_notice(f"'{path}' was made by fmu_mesh {version}, and this is {__version__}")
    if differs := machine_difference(metadata.versions, machine()):
        on_notice(f"'{path}' was made on another machine than this, so last digits may differ: {differs}")
    if differs := _computed_otherwise(metadata, plan):
        on_notice(f"'{path}' was computed otherwise than on this host, so values may differ: {differs}")
    return PlannedRerun(plan, values, last_point, first)


def _computed_otherwise(metadata: RunMetadata, plan: RunPlan) -> str:
    """In words what computes models here with another solver or another version of Wine; empty if nothing does.

    Files and configuration are those of the first run, so only the host can make a difference.
    """
    differs = []
    for name, own in metadata.models.items():
        now = plan.loaded.config.instances[name].summary(plan.plan.system.instances[name].description)
        if own.computed_by not in {"", now}:
            differs.append(f"'{name}' by '{own.computed_by}', and here by '{now}'")
    return ", ".join(differs)


def _metadata_of(path: Path, result: Result) -> tuple[RunMetadata, list[SetValue]]:
    entries = dict(result.metadata)
    values = entries.pop(_SET, [])
    entries.pop("keys", None)
    if "configuration" not in entries:
        beside = f"The file '{path.name}.json' beside it says it." if path.suffix.lower() != ".parquet" else None
        raise ConfigurationError(f"'{path}' does not say how it was made", hint=beside)
    try:
        return msgspec.convert(entries, RunMetadata), msgspec.convert(values, list[SetValue])
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"what '{path}' says about its run is not understood: {error}") from error


def _last_points(metadata: RunMetadata, result: Result) -> tuple[int, int | None]:
    """The point of the last row, and the one at which a rerun is stopped; None: it runs to its end."""
    if not len(result.times):
        raise ConfigurationError(f"'{result.file}' has no rows", hint="There is nothing to compare a rerun with.")
    last_time, stop_time = float(result.times[-1]), metadata.stop_time
    point = round((last_time - metadata.start_time) / metadata.step_size)
    ends_there = stop_time is not None and stop_time - last_time < metadata.step_size / 2
    return point, None if ends_there else point


def _check_models(path: Path, metadata: RunMetadata, plan: RunPlan) -> None:
    """Check that models and files of the scenario are those of the first run: a finding for each that is not."""
    findings = []
    for name, own in metadata.models.items():
        now = plan.contents.get(name, "")
        if own.sha256 and now != own.sha256:
            there = plan.plan.system.instances[name].fmu
            found = f"'{there}' has the SHA-256 {now[:12]}…"
            findings.append(Finding(str(path), f"models.{name}", found, f"{own.sha256[:12]}…, as in the first run"))
    files = scenario_files(plan.loaded, plan.plan.system)
    for file, sha256 in metadata.files.items():
        if (now := files.get(file, "")) != sha256:
            found = f"it has the SHA-256 {now[:12]}…"
            findings.append(Finding(str(path), f"files.{file}", found, f"{sha256[:12]}…, as in the first run"))
    if findings:
        changed = listed([f"'{finding.path.partition('.')[2]}'" for finding in findings])
        text = str(findings[0]) if len(findings) == 1 else f"{path}: {changed} have changed"
        raise ConfigurationError(text, findings=tuple(findings))
