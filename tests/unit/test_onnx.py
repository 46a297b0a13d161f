"""An ONNX model as an instance: its variables, its steps, its state, and what is refused."""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from fmu_mesh.cli.main import main
from fmu_mesh.config.instance_sections import InstanceSection
from fmu_mesh.config.mesh import LimitsConfig
from fmu_mesh.errors import InitializationFailed, LoadFailed, StepFailed
from fmu_mesh.instances import child_question
from fmu_mesh.instances.contract import Instance, KeepsState, Opening
from fmu_mesh.instances.registry import KINDS, content, describe, open_instance
from fmu_mesh.rings.ring import Ring
from fmu_mesh.simtime import TimeGrid
from fmu_mesh.system.layout import Layout
from fmu_mesh.variables.model_description import Value, Variable
from tests.helpers import FMUS
from tests.onnx_models import Nodes, weights, write_identity, write_model, write_network

GRID = TimeGrid(0.0, 0.1, 10)


def section_of(path: Path) -> InstanceSection:
    return KINDS.section("onnx")(onnx=str(path))  # type: ignore[call-arg]  # the Struct of this kind


def variables_of(path: Path) -> dict[str, Variable]:
    return {variable.name: variable for variable in describe(path, section_of(path)).variables}


def opened(path: Path, **start_values: Value) -> Instance:
    """An instance in Initialization Mode."""
    description = describe(path, section_of(path))
    instance = open_instance(Opening("policy", path, section_of(path), description, path.parent))
    instance.enter_initialization(0.0, None, start_values)
    return instance


class Stepped:
    """An instance with rings, at its first point."""

    def __init__(self, instance: Instance) -> None:
        variables = instance.description.variables
        self.instance = instance
        self.inputs = Ring(Layout.of(v for v in variables if v.causality == "input"), 4)
        self.outputs = Ring(Layout.of(v for v in variables if v.causality == "output"), 4)
        instance.exit_initialization()
        instance.bind(self.inputs, [self.outputs], GRID, 1)

    def step(self, number: int, **inputs: Value) -> None:
        for name, value in inputs.items():
            self.inputs.put(number, name, value)
        self.instance.do_step(number)


def refused(path: Path) -> LoadFailed:
    with pytest.raises(LoadFailed) as caught:
        describe(path, section_of(path))
    return caught.value


def answer(observation: Sequence[float]) -> float:
    """What the network of `write_network` answers, nearly: here in Float64."""
    own = {name: array.astype(np.float64) for name, array in weights(len(observation)).items()}
    return float(np.tanh(np.tanh(np.array(observation) @ own["first"]) @ own["second"])[0])


# ---- variables


@pytest.mark.parametrize(
    ("sizes", "shape"),
    [
        ([], ()),
        ([1], ()),
        (["N"], ()),
        ([None], ()),
        (["N", 1], ()),
        ([1, 1], ()),
        ([4], (4,)),
        (["N", 4], (4,)),
        ([None, 4], (4,)),
        ([1, 4], (4,)),
        ([1, 1, 4], (4,)),
        (["N", 3, 2], (3, 2)),
        ([2, 1], (2, 1)),
    ],
    ids=str,
)
def test_dynamic_batch_is_one_and_leading_dimensions_of_one_are_left_out(
    sizes: list[int | str | None], shape: tuple[int, ...], tmp_path: Path
) -> None:
    variables = variables_of(write_identity(tmp_path / "it.onnx", "DOUBLE", sizes))

    assert {name: (variable.causality, variable.shape) for name, variable in variables.items()} == {
        "x": ("input", shape),
        "y": ("output", shape),
    }
    assert variables["y"].dependencies == ("x",)


