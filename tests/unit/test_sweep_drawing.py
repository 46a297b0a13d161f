"""Pictures of sweeps: which colours, scales and notes they have, and what is refused."""

from __future__ import annotations

import importlib.util
import tracemalloc
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image
from matplotlib.collections import LineCollection, PathCollection, QuadMesh
from matplotlib.colors import LogNorm, Normalize, to_hex
from matplotlib.figure import Figure

from fmu_mesh.errors import CallRefused, ConfigurationError
from fmu_mesh.pictures.drawing import draw
from fmu_mesh.pictures.sweep_drawing import VariantCurve, _paths, curves_figure, heat_map_figure

TIMES = np.linspace(0.0, 10.0, 501)


def curves(colours: Sequence[Any], *, rows: int = 501) -> list[VariantCurve]:
    """One curve for each value of the parameter, which lies the higher the later it comes."""
    return [VariantCurve(TIMES[:rows], np.sin(TIMES[:rows]) + number, colour) for number, colour in enumerate(colours)]


def drawn(made: Iterable[VariantCurve]) -> Figure:
    return curves_figure("pair", "pendulum.a in rad", "pendulum.d in 1/s", made)


def lines_of(figure: Figure) -> list[LineCollection]:
    return [item for item in figure.axes[0].collections if isinstance(item, LineCollection)]


def legend_of(figure: Figure) -> list[str] | None:
    legend = figure.axes[0].get_legend()
    return None if legend is None else [text.get_text() for text in legend.get_texts()]


def note_of(figure: Figure) -> str:
    return figure.axes[0].get_title(loc="right")


def colours_of(figure: Figure) -> list[str]:
    return [to_hex(colour) for item in lines_of(figure) for colour in np.atleast_2d(item.get_colors())]


def pixels(figure: Figure, path: Path) -> np.ndarray[Any, Any]:
    draw(figure, path)
    return np.asarray(image.imread(path))


# --- curves


def test_many_numbers_have_a_colour_bar_with_the_ends_of_the_parameter() -> None:
    figure = drawn(curves(np.linspace(0.05, 0.8, 16).tolist()))

    bar = figure.axes[1]
    assert legend_of(figure) is None
    assert bar.get_ylim() == (0.05, 0.8)
    assert bar.get_ylabel() == "pendulum.d in 1/s"
    assert len(set(colours_of(figure))) == 16
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("time in s", "pendulum.a in rad")


def test_numbers_spread_by_ratio_over_a_decade_have_a_logarithmic_colour_bar() -> None:
    assert drawn(curves(np.geomspace(0.01, 1.0, 20).tolist())).axes[1].get_yscale() == "log"
    assert drawn(curves(np.geomspace(0.05, 0.8, 20).tolist())).axes[1].get_yscale() == "log"
    assert drawn(curves(np.geomspace(0.1, 0.8, 20).tolist())).axes[1].get_yscale() == "linear"
    assert drawn(curves(np.linspace(0.001, 1.0, 20).tolist())).axes[1].get_yscale() == "linear"
    assert drawn(curves(np.linspace(-1.0, 1.0, 20).tolist())).axes[1].get_yscale() == "linear"


def test_a_darker_colour_is_a_smaller_number_whatever_the_order_of_variants() -> None:
    figure = drawn(curves([0.9, 0.1, 0.5, *np.linspace(0.11, 0.8, 9)]))

    brightness = [sum(int(colour[i : i + 2], 16) for i in (1, 3, 5)) for colour in colours_of(figure)]
    assert brightness[1] == min(brightness)
    assert brightness[0] == max(brightness)


def test_few_numbers_have_a_legend_in_their_order() -> None:
    figure = drawn(curves([0.5, 0.1, 0.5, 2]))

    assert legend_of(figure) == ["0.1", "0.5", "2"]
    assert len(figure.axes) == 1
    assert len(set(colours_of(figure))) == 3


def test_truth_values_and_texts_have_a_legend() -> None:
    assert legend_of(drawn(curves([True, False, True]))) == ["false", "true"]
    assert legend_of(drawn(curves(["jacobi", "gauss_seidel"]))) == ["jacobi", "gauss_seidel"]
    assert legend_of(drawn(curves([1, True, "1"]))) == ["1", "true"]


