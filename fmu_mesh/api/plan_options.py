"""What a program can choose beside the configuration: for the plan of a run, and for the run itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

import msgspec
import numpy as np

from ..config.loading import PlainConfig
from ..errors import CallRefused
from ..recorder.arrays_file import ENDING
from ..run.events import Event
from ..run.options import Options
from ..run.run_plan import RunPlan
from ..text import shown
from ..variables.value_conversion import to_plain
from ..wire.runtime import run_name, runtime_folder
from ..wire.views import MeshStatus

__all__ = [
    "PlanOptions",
    "RunOptions",
    "StartOptions",
    "memory_of",
    "options_of",
    "plain",
    "texts_of",
    "with_record",
    "with_scenario",
]

_MEMORY = "memory."


class PlanOptions(TypedDict, total=False):
    """What `Mesh.plan` and `Mesh.check` take; each option of the configuration replaces its key for this run.

    Attributes:
        record: "memory" keeps the results as arrays, without a file.
        output: the result file; its ending chooses the format.
        start_values: start values by `instance.variable`; or texts as `--set` has them.
        scenario: values of inputs and tunable parameters over time: a file, or a mapping with the keys of such a file.
        config_values: values of any keys by their path, such as `{"simulation.window": 16}`; or texts as `--set-config`
            has them.
        algorithm: "jacobi" or "gauss_seidel".
        step_size: base communication step size in s.
        stop_time: time of the last communication point in s.
        window: how many points a node may run ahead of the slowest one, or "auto".
        real_time_factor: simulation time per wall-clock time; 0: as fast as possible.
        update_period: with a real-time factor, points that are due are stepped together once per this time in s.
        catch_up: largest lag behind the wall clock in s.
        listen: Zenoh endpoints where others can connect.
        connect: Zenoh endpoints to connect to.
        paused: stay paused at the first point until `Run.resume` or `Run.step`.
        allow_code: run Python code that a package or a file of another user names, or that other users can write.
        view: show the world of a physics engine in a window.
        video: film that world into this file.
        profile: measure where the time goes; `Result.outcome` has it.
        on_notice: called with a sentence before something that takes long, such as compiling an FMU; by default, the
            log gets it.
    """

    record: Literal["memory"] | None
    output: str | Path | None
    start_values: Mapping[str, Any] | Sequence[str]
    scenario: str | Path | Mapping[str, Any] | None
    config_values: Mapping[str, Any] | Sequence[str]
    algorithm: str | None
    step_size: float | None
    stop_time: float | None
    window: int | Literal["auto"] | None
    real_time_factor: float | None
    update_period: float | None
    catch_up: float | None
    listen: Sequence[str]
    connect: Sequence[str]
    paused: bool
    allow_code: bool
    view: bool
    video: str | Path | None
    profile: bool | Path | None
    on_notice: Callable[[str], None]


class StartOptions(TypedDict, total=False):
    """What `Run.start` takes.

    Attributes:
        processes: False runs everything in this process; the floats are the same.
        memory_limit: the most bytes of results in memory (1 GiB); a run that needs more is refused, or ends there.
        restarts: how often a run is started again from its first point if one of its processes is lost.
        on_progress: called with a `MeshStatus` about ten times per second.
        on_event: called with every event of `fmu_mesh.run.events`; without it, the log gets messages of FMUs.
    """

    processes: bool
    memory_limit: int
    restarts: int
    on_progress: Callable[[MeshStatus], object] | None
    on_event: Callable[[Event], object] | None


class RunOptions(PlanOptions, StartOptions, total=False):
    """What `Mesh.run` and `Mesh.start` take: what `Mesh.plan` takes, and what `Run.start` takes."""


def options_of(given: PlanOptions) -> Options:
    """The options of a plan, as the command line has them.

    Raises:
        CallRefused: two of them exclude each other, or a value cannot be written down.
    """
    fields: dict[str, Any] = {**given}
    fields.pop("on_notice", None)
    if fields.pop("record", None) == "memory":
        if fields.get("output") is not None:
            raise CallRefused('`output` and `record="memory"` exclude each other')
        fields["output"] = _memory_file()
    fields["profile"] = Path() if fields.get("profile") is True else fields.get("profile") or None
    if isinstance(fields.get("scenario"), Mapping):
        fields.pop("scenario")  # `with_scenario` takes it
    for name in ("output", "video", "scenario"):
        fields[name] = Path(fields[name]) if fields.get(name) is not None else None
    for name, what in (("start_values", "start value"), ("config_values", "value")):
        fields[name] = texts_of(fields.get(name, ()), what)
    for name in ("listen", "connect"):
        fields[name] = tuple(fields.get(name, ()))
    return Options(**fields)


def with_scenario(values: PlainConfig, given: PlanOptions) -> PlainConfig:
    """The values of a configuration with the scenario that a program gives as a mapping; unchanged without one."""
    scenario = given.get("scenario")
    if not isinstance(scenario, Mapping) or not isinstance(values.data, dict):
        return values
    lines = {path: line for path, line in values.lines.items() if path.partition(".")[0] != "scenario"}
    return values._replace(data={**values.data, "scenario": plain(scenario)}, lines=lines)


def texts_of(values: Mapping[str, object] | Sequence[str], what: str) -> tuple[str, ...]:
    """Values as the command line has them; JSON is YAML, and its floats are exact."""
    if not isinstance(values, Mapping):
        return tuple(values)
    texts = []
    for name, value in values.items():
        try:
            texts.append(f"{name}={msgspec.json.encode(to_plain(plain(value))).decode()}")
        except (TypeError, msgspec.MsgspecError) as error:
            raise CallRefused(f"the {what} of '{name}' is {shown(value)}: {error}", variable=name) from error
    return tuple(texts)


def with_record(section: Any, variables: Sequence[str], keys: Mapping[str, Any], *, also: bool) -> Any:  # noqa: ANN401  as a file has it
    """The section `record` with another first file, or with one more.

    Args:
        section: what it was: a mapping or a list of mappings.
        variables: what the file gets; all outputs if there are none.
        keys: other keys of its section; None leaves what the section says.
        also: whether it is one more file.
    """
    given = {"from" if key == "start" else key: plain(value) for key, value in keys.items() if value is not None}
    given["variables"] = list(variables) or None
    sections = section if isinstance(section, list) else [section]
    if also:
        return [*sections, given]
    changed = {**(sections[0] if sections and isinstance(sections[0], dict) else {}), **given}
    return [changed, *sections[1:]] if isinstance(section, list) else changed


def plain(value: Any) -> Any:  # noqa: ANN401  whatever a program gives
    """A value as a file has it: paths are text, arrays are nested lists."""
    match value:
        case Path():
            return str(value)
        case np.ndarray() | np.generic():
            return value.tolist()
        case Mapping():
            return {_key(key): plain(inner) for key, inner in value.items()}
        case list() | tuple():
            return [plain(inner) for inner in value]
        case _:
            return value


def _key(key: Any) -> Any:  # noqa: ANN401  whatever a program gives
    """A key as a file has it: text. Those of a `map` are numbers in a program."""
    match key:
        case bool():
            return "true" if key else "false"
        case int() | np.integer():
            return str(key)
        case _:
            return key


def _memory_file() -> Path:
    """The file for results that stay in memory; the run makes its folder, and removes it.

    If this process is killed, the next run of this user removes them.
    """
    return runtime_folder() / f"{_MEMORY}{run_name()}" / f"rows{ENDING}"


def memory_of(plan: RunPlan) -> Path | None:
    """The file for results that stay in memory; None if they go where the configuration says."""
    output = plan.options.output
    if output is None or output.suffix != ENDING or not output.parent.name.startswith(_MEMORY):
        return None
    return output if output.parent.parent == runtime_folder() else None
