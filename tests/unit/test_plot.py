"""Result files as pictures: what is read, what is drawn, and what is refused."""

from __future__ import annotations

import importlib.util
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from msgspec.structs import replace
from numpy.typing import NDArray

from fmu_mesh.api.result import Result
from fmu_mesh.cli.main import main
from fmu_mesh.cli.plotting import plot_results, plotted_where_it_ends
from fmu_mesh.errors import ConfigurationError, StepFailed
from fmu_mesh.pictures.drawing import reduced
from fmu_mesh.pictures.result_drawing import Curves, PictureOptions, figure_of
from fmu_mesh.results.formats import read_result
from fmu_mesh.results.recording import Columns
from fmu_mesh.system.plan import Plan
from fmu_mesh.system.records import RecordPlan
from fmu_mesh.variables.model_description import Variability
from tests.planning import prepare

CONFIGS = Path(__file__).parents[2] / "configs"

RESULTS = """\
time,a.y,"a.der(x,2)",b.on,b.count
0.0,1.5,-2.0,true,3
0.5,1e-3,nan,false,-4
1.0,2.5,inf,true,5
"""


@pytest.fixture
def results(tmp_path: Path) -> Path:
    path = tmp_path / "run.csv"
    path.write_text(RESULTS, encoding="utf-8")
    return path


def pixels(picture: Path) -> NDArray[np.float64]:
    """Height x width x colour."""
    return np.asarray(image.imread(picture), dtype=np.float64)


