"""What a file of a model declares, and whether it can run here. Nothing of it is executed."""

from __future__ import annotations

import textwrap
from base64 import b64encode
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Final

import msgspec

from .. import files
from ..config.call_options import checked
from ..config.instance_sections import KIND
from ..config.loading import LoadedConfig
from ..errors import CallRefused, LoadFailed, UnknownName
from ..instances.configuration import examine_data
from ..instances.registry import KINDS, describe
from ..pictures.tables import html_table, pairs, titled
from ..printing import page, printable
from ..ssp.configuration_files import names_package, read_configuration
from ..text import counted, did_you_mean, listed, matching, meant, nearest_file, short_number, shown
from ..variables.model_description import Causality, Kind, ModelDescription, Runs, Variable

__all__ = [
    "SHOWN_VARIABLES",
    "Inspection",
    "inspect",
    "readable_configuration",
    "variables_of_fmu",
    "variables_of_instance",
    "with_way_out",
]

SHOWN_VARIABLES: Final = 20
"""Variables of one causality on a page that does not list all."""

_WIDTH: Final = 120
_FMU: Final = "fmu"
_CAUSALITIES: Final[tuple[tuple[Causality, str], ...]] = (
    ("input", "Inputs"),
    ("output", "Outputs"),
    ("structuralParameter", "Structural parameters"),
    ("parameter", "Parameters"),
    ("calculatedParameter", "Calculated parameters"),
    ("independent", "Independent variable"),
    ("local", "Local variables"),
)
_CAPABILITIES: Final = (
    ("can_handle_variable_step_size", "variable step size"),
    ("can_reject_steps", "repeat a step"),
    ("can_get_and_set_state", "get and set its state"),
    ("can_serialize_state", "serialize its state"),
    ("can_interpolate_inputs", "interpolate inputs"),
    ("has_event_mode", "event mode"),
)


class Inspection(msgspec.Struct, frozen=True, omit_defaults=False):
    """What `inspect` found. As text, it is the page that `fmu-mesh inspect` prints; its fields are those of `--json`.

    Example:
        >>> import fmu_mesh
        >>> gain = fmu_mesh.inspect("fmus/Gain.fmu")
        >>> gain.runs_here, gain.problems
        (True, ())
        >>> print(gain.page(variables=["k"]))
        Parameters (1)
          k  Real  tunable  = 1.0  Gain

    Attributes:
        file: the path as it was given.
        sha256: of the archive, as hexadecimal digits; None for a folder.
        bytes: size of the archive; None for a folder.
        runs_here: whether it can run on this system.
        problems: violations and warnings as text; if it cannot run here, the first ones say why.
        description: the model description.
    """

    file: str
    sha256: str | None
    bytes: int | None
    runs_here: bool
    problems: tuple[str, ...]
    description: ModelDescription

    def page(self, width: int = _WIDTH, variables: Sequence[str] = (), *, everything: bool = False) -> str:
        """The page in lines of at most ``width`` columns, unless a name is longer; ``everything``: of all variables.

        ``variables`` are names, or patterns (`*`: any characters; `?`: one; `re:...`: a regular expression): only these
        are shown.

        Raises:
            UnknownName: there is no such variable; suggests the nearest one.
        """
        names = [variable.name for variable in self.description.variables]
        for pattern in variables:
            if (clock := self.description.clock(pattern)) is not None:
                raise UnknownName(f"{clock}.", hint="The page without `--variables` lists the clocks.")
            if not matching(pattern, names):
                raise UnknownName(f"'{self.file}' has no variable '{pattern}'", hint=did_you_mean(pattern, names))
        return page(_page(self, width, variables, everything=everything))

    def __str__(self) -> str:
        return self.page()

    def __repr__(self) -> str:
        return f"<Inspection of {self._in_short}>"

    @property
    def _in_short(self) -> str:
        runs = "runs here" if self.runs_here else "cannot run here"
        return f"{self.file}: {_kind(self.description)}, {counted(len(self.description.variables), 'variable')}, {runs}"

    def _repr_html_(self) -> str:
        order = [causality for causality, _ in _CAUSALITIES]
        variables = sorted(self.description.variables, key=lambda own: order.index(own.causality))
        starts = (_start(v).removeprefix("= ") for v in variables)
        rows = ((v.name, v.causality, v.type_name, v.variability, next(starts), v.description) for v in variables)
        title = ". ".join([self._in_short, *self.problems[:1]])
        heading = ["variable", "causality", "type", "variability", "start value", "description"]
        return html_table(title, heading, rows, len(variables))


