"""Pictures of results: several of them, units on the axes, steps, phase plots, differences and annotations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.text import Annotation

from fmu_mesh.api.mesh_builder import load
from fmu_mesh.api.result import Result
from fmu_mesh.cli.main import main
from fmu_mesh.errors import CallRefused, ConfigurationError
from fmu_mesh.pictures.drawing import PALETTE
from fmu_mesh.pictures.result_drawing import Curve, Curves, PictureOptions, figure_of, in_unit
from fmu_mesh.results.recording import Columns

ROOT = Path(__file__).parents[2]
TIMES = np.linspace(0.0, 1.0, 11)


def result(title: str, columns: Mapping[str, Any], times: Any = TIMES) -> Result:  # noqa: ANN401  an array or a list
    arrays = {name: np.array(values) for name, values in columns.items()}
    return Result(title, columns=Columns(np.array(times), arrays))


def legend_of(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize(
    ("unit", "label"),
    [
        ("rad", "a in rad"),
        ("degC", "a in °C"),
        ("m/s2", "a in m/s²"),
        ("kg.m2.s-3", "a in kg·m²·s⁻³"),
        ("N.m.s/rad", "a in N·m·s/rad"),
        ("Ohm", "a in Ω"),
        ("1", "a"),
        ("-", "a"),
        ("", "a"),
        ("%", "a in %"),
        ("1/s", "a in 1/s"),
    ],
)
def test_an_axis_has_a_name_and_a_unit(unit: str, label: str) -> None:
    assert in_unit("a", unit) == label


@pytest.mark.parametrize(
    ("names", "label"),
    [
        (["p.a"], "a in rad"),
        (["p.a", "q.a", "r.a"], "a in rad"),
        (["p.a", "q.b"], "a, b in rad"),
        (["p.a", "p.b", "p.c"], "value in rad"),
        (["w.left.position", "w.right.position", "v.up.position"], "position in rad"),
        (["p.der(a.b)", "p.der(c.b)", "p.d"], "value in rad"),
        (["p." + "x" * 30], "value in rad"),
    ],
)
def test_variables_with_one_unit_share_axes_that_are_named_after_them(names: list[str], label: str) -> None:
    values = dict.fromkeys(names, TIMES)
    picture = PictureOptions("made", {name: Curve("rad") for name in names})

    (axes,) = figure_of([Curves("made", TIMES, values)], picture).axes

    assert axes.get_ylabel() == label


def test_what_holds_is_drawn_in_steps() -> None:
    values = result("made", {"a.x": TIMES, "a.n": np.arange(11), "a.on": TIMES > 0.5})

    lines = [line for axes in values.plot().axes for line in axes.lines]

    assert [line.get_drawstyle() for line in lines] == ["default", "steps-post", "steps-post"]


def test_several_results_have_one_colour_per_variable_and_lines_per_result() -> None:
    one = result("one", {"a.x": TIMES, "a.y": TIMES * 2})
    two = result("two", {"a.x": TIMES + 1, "a.y": TIMES, "a.z": TIMES})

    (axes,) = one.plot(others=[two]).axes

    lines = {(line.get_color(), str(line.get_linestyle())) for line in axes.lines}
    assert lines == {(PALETTE[0], "-"), (PALETTE[1], "-"), (PALETTE[0], "--"), (PALETTE[1], "--"), (PALETTE[2], "--")}
    assert legend_of(axes) == ["a.x", "a.y", "a.z", "one", "two"]
    assert axes.get_title() == "one and two"


def test_results_of_the_same_mesh_are_numbered_and_files_have_their_names(tmp_path: Path) -> None:
    files = []
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        files.append(tmp_path / folder / "run.csv")
        files[-1].write_text("time,a.y\n0.0,1.0\n1.0,2.0\n")
    (tmp_path / "other.csv").write_text("time,a.y\n0.0,1.0\n1.0,2.0\n")
    one, two = (result("mesh", {"a.y": TIMES}) for _ in range(2))

    assert legend_of(one.plot(others=[two]).axes[0])[1:] == ["mesh (1)", "mesh (2)"]
    read = [Result.read(file) for file in files]
    assert [text[-14:] for text in legend_of(read[0].plot(others=[read[1]]).axes[0])[1:]] == [
        "/first/run.csv", "second/run.csv",
    ]  # fmt: skip
    others = [Result.read(tmp_path / "other.csv")]
    assert legend_of(read[0].plot(others=others).axes[0])[1:] == ["run.csv", "other.csv"]


def test_a_difference_is_in_axes_of_its_own_below_the_curves() -> None:
    one, two = result("one", {"a.x": TIMES * 3, "a.on": TIMES > 2}), result("two", {"a.x": TIMES, "a.on": TIMES > 2})

    curves, difference, flags = one.plot(others=[two], difference=True).axes

    assert [axes.get_ylabel() for axes in (curves, difference)] == ["x", "difference"]
    assert flags.get_ylabel() == "true (1) or false (0)"
    assert np.asarray(difference.lines[0].get_ydata()).tolist() == (TIMES * 3 - TIMES).tolist()
    assert legend_of(difference) == ["a.x", "one - two"]


def test_the_difference_of_results_with_other_times_is_at_common_times() -> None:
    one, two = result("one", {"a.x": TIMES}), result("two", {"a.x": [0.0, 0.0, 0.0]}, [0.0, 0.5, 1.0])

    difference = one.plot(others=[two], difference=True).axes[1]

    assert np.asarray(difference.lines[0].get_xdata()).tolist() == [0.0, 0.5, 1.0]


def test_a_phase_plot_has_a_variable_on_its_horizontal_axis() -> None:
    run = load(ROOT / "configs" / "pendulum_delay.yaml").run(record="memory", stop_time=1.0, processes=False)

    (axes,) = run.plot("delay.y", x="pendulum.a").axes

    assert (axes.get_xlabel(), axes.get_ylabel()) == ("pendulum.a in rad", "y in rad")
    assert np.asarray(axes.lines[0].get_xdata()).tolist() == run["pendulum.a"].tolist()
    assert np.asarray(axes.lines[0].get_ydata()).tolist() == run["delay.y"].tolist()


def test_annotations_stand_at_the_curve() -> None:
    run = result("one", {"a.x": TIMES * 3, "b.on": TIMES > 0.5})

    axes, flags = run.plot(annotate={(0.5, "a.x"): "half", (1.0, "b.on"): "on $1"}).axes

    (note,) = [child for child in axes.get_children() if isinstance(child, Annotation)]
    assert (note.get_text(), note.xy) == ("half", (0.5, 1.5))
    (on,) = [child for child in flags.get_children() if isinstance(child, Annotation)]
    assert (on.get_text(), on.xy) == ("on $1", (1.0, 1.0))
    run.plot("a.*", x="b.on", annotate={(0.5, "a.x"): "half"}).canvas.draw()


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"x": "a.s"}, CallRefused, "'a.s' has texts, which are no horizontal axis"),
        ({"x": "a.z"}, ConfigurationError, "has no variable 'a.z'"),
        ({"annotate": {(0.0, "a.z"): "no"}}, ConfigurationError, "has no variable 'a.z'"),
        ({"difference": True}, CallRefused, "a difference needs another result"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options: Mapping[str, Any], error: type[Exception], says: str) -> None:
    texts = np.array(["p"] * 11, object)
    run = Result("one", columns=Columns(TIMES, {"a.x": TIMES, "a.s": texts}))
    with pytest.raises(error, match=says):
        run.plot(**options)


def test_neighbouring_colours_differ_in_grey() -> None:
    def lightness(colour: str) -> float:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
        return 116.0 * float(np.cbrt(np.dot([0.2126, 0.7152, 0.0722], linear))) - 16.0

    shades = [lightness(colour) for colour in PALETTE]

    assert min(np.abs(np.diff(shades))) > 10.0
    assert max(shades) < 75.0  # visible on white


# --- the command


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two results; it is the current folder."""
    for name, factor in (("a", 1.0), ("b", 2.0)):
        rows = [f"{t!r},{factor * t!r},{factor!r}" for t in TIMES.tolist()]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time,p.a,p.b", *rows, ""]))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_draws_several_files_and_their_difference(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--difference", "--title", "both", "--variables", "p.?"]

    assert main(["plot", "a.csv", "b.csv", *arguments, "--output", "both.svg"]) == 0

    drawn = (files / "both.svg").read_text()
    for words in ("both", "p.a", "p.b", "a.csv", "b.csv", "a.csv - b.csv", "difference"):
        assert f"<!-- {words} -->" in drawn
    assert capsys.readouterr().out == "plot: both.svg\n"


def test_the_command_draws_a_variable_over_another_one(files: Path) -> None:
    assert main(["plot", "a.csv", "--x", "p.b", "--variables", "p.a", "--output", "phase.svg"]) == 0
    assert "<!-- p.b -->" in (files / "phase.svg").read_text()


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a.csv", "--difference"], "Name two result files."),
        (["a.csv", "b.csv", "--difference", "--x", "p.a"], "Leave --x out."),
        (["a.csv", "c.csv"], "'c.csv' cannot be read"),
        (["a.csv", "--variables", "q.*"], "has no variable 'q.*'"),
    ],
)
def test_the_command_says_what_it_cannot_draw(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plot", *arguments]) == 2
    assert says in capsys.readouterr().err