def test_texts_differ_in_their_dashes_as_well() -> None:
    styles = [item.get_linestyle() for item in lines_of(drawn(curves(["p", "q", "r"])))]
    assert len({repr(style) for style in styles}) == 3


def test_a_dollar_sign_and_an_underscore_are_only_characters() -> None:
    figure = curves_figure("$x^2$", "a.$y$", "_d$", curves(["_q$", "$r$"]))
    assert legend_of(figure) == ["\N{WORD JOINER}_q$", "$r$"]
    figure.canvas.draw()


def test_variants_without_rows_are_left_out_and_counted() -> None:
    figure = drawn([*curves([0.1, 0.2, 0.3]), *curves([0.4, 0.5], rows=0)])

    assert legend_of(figure) == ["0.1", "0.2", "0.3"]
    assert note_of(figure) == "without rows, not shown: 2 of 5"
    assert note_of(drawn(curves([0.1, 0.2]))) == ""


@pytest.mark.parametrize("made", [[], curves([0.1] * 3, rows=0)])
def test_a_sweep_without_rows_says_so_in_its_picture(made: list[VariantCurve]) -> None:
    figure = drawn(made)
    assert [text.get_text() for text in figure.axes[0].texts] == ["no points were recorded"]


def test_a_curve_of_one_point_is_visible(tmp_path: Path) -> None:
    one = pixels(drawn(curves([0.1], rows=1)), tmp_path / "one.png")
    none = pixels(drawn(curves([0.1], rows=0)), tmp_path / "none.png")

    purple = to_hex((0.267004, 0.004874, 0.329415))  # the darkest colour of viridis
    count = (np.rint(one[..., :3] * 255) == [int(purple[i : i + 2], 16) for i in (1, 3, 5)]).all(axis=-1).sum()
    assert count > 20
    assert one.shape[2] == none.shape[2]


def test_values_that_are_no_floats_hold_until_the_next_one() -> None:
    def corners(values: list[Any]) -> object:
        (path,) = lines_of(drawn([VariantCurve(np.array([0.0, 1.0, 2.0]), np.array(values), 0.1)]))[0].get_paths()
        return np.asarray(path.vertices).tolist()

    assert corners([1, 3, 2]) == [[0, 1], [1, 1], [1, 3], [2, 3], [2, 2]]
    assert corners([True, False, True]) == [[0, 1], [1, 1], [1, 0], [2, 0], [2, 1]]
    assert corners([1.0, 3.0, 2.0]) == [[0, 1], [1, 3], [2, 2]]


def test_thousands_of_curves_have_few_points_each_their_extremes_and_are_transparent() -> None:
    times = np.linspace(0.0, 40.0, 20_001)
    peaks = np.random.default_rng(1).integers(0, 20_001, 3000).tolist()

    def curve(peak: int) -> VariantCurve:
        values = np.sin(times)
        values[peak] = 5.0
        return VariantCurve(times, values, float(peak))

    (lines,) = lines_of(drawn(map(curve, peaks)))

    paths = [np.asarray(path.vertices) for path in lines.get_paths()]
    assert [times[peak] for peak in peaks] == [path[path[:, 1].argmax(), 0] for path in paths]
    assert sum(map(len, paths)) < 1_050_000
    assert all(path[0, 0] == 0.0 and path[-1, 0] == 40.0 for path in paths)
    alpha = lines.get_alpha()
    assert isinstance(alpha, float)
    assert alpha < 0.5


def test_the_curves_of_ten_thousand_variants_do_not_fill_the_memory() -> None:
    """All of their rows together would have 640 MB."""

    def made() -> Iterator[VariantCurve]:
        for number in range(10_000):
            times = np.linspace(0.0, 1.0, 4_000)
            yield VariantCurve(times, times * number, float(number))

    tracemalloc.start()
    try:
        paths, colours, _ = _paths("a.y", made())
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert (len(paths), colours[-1]) == (10_000, 9999.0)
    assert most < 64e6


