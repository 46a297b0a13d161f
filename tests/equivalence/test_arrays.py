"""Large arrays: the same floats in all ways, rings of a few rows, and words where something is too large."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import fmu_mesh
from fmu_mesh.run import limits
from fmu_mesh.system.layout import row_bytes
from tests.helpers import BY_STREAMS, BY_ZENOH

PARTS = '''\
"""Fields and images."""

import numpy as np

import fmu_mesh
from fmu_mesh import Input, Output, Parameter

SIZE = {size}


class Camera(fmu_mesh.Component):
    """A field, an image, and what nobody reads."""

    wrong = Parameter(0)
    field = Output(shape=SIZE)
    image = Output(shape=(SIZE // 50, 50), type="UInt8")
    unread = Output(shape=SIZE)

    def initialize(self):
        self.base = np.arange(SIZE) / 3.0
        self.step(0.0, 0.0)

    def step(self, time, step_size):
        self.field = self.base + time
        self.image = np.full((SIZE // 50, 50), round(100 * time) % 256, np.uint8)
        self.unread = -self.field
        if self.wrong and time > 0.035:
            self.field[SIZE // 2] = np.inf


class Filter(fmu_mesh.Component):
    """Half of the field, shifted."""

    u = Input(shape=SIZE)
    image = Input(shape=(SIZE // 50, 50), type="UInt8")
    y = Output(shape=SIZE)
    light = Output()

    def step(self, time, step_size):
        self.y = self.u * 1e200
        self.light = float(self.image.sum()) + self.image[0, 1]


class Sum(fmu_mesh.Component):
    """One number of each array."""

    u = Input(shape=SIZE)
    total = Output()
    last = Output()

    def step(self, time, step_size):
        self.total = float(self.u.sum())
        self.last = float(self.u[-1])
'''
NAMES = ("filter.light", "sum.total", "sum.last")


def mesh_of(
    folder: Path,
    size: int,
    *,
    window: int | str = "auto",
    record: tuple[str, ...] = NAMES,
    way: Mapping[str, bool] = {},
) -> fmu_mesh.Mesh:
    """Camera -> filter -> sum, with a factor on the way."""
    (folder / "parts.py").write_text(PARTS.format(size=size))
    config = folder / "fields.yaml"
    config.write_text(f"""\
mesh: fields
simulation: {{step_size: 0.01, stop_time: 0.4, window: {window}}}
instances:
  camera: {{python: parts.py:Camera}}
  filter: {{python: parts.py:Filter}}
  sum: {{python: parts.py:Sum}}
connections:
  - {{from: camera.field, to: filter.u, factor: 0.5, offset: 0.1}}
  - camera.image -> filter.image
  - {{from: filter.y, to: sum.u, factor: 1.0e-200}}