@pytest.mark.parametrize(
    ("kind", "taken", "given", "value"),
    [
        ("FLOAT16", "Float64", "Float32", 0.5),
        ("FLOAT", "Float64", "Float32", 0.5),
        ("DOUBLE", "Float64", "Float64", 0.1),
        ("INT8", "Int8", "Int8", -128),
        ("UINT8", "UInt8", "UInt8", 255),
        ("INT16", "Int16", "Int16", -(2**15)),
        ("UINT16", "UInt16", "UInt16", 2**16 - 1),
        ("INT32", "Int32", "Int32", -(2**31)),
        ("UINT32", "UInt32", "UInt32", 2**32 - 1),
        ("INT64", "Int64", "Int64", -(2**63)),
        ("UINT64", "UInt64", "UInt64", 2**64 - 1),
        ("BOOL", "Boolean", "Boolean", True),
        ("STRING", "String", "String", "Grüße"),
    ],
)
def test_a_value_of_every_type_goes_through(kind: str, taken: str, given: str, value: Value, tmp_path: Path) -> None:
    path = write_identity(tmp_path / "it.onnx", kind, ["N", 2])
    variables = variables_of(path)
    stepped = Stepped(opened(path))
    zero = stepped.outputs.value(0, "y")

    stepped.step(0, x=[value, value])

    assert (variables["x"].type, variables["y"].type) == (taken, given)
    assert stepped.outputs.value(1, "y") == [value, value]
    assert zero == variables["x"].start
    state = _keeper(stepped.instance).get_state()
    stepped.step(1, x=zero)
    _keeper(stepped.instance).set_state(state)
    assert stepped.instance.get_values(["y"]) == [[value, value]]


def test_a_float64_is_rounded_by_model_and_kept_as_it_is_outside(tmp_path: Path) -> None:
    stepped = Stepped(opened(write_identity(tmp_path / "it.onnx")))

    stepped.step(0, x=0.1)
    stepped.step(1, x=1e300)

    assert stepped.outputs.value(1, "y") == float(np.float32(0.1))
    assert stepped.outputs.value(2, "y") == math.inf
    assert stepped.instance.get_values(["x"]) == [1e300]


def test_the_description_says_what_the_model_is(tmp_path: Path) -> None:
    path = write_network(tmp_path / "policy.onnx")

    description = describe(path, section_of(path))

    assert (description.model_name, description.kind) == ("graph", "onnx_model")
    assert str(description.generation_tool).startswith("onnxruntime ")
    assert (description.can_get_and_set_state, description.can_serialize_state) == (True, True)
    assert content(path, section_of(path)) == hashlib.sha256(path.read_bytes()).hexdigest()


# ---- steps


def test_in_initialization_mode_the_outputs_follow_the_inputs(tmp_path: Path) -> None:
    instance = opened(write_network(tmp_path / "policy.onnx"), observation=[0.1, 0.2, 0.3, 0.4])

    first = instance.get_values(["action"])
    instance.set_values({"observation": [1.0, -1.0, 0.5, 0.0]})
    second = instance.get_values(["action"])

    assert first == [pytest.approx(answer([0.1, 0.2, 0.3, 0.4]), rel=1e-5)]
    assert second == [pytest.approx(answer([1.0, -1.0, 0.5, 0.0]), rel=1e-5)]


def test_later_the_outputs_change_in_a_step_only(tmp_path: Path) -> None:
    stepped = Stepped(opened(write_identity(tmp_path / "it.onnx"), x=1.0))

    stepped.instance.set_values({"x": 2.0})
    before = stepped.instance.get_values(["x", "y"])
    stepped.step(0, x=3.0)

    assert before == [2.0, 1.0]
    assert [stepped.outputs.value(row, "y") for row in (0, 1)] == [1.0, 3.0]
    assert stepped.instance.get_values(["x", "y"]) == [3.0, 3.0]