@checked
def inspect(path: str | Path, *, kind: str | None = None) -> Inspection:
    """Read what a model declares: its variables, capabilities and default experiment. Nothing of it is run.

    Example:
        >>> import fmu_mesh
        >>> pendulum = fmu_mesh.inspect("fmus/DampedPendulum.fmu").description
        >>> pendulum.fmi_version, pendulum.default_experiment.step_size
        ('2.0', 0.002)
        >>> [variable.name for variable in pendulum.with_causality("output")]
        ['a', 'der(a)', 'der(a,2)']
        >>> pendulum.variable("l").unit
        'm'

    Args:
        path: the file of the model.
        kind: the kind of instance, as its key in a configuration; default: the kind with the ending of the file,
            otherwise an FMU.

    Raises:
        LoadFailed: it is no such model; says why.
        CallRefused: no installed package offers this kind.
    """
    from ..instances.fmi.archive.archive import sha256_of, size_of  # noqa: PLC0415  these import FMPy
    from ..instances.fmi.archive.reading import read_description  # noqa: PLC0415  as above
    from ..instances.fmi.archive.system_libraries import missing_libraries  # noqa: PLC0415  as above

    file, names = Path(path), KINDS.names()
    if kind is not None and kind not in names:
        raise CallRefused(f"no installed package offers the kind of instance '{kind}'; there are {listed(names)}")
    key = kind if kind is not None else file.suffix.removeprefix(".") if files.exists(file) else _FMU
    reasons: tuple[str, ...] = ()
    try:
        if key in names and key != _FMU:
            section = msgspec.convert({KIND: key, key: str(path)}, KINDS.section(key))
            description = describe(file.absolute(), section)
        else:
            try:
                description = read_description(file)
                reasons = missing_libraries(file, description.library) if description.library else ()
            except LoadFailed as error:
                description = read_description(file, to_run=False)  # otherwise this says why
                reasons = (str(error),)
    except LoadFailed as error:
        raise with_way_out(error, file) from error
    return Inspection(
        file=str(path),
        sha256=sha256_of(file),
        bytes=size_of(file),
        runs_here=not reasons,
        problems=(*reasons, *description.problems),
        description=description,
    )


def with_way_out(error: LoadFailed, path: Path) -> LoadFailed:
    """The error for a path that should be a model and is something else, or nothing."""
    hint = None
    if path.suffix.partition(":")[0] == ".py":
        hint = "A component is not read without running it: `check` of a configuration imports it, `info` shows it."
    elif not files.exists(path):
        hint = meant(nearest_file(path))
    elif names_package(path):
        hint = f"It is a package of SSP: `fmu-mesh launch {path}` runs it, and `fmu-mesh inspect {path}` shows it."
    elif path.suffix in (".yaml", ".yml"):
        hint = f"A configuration is run by `fmu-mesh launch {path}`."
    return error.instead_of_hint(hint) if hint is not None else error


def _page(inspection: Inspection, width: int, patterns: Sequence[str], *, everything: bool) -> list[str]:
    description = inspection.description
    names = [variable.name for variable in description.variables]
    wanted = {name for pattern in patterns for name in matching(pattern, names)}
    chosen = [variable for variable in description.variables if not patterns or variable.name in wanted]
    limit = None if everything or patterns else SHOWN_VARIABLES
    sections = []
    if not patterns:
        problems = [_wrapped("  " + " ".join(problem.split()), width, "    ") for problem in inspection.problems]
        sections = [("", _facts(inspection, width)), (f"Problems ({len(problems)})", [*chain(*problems)])]
    for causality, title in _CAUSALITIES:
        members = [variable for variable in chosen if variable.causality == causality]
        lines = _variables(members[:limit], width) if members else []
        if limit is not None and len(members) > limit:
            lines.append(f"  ... and {len(members) - limit} more: --all lists them, a name such as 'x*' some")
        sections.append((f"{title} ({len(members)})", lines))
    return titled(sections)


