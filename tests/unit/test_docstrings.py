"""The examples in docstrings run, and every public name has one.

An example runs as a reader would type it at the root of a clone: `configs/...` and `fmus/...` are there, and so are the
names of its module and `fmu_mesh` itself.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
import io
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import fmu_mesh
from fmu_mesh.errors import FmuMeshError
from tests.helpers import Place

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = re.compile(r"^\s*>>> ", re.MULTILINE)
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted((ROOT / "fmu_mesh").rglob("*.py"))
    if EXAMPLE.search(path.read_text(encoding="utf-8"))
]

SKIPPED = {
    "fmu_mesh.ros.node.entry": "a node needs ROS and a running executor; tests/ros/test_node.py starts one",
    "fmu_mesh.ros.node.variable_parameters": "they need a node of ROS; tests/ros/test_node_examples.py has one",
}
"""Modules with examples that do not run (`# doctest: +SKIP`), with the reason."""

WITHOUT_EXAMPLE = {
    "__version__": "it is a string",
}
"""Public names without an example, with the reason. Exceptions have theirs in `FmuMeshError`: they are caught alike."""


@pytest.fixture
def clone(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, which looks like the root of a clone; what an example writes or starts stays in it."""
    with Place() as place:
        for name in ("configs", "examples", "fmus"):
            shutil.copytree(ROOT / name, place.folder / name)
        for name in ("FMU_MESH_RUNTIME_DIR", "TMPDIR", "COLUMNS"):
            monkeypatch.setenv(name, place.environment[name])
        monkeypatch.chdir(place.folder)
        yield place.folder


def examples_of(module: str) -> list[doctest.DocTest]:
    """The docstrings of a module that have examples."""
    imported = importlib.import_module(module)
    names = vars(imported) | {"fmu_mesh": fmu_mesh}
    found = doctest.DocTestFinder(exclude_empty=True).find(imported, globs=names)
    return [docstring for docstring in found if docstring.examples]


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.usefixtures("clone")
def test_the_examples_of_a_module_show_what_happens(module: str) -> None:
    shown = io.StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)

    for docstring in examples_of(module):
        runner.run(docstring, out=shown.write)

    assert runner.failures == 0, shown.getvalue()
    assert runner.tries > 0 or module in SKIPPED


@pytest.mark.parametrize("module", MODULES)
def test_no_example_of_a_module_is_overlooked(module: str) -> None:
    source = inspect.getsource(importlib.import_module(module))
    found = [example for docstring in examples_of(module) for example in docstring.examples]

    assert len(found) == len(EXAMPLE.findall(source))
    assert any(example.options.get(doctest.SKIP) for example in found) == (module in SKIPPED)


@pytest.mark.parametrize("name", sorted(fmu_mesh.__all__))
def test_a_public_name_has_a_docstring_with_an_example(name: str) -> None:
    offered = getattr(fmu_mesh, name)
    if name in WITHOUT_EXAMPLE or (inspect.isclass(offered) and issubclass(offered, FmuMeshError)):
        assert inspect.isclass(offered) is False or offered.__doc__
        return

    docstring = inspect.getdoc(offered) or ""

    assert EXAMPLE.search(docstring), f"the docstring of fmu_mesh.{name} has no example (`>>> `)"


def test_the_base_of_all_exceptions_shows_how_to_catch_them() -> None:
    assert EXAMPLE.search(FmuMeshError.__doc__ or "")


def test_what_has_no_example_is_public() -> None:
    assert WITHOUT_EXAMPLE.keys() <= set(fmu_mesh.__all__)
