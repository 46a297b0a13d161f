"""Results: arrays by name with their types, whether they come from a file or from memory."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import fmu_mesh
from tests.fmus.helpers import find_fmu
from tests.helpers import FMUS, write_config


def test_memory_and_file_have_the_same_arrays_units_and_rows(folder: Path) -> None:
    mesh = fmu_mesh.load(write_config(folder))
    file, memory = mesh.run(), mesh.run(record="memory")

    assert file.file == folder / "pair.csv"
    assert memory.file is None
    assert list(file) == list(memory) == file.names
    for name in file:
        assert file[name].dtype == memory[name].dtype == np.float64
        assert file[name].tobytes() == memory[name].tobytes()
    assert file.times.tobytes() == memory.times.tobytes()
    assert file.times.tolist() == [point * 0.001 for point in range(1001)]
    assert file.units == memory.units
    assert (file.units["pendulum.a"], file.units["delay.y"]) == ("rad", None)
    assert memory.outcome is not None
    assert (memory.outcome.state, memory.outcome.point, memory.outcome.rows) == ("done", 1000, 1001)
    assert memory.summary.startswith("1000 points in ")


def test_arrays_belong_to_the_caller(folder: Path) -> None:
    result = fmu_mesh.load(write_config(folder)).run(record="memory")
    result["pendulum.a"][:] = 0.0
    assert result["pendulum.a"].flags.writeable


@pytest.mark.parametrize("record", ["memory", None])
def test_every_type_comes_back_as_what_it_is(tmp_path: Path, record: None) -> None:
    types = find_fmu("AllTypes3", tmp_path)
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=0.3)
    mesh.add("it", fmu=types)
    run = mesh.check().run
    assert run is not None
    variables = run.plan.system.instances["it"].description.with_causality("output")
    outputs = [variable.name for variable in variables]
    mesh.record(*(f"it.{name}" for name in outputs), file="types.csv")

    result = mesh.run(record=record)

    kinds = {values.dtype.kind for values in result.values()}
    assert {"f", "i", "u", "b", "O"} <= kinds
    assert {len(values) for values in result.values()} == {4}
    texts = [value for values in result.values() if values.dtype == object for value in values]
    assert {type(text) for text in texts} == {str, bytes}


def test_a_name_that_is_not_there_is_refused_with_the_nearest(folder: Path) -> None:
    result = fmu_mesh.load(write_config(folder)).run(record="memory")

    with pytest.raises(fmu_mesh.UnknownName, match=r"Did you mean 'pendulum\.a'\?") as caught:
        result["pendulum.b"]
    assert isinstance(caught.value, KeyError)
    assert "pendulum.b" not in result
    assert result.get("pendulum.b") is None


def test_a_data_frame_has_the_times_as_its_index(folder: Path) -> None:
    pandas = pytest.importorskip("pandas")
    result = fmu_mesh.load(write_config(folder)).run(record="memory")

    frame = result.to_pandas()

    assert frame.index.name == "time"
    assert frame.index.to_numpy().tobytes() == result.times.tobytes()
    assert frame["delay.y"].to_numpy().tobytes() == result["delay.y"].tobytes()
    assert isinstance(frame, pandas.DataFrame)


def test_a_plot_has_axes_by_unit_and_the_chosen_names(folder: Path) -> None:
    result = fmu_mesh.load(write_config(folder)).run(record="memory")

    figure = result.plot("pendulum.a", "delay.y", title="angles")

    [axes] = figure.axes
    assert (axes.get_title(), axes.get_ylabel()) == ("angles", "a, y in rad")
    with pytest.raises(fmu_mesh.ConfigurationError, match=r"has no variable 'pendulum\.x'"):
        result.plot("pendulum.x")


def test_floats_that_are_no_numbers_come_back(folder: Path) -> None:
    file = folder / "odd.csv"
    file.write_text("time,a.x\n0.0,nan\n1.0,-inf\n2.0,1e-320\n")
    values = fmu_mesh.Result.read(file)["a.x"].tolist()
    assert math.isnan(values[0])
    assert values[1:] == [-math.inf, 1e-320]


def test_a_run_that_needs_too_much_memory_is_refused_before_it_starts(folder: Path) -> None:
    mesh = fmu_mesh.load(write_config(folder))
    with pytest.raises(
        fmu_mesh.CallRefused, match=r"take 40040 bytes of memory; the limit is 1000 bytes\. Raise `memory_"
    ):
        mesh.run(record="memory", memory_limit=1000)


def test_an_endless_run_ends_where_its_memory_does_with_what_was_recorded() -> None:
    mesh = fmu_mesh.Mesh("endless", step_size=0.001, stop_time=None)
    mesh.add("pendulum", fmu=FMUS / "DampedPendulum.fmu")

    with pytest.raises(fmu_mesh.CallRefused, match="do not fit into memory; the limit is 1000000 bytes") as caught:
        mesh.run(record="memory", memory_limit=1_000_000)

    result = caught.value.result
    assert len(result.times) == len(result["pendulum.a"]) >= 1_000_000 // 32
    assert result.times.tolist() == [point * 0.001 for point in range(len(result.times))]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize("from_file", [False, True])
def test_a_result_is_written_and_read_back_unchanged(tmp_path: Path, ending: str, from_file: bool) -> None:  # noqa: FBT001  a parameter of the test
    mesh = fmu_mesh.Mesh("types", step_size=0.1, stop_time=0.3)
    mesh.add("it", fmu=find_fmu("AllTypes3", tmp_path))
    result = mesh.run(output="types.parquet") if from_file else mesh.run(record="memory", processes=False)
    if from_file:
        result = fmu_mesh.Result.read("types.parquet")
    path = tmp_path / f"new/again.{ending}"

    getattr(result, f"to_{ending}")(path)

    again = fmu_mesh.Result.read(path)
    assert list(again) == list(result)
    assert again.units == result.units
    assert again.times.tobytes() == result.times.tobytes()
    for name in result:
        assert again[name].tolist() == result[name].tolist(), name
        assert [type(value) for value in again[name].tolist()] == [type(value) for value in result[name].tolist()]


def test_a_result_replaces_its_own_file_and_keeps_what_was_set(folder: Path) -> None:
    mesh = fmu_mesh.Mesh("gain", step_size=0.1, stop_time=1.0)
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    with mesh.start(output="gain.csv", paused=True) as run:
        run.set("gain.u", 0.1)
        run.resume()
        before = run.wait()
    values, metadata = before["gain.y"].tolist(), fmu_mesh.Result.read("gain.csv").metadata

    fmu_mesh.Result.read("gain.csv").to_csv("gain.csv")

    again = fmu_mesh.Result.read(folder / "gain.csv")
    assert again["gain.y"].tolist() == values
    assert again.metadata == metadata
    assert [(entry["variable"], entry["value"]) for entry in again.metadata["set"]] == [("u", 0.1)]


def test_a_data_frame_knows_the_units(folder: Path) -> None:
    result = fmu_mesh.load(write_config(folder)).run(record="memory", processes=False)

    units = result.to_pandas().attrs["units"]

    assert units == result.units
    assert (units["pendulum.a"], units["delay.y"]) == ("rad", None)


def test_a_result_without_rows_is_not_written(tmp_path: Path) -> None:
    empty = tmp_path / "empty.csv"
    empty.write_text("time,a\n")

    with pytest.raises(fmu_mesh.CallRefused, match="has no rows"):
        fmu_mesh.Result.read(empty).to_csv(tmp_path / "new.csv")
