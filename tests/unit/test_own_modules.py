"""The modules of the folder of a component belong to one instance, however they are imported."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from fmu_mesh.instances.python.importing import ImportedComponent
from fmu_mesh.instances.python.python_section import class_place_of

COMPONENT = """
import fmu_mesh
{top}

class C(fmu_mesh.Component):
    y = fmu_mesh.Output()

    def step(self, time, step_size):
        {step}
"""
HELPER = "GAIN = {gain}\ncalls = []\n"
DATA = """
from __future__ import annotations

import typing
from dataclasses import dataclass

import helper


@dataclass
class Data:
    one: typing.ClassVar[int] = 1
    gain: float = helper.GAIN
"""
PICKLED = b"chelper\nGAIN\n."
"""`GAIN` of a module that somebody else knows as `helper`."""
WAYS = {
    "at the top": ("from helper import GAIN", "return GAIN"),
    "in a function": ("", "import helper; return helper.GAIN"),
    "by name": ("import importlib", "return importlib.import_module('helper').GAIN"),
    "a submodule": ("import package.part", "return package.part.gain()"),
    "a submodule as a name": ("import package.part as part", "return part.gain()"),
    "a submodule by name": ("from importlib import import_module", "return import_module('package.part').gain()"),
    "a relative import": ("from package import relative", "return relative.gain()"),
    "a package without __init__": ("from plain import inner", "return inner.gain()"),
    "all names": ("from helper import *", "return GAIN"),
    "a circle": ("import circle", "return circle.gain()"),
    "exec": ("", "names = {}; exec('import helper; gain = helper.GAIN', names); return names['gain']"),
    "a class that was pickled elsewhere": ("import pickle", f"return pickle.loads({PICKLED!r})"),
    "a class that Python unpickles": (
        "import io, pickle",
        f"return pickle._Unpickler(io.BytesIO({PICKLED!r})).load()",
    ),
    "a dataclass": ("from package.data import Data", "return Data().gain"),
}
"""By the way of an import: what stands at the top of a component, and what its step does."""


def folder_with(folder: Path, gain: float, top: str, step: str) -> Path:
    """The file of a component whose modules have this gain."""
    (folder / "package").mkdir(parents=True)
    (folder / "plain").mkdir()
    files = {
        "helper.py": HELPER.format(gain=gain),
        "circle.py": "import component, helper\ndef gain(): return helper.GAIN if component.C else 0.0\n",
        "package/__init__.py": "",
        "package/part.py": "import helper\ndef gain(): return helper.GAIN\n",
        "package/relative.py": "from .part import gain\n",
        "package/data.py": DATA,
        "plain/inner.py": "import helper\ndef gain(): return helper.GAIN\n",
        "random.py": "raise RuntimeError('the one of the user')\n",
        "component.py": COMPONENT.format(top=top, step=step),
    }
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "component.py"


def stepped(imported: ImportedComponent) -> object:
    """What a step returns; between two calls, no name is lent."""
    imported.modules.forget_names()
    try:
        step: Any = imported.cls.step  # what it returns is for the test
        return step(None, 0.0, 0.1)
    finally:
        imported.modules.forget_names()


@contextmanager
def stepping(*files: Path) -> Iterator[list[Callable[[], Any]]]:
    """The steps of components."""
    with ExitStack() as stack:
        steps: list[Callable[[], Any]] = []
        for file in files:
            imported = ImportedComponent(file, class_place_of("component.py:C"))
            stack.callback(imported.close)
            imported.load()
            steps.append(partial(stepped, imported))
        yield steps


@pytest.mark.parametrize("way", WAYS)
def test_each_folder_has_modules_of_its_own(tmp_path: Path, way: str) -> None:
    before = {*sys.modules}
    files = [folder_with(tmp_path / name, gain, *WAYS[way]) for name, gain in (("a", 2.0), ("b", 30.0))]

    with stepping(*files) as (first, second):
        found = [first(), second(), first(), second()]

    assert found == [2.0, 30.0, 2.0, 30.0]
    assert not {name for name in {*sys.modules} - before if "@" in name or name.startswith(("helper", "package"))}


def test_two_instances_of_one_file_share_no_variables(tmp_path: Path) -> None:
    step = "helper.calls.append(1); return len(helper.calls)"
    file = folder_with(tmp_path / "a", 2.0, "import helper", step)

    with stepping(file, file) as (first, second):
        found = [first(), first(), second()]

    assert found == [1, 2, 1]


def test_what_is_installed_comes_before_the_files_of_a_user(tmp_path: Path) -> None:
    file = folder_with(tmp_path / "a", 2.0, "import random", "return random.Random(1).random()")

    with stepping(file) as (step,):
        assert 0.0 < step() < 1.0


def test_the_folder_of_the_program_does_not_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = folder_with(tmp_path / "a", 2.0, "import helper", "return helper.GAIN")
    program = folder_with(tmp_path / "program", 7.0, "", "pass").with_name("program.py")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(program), raising=False)
    monkeypatch.syspath_prepend(str(program.parent))

    with stepping(own) as (step,):
        assert step() == 2.0


def test_modules_that_all_processes_find_are_not_imported_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = folder_with(tmp_path / "a", 2.0, "import helper", "return helper.__name__")
    monkeypatch.syspath_prepend(str(file.parent))  # as site-packages, where a component may be installed, too
    monkeypatch.delitem(sys.modules, "helper", raising=False)

    with stepping(file) as (step,):
        assert step() == "helper"

    monkeypatch.delitem(sys.modules, "helper")


def test_an_object_of_a_module_of_the_folder_can_be_pickled(tmp_path: Path) -> None:
    top = "import pickle\nfrom package.data import Data"
    file = folder_with(tmp_path / "a", 2.0, top, "return pickle.loads(pickle.dumps(Data())) == Data()")

    with stepping(file) as (step,):
        assert step()


@pytest.mark.parametrize("step", ["import os; os.chdir('/')", "return 0.0"])
def test_a_module_that_may_change_the_process_is_known(tmp_path: Path, step: str) -> None:
    file = folder_with(tmp_path / "a", 2.0, "import package.part", "return package.part.gain()")
    (tmp_path / "a" / "package" / "part.py").write_text(f"def gain():\n    {step}\n", encoding="utf-8")

    imported = ImportedComponent(file, class_place_of("component.py:C"))
    imported.load()
    mentions = imported.modules.mention(re.compile(rb"\bchdir\b"))
    imported.close()

    assert mentions == ("chdir" in step)