record: {{file: fields.csv, variables: {json.dumps(record)}}}
zenoh: {json.dumps(way)}
""")
    return fmu_mesh.load(config)


def columns(result: fmu_mesh.Result) -> list[list[float]]:
    return [result[name].tolist() for name in NAMES]


@pytest.mark.parametrize("size", [1_000, 100_000])
def test_arrays_have_the_same_floats_in_all_ways(size: int, tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, size)

    launched = mesh.run()
    local = mesh.run(processes=False)
    with mesh.repeated() as runs:
        repeated = runs.run()
    with mesh.open() as system:
        rows = [[system.get(name) for name in NAMES]]
        while system.point < 40:
            system.step()
            rows.append([system.get(name) for name in NAMES])
        field, image = system.get("filter.y"), system.get("camera.image")

    assert (
        columns(launched) == columns(local) == columns(repeated) == [list(column) for column in zip(*rows, strict=True)]
    )
    assert launched["filter.light"][5] == (size + 1) * 4.0
    assert field.tolist() == (((np.arange(size) / 3.0 + 0.39) * 0.5 + 0.1) * 1e200).tolist()
    assert image.tolist() == np.full((size // 50, 50), 39).tolist()


@pytest.mark.parametrize("way", [BY_STREAMS, BY_ZENOH], ids=["streams", "frames"])
def test_arrays_between_hosts_have_the_same_floats(tmp_path: Path, way: Mapping[str, bool]) -> None:
    mesh = mesh_of(tmp_path, 100_000, window=3, way=dict(way))

    framed = mesh.run()

    assert columns(framed) == columns(mesh.run(processes=False))


@pytest.mark.parametrize("window", ["auto", 1, 5_000])
@pytest.mark.parametrize("record", [NAMES, ("camera.image[1,1]", *NAMES)])
def test_the_ring_of_a_wide_row_has_few_rows(window: int | str, record: tuple[str, ...], tmp_path: Path) -> None:
    plan = mesh_of(tmp_path, 100_000, window=window, record=record).plan().plan

    rings = {place.instance: place for node in plan.nodes.values() for place in node.rings}
    wide = rings["camera"]
    assert wide.layout.names == ("field", "image")  # `unread` costs nothing
    assert row_bytes(wide.layout) == 8 + 800_000 + 100_000
    assert all(plan.window + 3 < place.rows for place in rings.values())
    assert all(rings[name].rows <= 64 for name in ("camera", "filter"))


def test_what_nobody_records_does_not_narrow_the_recorder(tmp_path: Path) -> None:
    plan = mesh_of(tmp_path, 1_000_000, record=("sum.total",)).plan().plan

    rows = {place.instance: place.rows for node in plan.nodes.values() for place in node.rings}
    assert rows == {"camera": 32, "filter": 32, "sum": 524288}


def test_check_and_launch_say_which_ring_does_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "available_bytes", lambda: 50_000_000)
    mesh = mesh_of(tmp_path, 100_000)

    checked = mesh.check()
    with pytest.raises(fmu_mesh.ConfigurationError) as launched:
        mesh.run()

    said = str(checked.error)
    assert "the rings of this run need 54 MB, and this host has 50 MB for them" in said
    assert "the ring of 'camera' needs 29 MB (32 rows of 1 MB)" in said
    assert "`simulation.window` to 1" in said
    assert str(launched.value) == said
    assert len(mesh.run(processes=False).times) == 41


def test_a_csv_refuses_a_large_array_and_names_other_formats(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, 100_000, record=("filter.y", "sum.total"))

    (finding,) = mesh.check(output=tmp_path / "fields.csv").findings

    assert finding.path == "record.variables"
    assert "100,000 elements of 'filter.y'" in finding.found
    assert "a file ending in .parquet or .mcap" in finding.expected


@pytest.mark.parametrize("ending", ["parquet", "mcap"])
def test_files_have_the_floats_of_large_arrays(ending: str, tmp_path: Path) -> None:
    pytest.importorskip("mcap" if ending == "mcap" else "pyarrow")
    mesh = mesh_of(tmp_path, 12_000, record=("filter.y", "camera.image", "sum.total"))

    launched = mesh.run(stop_time=0.05, output=tmp_path / f"launched.{ending}")
    local = mesh.run(stop_time=0.05, output=tmp_path / f"local.{ending}", processes=False)
    memory = mesh.run(stop_time=0.05, record="memory", processes=False)

    assert list(launched) == list(local) == list(memory)
    assert len(memory) == 24_001
    for name, column in memory.items():
        assert launched[name].tobytes() == local[name].tobytes() == column.tobytes(), name
        assert local[name].dtype == column.dtype
    assert launched.compare(memory)


@pytest.mark.parametrize("processes", [True, False])
def test_an_element_that_is_not_finite_ends_the_run_with_its_name(
    processes: bool,  # noqa: FBT001  a parameter of the test
    tmp_path: Path,
) -> None:
    mesh = mesh_of(tmp_path, 1_000)

    with pytest.raises(fmu_mesh.NotFinite) as error:
        mesh.run(processes=processes, start_values={"camera.wrong": 1})

    assert (error.value.instance, error.value.variable, error.value.point) == ("camera", "field[501]", 5)


def test_arrays_are_read_set_and_watched_while_a_mesh_runs(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path, 10_000)

    with mesh.start(stop_time=600.0, real_time_factor=1.0) as run:
        field = run.get("camera.field")
        sample = next(iter(run.watch("camera.unread")))
        given = next(iter(run.watch("sum.u")))  # its ring has more rows than one of this width
        run.stop()

    assert len(field) == len(sample.value) == 10_000
    assert sample.value[0] == -(sample.point - 1) * 0.01
    assert given.value[0] == (((given.point - 1) * 0.01 * 0.5 + 0.1) * 1e200) * 1e-200


def test_a_system_takes_an_array_of_numpy_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "parts.py").write_text(PARTS.format(size=100_000))
    mesh = fmu_mesh.Mesh("alone", step_size=0.01, stop_time=1.0)
    mesh.add("sum", python=f"{tmp_path}/parts.py:Sum")
    values = np.arange(100_000) / 7.0

    with mesh.open() as system:
        system.set("sum.u", values)
        system.step()
        read = system.get("sum.u")
        total = system.get("sum.total")
        with pytest.raises(fmu_mesh.CallRefused, match="expected a finite number"):
            system.set("sum.u", np.full(100_000, np.nan))
        with pytest.raises(fmu_mesh.CallRefused, match="a list of 100000 values"):
            system.set("sum.u", values[1:])

    assert read.tolist() == values.tolist()
    assert total == values.sum()
