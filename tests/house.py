"""The rules of the house as questions to the source of the package: what breaks each of them?

An answer is written ``folder/module.py: name``, with the folder below ``fmu_mesh``. What may stay stands in `ALLOWED`
with its reason. What is still to be mended stands in `tests/unit/test_house.py`; ``python -m tests.house`` prints it.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

__all__ = [
    "ALLOWED",
    "MOST_ONE_USE_HELPERS",
    "PACKAGE",
    "RULES",
    "TESTS",
    "Package",
    "attributes_assigned_from_outside",
    "class_names_used_twice",
    "file_names_used_twice",
    "importers_of_kinds",
    "large_modules",
    "long_names_of_tests",
    "names_of_sections",
    "one_use_helpers",
    "private_names_of_others",
    "rebound_calls",
    "small_modules_with_one_importer",
    "threads_without_a_reason",
]

TESTS = Path(__file__).resolve().parent

PACKAGE = TESTS.parent / "fmu_mesh"

SMALL = 60
"""A module with fewer lines needs more than one importer, or a reason."""

LARGE = 450
"""A module with more lines needs a reason."""

LARGE_CLASS = 600
"""So does one that is one class, if it has more lines than this: half a class is harder to read than a long one."""

SHORT = 3
"""The lines of a body that a reader finds sooner where it is used."""

MOST_ONE_USE_HELPERS = 60
"""Private functions of so few lines with one use: so many may have a name that says more than their lines."""

MOST_WORDS = 12
"""Of the name of a test."""

CONCURRENT = {
    *("threading.Thread", "threading.Timer", "threading.Lock", "threading.RLock", "threading.Condition"),
    *("signal.signal", "signal.alarm", "signal.set_wakeup_fd", "signal.pthread_sigmask"),
    "ThreadPoolExecutor",
}
"""What makes a module one where threads or signals meet. An Event only ends a wait."""

_USERS = ("api/", "cli/", "dashboard/", "foxglove/")
"""Folders that use the library as a program does."""

Node = TypeVar("Node", bound=ast.AST)


class Source(NamedTuple):
    """One module.

    Attributes:
        path: its file, below the package.
        module: its dotted name.
        text: all of it.
        tree: what the parser makes of it.
    """

    path: str
    module: str
    text: str
    tree: ast.Module


class Package:
    """All modules of a package, and who imports whom.

    Args:
        folder: of the package.
    """

    def __init__(self, folder: Path) -> None:
        self.sources: list[Source] = []
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder.parent).with_suffix("").parts
            module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = path.read_text(encoding="utf-8")
            self.sources.append(Source(str(path.relative_to(folder)), module, text, ast.parse(text)))
        self._name = folder.name

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        """By the dotted name of a module, those that import it, wherever in their text they do."""
        found: dict[str, set[str]] = {source.module: set() for source in self.sources}
        for source in self.sources:
            for name in self._imported(source):
                # `from .folder import name` means the module `name`, if there is one, and else a name in `folder`.
                target = name if name in found else name.rpartition(".")[0]
                if target in found and target != source.module:
                    found[target].add(source.module)
        return found

    @property
    def kinds(self) -> set[str]:
        """The dotted names of the kinds of instances: the folders, and the one that is a module."""
        folders = {source.module for source in self.sources if re.fullmatch(r"instances/\w+/__init__.py", source.path)}
        return folders | {source.module for source in self.sources if source.path == "instances/position_pid.py"}

    def _imported(self, source: Source) -> Iterator[str]:
        folders = f"{self._name}/{source.path}".split("/")[:-1]
        for plain in _all(source.tree, ast.Import):
            yield from (alias.name for alias in plain.names)
        for node in _all(source.tree, ast.ImportFrom):
            above = folders[: len(folders) + 1 - node.level] if node.level else []
            yield from (".".join([*above, *filter(None, [node.module]), alias.name]) for alias in node.names)


def file_names_used_twice(package: Package) -> set[str]:
    """Names of files that stand in more than one folder."""
    stems = Counter(Path(source.path).stem for source in package.sources)
    return {stem for stem, times in stems.items() if times > 1} - {"__init__", "__main__"}


def class_names_used_twice(package: Package) -> set[str]:
    """Public names of classes that more than one module defines."""
    names = Counter(
        item.name for source in package.sources for item in source.tree.body if isinstance(item, ast.ClassDef)
    )
    return {name for name, times in names.items() if times > 1 and not name.startswith("_")}


def small_modules_with_one_importer(package: Package) -> set[str]:
    """Modules that belong into the only one that imports them."""
    return {
        source.path
        for source in package.sources
        if len(source.text.splitlines()) < SMALL
        and Path(source.path).stem not in {"__init__", "__main__"}
        and len(package.importers[source.module]) == 1
    }


def large_modules(package: Package) -> set[str]:
    """Modules with more lines than one subject needs."""
    found = set()
    for source in package.sources:
        public = [
            type(item)
            for item in source.tree.body
            if isinstance(item, ast.ClassDef | ast.FunctionDef) and not item.name.startswith("_")
        ]
        most = LARGE_CLASS if public == [ast.ClassDef] else LARGE
        if len(source.text.splitlines()) > most:
            found.add(source.path)
    return found


def attributes_assigned_from_outside(package: Package) -> set[str]:
    """Attributes assigned on an object other than ``self`` or ``cls``, by a statement or by ``setattr``."""
    found = set()
    for source in package.sources:
        for target in _all(source.tree, ast.Attribute):
            if isinstance(target.ctx, ast.Store) and not _is_own(target.value):
                found.add(f"{source.path}: {ast.unparse(target)}")
        for call in _all(source.tree, ast.Call):
            if ast.unparse(call.func) in {"setattr", "object.__setattr__"} and not _is_own(call.args[0]):
                found.add(f"{source.path}: setattr({ast.unparse(call.args[0])})")
    return found


def private_names_of_others(package: Package) -> set[str]:
    """What is private to others: names imported, asked for by text or hidden from SLF001, and local variables."""
    found = set()
    for source in package.sources:
        for line in source.text.splitlines():
            if re.search(r"noqa:[A-Z0-9, ]*\bSLF001\b", line):
                found.add(f"{source.path}: {line.partition('#')[0].strip()}")
        names = [alias.name for node in _all(source.tree, ast.ImportFrom) for alias in node.names]
        found |= {f"{source.path}: f_locals" for node in _all(source.tree, ast.Attribute) if node.attr == "f_locals"}
        for call in _all(source.tree, ast.Call):
            if ast.unparse(call.func) in {"getattr", "hasattr", "setattr"} and not _is_own(call.args[0]):
                names += [str(name.value) for name in call.args[1:2] if isinstance(name, ast.Constant)]
        found |= {f"{source.path}: {name}" for name in names if re.match(r"_(?!_)", name)}
    return found


def rebound_calls(package: Package) -> set[str]:
    """Methods that are assigned to at all, and callable attributes that are assigned to in more than one place.

    An attribute is callable if its class calls it, or annotates it with ``Callable``.
    """
    classes = {node.name: node for source in package.sources for node in _all(source.tree, ast.ClassDef)}
    found = set()
    for source in package.sources:
        for node in _all(source.tree, ast.ClassDef):
            methods = {name for one in _with_bases(node, classes) for name in _methods(one)}
            functions = {ast.unparse(call.func) for call in _all(node, ast.Call)}
            functions |= {
                ast.unparse(item.value)
                for item in _all(node, ast.Assign)
                if any(isinstance(name, ast.Name) and name.id in functions for name in item.targets)
            }
            called = {name.removeprefix("self.") for name in functions if name.startswith("self.")}
            declared = list(_all(node, ast.AnnAssign))
            annotated = {
                ast.unparse(item.target).removeprefix("self.")
                for item in declared
                if re.match(r"([\w.]+\.)?Callable\b", ast.unparse(item.annotation))
            }
            stored = [item for item in _all(node, ast.Attribute) if isinstance(item.ctx, ast.Store)]
            empty = [item.target for item in declared if item.value is None]
            assigned = Counter(item.attr for item in stored if _is_own(item.value) and item not in empty)
            found |= {
                f"{source.path}: {node.name}.{name}"
                for name, times in assigned.items()
                if name in methods or (times > 1 and name in called | annotated)
            }
    return found


def importers_of_kinds(package: Package) -> set[str]:
    """Modules that import from the folder of a kind of instance without being in it, as ``importer: kind``."""
    return {
        f"{importer}: {kind}"
        for kind in package.kinds
        for module, by in package.importers.items()
        if _is_in(module, kind)
        for importer in by
        if not _is_in(importer, kind)
    }


def one_use_helpers(package: Package) -> set[str]:
    """Private functions of at most three lines that are used in one place: a reader has to jump for them."""
    names = Counter(
        node.id if isinstance(node, ast.Name) else node.attr
        for source in package.sources
        for node in ast.walk(source.tree)
        if isinstance(node, ast.Name | ast.Attribute)
    )
    return {
        f"{source.path}: {function.name}"
        for source in package.sources
        for function in _all(source.tree, ast.FunctionDef)
        if re.match(r"_(?!_)", function.name) and names[function.name] == 1 and _lines_of_body(function) <= SHORT
    }


def threads_without_a_reason(package: Package) -> set[str]:
    """Modules with a thread, a lock or a signal that do not begin with what meets there, and the number of its ADR.

    They say it in their docstring, or in comments above their first class or function. The users of the library wait
    and draw as any program does: what meets there is said, and nothing was decided.
    """
    found = set()
    for source in package.sources:
        uses = {node.id for node in _all(source.tree, ast.Name)}
        uses |= {
            f"{node.value.id}.{node.attr}"
            for node in _all(source.tree, ast.Attribute)
            if isinstance(node.value, ast.Name)
        }
        first = min((item.lineno for item in source.tree.body if isinstance(item, _DEFINITIONS)), default=0)
        comments = [line for line in source.text.splitlines()[: max(first - 1, 0)] if line.startswith("#")]
        reason = " ".join([ast.get_docstring(source.tree) or "", *(line.lstrip("# ") for line in comments)])
        is_decided = re.search(r"ADR \d+", reason) or source.path.startswith(_USERS)
        if uses & CONCURRENT and not (re.search("[Tt]hread|[Ss]ignal", reason) and is_decided):
            found.add(source.path)
    return found


def long_names_of_tests(folder: Path) -> set[str]:
    """Tests whose name is a sentence with too many words, as ``file: name``."""
    return {
        f"{path.relative_to(folder)}: {name}"
        for path in folder.rglob("test_*.py")
        for name in re.findall(r"def test_(\w+)", path.read_text(encoding="utf-8"))
        if len(name.split("_")) > MOST_WORDS
    }


def names_of_sections(package: Package) -> set[str]:
    """Modules that speak of the section of a kind without being of that kind, as ``path: class``.

    The section of a kind is a Struct with a tag, which is the key that it has in a file.
    """
    homes = {
        node.name: source.module
        for source in package.sources
        if source.path.startswith(("instances/", "config/instance_sections"))
        for node in _all(source.tree, ast.ClassDef)
        if any(keyword.arg == "tag" for keyword in node.keywords)
    }
    assert homes, "no class has the keyword `tag`: look for the sections of kinds by something else"
    found = set()
    for source in package.sources:
        names = {node.id for node in _all(source.tree, ast.Name)}
        names |= {alias.name for node in _all(source.tree, ast.ImportFrom) for alias in node.names}
        of_kind = [kind for kind in package.kinds if _is_in(source.module, kind)]
        for name in names & homes.keys():
            if source.module != homes[name] and not any(_is_in(homes[name], kind) for kind in of_kind):
                found.add(f"{source.path}: {name}")
    return found


RULES: tuple[Callable[[Package], set[str]], ...] = (
    file_names_used_twice,
    class_names_used_twice,
    small_modules_with_one_importer,
    large_modules,
    attributes_assigned_from_outside,
    private_names_of_others,
    rebound_calls,
    importers_of_kinds,
    names_of_sections,
    threads_without_a_reason,
)

_DEFINITIONS = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)

_C_STRUCT = "a field of a C struct, which ctypes has no other way to set"
_MUJOCO = "an object of MuJoCo, which is told by its fields"
_ONNX = "an option of onnxruntime, which is told by its fields"
_ROS = "a field of a ROS message"
_ZIP = "a field of ZipInfo, which zipfile has no other way to set"

ALLOWED: dict[str, dict[str, str]] = {
    "attributes_assigned_from_outside": {
        "ros/node/entry.py: sys.unraisablehook": "Python offers no other way to set this hook",
        "archives/archive_entries.py: entry.filename": _ZIP,
        "config/call_options.py: refusing.__doc__": "a function that is made there",
        "config/call_options.py: refusing.__signature__": "a function that is made there",
        "config/yaml_text.py: yaml.default_flow_style": "ruamel.yaml has no parameter for it",
        "config/yaml_text.py: yaml.representer.ignore_aliases": "as above",
        "config/yaml_text.py: yaml.version": "as above",
        "config/yaml_text.py: yaml.width": "as above",
        "instances/python/plain_state.py: source.state": "a generator of numpy has no other way to get its state",
        "instances/fmi/callbacks.py: callbacks.allocateMemory": _C_STRUCT,
        "instances/fmi/callbacks.py: callbacks.componentEnvironment": _C_STRUCT,
        "instances/fmi/callbacks.py: callbacks.freeMemory": _C_STRUCT,
        "instances/fmi/callbacks.py: callbacks.logger": _C_STRUCT,
        "instances/fmi/callbacks.py: callbacks.stepFinished": _C_STRUCT,
        "instances/fmi/fmu_library.py: entry.name": _C_STRUCT,
        "instances/fmi/component_library.py: config.parallel_compilation": "wasmtime has no other way to set it",
        "instances/fmi/webassembly/compiling.py: config.epoch_interruption": "as above",
        **{f"node/burst_engine.py: member.{name}": _C_STRUCT for name in ("python_at", "stage", "tracks_from")},
        **{f"node/engine.py: member.{name}": _C_STRUCT for name in ("stage", "step")},
        **{f"node/engine.py: place.{name}": _C_STRUCT for name in ("last_tick", "next", "spent_ns", "stopped", "tick")},
        "node/burst_engine.py: node.eager": _C_STRUCT,
        "node/burst_engine.py: node.quiet_ns": _C_STRUCT,
        "node/burst_engine.py: node.wait_ns": _C_STRUCT,
        "node/burst_engine.py: copy.goal": _C_STRUCT,
        "rings/native.py: structure._fields_": "the fields that the header of C declares, by a decorator",
        "node/burst_engine.py: self._units[unit].stopped": _C_STRUCT,
        "instances/fmi/archive/reading.py: variable.sourceline": "FMPy has read a repaired text, with other lines",
        "instances/fmi/archive/repairing.py: element.tag": "lxml has no other way to rename an element",
        "instances/fmi/calls.py: function.errcheck": "ctypes checks a result by this attribute",
        **{
            f"ssp/package_writing.py: info.{name}": _ZIP
            for name in ("compress_type", "create_system", "external_attr", "file_size")
        },
        "ssp/ssd_writing.py: etree.SubElement(entry, ANNOTATION_ELEMENT, nsmap={None: namespace}).text": "lxml has no "
        "parameter for it",
        "instances/mujoco/mujoco_instance.py: self._data.time": _MUJOCO,
        "instances/mujoco/mujoco_instance.py: self._model.opt.disableflags": _MUJOCO,
        "instances/mujoco/mujoco_instance.py: self._model.opt.timestep": _MUJOCO,
        "instances/mujoco/rendering.py: self._viewer.cam.fixedcamid": _MUJOCO,
        "instances/mujoco/rendering.py: self._viewer.cam.type": _MUJOCO,
        "instances/onnx/onnx_model.py: options.inter_op_num_threads": _ONNX,
        "instances/onnx/onnx_model.py: options.intra_op_num_threads": _ONNX,
        "instances/onnx/onnx_model.py: options.log_severity_level": _ONNX,
        "instances/onnx/onnx_model.py: options.use_deterministic_compute": _ONNX,
        "ssp/xml_reading.py: parser.StartElementHandler": "expat takes its handlers in no other way",
        "ros/node/entry.py: timer.daemon": "a Timer has no parameter for it",
        "ros/node/node_topics.py: message.header.stamp": _ROS,
        "ros/node/node_topics.py: message.header.frame_id": _ROS,
        "ros/node/node_topics.py: setattr(owner)": _ROS,
    },
    "private_names_of_others": {
        "api/mesh_builder.py: mesh._take(configuration, KnownModels(keeps_code=keeps_code))": "its own class",
        "api/mesh_builder.py: mesh._take(PlainConfig(data, file), known)": "its own class",
        "instances/call_guard.py: frame = sys._current_frames().get(thread)": "documented; nothing else tells the line",
        "ros/node/variable_parameters.py: overrides = node._parameter_overrides": "rclpy has no public way to read it",
    },
    "rebound_calls": {
        "instances/call_guard.py: CallWatch._position": "what the present call says of itself: state, no behaviour",
        "instances/fmi/model_exchange/model_calls.py: ModelCalls.line": "inputs of the present step: state",
    },
    "small_modules_with_one_importer": {
        "pictures/shown_figure.py": "it derives from a class of matplotlib, which is an extra, and slow to import",
    },
    "large_modules": {
        "instances/fmi/fmu_instance.py": "one class",
        "api/mesh_builder.py": "one public class, and half of it are docstrings with examples",
        "api/result.py": "one public class, and half of it are docstrings with examples",
    },
    "importers_of_kinds": {
        "fmu_mesh: fmu_mesh.instances.python": "what a component derives from is public",
        "fmu_mesh.api.mesh_builder: fmu_mesh.instances.python": "a program gives a class, not the place of a class",
        "fmu_mesh.api.result: fmu_mesh.instances.python": "a file has units by the names that components use",
        "fmu_mesh.run.preparing: fmu_mesh.instances.python": "a scenario has units by the names that components use",
        "fmu_mesh.adapter.adapter: fmu_mesh.instances.fmi": "FMIAdapter is one FMU, by what it promises",
        "fmu_mesh.api.inspection: fmu_mesh.instances.fmi": "`inspect` shows what is in an .fmu file",
        "fmu_mesh.ssp.fmi_world_reading: fmu_mesh.instances.gazebo": "the joints of a world say what its plugins mean",
        "fmu_mesh.ssp.package: fmu_mesh.instances.fmi": "a package is opened as an FMU is, and may lie in one",
        "fmu_mesh.ssp.package_writing: fmu_mesh.instances.fmi": "a package has each FMU once, by its content",
        "fmu_mesh.ssp.system_reading: fmu_mesh.instances.fmi": "the variables of its FMUs say what a package means",
    },
}
"""By rule, what breaks it and may, with the reason."""


def _is_in(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def _all(tree: ast.AST, kind: type[Node]) -> Iterator[Node]:
    return (node for node in ast.walk(tree) if isinstance(node, kind))


def _is_own(node: ast.AST) -> bool:
    return isinstance(node, ast.Name) and node.id in {"self", "cls"}


def _with_bases(node: ast.ClassDef, classes: dict[str, ast.ClassDef]) -> list[ast.ClassDef]:
    """A class and all its bases that the package defines."""
    found = [node]
    for one in found:
        names = [ast.unparse(base).partition("[")[0].rpartition(".")[2] for base in one.bases]
        found += [classes[name] for name in names if name in classes and classes[name] not in found]
    return found


def _lines_of_body(function: ast.FunctionDef) -> int:
    """The lines of a function below its docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return 0 if not body else (body[-1].end_lineno or 0) - body[0].lineno + 1


def _methods(node: ast.ClassDef) -> set[str]:
    """The methods of a class; its properties are attributes."""
    functions = [item for item in node.body if isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef)]
    return {
        item.name
        for item in functions
        if not any(re.search(r"property$|\.setter$", ast.unparse(decorator)) for decorator in item.decorator_list)
    }


def main() -> None:
    """Print what breaks the rules, and what is allowed for nothing."""
    package = Package(PACKAGE)
    for rule in RULES:
        found, allowed = rule(package), ALLOWED.get(rule.__name__, {}).keys()
        for answer in sorted(found ^ allowed):
            print(f"{rule.__name__}: {answer}" + (" is in ALLOWED for nothing" if answer in allowed else ""))  # noqa: T201 a command


if __name__ == "__main__":
    main()
