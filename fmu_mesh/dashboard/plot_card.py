"""One plot of a page: a choice of variables above their curves, which `static/plots.js` draws."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any, Final

from nicegui import ui

from .mesh_follower import Catalogue

__all__ = ["PlotCard", "first_plots"]

_PLOTS: Final = 4
_CURVES: Final = 5
_HELD: Final = ("parameter", "calculatedParameter")
"""Their values hold until they get others, whatever their variability is."""


class PlotCard:
    """One plot: a choice of variables above their curves.

    Attributes:
        names: the variables that it shows.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        names: list[str],
        changed: Callable[[], None],
        removed: Callable[[PlotCard], None],
    ) -> None:
        self.names = names
        self._catalogue = catalogue
        self._changed = changed
        self._removed = removed

    def build(self) -> None:
        """Make its elements."""
        elements = self._catalogue.elements
        with ui.card().classes("fm-card fm-plot-card").props("flat bordered") as self._card:
            with ui.row().classes("items-center no-wrap").style("width: 100%"):
                choice = ui.select([*elements], value=self.names, multiple=True, label="variables", with_input=True)
                choice.props("dense outlined use-chips").classes("col").on_value_change(self._choose)
                ui.button(icon="close", on_click=self._remove).props(
                    "dense flat round aria-label='Remove this plot'"
                ).tooltip("Remove this plot")
            self._chart = ui.echart(_options(self._catalogue, self.names)).classes("fm-plot").props("role=img")
        self._tell()

    def _choose(self, event: Any) -> None:  # noqa: ANN401  an event of NiceGUI
        self.names = list(event.value or [])
        self._chart.options.clear()
        self._chart.options.update(_options(self._catalogue, self.names))
        self._chart.update()
        self._tell()
        self._changed()

    def _tell(self) -> None:
        self._chart.props["aria-label"] = f"curves over time of {', '.join(self.names) or 'no variable'}"
        ui.run_javascript(f"fmuMeshPlots.plot({self._chart.id}, {json.dumps(self.names)})")

    def _remove(self) -> None:
        ui.run_javascript(f"fmuMeshPlots.drop({self._chart.id})")
        self._card.delete()
        self._removed(self)


def _options(catalogue: Catalogue, names: Sequence[str]) -> dict[str, Any]:
    """The options of ECharts for these curves, which have no values yet."""
    variables = [catalogue.variables[catalogue.elements[name][0]] for name in names]
    units = {v.unit for v in variables}
    unit = next(iter(units)) if len(units) == 1 else None
    return {
        "animation": False,
        "grid": {"left": 70, "right": 20, "top": 34, "bottom": 44},
        "legend": {"type": "scroll", "top": 0},
        "tooltip": {"trigger": "axis", "transitionDuration": 0},
        "toolbox": {
            "feature": {"dataZoom": {"yAxisIndex": "none"}, "restore": {}},
            "right": 0,
            "top": 0,
            "itemSize": 11,
        },
        "xAxis": {
            "type": "value",
            "name": "time in s",
            "nameLocation": "middle",
            "nameGap": 24,
            "axisLabel": {"showMaxLabel": False, "showMinLabel": False},
        },
        "yAxis": {"type": "value", "scale": True, "name": f"in {unit}" if unit else "", "nameLocation": "end"},
        "series": [
            {
                "type": "line",
                "name": f"{name} in {v.unit}" if v.unit and unit is None else name,
                "showSymbol": False,
                "step": "end" if v.variability != "continuous" or v.causality in _HELD else False,
                "lineStyle": {"width": 1, "join": "bevel"},
                "data": [],
            }
            for name, v in zip(names, variables, strict=True)
        ],
    }


def first_plots(catalogue: Catalogue) -> list[list[str]]:
    """The first outputs, those with the same unit in one plot."""
    groups: dict[str | None, list[str]] = {}
    for name, (variable, _) in catalogue.elements.items():
        own = catalogue.variables[variable]
        if own.causality == "output" and (len(groups) < _PLOTS or own.unit in groups):
            group = groups.setdefault(own.unit, [])
            if len(group) < _CURVES:
                group.append(name)
    return [*groups.values()]
