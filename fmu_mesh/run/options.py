"""The options of a run: what may be chosen beside the configuration, each in one field of one Struct."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ..config.call_options import CallOptions, Option
from ..errors import CallRefused

if TYPE_CHECKING:
    from ..wire.views import MeshStatus
    from .events import Event

__all__ = [
    "BatchOptions",
    "BeginOptions",
    "ConvergenceOptions",
    "OpenOptions",
    "PlanOptions",
    "RerunOptions",
    "RunOptions",
    "SimulateOptions",
    "StartOptions",
    "State",
    "SweepForce",
    "SweepResume",
    "VariantOptions",
    "Workers",
]

Values = Mapping[str, Any] | Iterable[Any] | None
File = str | Path | None
Number = float | None

AllowCode = Annotated[
    bool, Option("run Python code, and compile FMUs, that a file of others names, or others can write", "--allow-code")
]
OnNotice = Annotated[Callable[[str], None] | None, Option("called with a sentence before something that takes long")]
Output = Annotated[File, Option("result file; its ending chooses the format", "--output", "FILE", "record.file")]
StartValues = Annotated[Values, Option("start values by `instance.variable`", "--set", "INSTANCE.VARIABLE=VALUE")]
Processes = Annotated[bool, Option("False: run everything in this one process", "--local")]
MemoryLimit = Annotated[int, Option("the most bytes of results in memory; a run ends there, or is refused", least=0)]
Restarts = Annotated[
    int | None,
    Option(
        "start all processes again when one is lost, at most N times; None: as `recovery` says",
        "--restarts",
        "N",
        least=0,
    ),
]
Resume = Annotated[
    bool, Option("go on with the run in `recovery.directory`, which was cut off by a power cut or killed", "--resume")
]
State = Annotated[
    File, Option("begin with this state, which `System.save` or `Run.checkpoint` has written", "--from", "FILE")
]
Workers = Annotated[int | None, Option("processes of this host; None: one per processor", "--workers", "N", least=1)]
SweepResume = Annotated[bool, Option("keep the runs that the folder has, and run what is missing", "--resume")]
SweepForce = Annotated[bool, Option("remove the sweep that the folder has, and no other files", "--force")]
OnProgress = Annotated[Callable[["MeshStatus"], object] | None, Option("called about ten times per second")]
OnEvent = Annotated[Callable[["Event"], object] | None, Option("called with every event of `fmu_mesh.run.events`")]
MEMORY_LIMIT = 2**30
_MOST_HALVINGS = 6


class VariantOptions(CallOptions, frozen=True, kw_only=True):
    """What any run takes, also each run of a sweep; None leaves what the configuration says."""

    algorithm: Annotated[str | None, Option(None, "--algorithm", "NAME", "simulation.algorithm")] = None
    step_size: Annotated[Number, Option(None, "--step-size", "S", "simulation.step_size")] = None
    stop_time: Annotated[Number, Option(None, "--stop-time", "S", "simulation.stop_time")] = None
    window: Annotated[int | Literal["auto"] | None, Option(None, "--window", "N", "simulation.window")] = None
    start_values: StartValues = None
    config_values: Annotated[Values, Option("values of any keys by their path", "--set-config", "KEY=VALUE")] = None
    keys_from: Annotated[
        File,
        Option("take the values of keys from this result of an earlier run, and no others", "--keys-from", "RESULT"),
    ] = None
    allow_code: AllowCode = False
    on_notice: OnNotice = None


class ConvergenceOptions(VariantOptions, frozen=True, kw_only=True):
    """What `Mesh.convergence` takes."""

    halvings: Annotated[
        int, Option(f"how often the step size is halved, 1 to {_MOST_HALVINGS}; default: 2", "--halvings", "N", least=1)
    ] = 2
    workers: Workers = None
    folder: Annotated[
        File, Option("keep the runs in this folder, as a sweep; default: they are removed", "--folder", "FOLDER")
    ] = None
    resume: SweepResume = False
    force: SweepForce = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.halvings > _MOST_HALVINGS:
            raise CallRefused(f"`halvings={self.halvings}`: expected a whole number from 1 to {_MOST_HALVINGS}")


class BeginOptions(VariantOptions, frozen=True, kw_only=True):
    """With which state it begins."""

    state: State = None
    replaced: Annotated[
        Sequence[str],
        Option("begin this instance anew in that state, also with another model", "--replace", "INSTANCE"),
    ] = ()


class OpenOptions(BeginOptions, frozen=True):
    """What `Mesh.open` takes."""

    start_values: StartValues = None


class BatchOptions(VariantOptions, frozen=True):
    """What `Mesh.batch` takes."""

    start_values: StartValues = None
    threads: Annotated[
        int, Option("step the copies on so many threads, each with a library of its own of each FMU", least=1)
    ] = 1
    processes: Annotated[
        int | None,
        Option("have the copies in so many processes; 1: in this one; default: as many as pay", least=1),
    ] = None
    record: Annotated[
        Literal["memory"] | Sequence[str] | None,
        Option('variables to record for `Batch.result`, or "memory" for those of the configuration; None: nothing'),
    ] = None
    memory_limit: MemoryLimit = MEMORY_LIMIT


class PlanOptions(BeginOptions, frozen=True, kw_only=True):
    """What `Mesh.plan` and `Mesh.check` take; each option of the configuration replaces its key for this run.

    Example:
        >>> PlanOptions(window=1, start_values=[("gain.k", 2.5)]).given()
        {'window': 1, 'start_values': {'gain.k': 2.5}}
    """

    real_time_factor: Annotated[Number, Option(None, "--real-time-factor", "F", "simulation.real_time_factor")] = None
    update_period: Annotated[Number, Option(None, "--update-period", "S", "simulation.update_period")] = None
    catch_up: Annotated[Number, Option(None, "--catch-up", "S", "simulation.catch_up")] = None
    defects: Annotated[
        bool, Option("show where inputs differ most from what was assumed", "--defects", key="simulation.defects")
    ] = False
    record: Annotated[
        Literal["memory"] | Sequence[str] | None,
        Option(
            'variables to record, or "memory" for those of the configuration: as arrays, unless `output` names a file'
        ),
    ] = None
    output: Output = None
    scenario: Annotated[
        File | Mapping[str, Any], Option("values over time: a file, or what such a file has", "--scenario", "FILE")
    ] = None
    listen: Annotated[Sequence[str] | None, Option(None, "--listen", "ENDPOINT", "zenoh.listen")] = None
    connect: Annotated[Sequence[str] | None, Option(None, "--connect", "ENDPOINT", "zenoh.connect")] = None
    security: Annotated[
        File, Option("folder with the certificate of this host", "--security", "DIR/NAME", "security.folder")
    ] = None
    insecure: Annotated[
        bool, Option("let everybody at a network read, set and end the mesh", "--insecure", key="zenoh.insecure")
    ] = False
    paused: Annotated[bool, Option("stay paused at the first point", "--paused")] = False
    view: Annotated[bool, Option("show the world of the physics engine in a window", "--view")] = False
    video: Annotated[File, Option("film that world into a file, .mp4 or .gif", "--video", "FILE.mp4")] = None
    profile: Annotated[
        bool | str | Path,
        Option("show where the time went; also a trace for Perfetto in a file", "--profile", "FILE.json", bare=True),
    ] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.record == "memory" and self.output is not None:
            raise CallRefused('`output` and `record="memory"` exclude each other', hint="Leave one of them out.")


class ResetOptions(CallOptions, frozen=True, kw_only=True):
    """What `Run.reset` takes."""

    start_values: StartValues = None


class StartOptions(CallOptions, frozen=True, kw_only=True):
    """What `Run.start` takes."""

    processes: Processes = True
    memory_limit: MemoryLimit = MEMORY_LIMIT
    restarts: Restarts = None
    resume: Resume = False
    on_progress: OnProgress = None
    on_event: OnEvent = None


class RunOptions(PlanOptions, frozen=True, kw_only=True):
    """What `Mesh.run` and `Mesh.start` take: what `Mesh.plan` takes, and what `Run.start` takes."""

    processes: Processes = True
    memory_limit: MemoryLimit = MEMORY_LIMIT
    restarts: Restarts = None
    resume: Resume = False
    on_progress: OnProgress = None
    on_event: OnEvent = None


class RerunOptions(StartOptions, frozen=True, kw_only=True):
    """What `fmu_mesh.rerun` takes."""

    output: Output = None
    allow_code: AllowCode = False
    on_notice: OnNotice = None


class SimulateOptions(CallOptions, frozen=True, kw_only=True):
    """What `simulate` takes; times that are None are those of the FMU's default experiment."""

    start_time: Annotated[Number, Option("time at which it starts, in s", "--start-time", "S")] = None
    stop_time: Annotated[Number, Option("time at which it ends, in s", "--stop-time", "S")] = None
    step_size: Annotated[Number, Option("communication step size in s", "--step-size", "S")] = None
    output_interval: Annotated[
        Number, Option("time between two rows in s, a whole multiple of the step size", "--output-interval", "S")
    ] = None
    kind: Annotated[
        Literal["auto", "co_simulation", "model_exchange"],
        Option("which kind of the FMU to use; auto: co-simulation if it has both", "--kind", "KIND"),
    ] = "auto"
    tolerance: Annotated[Number, Option("relative tolerance of a co-simulation FMU", "--tolerance", "X")] = None
    solver: Annotated[
        Mapping[str, Any] | None, Option("of model exchange: name, relative_tolerance and maximum_step_size")
    ] = None
    start_values: Annotated[Values, Option("start values by variable", "--set", "VARIABLE=VALUE")] = None
    inputs: Annotated[
        object, Option("inputs over time: a table; in Python also an array, a frame or a mapping", "--inputs", "FILE")
    ] = None
    record: Annotated[
        Sequence[str] | None, Option("variables or patterns; default: all outputs", "--record", "NAME")
    ] = None
    output: Output = None
    processes: Processes = True
    memory_limit: MemoryLimit = MEMORY_LIMIT
    on_progress: OnProgress = None
    on_event: OnEvent = None
    on_notice: OnNotice = None
