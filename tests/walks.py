"""Follows one value through the package, and counts the files and functions that a reader meets on its way.

``python -m tests.walks`` prints the counts, and with ``--names`` the functions as well.

A walk runs a mesh with `launch`. The value is a number or a text that occurs nowhere else. A profile hook, in all
processes and threads that Python starts, looks at each function of fmu_mesh when it is entered and when it returns. It
is on the way if the value is in an argument or in what it returns: itself, in a text, or up to `DEPTH` containers and
Structs deep. Functions on threads of Zenoh are not seen, and neither are comprehensions.

The way of a value to an FMU leads through the process that reads the file, and those from which the process of the FMU
was forked, until the FMU has it. What other processes, or these later, have of it is not on the way: the metadata of
the result. The way of an error leads to the terminal, through all processes.

Files and functions at the commit before version 0.3, and with it: a start value 39 and 100, now 30 and 90; a parameter
of SSP 48 and 119, now 38 and 108; an error 24 and 53, now 27 and 57, because master and launcher decide in modules of
their own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import NamedTuple

import msgspec

__all__ = ["WALKS", "Walked", "follow", "walked"]

DEPTH = 4
"""A configuration has instances, one of them has start values, and those have the value: the complete file counts."""

_ROOT = Path(__file__).resolve().parents[1]
_PACKAGE = f"{_ROOT / 'fmu_mesh'}{os.sep}"
_OVER = "over"
_NUMBER, _TEXT = 1.2345678, "the message of this one error"
_MOST_ITEMS = 200
"""Of a container: longer ones have rows, and the value is no row."""


class Walked(NamedTuple):
    """What a value has passed, sorted: files below the package, and functions as ``file: name``."""

    files: list[str]
    functions: list[str]


class _Walk(msgspec.Struct, frozen=True):
    """One walk, as a process gets it.

    Attributes:
        value: what is followed.
        folder: of the file into which all processes write.
        until: the walk is over when a function of this name has returned in this folder; empty: with the processes.
    """

    value: float | str
    folder: str
    until: tuple[str, str] = ("", "")

    @property
    def file(self) -> Path:
        return Path(self.folder) / "functions"

    def note(self, name: str) -> None:
        """Note a function, and the process that has entered it."""
        # Opened each time: a forked process closes files that it does not know, and its end flushes nothing.
        with self.file.open("a", encoding="utf-8") as functions:
            functions.write(f"{os.getpid()} {os.getppid()} {name}\n")

    def functions(self) -> set[str]:
        """The functions on the way, of all that are noted."""
        noted = [tuple(line.split(" ", 2)) for line in self.file.read_text(encoding="utf-8").splitlines()]
        over = next((number for number, (*_, name) in enumerate(noted) if name == _OVER), None)
        if over is None:
            return {name for *_, name in noted if name}
        parents = {process: parent for process, parent, _ in noted}
        way = [noted[over][0]]
        while (parent := parents.get(way[-1])) is not None:
            way.append(parent)
        return {name for process, _, name in noted[:over] if name and process in way}


def follow(file: str) -> None:
    """Follow a value in this process, as the file of a walk says."""
    walk = msgspec.json.decode(Path(file).read_bytes(), type=_Walk)
    seen: set[str] = set()

    def hook(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event not in {"call", "return"} or not code.co_filename.startswith(_PACKAGE) or "<" in code.co_name:
            return
        path = code.co_filename.removeprefix(_PACKAGE)
        name = f"{path}: {code.co_qualname}"
        values = [argument] if event == "return" else frame.f_locals.values()
        if name not in seen and any(_holds(value, walk.value, DEPTH) for value in values):
            seen.add(name)
            walk.note(name)
        if event == "return" and code.co_name == walk.until[0] and path.startswith(walk.until[1]):
            walk.note(_OVER)

    walk.note("")  # so that its parent is known
    threading.setprofile(hook)
    sys.setprofile(hook)


def _holds(value: object, wanted: float | str, depth: int) -> bool:
    """Whether something is what is wanted, or has it in it."""
    match value:
        case float():
            return value == wanted
        case str():
            return str(wanted) in value
        case bytes():
            return str(wanted).encode() in value
    parts: Iterable[object] = ()
    match value:
        case dict():
            parts = value.values()
        case list() | tuple():
            parts = value
        case BaseException():  # its text may not be there yet, in its constructor
            parts = (*value.args, *vars(value).values())
        case msgspec.Struct():
            parts = (getattr(value, name, None) for name in value.__struct_fields__)
    return depth > 0 and any(
        _holds(part, wanted, depth - 1) for part, _ in zip(parts, range(_MOST_ITEMS), strict=False)
    )


def walked(name: str) -> Walked:
    """Run a walk of `WALKS`.

    Raises:
        CalledProcessError: the run did not end as it should.
    """
    with TemporaryDirectory() as text:
        folder = Path(text)
        walk, file, *options = WALKS[name](folder)
        path = os.pathsep.join([str(_ROOT), str(Path(__file__).parent / "walk_hook")])
        (folder / "walk.json").write_bytes(msgspec.json.encode(walk))
        environment = os.environ | {"PYTHONPATH": path, "FMU_MESH_WALK": str(folder / "walk.json")}
        command = [sys.executable, "-m", "fmu_mesh", "launch", file, "--no-progress", *options]
        done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
        fails = walk.value == _TEXT
        if (done.returncode == 0) == fails or (_TEXT in done.stderr) != fails:
            raise subprocess.CalledProcessError(done.returncode, command, done.stdout, done.stderr)
        functions = sorted(walk.functions())
    return Walked(sorted({function.partition(": ")[0] for function in functions}), functions)


_UNTIL_IT_IS_SET = ("enter_initialization", "instances/fmi/")
_GAIN = _ROOT / "fmus/Gain.fmu"


def _start_value(folder: Path) -> tuple[_Walk, str, *tuple[str, ...]]:
    """A start value, from the file to the FMU."""
    instances = {"gain": {"fmu": str(_GAIN), "start_values": {"k": _NUMBER}}}
    return _Walk(_NUMBER, str(folder), _UNTIL_IT_IS_SET), _configuration(folder, instances)


def _ssp_parameter(folder: Path) -> tuple[_Walk, str, *tuple[str, ...]]:
    """A parameter of a package, from its .ssv to the FMU."""
    spaces = " ".join(
        f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
        for prefix, name in (("ssd", "Description"), ("ssc", "Common"), ("ssv", "ParameterValues"))
    )
    structure = (
        f'<ssd:SystemStructureDescription {spaces} name="own" version="1.0"><ssd:System name="root">'
        f'<ssd:ParameterBindings><ssd:ParameterBinding source="values.ssv"/></ssd:ParameterBindings><ssd:Elements>'
        f'<ssd:Component name="gain" source="resources/Gain.fmu"><ssd:Connectors><ssd:Connector name="y" kind="output">'
        f"<ssc:Real/></ssd:Connector></ssd:Connectors></ssd:Component></ssd:Elements></ssd:System>"
        f'<ssd:DefaultExperiment stopTime="0.1"/></ssd:SystemStructureDescription>'
    )
    values = (
        f'<ssv:ParameterSet {spaces} version="1.0" name="set"><ssv:Parameters><ssv:Parameter name="gain.k"><ssv:Real '
        f'value="{_NUMBER}"/></ssv:Parameter></ssv:Parameters></ssv:ParameterSet>'
    )
    with zipfile.ZipFile(folder / "walk.ssp", "w") as package:
        package.writestr("SystemStructure.ssd", structure)
        package.writestr("values.ssv", values)
        package.write(_GAIN, "resources/Gain.fmu")
    return (
        _Walk(_NUMBER, str(folder), _UNTIL_IT_IS_SET),
        "walk.ssp",
        *("--step-size", "0.01", "--algorithm", "jacobi"),
    )


def _error(folder: Path) -> tuple[_Walk, str, *tuple[str, ...]]:
    """An error in the step of a component, from its process to the terminal."""
    component = (
        "import fmu_mesh\n\nclass Failing(fmu_mesh.Component):\n    y = fmu_mesh.Output()\n\n"
        f"    def step(self, time, step_size):\n        raise ValueError(' '.join({_TEXT.split()}))\n"
    )
    (folder / "failing.py").write_text(component, encoding="utf-8")
    instances = {"failing": {"python": "failing.py:Failing"}}
    # What the recorder gets of it does not lead to the terminal.
    return _Walk(_TEXT, str(folder)), _configuration(folder, instances, record={"file": None})


def _configuration(folder: Path, instances: Mapping[str, Mapping[str, object]], **sections: object) -> str:
    text = {"mesh": "walk", "simulation": {"stop_time": 0.1, "step_size": 0.01}, "instances": instances, **sections}
    (folder / "walk.yaml").write_text(json.dumps(text), encoding="utf-8")
    return "walk.yaml"


WALKS: dict[str, Callable[[Path], tuple[_Walk, str, *tuple[str, ...]]]] = {
    "start value": _start_value,
    "SSP parameter": _ssp_parameter,
    "error of a component": _error,
}


def main() -> None:
    """Print the counts of all walks."""
    for name in WALKS:
        way = walked(name)
        print(f"{name}: {len(way.files)} files, {len(way.functions)} functions")  # noqa: T201 a command
        if "--names" in sys.argv:
            print("\n".join(f"    {function}" for function in way.functions))  # noqa: T201 a command


if __name__ == "__main__":
    main()