def test_gaps_and_infinite_values_do_not_change_the_axes() -> None:
    values = np.sin(TIMES)
    values[100:200], values[300] = np.nan, np.inf

    figure = drawn([VariantCurve(TIMES, values, 0.1)])

    low, high = figure.axes[0].get_ylim()
    assert -1.2 < low < -1.0
    assert 1.0 < high < 1.2


def test_texts_have_no_curve() -> None:
    with pytest.raises(CallRefused, match=r"'pendulum.a in rad' has texts, which have no curve"):
        drawn([VariantCurve(TIMES[:2], np.array(["p", "q"], object), 0.1)])


# --- heat maps

D = [0.1, 0.2, 0.4, 0.8, 1.6]
L = [0.5, 1.0, 1.5]


def grid_of(xs: Sequence[Any], ys: Sequence[Any], z: Sequence[float | None]) -> Figure:
    return heat_map_figure(
        "pair", ("d", [x for x in xs for _ in ys]), ("l", [y for _ in xs for y in ys]), ("max(a)", z)
    )


def cells_of(figure: Figure) -> QuadMesh:
    (mesh,) = (item for item in figure.axes[0].collections if isinstance(item, QuadMesh))
    return mesh


def shades_of(figure: Figure) -> list[float | None]:
    """The values that the colours of the cells stand for, row by row from below; None for a cell without one."""
    values: list[float | None] = np.ma.asarray(cells_of(figure).get_array()).ravel().tolist()
    return values


def test_each_cell_of_grid_is_around_its_values_and_has_its_colour() -> None:
    figure = grid_of(D, L, [float(number) for number in range(15)])

    corners = np.asarray(cells_of(figure).get_coordinates())
    assert shades_of(figure)[0::5] == [0.0, 1.0, 2.0]
    assert shades_of(figure)[10:] == [2.0, 5.0, 8.0, 11.0, 14.0]
    assert corners[:, 0, 1].tolist() == [0.25, 0.75, 1.25, 1.75]
    # The edges come from logarithms, which are rounded.
    assert corners[0, :, 0].tolist() == pytest.approx([0.1 * 2.0**power for power in np.arange(-0.5, 5.0)])
    assert figure.axes[1].get_ylabel() == "max(a)"


def test_an_axis_is_logarithmic_where_its_values_are_spread_by_ratio() -> None:
    axes = grid_of(D, L, [0.0] * 15).axes[0]

    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "linear")
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.1", "0.2", "0.4", "0.8", "1.6"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["0.5", "1", "1.5"]


def test_the_order_of_the_variants_does_not_matter() -> None:
    d, length, z = [x for x in D for _ in L], L * 5, [float(number) for number in range(15)]
    order = np.random.default_rng(0).permutation(15)

    shuffled = heat_map_figure(
        "pair", ("d", [d[k] for k in order]), ("l", [length[k] for k in order]), ("max(a)", [z[k] for k in order])
    )

    assert shades_of(shuffled) == shades_of(grid_of(D, L, z))


def test_cells_that_failed_or_are_missing_are_hatched_and_counted(tmp_path: Path) -> None:
    z: list[float | None] = [float(number) for number in range(15)]
    z[0], z[4] = None, float("nan")
    missing = heat_map_figure("pair", ("d", [1, 1, 2]), ("l", [1, 2, 2]), ("max(a)", [0.0, 1.0, 2.0]))

    figure = grid_of(D, L, z)

    assert note_of(figure) == "hatched, without a value: 2 of 15"
    assert note_of(missing) == "hatched, without a value: 1 of 4"
    assert note_of(grid_of(D, L, [1.0] * 15)) == ""
    assert figure.axes[0].patch.get_hatch()
    assert pixels(figure, tmp_path / "failed.png").shape[0] > 100
    assert shades_of(figure).count(None) == 2


