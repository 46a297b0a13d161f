"""A mesh as a Python object: read from a file or built in a program, then checked, run, started or stepped."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, TypedDict, Unpack

import msgspec
import numpy as np

from ..config.loading import PlainConfig, read_file, read_text
from ..config.yaml_text import written
from ..errors import CallRefused, ConfigurationError, Finding
from ..instances.configuration import examine_data
from ..instances.python.importing import being_imported, component_section
from ..instances.registry import KINDS, check_engines
from ..run.events import Event, Status
from ..run.options import Options
from ..run.preparing import planned
from ..run.run_plan import RunPlan
from ..text import listed, shown
from ..wire.views import MeshStatus
from .open_system import System
from .result import Result
from .run_handle import Run
from .run_thread import MEMORY_LIMIT, RunThread, Settings, memory_file

__all__ = ["Check", "Mesh", "RunOptions"]

log = logging.getLogger("fmu_mesh.run")


class RunOptions(TypedDict, total=False):
    """What `Mesh.run` and `Mesh.start` take; each option of the configuration replaces its key for this run.

    Attributes:
        processes: False runs everything in this process; the floats are the same.
        record: "memory" keeps the results as arrays, without a file.
        memory_limit: the most bytes of such results (1 GiB); a run that needs more is refused, or ends there.
        output: the result file; its ending chooses the format.
        start_values: start values by `instance.variable`.
        step_size: base communication step size in s.
        stop_time: time of the last communication point in s.
        window: how many points a node may run ahead of the slowest one, or "auto".
        real_time_factor: simulation time per wall-clock time; 0: as fast as possible.
        update_period: with a real-time factor, points that are due are stepped together once per this time in s.
        catch_up: largest lag behind the wall clock in s.
        listen: Zenoh endpoints where others can connect.
        connect: Zenoh endpoints to connect to.
        paused: stay paused at the first point until `Run.resume` or `Run.step`.
        restarts: how often a run is started again from its first point if one of its processes is lost.
        allow_code: run the Python code that a configuration names although another user owns the file.
        view: show the world of a physics engine in a window.
        video: film that world into this file.
        on_progress: called with a `MeshStatus` about ten times per second.
        on_event: called with every event of `fmu_mesh.run.events`.
    """

    processes: bool
    record: Literal["memory"] | None
    memory_limit: int
    output: str | Path | None
    start_values: Mapping[str, Any]
    step_size: float
    stop_time: float
    window: int | Literal["auto"]
    real_time_factor: float
    update_period: float
    catch_up: float
    listen: Sequence[str]
    connect: Sequence[str]
    paused: bool
    restarts: int
    allow_code: bool
    view: bool
    video: str | Path
    on_progress: Callable[[MeshStatus], object]
    on_event: Callable[[Event], object]


class Check(msgspec.Struct, frozen=True):
    """What `Mesh.check` found.

    Example:
        >>> import fmu_mesh
        >>> check = fmu_mesh.load("configs/pendulum_delay.yaml").check()
        >>> bool(check), check.findings
        (True, ())

    Attributes:
        findings: everything that is wrong, each with its place; empty if the mesh can run.
        warnings: what may be wrong, in words.
        run: the plan of the run; None if something is wrong.
    """

    findings: tuple[Finding, ...] = ()
    warnings: tuple[str, ...] = ()
    run: RunPlan | None = None

    def __bool__(self) -> bool:
        return not self.findings

    def __str__(self) -> str:
        lines = [*map(str, self.findings), *(f"warning: {warning}" for warning in self.warnings)]
        return "\n".join(lines) or "OK"


class Mesh:
    """A mesh: instances, connections, and how they are simulated.

    Everything that a configuration file can say can be said here, with the same names. A mesh that a program builds
    looks for files in the folder in which it was made.

    Example:
        >>> import fmu_mesh
        >>> mesh = fmu_mesh.Mesh("pair", step_size=0.002, stop_time=1.0)
        >>> mesh.add("pendulum", fmu="fmus/DampedPendulum.fmu", start_values={"a": 1.3})
        >>> mesh.add("delay", fmu="fmus/TransportDelay.fmu", start_values={"d": 0.5})
        >>> mesh.connect("pendulum.a", "delay.x")
        >>> result = mesh.run(record="memory")
        >>> float(result["delay.y"][-1]) == float(result["pendulum.a"][-251])
        True

    Args:
        name: name of the mesh; part of every Zenoh key.
        step_size: base communication step size in s.
        stop_time: time of the last communication point in s; None: the run goes on until it is stopped.
        simulation: any other key of the section `simulation`, such as ``algorithm="jacobi"``.
    """

    def __init__(
        self,
        name: str,
        *,
        step_size: float,
        stop_time: float | None,
        **simulation: Any,  # noqa: ANN401  as the file has it
    ) -> None:
        keys = {"step_size": step_size, "stop_time": stop_time, **simulation}
        data = {"mesh": name, "simulation": _plain(keys), "instances": {}, "connections": []}
        self._take(PlainConfig(data, Path.cwd() / f"<mesh {name}>"))

    @classmethod
    def from_yaml(cls, text: str, *, folder: str | Path = ".") -> Self:
        """A mesh from the text of a configuration file.

        Args:
            text: the YAML text.
            folder: relative paths in the text refer to it.

        Raises:
            ConfigurationError: the text is no YAML. What it means is checked by `check`, and before a run.
        """
        mesh = cls.__new__(cls)
        mesh._take(read_text(text, Path(folder).absolute() / "<text>"))  # noqa: SLF001  its own method
        return mesh

    @classmethod
    def from_file(cls, path: str | Path) -> Self:
        """As `load`."""
        mesh = cls.__new__(cls)
        mesh._take(read_file(Path(path)))  # noqa: SLF001  its own method
        return mesh

    def _take(self, plain: PlainConfig) -> None:
        self._plain = plain

    # --- building

    @property
    def name(self) -> str:
        """Name of the mesh."""
        return str(self._data.get("mesh"))

    @property
    def instances(self) -> list[str]:
        """Names of the instances."""
        return list(self._data.get("instances") or ())

    def add(  # noqa: PLR0913  keys of a section
        self,
        name: str,
        *,
        fmu: str | Path | None = None,
        component: object = None,
        start_values: Mapping[str, Any] | None = None,
        step_size: float | None = None,
        group: str | None = None,
        **section: Any,  # noqa: ANN401  the kind of instance says what it takes
    ) -> None:
        """Add an instance.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.Mesh("gain", step_size=0.01, stop_time=1.0)
            >>> mesh.add("gain", fmu="fmus/Gain.fmu", start_values={"k": 2.0}, step_size=0.02)
            >>> mesh.instances
            ['gain']

        Args:
            name: its name.
            component: a component in Python, which the processes of a run import from its file.
            fmu: path of an FMU; instances of other kinds have their own key, such as ``mujoco="world.xml"``.
            start_values: by variable; an array as nested lists or as a numpy array.
            step_size: step size of this instance in s, a whole multiple of that of the mesh.
            group: instances of one group share one process.
            section: any other key of the section of an instance in a configuration file.

        Raises:
            CallRefused: there is an instance of this name, or no key says what it is.
            ConfigurationError: other processes cannot import the component.
        """
        if name in self.instances:
            raise CallRefused(f"mesh '{self.name}' has an instance '{name}' already")
        own = component_section(component)[0] if component is not None else {}
        keys = {"fmu": fmu, **own, **section, "start_values": start_values, "step_size": step_size, "group": group}
        given = {key: value for key, value in keys.items() if value is not None}
        if not given.keys() & {*KINDS.names()}:
            raise CallRefused(
                f"nothing says what '{name}' is", hint=f"Give it one of the keys {listed(KINDS.names())}."
            )
        self._section("instances")[name] = _plain(given)

    def connect(self, source: str, target: str, **keys: Any) -> None:  # noqa: ANN401  as the file has it
        """Connect an output to an input, both as `instance.variable`.

        Args:
            source: the output.
            target: the input.
            keys: any other key of a connection in a configuration file, such as ``factor=2.0``.
        """
        connections = self._data.setdefault("connections", [])
        connections.append(_plain({"from": source, "to": target, **keys}))

    def record(self, *variables: str, file: str | Path | None = None) -> None:
        """Choose what is recorded, and into which file.

        Args:
            variables: outputs as `instance.variable`; all outputs if none is named.
            file: the result file; None leaves the one of the configuration.
        """
        section = self._section("record")
        section.update(_plain({"variables": list(variables) or None} | ({"file": file} if file is not None else {})))

    def configure(self, **sections: Any) -> None:  # noqa: ANN401  as the file has it
        """Set keys of other sections of the configuration, or of the top level.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.configure(group="auto", timeouts={"step": 5.0}, simulation={"window": 64})

        Args:
            sections: a value, or a mapping that is merged into the section.
        """
        for key, value in sections.items():
            if isinstance(value, Mapping):
                self._section(key).update(_plain(dict(value)))
            else:
                self._data[key] = _plain(value)

    def to_yaml(self) -> str:
        """The configuration as the text of a file, for the folder that this mesh looks for files in."""
        return written(self._data)

    def save(self, path: str | Path) -> None:
        """Write the configuration into a file, which `fmu-mesh launch` runs.

        Raises:
            ConfigurationError: the file cannot be written, or lies in another folder than the one that this mesh looks
                for files in, so that its paths would lead elsewhere.
        """
        path = Path(path)
        if path.absolute().parent.resolve() != self._plain.file.absolute().parent.resolve():
            folder = self._plain.file.absolute().parent
            raise ConfigurationError(f"'{path}' lies outside '{folder}', to which the paths in it refer")
        try:
            path.write_text(self.to_yaml(), encoding="utf-8")
        except OSError as error:
            raise ConfigurationError(f"'{path}' cannot be written: {error.strerror}") from error

    # --- running

    def check(self, **options: Unpack[RunOptions]) -> Check:
        """Check the configuration, its models, and that this host can run them; nothing is started.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.add("gain", fmu="../fmus/Gian.fmu")
            >>> for finding in mesh.check().findings:
            ...     print(finding.path, finding.suggestion[-8:])
            instances.gain.fmu Gain.fmu
        """
        try:
            run = self._planned(_options_of(options))
            check_engines(run.plan.system.config.instances, str(self._plain.file))
        except ConfigurationError as error:
            findings = error.findings or (Finding(str(self._plain.file), "", error.message, error.hint or ""),)
            return Check(findings=findings)
        return Check(warnings=tuple(map(str, run.plan.system.warnings)), run=run)

    def run(self, **options: Unpack[RunOptions]) -> Result:
        """Run the mesh to its end, and return what it has recorded.

        Ctrl-C ends the run, and raises `KeyboardInterrupted`.

        Example:
            >>> import fmu_mesh
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> apart = mesh.run(record="memory", stop_time=1.0)
            >>> here = mesh.run(record="memory", stop_time=1.0, processes=False)
            >>> bool((apart["delay.y"] == here["delay.y"]).all())
            True

        Args:
            options: see `RunOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
            FmuMeshError: the run ended early; names instance, variable and point, and its `result` has what was
                recorded up to then.
        """
        with self.start(**options) as run:
            return run.wait()

    def start(self, **options: Unpack[RunOptions]) -> Run:
        """Start the mesh, and return a handle to look into it, steer it and wait for it.

        Use it as a context manager, or call `Run.wait` or `Run.close`. What still runs at the end of the program is
        ended.

        Args:
            options: see `RunOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
        """
        memory = None
        if options.get("record") == "memory":
            if options.get("output") is not None:
                raise CallRefused('`output` and `record="memory"` exclude each other')
            memory = memory_file()
        try:
            plan = self._planned(_options_of(options, memory))
            settings = Settings(
                processes=options.get("processes", True),
                restarts=options.get("restarts", 0),
                on_event=_listener(options),
                memory=memory,
                memory_limit=options.get("memory_limit", MEMORY_LIMIT),
            )
            return Run(plan.mesh, own=RunThread(plan, settings))
        except BaseException:
            if memory is not None:
                memory.parent.rmdir()
            raise

    def open(self, start_values: Mapping[str, Any] | None = None) -> System:
        """Open all instances in this process, for a program that steps them itself (docs/stepping.md).

        Nothing is recorded into a file, and no other process is started.

        Example:
            >>> import fmu_mesh
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open({"pendulum.a": 0.5}) as system:
            ...     system.step(100)
            ...     system.time, system.get("pendulum.a") < 0.5
            (0.2, True)

        Args:
            start_values: start values by `instance.variable`; they come before those of the configuration.

        Raises:
            ConfigurationError: the configuration, a model or a start value is wrong; carries all findings. Or two
                instances need a process of their own each.
            FmuError: an instance cannot be opened or initialized. Nothing is left behind.
        """
        return System(self._planned(_options_of({"start_values": start_values or {}})))

    def _planned(self, options: Options) -> RunPlan:
        if (place := being_imported()) is not None:
            hint = 'Write `if __name__ == "__main__":` before what the program does.'
            raise ConfigurationError(f"mesh '{self.name}' would run while '{place}' is imported", hint=hint)
        file = self._plain.file
        if file.is_relative_to(here := Path.cwd()):  # findings name it; the folder of the program says nothing new
            file = file.relative_to(here)
        loaded, findings = examine_data(self._plain._replace(file=file), options.start_values)
        return planned(loaded, findings, options, log.info)

    @property
    def _data(self) -> dict[str, Any]:
        data = self._plain.data
        if not isinstance(data, dict):
            raise ConfigurationError(f"'{self._plain.file}' has {shown(data)} where a configuration should be")
        return data

    def _section(self, key: str) -> dict[str, Any]:
        section = self._data.setdefault(key, {})
        if not isinstance(section, dict):
            raise ConfigurationError(f"'{key}' of '{self._plain.file}' is {shown(section)}, where a mapping should be")
        return section


def _options_of(given: RunOptions, memory: Path | None = None) -> Options:
    """The options of a run, as the command line has them."""
    output = given.get("output")
    video = given.get("video")
    return Options(
        step_size=given.get("step_size"),
        stop_time=given.get("stop_time"),
        window=given.get("window"),
        real_time_factor=given.get("real_time_factor"),
        update_period=given.get("update_period"),
        catch_up=given.get("catch_up"),
        start_values=tuple(_start_value(*item) for item in given.get("start_values", {}).items()),
        output=memory if memory is not None else Path(output) if output is not None else None,
        listen=tuple(given.get("listen", ())),
        connect=tuple(given.get("connect", ())),
        paused=given.get("paused", False),
        allow_code=given.get("allow_code", False),
        view=given.get("view", False),
        video=Path(video) if video is not None else None,
    )


def _start_value(name: str, value: object) -> str:
    """A start value as the command line has it; JSON is YAML, and its floats are exact."""
    try:
        return f"{name}={msgspec.json.encode(_plain(value)).decode()}"
    except (TypeError, msgspec.MsgspecError) as error:
        raise CallRefused(f"the start value of '{name}' is {shown(value)}: {error}", variable=name) from error


def _listener(options: RunOptions) -> Callable[[Event], None] | None:
    """What is called with the events of a run; None if nothing is asked for."""
    on_event, on_progress = options.get("on_event"), options.get("on_progress")
    if on_event is None and on_progress is None:
        return None

    def tell(event: Event) -> None:
        if on_event is not None:
            on_event(event)
        if on_progress is not None and isinstance(event, Status):
            on_progress(event.status)

    return tell


def _plain(value: Any) -> Any:  # noqa: ANN401  whatever a program gives
    """A value as a file has it: paths are text, arrays are nested lists."""
    match value:
        case Path():
            return str(value)
        case np.ndarray() | np.generic():
            return value.tolist()
        case Mapping():
            return {key: _plain(inner) for key, inner in value.items()}
        case list() | tuple():
            return [_plain(inner) for inner in value]
        case _:
            return value