def _facts(inspection: Inspection, width: int) -> list[str]:
    description = inspection.description
    experiment = description.default_experiment
    can = [words for field, words in _CAPABILITIES if getattr(description, field)]
    needs = ["one process for each instance"] if description.only_once_per_process else []
    needs += ["the tool that made it"] if description.needs_execution_tool else []
    counts = [
        f"{count} {title.lower() if count > 1 else title.lower().removesuffix('s')}"
        for causality, title in _CAUSALITIES
        if (count := len(description.with_causality(causality)))
    ]
    of_time = ("start", experiment.start_time), ("stop", experiment.stop_time), ("step", experiment.step_size)
    times = [f"{what} {short_number(value)} s" for what, value in of_time if value is not None]
    states = [f"{description.continuous_states} continuous"] if description.continuous_states else []
    if indicators := description.event_indicators:
        states.append(counted(indicators, "event indicator"))
    times += [f"tolerance {short_number(experiment.tolerance)}"] if experiment.tolerance is not None else []
    other = msgspec.convert({KIND: _FMU, _FMU: inspection.file}, KINDS.section(_FMU)).other_kind(description)
    platforms = ", ".join(_PLATFORM_WORDS.get(name, name) for name in description.platforms)
    size = f" ({inspection.bytes} bytes)" if inspection.bytes is not None else " (a folder)"
    facts = [
        ("File", f"{inspection.file}{size}"),
        ("SHA-256", inspection.sha256 or ""),
        ("Model", description.model_name),
        ("Description", description.description or ""),
        ("Kind", _kind(description)),
        ("Used as", f"co-simulation: it {other}" if other is not None else ""),
        ("Identifier", description.model_identifier),
        ("GUID", description.guid),
        ("Made by", description.generation_tool or ""),
        ("Platforms", platforms or ("none" if description.kinds else "")),
        ("Runs here", _runs(description) if inspection.runs_here else "no, see Problems"),
        ("Can", ", ".join(can)),
        ("Needs", ", ".join(needs)),
        ("Experiment", ", ".join(times)),
        ("Variables", ", ".join(counts) or "none"),
        ("States", ", ".join(states)),
        ("Clocks", ", ".join(map(str, description.clocks))),
    ]
    lines = pairs((name, " ".join(value.split())) for name, value in facts)
    indent = " " * (2 + max(len(name) for name, value in facts if value))
    return [part for line in lines for part in _wrapped(line, width, indent)]


def _kind(description: ModelDescription) -> str:
    kinds = " or ".join(_KIND_WORDS[kind] for kind in description.kinds)
    return f"FMI {description.fmi_version} {kinds}" if kinds else description.kind.replace("_", " ")


def _runs(description: ModelDescription) -> str:
    from ..instances.fmi.wine import wine_version  # noqa: PLC0415  what starts programs is slow to import

    return f"under {wine_version()}" if description.runs == "wine" else _RUNS_WORDS[description.runs]


_KIND_WORDS: Final[dict[Kind, str]] = {"co_simulation": "co-simulation", "model_exchange": "model exchange"}
_RUNS_WORDS: Final[dict[Runs, str]] = {"native": "yes", "wasm": "in WebAssembly"}
_PLATFORM_WORDS: Final = {"c-code": "C sources"}


def _wrapped(line: str, width: int, indent: str) -> list[str]:
    """Wrap a line without breaking paths and hashes, so that they can be copied."""
    return textwrap.wrap(
        line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, replace_whitespace=False
    )


def _variables(variables: Sequence[Variable], width: int) -> list[str]:
    """One line each: name, type, variability, start value with unit, and as much of the description as fits."""
    found = (
        (v.name, v.type_name, v.variability, _start(v), " ".join((v.description or "").split())) for v in variables
    )
    rows = [[*map(printable, row)] for row in found]
    widest = [max(len(row[column]) for row in rows) for column in range(4)]
    # A very long name must not move the other columns off the page.
    widest[0] = min(widest[0], width // 2)
    lines = []
    for row in rows:
        cells = "  ".join(cell.ljust(size) for cell, size in zip(row, widest, strict=False) if size)
        line = f"  {cells.rstrip()}" if not row[4] else f"  {cells}  {row[4]}"
        if row[4] and len(line) > width:  # with a shortened description, or without it on a narrow page
            least = 2 + len(cells)
            line = f"{line[: width - 3].rstrip()}..." if width - 3 > least + 10 else line[:least].rstrip()
        lines.append(line)
    return lines


def _start(variable: Variable) -> str:
    """The start value with its unit; only the unit if there is none."""
    unit = variable.unit or ""
    if variable.start is None:
        return f"[{unit}]" if unit else ""
    match variable.start:
        case list() as rows:
            text = msgspec.json.encode(rows).decode()
        case bytes() as data:
            text = shown(b64encode(data).decode())
        case start:
            item = next((item for item, value in variable.items if value == start), None)
            text = f"{item} ({start})" if item is not None else shown(start)
    return f"= {text} {unit}".rstrip()


# --- to complete names: a wrong part of a file hides no other, and no code runs


def readable_configuration(path: Path, ssd: str | None = None, ssv: Sequence[str] = ()) -> LoadedConfig:
    """What can be read of a configuration; see `read_configuration`."""
    return examine_data(read_configuration(path, ssd, ssv))[0]


def variables_of_instance(loaded: LoadedConfig, name: str) -> tuple[Variable, ...]:
    """The variables of an instance; none if there is no such instance, or only its code knows them."""
    section = loaded.config.instances.get(name)
    if section is None or section.runs_code:
        return ()
    path = loaded.resolve(section.path)
    return variables_of_fmu(path) if section.follows_fmi else describe(path, section, loaded.config.limits).variables


def variables_of_fmu(path: Path) -> tuple[Variable, ...]:
    """The variables of an FMU, which is not compiled."""
    from ..instances.fmi.archive.reading import read_description  # noqa: PLC0415  as above

    return read_description(path, to_run=False).variables
