"""A mesh as a Python object: read from a file or built in a program, then checked, run, started or stepped."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Self

import msgspec
from msgspec.structs import replace

from ..config.call_options import checked, takes
from ..config.instance_sections import KIND
from ..config.key_sections import KEY
from ..config.loading import PlainConfig, read_text
from ..config.mesh import LimitsConfig
from ..config.plain_values import plain
from ..config.yaml_text import written
from ..errors import CallRefused, ConfigurationError, FmuError, LoadFailed
from ..files import write_whole
from ..instances.python.python_section import importing
from ..instances.registry import KINDS
from ..pictures.tables import html_table, shortened
from ..run.options import BatchOptions, ConvergenceOptions, OpenOptions, PlanOptions, RunOptions, StartOptions
from ..run.overriding import memory_file, memory_of
from ..run.preparing import KnownModels, planned, without_keys
from ..run.run_plan import RunPlan
from ..ssp.configuration_files import read_configuration
from ..text import counted, listed, shown
from ..variables.model_description import ModelDescription
from .inspection import with_way_out
from .mesh_check import Check, check_of
from .mesh_editing import (
    check_part,
    connections_of,
    ends_of,
    rebased,
    said_by,
    sections_of,
    unknown,
    with_connections,
    with_record,
    without_instance,
)

if TYPE_CHECKING:
    from .. import Convergence
    from ..errors import Finding
    from ..pictures.system_graph import SystemGraph
    from .batch import Batch
    from .open_system import System
    from .repeated_mesh import RepeatedMesh
    from .result import Result
    from .run_handle import Run

__all__ = ["Mesh", "load"]

log = logging.getLogger("fmu_mesh.run")


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
        data = {"mesh": name, "simulation": plain(keys), "instances": {}, "connections": []}
        self._take(PlainConfig(data, Path.cwd() / f"<mesh {name}>"))

    @classmethod
    @checked
    def from_yaml(cls, text: str, *, folder: str | Path = ".") -> Self:
        """A mesh from the text of a configuration file.

        Args:
            text: the YAML text.
            folder: relative paths in the text refer to it.

        Raises:
            ConfigurationError: the text is no YAML. What it means is checked by `check`, and before a run.
        """
        return cls.from_configuration(read_text(text, Path(folder).absolute() / "<text>"))

    @classmethod
    def from_configuration(cls, configuration: PlainConfig, *, keeps_code: bool = False) -> Self:
        """A mesh from the values of a configuration, such as those of `configuration`.

        Args:
            configuration: the values.
            keeps_code: whether components in Python are described once, and not for each plan; right where their code
                does not change between two plans.
        """
        mesh = cls.__new__(cls)
        mesh._take(configuration, KnownModels(keeps_code=keeps_code))  # noqa: SLF001  its own method
        return mesh

    @classmethod
    @checked
    def from_file(cls, path: str | Path, *, ssd: str | None = None, ssv: Sequence[str | Path] = ()) -> Self:
        """As `load`."""
        return cls.from_configuration(read_configuration(Path(path), ssd, ssv))

    @classmethod
    @checked
    def from_fmu(
        cls,
        path: str | Path,
        *,
        name: str | None = None,
        simulation: Mapping[str, Any] | Callable[[ModelDescription], Mapping[str, Any]] = MappingProxyType({}),
        on_notice: Callable[[str], None] = log.info,
        **section: Any,  # noqa: ANN401  as the file has it
    ) -> Self:
        """A mesh of one FMU, as `fmu-mesh run` makes it; nothing is recorded, unless an option says so.

        Example:
            >>> mesh = fmu_mesh.Mesh.from_fmu("fmus/DampedPendulum.fmu", simulation={"stop_time": 1.0})
            >>> mesh.run(record="memory")["DampedPendulum.a"].shape
            (501,)

        Args:
            path: the FMU.
            name: name of the mesh and of its instance; None: the model identifier.
            simulation: keys of the section `simulation`, or what gives them for a model description; by default, the
                FMU says the step size, and there is no end.
            on_notice: called with a sentence before something that takes long, such as compiling the FMU.
            section: other keys of the instance, as in `add`.

        Raises:
            LoadFailed: it is no FMU that can run here; says why.
            CallRefused: neither the FMU nor ``simulation`` has a step size.
        """
        file = Path(path)
        own = msgspec.convert({KIND: "fmu", "fmu": str(file.absolute())}, KINDS.section("fmu"))
        known = KnownModels()
        try:
            description = known.describe(file, own, LimitsConfig(), on_notice)
        except LoadFailed as error:
            raise with_way_out(error, file) from error
        own_name = name if name is not None else description.model_identifier
        given = simulation(description) if callable(simulation) else simulation
        times = {"step_size": description.step_size, "stop_time": None, **given}
        if times["step_size"] is None:
            hint = 'Give one, as `simulation={"step_size": ...}`.'
            raise CallRefused(f"'{path}' has no default step size.", hint=hint)
        instances = {own_name: {"fmu": file.absolute(), **section}}
        data = plain({"mesh": own_name, "simulation": times, "instances": instances, "record": {"file": None}})
        mesh = cls.__new__(cls)
        mesh._take(PlainConfig(data, file), known)  # noqa: SLF001  its own method
        return mesh

    def _take(self, values: PlainConfig, known: KnownModels | None = None) -> None:
        self._plain = values
        self._known = known or KnownModels()

    def __repr__(self) -> str:
        return f"<Mesh {self._in_short}>"

    def _repr_html_(self) -> str:
        instances = _mapping(_mapping(self._plain.data).get("instances"))
        rows = ((name, _in_words(own), _in_words(_mapping(own).get("start_values"))) for name, own in instances.items())
        return html_table(self._in_short, ["instance", "what it is", "start values"], rows, len(instances))

    @property
    def _in_short(self) -> str:
        data = _mapping(self._plain.data)  # a file may say anything
        found = ((what, data.get(f"{what}s")) for what in ("instance", "connection"))
        counts = (counted(len(own) if isinstance(own, dict | list) else 0, what) for what, own in found)
        return f"{shortened(str(data.get('mesh')), 40)}: {', '.join(counts)}"

    # --- building

    @property
    def name(self) -> str:
        """Name of the mesh."""
        return str(self._data.get("mesh"))

    @property
    def configuration(self) -> PlainConfig:
        """The values of the configuration, as a file has them, and where they come from."""
        return self._plain

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
        group: str | Mapping[str, Any] | None = None,
        replace: bool = False,
        **section: Any,  # noqa: ANN401  the kind of instance says what it takes
    ) -> None:
        """Add an instance.

        Example:
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
            group: instances of one group share one process; ``{"name": "g", "solve": "newton"}`` also solves it.
            replace: whether it takes the place of an instance of this name, whose connections stay.
            section: any other key of the section of an instance in a configuration file.

        Raises:
            CallRefused: there is an instance of this name, no key says what it is, or a key is wrong.
            ConfigurationError: other processes cannot import the component.
        """
        if name in self.instances and not replace:
            hint = "Call it with `replace=True`, or `remove` the other one."
            raise CallRefused(f"mesh '{self.name}' has an instance '{name}' already", hint=hint)
        own: Mapping[str, Any] = {}
        if component is not None:
            from ..instances.python.importing import component_section  # noqa: PLC0415 a file names no class

            own = component_section(component)[0]
        keys = {"fmu": fmu, **own, **section, "start_values": start_values, "step_size": step_size, "group": group}
        given = {key: value for key, value in keys.items() if value is not None}
        if not given.keys() & {*KINDS.names()}:
            hint = f"Give it one of the keys {listed(KINDS.names())}."
            raise CallRefused(f"nothing says what '{name}' is", hint=hint)
        call, path, own = f"mesh.add({name!r})", f"instances.{name}", plain(given)
        check_part(call, {"instances": {name: own}}, [path], path)
        self._plain = said_by(self._plain, call, [path], new=name not in self.instances)
        self._data["instances"] = {**self._section("instances"), name: own}

    def remove(self, name: str) -> None:
        """Remove an instance, its connections, what the scenario sets of it, and what was chosen of it to be recorded.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.disconnect(target="delay.x")
            >>> mesh.remove("delay")
            >>> mesh.instances
            ['pendulum']

        Raises:
            UnknownName: there is no such instance; suggests the nearest one.
        """
        if name not in self.instances:
            raise unknown(f"mesh '{self.name}' has no instance '{name}'", name, self.instances)
        self._plain = without_instance(self._plain, name)

    def connect(self, source: str, target: str, **keys: Any) -> None:  # noqa: ANN401  as the file has it
        """Connect an output to an input, both as `instance.variable`; the same two once again get other ``keys``.

        Args:
            source: the output.
            target: the input.
            keys: any other key of a connection in a configuration file, such as ``factor=2.0``.

        Raises:
            CallRefused: a key is wrong.
        """
        self._join(f"mesh.connect({source!r}, {target!r})", {"from": source, "to": target, **keys}, [source, target])

    def subscribe(self, key: str, target: str, **keys: Any) -> None:  # noqa: ANN401  as the file has it
        """Let an input get what other programs publish under a Zenoh key (docs/live-data.md).

        Example:
            >>> mesh = fmu_mesh.Mesh("twin", step_size=0.01, stop_time=1.0, real_time_factor=1.0)
            >>> mesh.add("pump", fmu="fmus/Gain.fmu")
            >>> mesh.subscribe("plant/pump/flow", "pump.u", field="sensors[0].value", time="timestamp")
            >>> mesh.publish("pump.y", "twin/pump/y", every=0.1)
            >>> for key in mesh.check().plan.keys:
            ...     print(key.ends, "|", key.encoding, "|", key.rule)
            plant/pump/flow -> pump.u | auto sensors[0].value | at its timestamp
            pump.y -> twin/pump/y | json | every 10 points

        Args:
            key: the key of Zenoh; with ``take="newest"`` it may have wildcards.
            target: the input, or a tunable parameter, as `instance.variable`.
            keys: any other key of such a connection in a configuration file, such as ``encoding="text"``.

        Raises:
            CallRefused: a key is wrong.
        """
        self._join(f"mesh.subscribe({key!r}, {target!r})", {"key": key, "to": target, **keys}, [target])

    def publish(self, source: str, key: str, **keys: Any) -> None:  # noqa: ANN401  as the file has it
        """Publish the values of an output under a Zenoh key, for other programs; see `subscribe`.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.publish("delay.y", "twin/angle", on="change", encoding="text")
            >>> mesh.disconnect("delay.y", "twin/angle")

        Args:
            source: the output as `instance.variable`.
            key: the key of Zenoh.
            keys: any other key of such a connection in a configuration file, such as ``every=0.1``.

        Raises:
            CallRefused: a key is wrong.
        """
        self._join(f"mesh.publish({source!r}, {key!r})", {"from": source, "key": key, **keys}, [source])

    def _join(self, call: str, entry: Mapping[str, Any], ends: Sequence[str]) -> None:
        own = plain(entry)
        check_part(call, {"connections": [own]}, ["connections[0]"], "connections[0]")
        if wrong := [end for end in ends if not all(end.partition(".")[::2])]:
            raise CallRefused(f"{call}: '{wrong[0]}'; expected instance.variable")
        connections = connections_of(self._plain)
        both = ends_of(own)
        place = next((n for n, one in enumerate(connections) if ends_of(one) == both), len(connections))
        self._plain = said_by(self._plain, call, [f"connections[{place}]"], new=place == len(connections))
        connections[place : place + 1] = [own]
        self._data["connections"] = connections

    def disconnect(self, source: str | None = None, target: str | None = None) -> None:
        """Remove connections: of an output, of an input, or the one from an output to an input.

        Args:
            source: the output, or the Zenoh key; None: any.
            target: the input, or the Zenoh key; None: any.

        Raises:
            UnknownName: there is no such connection; suggests the nearest one.
        """

        def keeps(one: object, other: object) -> bool:
            pairs = (source, one), (target, other)
            return any(wanted is not None and end not in (wanted, f"{KEY}{wanted}") for wanted, end in pairs)

        left, there = with_connections(self._plain, keeps), connections_of(self._plain)
        if source is target is None or len(connections_of(left)) == len(there):
            wanted = f"{source or '*'} -> {target or '*'}"
            names = [" -> ".join(map(str, ends_of(one))) for one in there]
            raise unknown(f"mesh '{self.name}' has no connection '{wanted}'", wanted, names)
        self._plain = left

    def record(self, *variables: str, file: str | Path | None = None, also: bool = False, **keys: Any) -> None:  # noqa: ANN401  as the file has it
        """Choose what is recorded, and into which file.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.record("pendulum.a", "in:delay.*", file="results/all.csv")
            >>> mesh.record("pendulum.a", file="results/slow.csv", every=100, also=True)
            >>> [result.names for result in mesh.run(stop_time=1.0).all]
            [['pendulum.a', 'delay.x'], ['pendulum.a']]

        Args:
            variables: variables as `instance.variable`, or patterns; all outputs if none is named.
            file: the result file; None leaves the one of the configuration.
            also: whether this is one more result file, or the first one is changed.
            keys: any other key of the section in a configuration file; the key `from` is ``start``.
        """
        section = self._data.get("record", {})
        own = with_record(section, variables, {"file": file, **keys}, also=also)
        base = "record" if not isinstance(own, list) else f"record[{len(own) - 1 if also else 0}]"
        given = ["variables", *("from" if key == "start" else key for key in {"file": file, **keys})]
        self._change("mesh.record(...)", {"record": own}, [base] if also else [f"{base}.{key}" for key in given])

    def scenario(
        self,
        values: Mapping[str, Any] | None = None,
        events: Sequence[Mapping[str, Any]] = (),
        *,
        file: str | Path | None = None,
    ) -> None:
        """Say what inputs and tunable parameters get while the mesh runs; adds to what was said before.

        Example:
            >>> mesh = fmu_mesh.Mesh("gain", step_size=0.5, stop_time=2.0)
            >>> mesh.add("gain", fmu="fmus/Gain.fmu")
            >>> mesh.scenario({"gain.u": {"times": [0, 1], "values": [1, 3], "interpolation": "linear"}})
            >>> mesh.scenario(events=[{"at": 1.5, "set": {"gain.k": 10.0}}])
            >>> mesh.run(record="memory", processes=False)["gain.y"].tolist()
            [1.0, 1.0, 2.0, 3.0, 30.0]

        Args:
            values: by `instance.variable`: a constant, or a mapping with times and values, or with a file.
            events: mappings with a time in s (``at``) and the values from then on (``set``), by `instance.variable`.
            file: a file with `values` and `events`, in the place of everything that was said before.
        """
        call = "mesh.scenario(...)"
        if file is not None:
            self._change(call, {"scenario": plain(Path(file))}, ["scenario"])
            return
        section, own = self._section("scenario"), plain(dict(values or {}))
        before = section.get("events", [])
        new = [event for event in plain(list(events)) if event not in before]
        paths = [f"scenario.values.{name}" for name in own]
        paths += [f"scenario.events[{len(before) + place}]" for place in range(len(new))]
        changed = {**section, "values": {**section.get("values", {}), **own}, "events": [*before, *new]}
        self._change(call, {"scenario": changed}, paths)

    def configure(self, **sections: Any) -> None:  # noqa: ANN401  as the file has it
        """Set keys of other sections of the configuration, or of the top level.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.configure(group="auto", timeouts={"step": 5.0}, simulation={"window": 64})

        Args:
            sections: a value, or a mapping that is merged into the section.
        """
        paths: list[str] = []
        changed: dict[str, Any] = {}
        for key, value in sections.items():
            own = plain(value)
            changed[key] = {**self._section(key), **own} if isinstance(own, dict) else own
            paths += [f"{key}.{inner}" for inner in own] if isinstance(own, dict) else [key]
        self._change(f"mesh.configure({', '.join(f'{key}=...' for key in sections)})", changed, paths)

    @checked
    def to_yaml(self, folder: str | Path | None = None) -> str:
        """The configuration as the text of a file.

        Args:
            folder: where the file will be: relative paths are those from there; None: the folder that this mesh looks
                for files in, so that all paths stay as they are.

        Raises:
            ConfigurationError: too much of the configuration is wrong to know its paths.
        """
        return written(self._data if folder is None else rebased(self._plain, Path(folder)))

    @checked
    def save(self, path: str | Path) -> None:
        """Write the configuration into a file, which `fmu-mesh launch` runs; its paths lead to the same files.

        Raises:
            ConfigurationError: the file cannot be written, or too much of the configuration is wrong to know its paths.
        """
        path = Path(path)
        write_whole(path, self.to_yaml(path.parent))

    @checked
    def to_ssp(self, path: str | Path, *, version: Literal["1.0", "2.0"] | None = None) -> tuple[Finding, ...]:
        """Write the mesh as a package of SSP (docs/ssp.md): its FMUs, start values and connections in one file.

        `load` reads it back. What SSP cannot say, such as the step size, is an annotation of the package. A mesh that
        was loaded from a package, and whose instances and connections are still the same, keeps everything else in it.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.to_ssp("pendulum_delay.ssp")
            ()

        Args:
            path: the file, which ends in `.ssp`; an older one is replaced.
            version: of SSP; None: that of the package that the mesh was loaded from, otherwise 1.0. Arrays and types
                of FMI 3.0 need 2.0.

        Returns:
            What the package that the mesh was loaded from has, and this one has not.

        Raises:
            ConfigurationError: the mesh is wrong, SSP cannot say something, or a file cannot be read or written;
                carries all findings. No file is left behind.
        """
        from ..ssp.exporting import export  # noqa: PLC0415  only this needs it

        return export(self._plain, lambda: self.plan().plan.system, Path(path), version)

    # --- running

    @takes(PlanOptions)
    def check(self, options: PlanOptions) -> Check:
        """Check the configuration, its models, and that this host can run them; nothing is started.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> mesh.add("gain", fmu="../fmus/Gian.fmu")
            >>> for finding in mesh.check().findings:
            ...     print(finding.path, finding.suggestion[-8:])
            instances.gain.fmu Gain.fmu

        Args:
            options: see `PlanOptions`.
        """
        return check_of(str(self._shown_file), partial(self.plan, **options.given()))

    @takes(PlanOptions)
    def plan(self, options: PlanOptions) -> RunPlan:
        """Read all models and plan a run, which `Run.start` starts; nothing is started here.

        Example:
            >>> plan = fmu_mesh.load("configs/pendulum_delay.yaml").plan(stop_time=1.0, record="memory")
            >>> plan.plan.grid.last_point
            500
            >>> with fmu_mesh.Run.start(plan) as run:
            ...     len(run.wait().times)
            501

        Args:
            options: see `PlanOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
        """
        if (place := importing.get()) is not None:
            hint = 'Write `if __name__ == "__main__":` before what the program does.'
            raise ConfigurationError(f"mesh '{self.name}' would run while '{place}' is imported", hint=hint)
        if options.record is not None and options.output is None:
            names = options.record if options.record != "memory" else None
            options = replace(options, record=names, output=memory_file())
        values = self._plain._replace(file=self._shown_file)
        return planned(values, options, options.on_notice or log.info, self._known)

    @takes(PlanOptions)
    def graph(self, options: PlanOptions) -> SystemGraph:
        """The graph of the mesh: instances, connections, processes and cycles, as a picture or as text.

        Example:
            >>> print(fmu_mesh.load("configs/pendulum_delay.yaml").graph().text())
            pendulum_delay: 2 instances in 2 processes, 1 connection
            <BLANKLINE>
            pendulum  DampedPendulum.fmu
              a -> delay.x  rad
            delay  TransportDelay.fmu

        Args:
            options: see `PlanOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
        """
        from ..pictures.system_graph import graph_of_plan  # noqa: PLC0415  only this needs it

        return graph_of_plan(self.plan(**options.given()).plan)

    @takes(RunOptions)
    def run(self, options: RunOptions) -> Result:
        """Run the mesh to its end, and return what it has recorded.

        Ctrl-C ends the run, and raises `KeyboardInterrupted`.

        Example:
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
        with self._started(options, to_its_end=True) as run:
            return run.wait()

    @takes(RunOptions)
    def start(self, options: RunOptions) -> Run:
        """Start the mesh, and return a handle to look into it, steer it and wait for it.

        Use it as a context manager, or call `Run.wait` or `Run.close`. What still runs at the end of the program is
        ended.

        Args:
            options: see `RunOptions`.

        Raises:
            ConfigurationError: the configuration, a model or an option is wrong; carries all findings.
        """
        return self._started(options)

    def _started(self, options: RunOptions, *, to_its_end: bool = False) -> Run:
        from .run_handle import Run  # noqa: PLC0415  `check` starts nothing
        from .run_thread import check_memory  # noqa: PLC0415  as above

        given = options.given()
        how = {name: given.pop(name) for name in StartOptions.__struct_fields__ if name in given}
        plan = self.plan(**given)
        if to_its_end and memory_of(plan) is not None and "memory_limit" not in how:  # a chosen limit is an end
            check_memory(plan, options.memory_limit, to_its_end=True)
        return Run.start(plan, **how)

    @takes(ConvergenceOptions)
    def convergence(self, options: ConvergenceOptions) -> Convergence:
        """Run the mesh with smaller and smaller steps, and estimate its error by the differences (docs/convergence.md).

        Args:
            options: see `ConvergenceOptions`.

        Raises:
            CallRefused: an option is wrong, or the program has no `if __name__ == "__main__":`, as for `sweep`.
            FmuMeshError: the mesh is wrong, or cannot have smaller steps; or a run has failed: names its step size.
        """
        from .. import Convergence  # noqa: PLC0415  its runs are a sweep, which is a user of this module

        return Convergence.of(self, options)

    @takes(OpenOptions)
    def open(self, options: OpenOptions) -> System:
        """Open all instances in this process, for a program that steps them itself (docs/stepping.md).

        Nothing is recorded into a file, and no other process is started. Inputs with a Zenoh key are free to be set.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").open({"pendulum.a": 0.5}) as system:
            ...     system.step(100)
            ...     system.time, system.get("pendulum.a") < 0.5
            (0.2, True)

        Args:
            options: see `OpenOptions`.

        Raises:
            ConfigurationError: the configuration, a model or a start value is wrong; carries all findings. Or two
                instances need a process of their own each; or the state cannot be read, or is not one of this mesh.
            FmuError: an instance cannot be opened or initialized. Nothing is left behind.
        """
        from ..run.state_file import StateFile  # noqa: PLC0415  only this needs it
        from .open_system import System  # noqa: PLC0415  as above

        state = StateFile.of(options)
        run, given = self._opened(options), options.given()
        for own in ("state", "replaced"):
            given.pop(own, None)
        values, known = deepcopy(self._plain._replace(file=self._shown_file)), KnownModels.of(run)

        def plan_again(start_values: Mapping[str, Any]) -> RunPlan:
            own = PlanOptions(**given | {"start_values": given.get("start_values", {}) | start_values})
            return without_keys(planned(values, own, own.on_notice or log.info, known))

        return System(run, plan_again, state, options.replaced)

    @takes(BatchOptions)
    def batch(self, copies: int, options: BatchOptions) -> Batch:
        """Open many copies of all instances, for a program that steps them as arrays (docs/batches.md).

        No file is written; with `record`, rows stay in memory for `Batch.result`. Inputs with a Zenoh key are free.
        Many copies get processes of their own, as many as this program may use processors; `processes` says how many,
        and 1 that it is this process.

        Example:
            >>> with fmu_mesh.load("configs/pendulum_delay.yaml").batch(2, {"pendulum.a": 0.5}) as batch:
            ...     batch.step(100)
            ...     batch.time.tolist()
            [0.2, 0.2]

        Args:
            copies: how many, 1 or more.
            options: see `BatchOptions`.

        Raises:
            ConfigurationError: the configuration, a model or a start value is wrong; carries all findings. Or two
                instances need a process of their own each.
            CallRefused: there is not enough memory, or these models cannot be stepped on several threads, or threads
                and processes are asked for.
            FmuError: an instance cannot be opened or initialized. Nothing is left behind.
            MeshLost: a process has ended before its copies were ready.
        """
        from .batch import Batch  # noqa: PLC0415  only this needs it

        limit = options.memory_limit if options.record is not None else None
        return Batch(self._opened(options), copies, options.threads, options.processes, memory_limit=limit)

    def _opened(self, options: OpenOptions | BatchOptions) -> RunPlan:
        if options.keys_from is not None:
            raise CallRefused("`keys_from` for a system that a program steps", hint="Set the inputs with `set`.")
        given = options.given()
        for own in ("state", "replaced", "threads", "processes", "memory_limit"):
            given.pop(own, None)
        return without_keys(self.plan(**given))

    def repeated(self, *, reset: bool = False, on_hang: Callable[[FmuError], None] = log.error) -> RepeatedMesh:
        """Keep the models loaded for many runs in this process, one after another: optimizers, calibration.

        Args:
            reset: reset the instances of FMUs between two runs, and do not make new ones (fmi2Reset; FMI 2.0, 2.1.6).
            on_hang: called on another thread if an FMU does not return in time; by default, the log gets the error.
        """
        from .repeated_mesh import RepeatedMesh  # noqa: PLC0415  only this needs it

        mesh = self.from_configuration(self._plain, keeps_code=True)
        return RepeatedMesh(repr(self), mesh.plan, reset=reset, on_hang=on_hang)

    @property
    def _shown_file(self) -> Path:
        """The file as findings name it; a mesh without a file is named without the working directory."""
        file, here = self._plain.file, Path.cwd()
        return file.relative_to(here) if file.name.startswith("<") and file.is_relative_to(here) else file

    def _change(self, call: str, sections: Mapping[str, Any], paths: Sequence[str]) -> None:
        """Replace sections, if what the call gives in them is right."""
        check_part(call, sections, paths)
        self._data.update(sections)
        self._plain = said_by(self._plain, call, paths)

    @property
    def _data(self) -> dict[str, Any]:
        return sections_of(self._plain)

    def _section(self, key: str) -> dict[str, Any]:
        section = self._data.get(key) or {}
        if not isinstance(section, dict):
            raise ConfigurationError(f"'{key}' of '{self._plain.file}' is {shown(section)}, where a mapping should be")
        return section