def test_truth_values_and_texts_lie_side_by_side() -> None:
    axes = grid_of([True, False], ["jacobi", "gauss_seidel", "_$x$"], [1.0] * 6).axes[0]

    assert [text.get_text() for text in axes.get_xticklabels()] == ["false", "true"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["jacobi", "gauss_seidel", "_$x$"]


@pytest.mark.parametrize(
    ("xs", "ys", "z"),
    [([0.1], [2.0], [1.0]), ([0.1], [1, 2, 3], [1.0, 2.0, 3.0]), ([0.0], [-1], [None]), ([1, 2], [1, 2], [None] * 4)],
)
def test_one_value_one_row_and_nothing_but_failures_have_a_picture(
    tmp_path: Path, xs: list[float], ys: list[float], z: list[float | None]
) -> None:
    assert pixels(grid_of(xs, ys, z), tmp_path / "map.png").shape[0] > 100


def test_what_a_sampler_has_chosen_is_drawn_as_points() -> None:
    generator = np.random.default_rng(1)
    d, length = np.exp(generator.uniform(np.log(0.01), 0.0, 64)).tolist(), generator.uniform(0.5, 2.0, 64).tolist()
    z: list[float | None] = [None, *generator.uniform(0.0, 1.0, 63).tolist()]

    figure = heat_map_figure("pair", ("d", d), ("l", length), ("max(a)", z))

    points, crosses = (item for item in figure.axes[0].collections if isinstance(item, PathCollection))
    assert np.asarray(points.get_offsets()).tolist() == [[x, y] for x, y in zip(d[1:], length[1:], strict=True)]
    assert np.asarray(points.get_array()).tolist() == z[1:]
    assert np.asarray(crosses.get_offsets()).tolist() == [[d[0], length[0]]]
    assert note_of(figure) == "crosses, without a value: 1 of 64"
    assert (figure.axes[0].get_xscale(), figure.axes[0].get_yscale()) == ("log", "linear")


@pytest.mark.parametrize(
    ("z", "kind"),
    [
        (np.geomspace(1e-3, 10.0, 15), LogNorm),
        (np.geomspace(0.5, 10.0, 15), Normalize),
        (np.linspace(1e-3, 10.0, 15), Normalize),
    ],
)
def test_the_colours_of_a_value_over_decades_are_logarithmic(z: np.ndarray[Any, Any], kind: type) -> None:
    assert type(cells_of(grid_of(D, L, z.tolist())).norm) is kind


def test_a_cell_of_several_variants_is_refused() -> None:
    with pytest.raises(
        CallRefused, match=r"several variants have the same 'd' and 'l'. Choose variants that differ only"
    ):
        heat_map_figure("pair", ("d", [1, 1, 2, 2, 1]), ("l", [1, 2, 1, 2, 2]), ("max(a)", [0.0] * 5))


def test_a_heat_map_of_texts_is_refused() -> None:
    texts: Any = ["p"]
    with pytest.raises(CallRefused, match=r"'last\(log.text\)' is 'p' in a variant, and a heat map needs numbers"):
        heat_map_figure("pair", ("d", [1]), ("l", [1]), ("last(log.text)", texts))


HARD: list[list[Any]] = [
    [1e308, -1e308, 0.0, *range(12)],
    [5e-324 * k for k in range(12)],
    [float("nan"), float("inf"), 1, 2],
    np.geomspace(1e-300, 1e300, 12).tolist(),
    [1e15 + k for k in range(12)],
    ["_a", "$x^$", "日本", "", "a\nb"],
    [[1.0, 2.0], [3.0, 4.0]],
]


@pytest.mark.parametrize("values", HARD, ids=lambda values: repr(values[0]))
def test_no_value_of_a_parameter_breaks_a_picture(tmp_path: Path, values: list[Any]) -> None:
    """Warnings are errors in tests, so this shows as well that the user gets none."""
    numbers: list[float | None] = [1e308, None, float("inf"), *map(float, range(len(values)))][: len(values)]

    for x in (values, ["one"] * len(values)):
        figure = heat_map_figure("pair", ("d", x), ("l", list(range(len(values)))), ("z", numbers))
        assert pixels(figure, tmp_path / "map.png").shape[0] > 100
    made = [VariantCurve(TIMES, np.sin(TIMES) * 1e307, value) for value in values]
    assert pixels(drawn(made), tmp_path / "curves.png").shape[0] > 100


def test_without_matplotlib_a_picture_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name))

    with pytest.raises(ConfigurationError, match=r"library matplotlib.*-m pip install 'matplotlib"):
        drawn(curves([0.1]))
    with pytest.raises(ConfigurationError, match=r"library matplotlib.*-m pip install 'matplotlib"):
        grid_of([1], [1], [1.0])