def legend_of(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.skipif(shutil.which("prlimit") is None, reason="needs prlimit")
@pytest.mark.parametrize("format_", ["png", "svg", "pdf"])
def test_a_plot_for_which_the_disk_has_no_room_leaves_last_one(results: Path, format_: str) -> None:
    plot = results.with_suffix(f".{format_}")
    plot.write_bytes(b"the last one")
    python = [sys.executable, "-B"]  # otherwise half of a module stays in its cache
    command = ["prlimit", "--fsize=1000", *python, "-m", "fmu_mesh", "plot", str(results), "--output", str(plot)]

    done = subprocess.run(command, capture_output=True, text=True, check=False)

    assert done.returncode == 2
    assert done.stderr.startswith(f"fmu-mesh: the plot '{plot}' cannot be written: ")
    assert plot.read_bytes() == b"the last one"
    assert sorted(path.name for path in results.parent.iterdir()) == ["run.csv", plot.name]


def test_a_result_file_is_read_as_it_was_written(results: Path) -> None:
    read = read_result(results)

    assert read.times.tolist() == [0.0, 0.5, 1.0]
    assert list(read.values) == ["a.y", "a.der(x,2)", "b.on", "b.count"]
    assert read.values["a.y"].tolist() == [1.5, 0.001, 2.5]
    assert math.isnan(read.values["a.der(x,2)"][1])
    assert read.values["a.der(x,2)"][2] == math.inf
    assert read.values["b.on"].tolist() == [True, False, True]
    assert read.values["b.count"].tolist() == [3, -4, 5]


@pytest.mark.parametrize("rest", ["1.5", "1.5,0.1", "1.5,0.1,0.2,true,1", ""])
def test_a_last_row_that_is_cut_off_is_left_out(results: Path, rest: str) -> None:
    results.write_text(RESULTS + rest, encoding="utf-8")
    assert read_result(results).times.tolist() == [0.0, 0.5, 1.0]


def test_columns_of_text_are_read_and_not_drawn(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text('time,a,"s,t",b\n0.0,1.5,"x, ""y""\nz",2\n0.5,2.5,"",3\n1.0,3.5,"cut')

    values = read_result(path).values

    assert {name: column.tolist() for name, column in values.items()} == {
        "a": [1.5, 2.5],
        "s,t": ['x, "y"\nz', ""],
        "b": [2, 3],
    }
    assert legend_of(Result.read(path).plot().axes[0]) == ["a", "b"]


def test_variables_are_chosen_in_the_order_asked_for(results: Path) -> None:
    assert legend_of(Result.read(results).plot("b.count", "a.y").axes[0]) == ["b.count", "a.y"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty, not 'time'"),
        ("mesh: pair\n", "its first column is 'mesh: pair', not 'time'"),
        (RESULTS + "1.5,1\n", "line 5: 2 values where the heading has 5"),
        (RESULTS + "1.5,x,1.0,true,1\n", "line 5: 'x' is no value of type Float64"),
        ("time,a\n\0\xff", ""),
    ],
)
def test_what_is_no_result_file_is_refused_with_the_place(results: Path, text: str, message: str) -> None:
    results.write_text(text, encoding="latin-1")
    if not message:
        results.write_bytes(b"time,a\n\xff\xfe\n")
        message = "codec can't decode"
    with pytest.raises(ConfigurationError, match=r"'.*run\.csv' is no result file: ") as caught:
        read_result(results)
    assert message in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", str(tmp_path / "nothing.csv")]) == 2
    assert "cannot be read: No such file or directory" in capsys.readouterr().err


def test_an_unknown_variable_is_refused_with_the_nearest_name(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plot", str(results), "--variables", "b.cont"]) == 2
    assert "has no variable 'b.cont'. Did you mean 'b.count'?" in capsys.readouterr().err


def test_the_command_draws_beside_the_result_file(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", str(results)]) == 0

    picture = results.with_suffix(".png")
    assert capsys.readouterr().out == f"plot: {picture}\n"
    height, width, _ = pixels(picture).shape
    assert height == 816  # two axes
    assert width > 1008  # the axes, and the legend beside them
    assert len(np.unique(pixels(picture).reshape(-1, 4), axis=0)) > 10


def test_a_format_that_does_not_exist_is_refused(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", str(results), "--output", str(results.with_suffix(".xyz"))]) == 2
    assert "supported formats" in capsys.readouterr().err


@pytest.mark.parametrize("rows", ["", "0.0,1.0,1.0,true,1\n"])
def test_no_points_and_one_point_can_be_drawn(results: Path, rows: str) -> None:
    results.write_text(RESULTS.splitlines(keepends=True)[0] + rows, encoding="utf-8")
    assert main(["plot", str(results)]) == 0
    assert results.with_suffix(".png").stat().st_size > 1000


def test_with_a_plan_every_unit_has_axes_of_its_own(tmp_path: Path) -> None:
    plan = prepare(CONFIGS / "chain8.yaml")
    names = [".".join(recorded) for recorded in plan.system.recorded]
    result = tmp_path / "chain8.csv"
    heading = ",".join(["time", *(f'"{name}"' for name in names)])
    result.write_text(f"{heading}\n0.0{',1.0' * len(names)}\n", encoding="utf-8")
    picture, text = tmp_path / "chain8.png", tmp_path / "chain8.svg"

    plot_results(result, picture, plan)
    plot_results(result, text, plan)

    assert pixels(picture).shape[0] == 1488  # rad, rad/s, rad/s2 and none
    drawn = text.read_text(encoding="utf-8")
    for words in ("chain8", "a in rad", "der(a) in rad/s", "der(a,2) in rad/s²", "y", "time in s", *names):
        assert f"<!-- {words} -->" in drawn


def test_without_matplotlib_the_error_says_what_to_install(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find_spec(name))

    assert main(["plot", str(results)]) == 2
    assert main(["launch", str(CONFIGS / "pendulum_delay.yaml"), "--plot", str(results.with_suffix(".png"))]) == 2

    assert capsys.readouterr().err.count("-m pip install 'matplotlib>=3.8'`") == 2


def test_a_reduced_line_keeps_its_extremes_and_gaps() -> None:
    times: NDArray[np.float64] = np.linspace(0.0, 100.0, 100_000)
    values: NDArray[np.float64] = np.sin(times)
    values[12_345], values[54_321] = 7.0, -9.0
    values[70_000:80_000] = math.nan
    values[90_000] = math.inf

    few_times, few = reduced(times, values, 1000)

    assert 900 < len(few) <= 1002
    assert np.nanmax(few) == 7.0
    assert few_times[np.nanargmax(few)] == times[12_345]
    assert np.nanmin(few) == -9.0
    assert np.isnan(few[(few_times >= 71.0) & (few_times < 79.0)]).all()
    assert (few_times[0], few_times[-1]) == (times[0], times[-1])
    assert (np.diff(few_times) > 0).all()


def test_a_short_line_is_drawn_as_it_is() -> None:
    times = np.arange(5.0)
    assert reduced(times, times * 2, 5)[1].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]


def test_the_plot_of_a_finished_plan_may_lie_in_a_new_folder(results: Path, tmp_path: Path) -> None:
    plan = prepare(CONFIGS / "pendulum_delay.yaml")
    plan = replace(plan, system=replace(plan.system, records=()))
    plot_results(results, tmp_path / "new" / "run.png", plan)
    assert (tmp_path / "new" / "run.png").exists()


def plotted(plan: Plan, folder: Path) -> str:
    """The text of the picture of a result file with two rows of ones."""
    result, picture = folder / "result.csv", folder / "result.svg"
    names = [".".join(recorded) for recorded in plan.system.recorded]
    ones = ",1.0" * len(names)
    result.write_text(f"time,{','.join(names)}\n0.0{ones}\n1.0{ones}\n", encoding="utf-8")
    plot_results(result, picture, plan)
    return picture.read_text(encoding="utf-8")


def with_unit(plan: Plan, instance: str, name: str, unit: str) -> Plan:
    """``plan``, in which one variable has another unit."""
    own = plan.system.instances[instance]
    variables = tuple(
        replace(variable, unit=unit) if variable.name == name else variable for variable in own.description.variables
    )
    own = replace(own, description=replace(own.description, variables=variables))
    return replace(plan, system=replace(plan.system, instances={**plan.system.instances, instance: own}))


def test_what_an_fmu_only_passes_on_shares_axes_of_what_it_gets(tmp_path: Path) -> None:
    drawn = plotted(prepare(CONFIGS / "pendulum_delay.yaml"), tmp_path)

    assert drawn.count(" in rad -->") == 1
    for words in ("a, y in rad", "pendulum.a", "delay.y (no unit)"):
        assert f"<!-- {words} -->" in drawn


@pytest.mark.parametrize("unit", ["1", "-"])
def test_a_unit_that_says_that_there_is_none_is_no_label(tmp_path: Path, unit: str) -> None:
    plan = with_unit(prepare(CONFIGS / "pendulum_delay.yaml"), "delay", "y", unit)

    drawn = plotted(plan, tmp_path)

    assert "<!-- a in rad -->" in drawn
    assert "<!-- y -->" in drawn
    assert " in -" not in drawn
    assert " in 1" not in drawn


@pytest.mark.parametrize(("variability", "style"), [("continuous", "default"), ("discrete", "steps-post")])
def test_a_float_that_only_changes_at_events_is_drawn_in_steps(variability: Variability, style: str) -> None:
    system = prepare(CONFIGS / "pendulum_delay.yaml").system
    own = system.instances["delay"]
    variables = tuple(replace(variable, variability=variability) for variable in own.description.variables)
    own = replace(own, description=replace(own.description, variables=variables))
    system = replace(system, instances={**system.instances, "delay": own})
    columns = Columns(np.arange(2.0), {"pendulum.a": np.ones(2), "delay.y": np.ones(2)})

    (axes,) = Result("drawn", system=system, columns=columns).plot("delay.y").axes

    assert [line.get_drawstyle() for line in axes.lines] == [style]


def drawn_of(columns: Mapping[str, Sequence[float]]) -> Figure:
    """The picture of results at 0, 1, 2 … s."""
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    times = np.arange(len(next(iter(arrays.values()))), dtype=np.float64)
    return figure_of([Curves("drawn", times, arrays)], PictureOptions("drawn"))


def test_78_lines_can_be_told_apart_and_their_legend_covers_nothing() -> None:
    names = [f"plant.subsystem.actuator[{number}].flange.angularVelocity" for number in range(78)]
    figure = drawn_of({name: [number, -number] for number, name in enumerate(names)})

    figure.canvas.draw()  # lays it out; a layout for which there is no room is a warning, and so an error here

    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == names
    styles = [(line.get_color(), str(line._dash_pattern)) for line in legend.get_lines()]  # type: ignore[attr-defined] # no public name
    assert len(set(styles)) == 78
    of_axes, of_legend = axes.get_window_extent(), legend.get_window_extent()
    assert of_axes.width > 7 * figure.dpi
    assert of_legend.x0 > of_axes.x1
    assert of_legend.x1 <= figure.bbox.x1
    assert of_legend.y0 >= figure.bbox.y0


def test_lines_that_lie_on_one_another_all_show() -> None:
    wave = [0.0, 1.0, 0.0, -1.0]
    columns = {"engine.a": wave, "fmu.a": wave, "other.a": [-value for value in wave], "third.a": wave}

    (axes,) = drawn_of(columns).axes

    first, second, other, third = axes.lines
    assert [line.is_dashed() for line in (first, second, other, third)] == [False, True, True, True]
    assert second._dash_pattern != third._dash_pattern  # type: ignore[attr-defined] # no public name


@pytest.mark.parametrize(
    ("heading", "row"),
    [("_x.y,b.$a$,c.\u65e5", "1.0,2.0,3.0"), ("a.y,b.y,c.y", "1e308,-1e308,nan"), ("a." + "x" * 300, "1.0")],
    ids=["names", "values", "a long name"],
)
def test_nothing_that_matplotlib_warns_of_reaches_the_user(tmp_path: Path, heading: str, row: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"time,{heading}\n0.0,{row}\n1.0,{row}\n2.0,{row}\n", encoding="utf-8")
    without_cache = {**os.environ, "MPLCONFIGDIR": str(path)}  # not a folder

    done = subprocess.run(
        [sys.executable, "-m", "fmu_mesh", "plot", str(path)],
        capture_output=True,
        text=True,
        check=False,
        env=without_cache,
    )

    assert (done.returncode, done.stdout, done.stderr) == (0, f"plot: {path.with_suffix('.png')}\n", "")


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        (["y"], "has no variable 'y'. Did you mean 'a.y'?"),
        (["coumt"], "has no variable 'coumt'. Did you mean 'b.count'?"),
        (["y", "on"], "has no variable 'y' or 'on'. Did you mean 'a.y' or 'b.on'?"),
        (["zzz"], "has no variable 'zzz'. There are: a.y, a.der(x,2), b.on, b.count."),
    ],
)
def test_a_variable_without_its_instance_is_told_with_it(
    results: Path, capsys: pytest.CaptureFixture[str], wanted: list[str], says: str
) -> None:
    assert main(["plot", str(results), "--variables", *wanted]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize("wrote", [False, True])
def test_of_a_run_that_failed_only_what_it_recorded_itself_is_plotted(results: Path, *, wrote: bool) -> None:
    plan = prepare(CONFIGS / "pendulum_delay.yaml")
    plan = replace(plan, system=replace(plan.system, records=(RecordPlan(str(results), ()),)))
    plot = results.with_suffix(".png")

    def fail() -> None:
        if wrote:
            results.write_text("time,a.y\n0.0,1.5\n", encoding="utf-8")
        raise StepFailed("no")

    with pytest.raises(StepFailed), plotted_where_it_ends(plan, plot):
        fail()

    assert plot.exists() == wrote