def test_the_state_is_that_of_another_instance_too(tmp_path: Path) -> None:
    path = write_network(tmp_path / "policy.onnx")
    one, other = Stepped(opened(path)), Stepped(opened(path))
    one.step(0, observation=[0.1, 0.2, 0.3, 0.4])
    keeps, takes = _keeper(one.instance), _keeper(other.instance)

    state = keeps.get_state()
    takes.set_state(takes.deserialize_state(keeps.serialize_state(state)))
    keeps.free_state(state)

    names = ["observation", "action"]
    assert other.instance.get_values(names) == one.instance.get_values(names)
    with pytest.raises(StepFailed, match="3 bytes are no state of this model"):
        takes.set_state(b"abc")


def _keeper(instance: Instance) -> KeepsState:
    return instance  # type: ignore[return-value]  # as its description says


def test_a_model_is_computed_on_one_thread_and_sends_nothing(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    constants = {"w": random.standard_normal((2000, 2000)).astype(np.float32)}
    sizes = {"x": ("FLOAT", [1, 2000])}
    path = tmp_path / "large.onnx"
    write_model(path, [("MatMul", ["x", "w"], ["y"])], sizes, {"y": ("FLOAT", [1, 2000])}, constants)
    folder = tmp_path / "temporary"
    folder.mkdir()
    program = """
import os, sys
from pathlib import Path
import numpy
before = len(os.listdir("/proc/self/task"))  # numpy has its own
from fmu_mesh.instances.onnx.onnx_model import OnnxModel
model = OnnxModel(Path(sys.argv[1]))
model.compute({"x": numpy.ones((1, 2000), dtype=numpy.float32)})
print(len(os.listdir("/proc/self/task")) - before)
"""
    environment = {key: value for key, value in os.environ.items() if key != "ORT_DISABLE_TELEMETRY"}

    done = subprocess.run(
        [sys.executable, "-c", program, path],
        env=environment | {"TMPDIR": str(folder), "HOME": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    )

    assert (done.stdout, done.stderr) == ("0\n", "")
    assert [*folder.iterdir()] == []


# ---- failing


def test_an_input_that_is_no_number_fails_even_where_model_hides_it(tmp_path: Path) -> None:
    sizes = {"x": ("FLOAT", [3])}
    path = write_model(tmp_path / "relu.onnx", [("Relu", ["x"], ["y"])], sizes, {"y": ("FLOAT", [3])})

    with pytest.raises(StepFailed, match=r"instance policy\.x\[2\]: the input is not a number \(NaN\)"):
        Stepped(opened(path)).step(0, x=[0.0, math.nan, 1.0])
    with pytest.raises(InitializationFailed, match=r"instance policy\.x\[3\]: the input is not a number"):
        opened(path, x=[0.0, 1.0, "NaN"]).exit_initialization()


def test_an_output_that_is_no_number_fails_and_is_named(tmp_path: Path) -> None:
    sizes = {"x": ("FLOAT", ["N"])}
    path = write_model(tmp_path / "log.onnx", [("Log", ["x"], ["y"])], sizes, {"y": ("FLOAT", ["N"])})
    stepped = Stepped(opened(path, x=1.0))

    stepped.step(0, x=math.inf)
    assert stepped.outputs.value(1, "y") == math.inf
    with pytest.raises(StepFailed, match=r"instance policy\.y: the output is not a number \(NaN\)"):
        stepped.step(1, x=-1.0)


def test_what_onnxruntime_says_in_a_step_is_in_the_error(tmp_path: Path) -> None:
    nodes: Nodes = [("Gather", ["table", "x"], ["y"])]
    table = {"table": np.arange(3, dtype=np.float32)}
    path = write_model(tmp_path / "table.onnx", nodes, {"x": ("INT64", [1])}, {"y": ("FLOAT", [1])}, table)
    stepped = Stepped(opened(path))

    with pytest.raises(StepFailed, match=r"instance policy: onnxruntime cannot compute it: .*out of data bounds"):
        stepped.step(0, x=7)


def test_an_output_that_changes_its_size_fails(tmp_path: Path) -> None:
    sizes = {"x": ("FLOAT", [2])}
    nodes: Nodes = [("Not", ["b"], ["n"]), ("Cast", ["x"], ["b"], {"to": 9}), ("NonZero", ["n"], ["y"])]
    path = write_model(tmp_path / "found.onnx", [nodes[1], nodes[0], nodes[2]], sizes, {"y": ("INT64", [1, "found"])})
    stepped = Stepped(opened(path))

    with pytest.raises(StepFailed, match=r"policy\.y: the output has 1 elements now and had 2 for inputs of 0"):
        stepped.step(0, x=[0.0, 1.0])


# ---- refused


def test_dynamic_dimensions_besides_the_batch_are_named(tmp_path: Path) -> None:
    text = str(refused(write_identity(tmp_path / "it.onnx", "FLOAT", ["batch", "height", 3, None])))
    assert "the input 'x' has dynamic dimensions besides the first, the batch: 'height', '4'" in text


def test_a_model_with_random_numbers_is_refused(tmp_path: Path) -> None:
    sizes = {"x": ("FLOAT", [1, 2])}
    nodes: Nodes = [("RandomNormalLike", ["x"], ["y"], {"seed": 1.0})]
    error = refused(write_model(tmp_path / "random.onnx", nodes, sizes, {"y": ("FLOAT", [1, 2])}))
    assert "the output 'y' of " in str(error)
    assert "has different values for the same inputs" in str(error)


def test_weights_in_another_file_are_refused_although_they_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_network(tmp_path / "policy.onnx")
    onnx.save(onnx.load(path), path, save_as_external_data=True, location="policy.data", size_threshold=0)
    monkeypatch.chdir(tmp_path)

    error = refused(path)

    assert "has its weights in another file" in str(error)
    assert "onnx.save(onnx.load('policy.onnx'), 'policy.onnx')" in str(error)
    onnx.save(onnx.load(path), path)
    assert [*variables_of(path)] == ["observation", "action"]


@pytest.mark.parametrize(
    ("nodes", "outputs", "expected"),
    [
        ([("Foo", ["x"], ["y"])], {"y": ("FLOAT", [1])}, "onnxruntime cannot load"),
        ([("Foo", ["x"], ["y"])], {"y": ("FLOAT", [1])}, "No Op registered for Foo"),
        ([("Identity", ["x"], ["y"])], {"x": ("FLOAT", [1]), "y": ("FLOAT", [1])}, "'x' is the name of an input and"),
        ([("SequenceConstruct", ["x"], ["y"])], None, "the output 'y' is a seq(tensor(float))"),
        ([("Reshape", ["x", "five"], ["y"])], {"y": ("FLOAT", [5])}, "cannot compute "),
    ],
)
def test_a_model_that_cannot_be_an_instance_says_why(
    nodes: Nodes, outputs: dict[str, Any] | None, expected: str, tmp_path: Path
) -> None:
    constants = {"five": np.array([5], dtype=np.int64)}
    path = write_model(
        tmp_path / "it.onnx", nodes, {"x": ("FLOAT", ["N"])}, outputs or {"y": ("FLOAT", [1])}, constants
    )
    if outputs is None:
        model = onnx.load(path)
        tensor = onnx.helper.make_tensor_type_proto(onnx.TensorProto.FLOAT, [1])
        sequence = onnx.helper.make_sequence_type_proto(tensor)
        model.graph.output[0].CopyFrom(onnx.helper.make_value_info("y", sequence))
        onnx.save(model, path)

    assert expected in str(refused(path))


@pytest.mark.parametrize(("data", "expected"), [(b"", "No graph was found"), (b"hello", "protobuf parsing failed")])
def test_a_file_that_is_no_model_says_so(data: bytes, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "it.onnx"
    path.write_bytes(data)
    assert expected in str(refused(path))


def test_a_file_beyond_the_limit_is_not_read(tmp_path: Path) -> None:
    path = write_network(tmp_path / "policy.onnx")
    with pytest.raises(LoadFailed, match=r"has \d+ bytes; the limit is 100"):
        describe(path, section_of(path), LimitsConfig(unpacked_bytes=100))


def test_a_file_that_was_changed_after_the_run_was_planned_is_refused(tmp_path: Path) -> None:
    path = write_network(tmp_path / "policy.onnx")
    description, planned = describe(path, section_of(path)), content(path, section_of(path))
    write_network(path, inputs=3)

    with pytest.raises(LoadFailed, match=r"instance policy: '.*policy\.onnx' was changed after the run was planned"):
        open_instance(Opening("policy", path, section_of(path), description, tmp_path, planned))


# ---- the command line


def config_of(folder: Path) -> Path:
    write_network(folder / "policy.onnx")
    config = folder / "mesh.yaml"
    config.write_text(
        f"""\
mesh: m
simulation: {{stop_time: 1.0, step_size: 0.1}}
instances:
  gain: {{fmu: {FMUS}/Gain.fmu, start_values: {{u: 0.5}}}}
  policy: {{onnx: policy.onnx, start_values: {{observation: [0, 1, 2, 3]}}}}
connections: ["gain.y -> policy.observation[1]"]
""",
        encoding="utf-8",
    )
    return config


def test_check_shows_the_model_and_its_connections(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(config_of(tmp_path))]) == 0

    page = capsys.readouterr().out
    assert "policy.onnx (onnxruntime " in page
    assert "gain.y -> policy.observation[1]" in page
    assert "policy.action  Float32" in page


def test_inspect_shows_a_model_and_says_why_it_cannot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_network(tmp_path / "policy.onnx")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"hello")

    assert main(["inspect", str(path)]) == 0
    page = " ".join(capsys.readouterr().out.split())
    assert main(["inspect", str(path), "--json"]) == 0
    description = json.loads(capsys.readouterr().out)["description"]
    assert main(["inspect", str(broken)]) == 2

    assert "Kind onnx model" in page
    assert "Inputs (1) observation Float64[4] continuous" in page
    assert "Platforms" not in page
    assert [variable["name"] for variable in description["variables"]] == ["observation", "action"]
    assert "protobuf parsing failed" in capsys.readouterr().err


def test_without_onnxruntime_the_finding_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "onnxruntime.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    assert main(["check", str(config_of(tmp_path))]) == 2

    told = capsys.readouterr().err
    assert "mesh.yaml:5: instances.policy.onnx: ONNX models need the library onnxruntime" in told
    assert "-m pip install 'onnxruntime>=1.22'`" in told


# --- no end


def write_endless(path: Path) -> Path:
    """Write a model that computes for ever where its input is not above 0.5."""
    nothing: list[onnx.NodeProto] = [
        onnx.helper.make_node("Identity", [name], [f"next {name}"]) for name in ("goes on", "value")
    ]
    kinds = {"number": ("INT64", []), "goes on": ("BOOL", []), "value": ("FLOAT", [1])}
    of = {
        name: onnx.helper.make_tensor_value_info(name, getattr(onnx.TensorProto, kind), sizes)
        for name, (kind, sizes) in {**kinds, **{f"next {name}": kind for name, kind in kinds.items()}}.items()
    }
    body = onnx.helper.make_graph(nothing, "body", [of[name] for name in kinds], [of["next goes on"], of["next value"]])
    return write_model(
        path,
        [
            ("Greater", ["limit", "x"], ["below"]),
            ("Squeeze", ["below"], ["for ever"]),
            ("Loop", ["", "for ever", "x"], ["y"], {"body": body}),
        ],
        {"x": ("FLOAT", [1])},
        {"y": ("FLOAT", [1])},
        {"limit": np.array([0.5], np.float32)},
    )


def test_a_model_that_computes_for_ever_is_a_finding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_question, "_DEADLINE_S", 3.0)
    path = write_endless(tmp_path / "endless.onnx")

    with pytest.raises(LoadFailed) as caught:
        describe(path, section_of(path))

    assert f"onnxruntime, which loads and computes '{path}', did not end within 3 s" in str(caught.value)