def _mapping(data: object) -> dict[str, Any]:
    return data if isinstance(data, dict) else {}


def _in_words(data: object) -> str:
    """The keys of a section that have plain values."""
    return ", ".join(f"{key}: {one}" for key, one in _mapping(data).items() if not isinstance(one, dict))


@checked
def load(path: str | Path, *, ssd: str | None = None, ssv: Sequence[str | Path] = ()) -> Mesh:
    """Read a configuration: a YAML file, a package of SSP, or a world of Gazebo.

    Example:
        >>> import fmu_mesh
        >>> fmu_mesh.load("configs/pendulum_delay.yaml").instances
        ['pendulum', 'delay']

    Args:
        path: the YAML file; an .ssp file, the folder of an unpacked one, or an .ssd file; or an SDF world.
        ssd: which system structure description of a package: the name of its file, such as "VarB.ssd", or the name that
            it has; None: SystemStructure.ssd.
        ssv: files with parameter values (SSP 2.0, 6) that replace those of a package; of several, the last one counts.
            Each is a file in the package, or else on the disk. Its names are those of the root system: `inner.gain.k`.

    Raises:
        ConfigurationError: the file cannot be read, or is no YAML. What it means is checked by `Mesh.check`, and before
            a run.
    """
    return Mesh.from_file(path, ssd=ssd, ssv=ssv)
