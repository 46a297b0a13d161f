"""Builds the event test FMUs: one model behind the functions of FMI 1.0, 2.0 or 3.0, for both kinds if there are two.

One table per model gives its model description in each version and the C header with the roles of its variables. The
FMUs hold the state machines of their standard and abort the process on a call that it forbids, so every run of one of
them proves the calling sequence. Nothing of the mesh is involved here.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal

from fmus.build import WINDOWS_FROM_LINUX, Platform, find_compiler, this_platform

__all__ = ["MODELS", "build_event_fmu", "event_source_fmu"]

SOURCES = Path(__file__).resolve().parent / "src" / "events"
FIRST_INTEGER = 100
FIRST_CLOCK = 200
TIME = 15
FLAGS = ("-O1", "-std=gnu99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")

Version = Literal[1, 2, 3]
Role = Literal["read", "fixed", "tunable", "discrete", "continuous"]


@dataclass(frozen=True)
class Var:
    """One variable; its value reference is its place among those of its type.

    A role is how it may be set: see ``model.h``.
    """

    name: str
    role: Role = "read"
    start: float | None = None
    output: bool = False
    continuous: bool = True
    derivative: str | None = None


@dataclass(frozen=True)
class Model:
    """The tables of one model: its Real variables begin with the states and their derivatives."""

    states: int
    indicators: tuple[str, ...]
    reals: tuple[Var, ...]
    integers: tuple[Var, ...]


MODELS = {
    "Ball": Model(
        states=2,
        indicators=("z",),
        reals=(
            Var("h", "fixed", 1.0, output=True),
            Var("v", "fixed", 0.0, output=True),
            Var("der(h)", derivative="h"),
            Var("der(v)", derivative="v"),
            Var("g", "fixed", 9.81),
            Var("e", "tunable", 0.7),
            Var("last_bounce", output=True, continuous=False),
            Var("z"),
            Var("u", "continuous", 0.0),
        ),
        integers=(Var("bounces", output=True), Var("events"), Var("completed_steps"), Var("resting")),
    ),
    "Oscillator": Model(
        states=2,
        indicators=(),
        reals=(
            Var("x", "fixed", 2.0, output=True),
            Var("y", "fixed", 0.0, output=True),
            Var("der(x)", derivative="x"),
            Var("der(y)", derivative="y"),
            Var("mu", "fixed", 1.0),
            Var("u", "continuous", 0.0),
            Var("limit", "tunable", 1e300),
        ),
        integers=(Var("completed_steps"), Var("events")),
    ),
    "Stairs": Model(
        states=0,
        indicators=(),
        reals=(
            Var("period", "fixed", 1.0),
            Var("longest_step", "tunable", 1e300),
            Var("last_stair", output=True, continuous=False),
            Var("last_tick", output=True, continuous=False),
        ),
        integers=(
            Var("counter", output=True),
            Var("increment", "discrete", 1),
            Var("end", "tunable", 1000000),
            Var("forever", "fixed", 0),
            Var("events", output=True),
        ),
    ),
    "Integral": Model(
        states=1,
        indicators=("z",),
        reals=(
            Var("s", "fixed", 0.0, output=True),
            Var("der(s)", derivative="s"),
            Var("u", "continuous", 0.0),
            Var("level", "fixed", 0.5),
            Var("z"),
            Var("last_change", output=True, continuous=False),
        ),
        integers=(Var("above", output=True), Var("events")),
    ),
    "Winding": Model(
        states=1,
        indicators=(),
        reals=(
            Var("I", "fixed", 0.0, output=True),
            Var("der(I)", derivative="I"),
            Var("M", output=True),
            Var("R", "fixed", 1.0),
            Var("L", "fixed", 0.001),
            Var("k", "fixed", 0.1),
            Var("U", "continuous", 0.0),
            Var("w", "continuous", 0.0),
        ),
        integers=(),
    ),
    "Heater": Model(
        states=2,
        indicators=("z",),
        reals=(
            Var("T", "fixed", 0.5, output=True),
            Var("F", "fixed", 0.0, output=True),
            Var("der(T)", derivative="T"),
            Var("der(F)", derivative="F"),
            Var("tau", "fixed", 1e-5),
            Var("late", "fixed", 0.0),
            Var("low", "fixed", 0.4),
            Var("high", "fixed", 0.6),
            Var("refused", "fixed", 1e300),
            Var("last_switch", output=True, continuous=False),
            Var("z"),
            Var("u", "continuous", 0.0),
        ),
        integers=(Var("on", "fixed", 1), Var("switches", output=True), Var("completed_steps")),
    ),
    "LinearPart": Model(
        states=2,
        indicators=(),
        reals=(
            Var("x", "fixed", 0.0, output=True),
            Var("v", "fixed", 0.0, output=True),
            Var("der(x)", derivative="x"),
            Var("der(v)", derivative="v"),
            Var("y", output=True),
            *(Var(name, "fixed", 0.0) for name in ("a", "b", "e", "c", "d", "f")),
            Var("u", "continuous", 0.0),
            Var("w", "continuous", 0.0),
        ),
        integers=(Var("masses", "fixed", 0), Var("stays", "fixed", 0)),
    ),
    "Rotor": Model(
        states=1,
        indicators=(),
        reals=(
            Var("w", "fixed", 0.0, output=True),
            Var("der(w)", derivative="w"),
            Var("J", "fixed", 0.001),
            Var("d", "fixed", 0.0),
            Var("M_A", "continuous", 0.0),
            Var("M_B", "continuous", 0.0),
        ),
        integers=(),
    ),
}


def build_event_fmu(name: str, version: Version, folder: Path, **changes: str) -> Path:
    """Build ``<name><version>.fmu`` into ``folder`` and return its path; one that is there already is used again.

    Args:
        name: a key of `MODELS`.
        version: of FMI; in 1.0 only model exchange is there.
        folder: made if missing.
        changes: attributes of the co-simulation element that differ, such as ``canGetAndSetFMUstate="false"``; with
            ``only="model_exchange"`` or ``"co_simulation"`` the other kind is not declared; with ``runs="windows"`` its
            only library is for Windows.
    """
    model = MODELS[name]
    label = hashlib.sha256(repr(sorted(changes.items())).encode()).hexdigest()[:8] if changes else ""
    built = folder / f"{name}{version}{label}.fmu"
    if built.is_file():
        return built
    folder.mkdir(parents=True, exist_ok=True)
    guid = f"{{{hashlib.sha256(f'{name}{version}{label}'.encode()).hexdigest()[:32]}}}"
    platform = WINDOWS_FROM_LINUX if changes.pop("runs", None) else this_platform()
    description = {1: _fmi1, 2: _fmi2, 3: _fmi3}[version](name, model, guid, changes)
    folder_name = platform.name_in_fmi3 if version == 3 else platform.name
    with zipfile.ZipFile(folder / f"{built.name}.{os.getpid()}.tmp", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description)
        archive.writestr(
            f"binaries/{folder_name}/{name}{platform.suffix}", _compiled(name, model, version, guid, platform)
        )
    written = Path(archive.filename or "")
    with suppress(
        FileExistsError
    ):  # another worker was faster, and its file may be in use: archives have times in them
        built.hardlink_to(written)
    written.unlink()
    return built


def event_source_fmu(
    name: str,
    version: Version,
    target: Path,
    description: Callable[[str], str] = lambda text: text,
    add: Mapping[str, str] = {},
    only: str | None = None,
) -> Path:
    """Write ``target``: the same FMU with its sources only.

    Args:
        name: a key of `MODELS`.
        version: of FMI.
        target: the archive.
        description: makes another model description of it.
        add: more files of the archive, or others instead of those that there would be.
        only: the one kind that it declares.
    """
    guid = f"{{source of {name}{version}}}"
    shared = f'#define FMU_GUID "{guid}"\n#ifndef MODEL_IDENTIFIER\n#define MODEL_IDENTIFIER {name}\n#endif\n'
    text = {1: _fmi1, 2: _fmi2, 3: _fmi3}[version](name, MODELS[name], guid, {"only": only} if only else {})
    members = {"modelDescription.xml": description(text), "sources/variables.h": _header(MODELS[name])}
    for file in ("model.h", f"fmi{version}.c", "stepping.c", f"{name}.c"):
        content = (SOURCES / file).read_text(encoding="utf-8")
        members[f"sources/{file}"] = shared + content if file == "model.h" else content
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in (members | dict(add)).items():
            archive.writestr(member, content)
    return target


def _compiled(name: str, model: Model, version: Version, guid: str, platform: Platform) -> bytes:
    headers = str(files("fmpy") / "c-code")
    with tempfile.TemporaryDirectory(prefix="fmu_build_") as folder:
        Path(folder, "variables.h").write_text(_header(model), encoding="utf-8")
        sources = [str(SOURCES / file) for file in (f"fmi{version}.c", "stepping.c", f"{name}.c")]
        library = Path(folder, f"library{platform.suffix}")
        defines = [f'-DFMU_GUID="{guid}"', f"-DMODEL_IDENTIFIER={name}"]
        own_flags = ["-Wl,-Bsymbolic"] if platform.suffix == ".so" else []
        command = [*(platform.compiler or find_compiler()), *FLAGS, *platform.link_flags, *own_flags, *defines]
        command += [f"-I{folder}", f"-I{SOURCES}", f"-I{headers}"]
        subprocess.run([*command, "-o", str(library), *sources, "-lm"], check=True)
        return library.read_bytes()


def _header(model: Model) -> str:
    def roles(variables: tuple[Var, ...]) -> str:
        return ", ".join(f"ROLE_{variable.role.upper()}" for variable in variables)

    return (
        f"#define STATES {model.states}\n#define INDICATORS {len(model.indicators)}\n"
        f"static const Role real_roles[REALS] = {{{roles(model.reals)}}};\n"
        f"static const Role integer_roles[INTEGERS] __attribute__((unused)) = {{{roles(model.integers)}}};\n"
    )


def _causality(variable: Var, version: Version) -> str:
    if variable.role in ("discrete", "continuous"):
        return "input"
    if variable.output:
        return "output"
    if variable.role in ("fixed", "tunable"):
        return "internal" if version == 1 else "parameter"
    return "internal" if version == 1 else "local"


def _variability(variable: Var, *, real: bool, version: Version) -> str:
    if variable.role in ("fixed", "tunable") and not variable.output:
        return "parameter" if version == 1 else variable.role
    return "continuous" if real and variable.continuous else "discrete"


def _fmi1(name: str, model: Model, guid: str, changes: dict[str, str]) -> str:
    assert not changes
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="1.0" modelName="{name}" modelIdentifier="{name}" guid="{guid}"',
        f'    numberOfContinuousStates="{model.states}" numberOfEventIndicators="{len(model.indicators)}">',
        "  <ModelVariables>",
    ]
    for reference, variable, type_ in _all(model):
        variability = _variability(variable, real=type_ == "Real", version=1)
        start = "" if variable.start is None else f' start="{_number(variable.start, type_)}"'
        fixed = ' fixed="true"' if start and _causality(variable, 1) != "input" else ""
        lines.append(
            f'    <ScalarVariable name="{variable.name}" valueReference="{reference}" '
            f'causality="{_causality(variable, 1)}" variability="{variability}">'
            f"<{type_}{start}{fixed}/></ScalarVariable>"
        )
    return "\n".join([*lines, "  </ModelVariables>", "</fmiModelDescription>", ""])


def _all(model: Model) -> list[tuple[int, Var, str]]:
    reals = [(reference, variable, "Real") for reference, variable in enumerate(model.reals)]
    return reals + [
        (FIRST_INTEGER + reference, variable, "Integer") for reference, variable in enumerate(model.integers)
    ]


def _number(value: float, type_: str) -> str:
    return repr(float(value)) if type_ == "Real" else str(int(value))


def _initial(variable: Var) -> str:
    if variable.role in ("discrete", "continuous"):
        return ""
    return ' initial="exact"' if variable.start is not None else ' initial="calculated"'


def _kinds(name: str, changes: dict[str, str], defaults: dict[str, str]) -> str:
    only = changes.get("only")
    attributes = defaults | {key: value for key, value in changes.items() if key != "only"}
    shared = {key: value for key, value in attributes.items() if key in _SHARED}
    kinds = ""
    if only != "co_simulation":
        told = {} if "canGetAndSetFMUstate" in defaults else {"needsCompletedIntegratorStep": "true"}
        kinds += f'  <ModelExchange modelIdentifier="{name}"{_written(shared | told)}/>\n'
    if only != "model_exchange":
        kinds += f'  <CoSimulation modelIdentifier="{name}"{_written(attributes)}/>\n'
    return kinds


_SHARED = (
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "canGetAndSetFMUState",
    "canSerializeFMUState",
    "canBeInstantiatedOnlyOncePerProcess",
    "needsExecutionTool",
)


def _written(attributes: dict[str, str]) -> str:
    return "".join(f' {key}="{value}"' for key, value in attributes.items())


def _fmi2(name: str, model: Model, guid: str, changes: dict[str, str]) -> str:
    defaults = {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
    }
    variables, outputs, derivatives, unknowns = "", "", "", ""
    names = [variable.name for _, variable, _ in _all(model)]
    for index, (reference, variable, type_) in enumerate(_all(model), start=1):
        start = "" if variable.start is None else f' start="{_number(variable.start, type_)}"'
        state = "" if variable.derivative is None else f' derivative="{names.index(variable.derivative) + 1}"'
        variability = _variability(variable, real=type_ == "Real", version=2)
        variables += (
            f'    <ScalarVariable name="{variable.name}" valueReference="{reference}" '
            f'causality="{_causality(variable, 2)}" variability="{variability}"'
            f"{_initial(variable)}><{type_}{start}{state}/></ScalarVariable>\n"
        )
        if variable.output:
            outputs += f'      <Unknown index="{index}"/>\n'
        if variable.derivative:
            derivatives += f'      <Unknown index="{index}"/>\n'
        if (variable.output or variable.derivative) and variable.start is None:
            unknowns += f'      <Unknown index="{index}"/>\n'
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{guid}" '
        f'numberOfEventIndicators="{len(model.indicators)}">\n'
        f"{_kinds(name, changes, defaults)}  <ModelVariables>\n{variables}  </ModelVariables>\n  <ModelStructure>\n"
        f"    <Outputs>\n{outputs}    </Outputs>\n"
        + (f"    <Derivatives>\n{derivatives}    </Derivatives>\n" if derivatives else "")
        + (f"    <InitialUnknowns>\n{unknowns}    </InitialUnknowns>\n" if unknowns else "")
        + "  </ModelStructure>\n</fmiModelDescription>\n"
    )


def _fmi3(name: str, model: Model, guid: str, changes: dict[str, str]) -> str:
    clocks = changes.pop("clocks", "")
    defaults = {
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "canHandleVariableCommunicationStepSize": "true",
        "hasEventMode": "true",
    }
    variables = f'    <Float64 name="time" valueReference="{TIME}" causality="independent" variability="continuous"/>\n'
    structure = ["", "", ""]
    references = {variable.name: reference for reference, variable, _ in _all(model)}
    for reference, variable, old_type in _all(model):
        type_ = "Float64" if old_type == "Real" else "Int32"
        start = "" if variable.start is None else f' start="{_number(variable.start, old_type)}"'
        state = "" if variable.derivative is None else f' derivative="{references[variable.derivative]}"'
        variability = _variability(variable, real=old_type == "Real", version=3)
        variables += (
            f'    <{type_} name="{variable.name}" valueReference="{reference}" causality="{_causality(variable, 3)}" '
            f'variability="{variability}"{_initial(variable)}{state}{start}/>\n'
        )
        if variable.output:
            structure[0] += f'    <Output valueReference="{reference}"/>\n'
        if variable.derivative:
            structure[1] += f'    <ContinuousStateDerivative valueReference="{reference}"/>\n'
        if (variable.output or variable.derivative) and variable.start is None:
            structure[2] += f'    <InitialUnknown valueReference="{reference}"/>\n'
    if clocks:
        variables += (
            f'    <Clock name="tick" valueReference="{FIRST_CLOCK}" causality="input" {clocks}/>\n'
            f'    <Clock name="stair" valueReference="{FIRST_CLOCK + 1}" causality="output" '
            'intervalVariability="triggered"/>\n'
        )
    structure += [f'    <EventIndicator valueReference="{references[indicator]}"/>\n' for indicator in model.indicators]
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="3.0" modelName="{name}" instantiationToken="{guid}">\n'
        f"{_kinds(name, changes, defaults)}  <ModelVariables>\n{variables}  </ModelVariables>\n"
        f"  <ModelStructure>\n{''.join(structure)}  </ModelStructure>\n</fmiModelDescription>\n"
    )
