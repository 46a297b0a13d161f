"""What a page shows of one run of a mesh, and what happens when somebody uses it.

The page asks the follower four times a second, on the event loop; what waits for a mesh is done on another thread.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from nicegui import run, ui

from ..api.run_handle import Run
from ..errors import FmuMeshError
from ..pictures.tables import DEFECT_COLUMNS, defect_rows
from ..printing import paragraph
from ..wire.views import InstanceStatus
from .mesh_follower import Catalogue, MeshFollower, MeshView
from .setting_fields import SettingField

__all__ = ["MeshPage"]

_TABLE_S: Final = 1.0
_PICTURE_S: Final = 1.0
_INSTANCE_S: Final = 0.05
"""A picture of 64 instances takes a browser a tenth of a second or more, so it gets one every 3 s."""
_VALUES_S: Final = 2.0
_FIELDS: Final = 8
_SPANS: Final = {0: "from the start", 1: "last 1 s", 10: "last 10 s", 60: "last 60 s", 600: "last 600 s"}
_STATES: Final = {"running": "positive", "paused": "warning", "failed": "negative"}
_COLUMNS: Final = {
    "instance": "instance",
    "host": "host",
    "state": "state",
    "point": "point",
    "rate": "points/s",
    "step": "step time",
    "share": "computes, waits",
    "restarts": "restarts",
    "activity": "activity",
}
_BAR: Final = """
<q-td :props="props"><div class="fm-bar" role="img" :title="props.row.shares" :aria-label="props.row.shares">
<div :style="{width: props.row.share[0] + '%'}"></div><div :style="{width: props.row.share[1] + '%'}"></div>
</div></q-td>
"""
_DEFECTS: Final = "Largest defects: a pointer to the connection, no error estimate"
_PLOTS: Final = 4
_CURVES: Final = 5
_HELD: Final = ("parameter", "calculatedParameter")
"""Their values hold until they get others, whatever their variability is."""


class MeshPage:
    """One run of a mesh on one page."""

    def __init__(self, follower: MeshFollower, view: MeshView, plots: list[list[str]], *, read_only: bool) -> None:
        self.key = view.key
        self.run = view.run
        self._follower = follower
        self._view = view
        self._read_only = read_only
        known = [[name for name in names if name in view.catalogue.elements] for names in plots]
        self._chosen = [names for names in known if names] or _first_plots(view.catalogue)
        self._plots: list[_PlotCard] = []
        self._fields: dict[str, SettingField] = {}
        self._last_line = 0
        self._parts: list[Any] = []

    @property
    def plots(self) -> list[list[str]]:
        """The curves of each plot."""
        return [plot.names for plot in self._plots]

    def remove(self) -> None:
        """Take it from the page."""
        for part in self._parts:
            part.delete()

    # --- its elements

    def build(self, head: Any, body: Any) -> None:  # noqa: ANN401  elements of NiceGUI
        """Make the elements, in the head and in the body of the page."""
        ui.run_javascript(f"fmuMeshPlots.show({json.dumps(self.key)}, {self.run})")
        with head, ui.row().classes("fm-line fm-head col") as row:
            self._parts.append(row)
            self._state = ui.badge("").classes("text-body2 fm-state").props("role=status")
            self._numbers = ui.label().classes("fm-numbers fm-progress")
            if self._read_only:
                ui.badge("read only", color="grey-8").classes("text-body2")
            else:
                with ui.row().classes("fm-line fm-buttons") as self._buttons:
                    self._add_buttons()
        with body:
            self._trouble = ui.label().classes("fm-trouble").props("role=alert")
            self._parts.append(self._trouble)
        with body, ui.element("div").classes("fm-columns") as columns:
            self._parts.append(columns)
            with ui.element("div").classes("fm-column"):
                self._add_plots()
                with _card("Instances"):
                    self._table = _InstanceTable(has_hosts=any(own.deploy_host for own in self._view.infos.values()))
            with ui.element("div").classes("fm-column"):
                if not self._read_only:
                    self._add_settings()
                self._add_picture()
                with _card("Log"):
                    self._log = ui.log(max_lines=500).classes("fm-log")
                    self._log.props("role=log aria-label=Log tabindex=0")
        self._parts.append(ui.timer(_TABLE_S, lambda: self._table.show(self._view)))
        self._parts.append(ui.timer(max(_PICTURE_S, _INSTANCE_S * len(self._view.infos)), self._draw_picture))
        if not self._read_only:
            self._parts.append(ui.timer(_VALUES_S, self._read_values))

    def _add_buttons(self) -> None:
        self._pausing = _button("Pause", "pause", partial(self._act, Run.pause))
        self._resuming = _button("Resume", "play_arrow", partial(self._act, Run.resume))
        self._points = ui.number(value=1, min=1, precision=0, label="points").props("dense dark outlined")
        self._points.classes("fm-points")
        _button("Step", "skip_next", self._step)
        with ui.dialog().props("aria-label='Stop the run?'") as dialog, ui.card():
            ui.label(f"Stop the run of '{self.key}'? Its result file keeps what was recorded.")
            with ui.row():
                ui.button("Stop the run", color="negative", on_click=lambda: dialog.submit(True))  # noqa: FBT003  its value
                ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")  # noqa: FBT003  its value
        self._dialog = dialog
        _button("Stop", "stop", self._stop, "negative")

    def _add_plots(self) -> None:
        with ui.row().classes("fm-line"):
            span = ui.select(_SPANS, value=0, label="time", on_change=_show_span)
            span.props("dense outlined")
            ui.button("Add a plot", icon="add", on_click=lambda: self._add_plot([])).props("dense flat")
        self._charts = ui.element("div").classes("fm-column")
        for names in self._chosen:
            self._add_plot(names)
        self._remember()

    def _add_plot(self, names: list[str]) -> None:
        def removed(plot: _PlotCard) -> None:
            self._plots.remove(plot)
            self._remember()

        with self._charts:
            self._plots.append(_PlotCard(self._view.catalogue, names, self._remember, removed))

    def _remember(self) -> None:
        """Put the curves into the address of the page, so that it shows them again when it is loaded."""
        curves = [f"{number}:{name}" for number, plot in enumerate(self._plots) for name in plot.names]
        query = json.dumps([["mesh", self.key], *(["curve", curve] for curve in curves)])
        ui.run_javascript(f"history.replaceState(null, '', '/?' + new URLSearchParams({query}))")

    def _add_picture(self) -> None:
        with _card("Connections"):
            switch = ui.switch("full size", on_change=lambda: self._picture.classes(toggle="fm-full"))
            switch.props("dense").classes("fm-corner")
            self._picture: ui.html = ui.html("", sanitize=False)  # our own SVG, in which names are escaped
            self._picture.classes("fm-graph").props(
                "role=img aria-label='the instances and their connections' tabindex=0"
            )
            columns = [{"name": name, "label": name, "field": name, "align": "left"} for name in DEFECT_COLUMNS]
            self._defects = ui.table(rows=[], columns=columns, row_key=DEFECT_COLUMNS[0], title=_DEFECTS)
            self._defects.classes("fm-defects fm-numbers").props("dense flat hide-pagination wrap-cells")

    def _add_settings(self) -> None:
        settable = self._view.catalogue.settable
        with _card("Values to set"):
            if not settable:
                ui.label("This mesh has no unconnected input and no tunable parameter.")
                return
            first = [name for name, v in settable.items() if not v.shape][:_FIELDS] or [*settable][:_FIELDS]
            if len(settable) > len(first):
                choice = ui.select([*settable], value=first, multiple=True, label="variables", with_input=True)
                choice.props("dense outlined use-chips").style("width: 100%")
                choice.on_value_change(lambda event: self._show_fields(event.value or []))
            self._settings = ui.element("div").classes("fm-column").style("gap: 4px")
            self._show_fields(first)

    # --- what it shows

    def look(self, view: MeshView) -> None:
        """Show what is known now."""
        self._view = view
        status = view.status
        assert status is not None  # otherwise there is no page yet
        state = "ended" if view.ended and status.state not in ("done", "failed") else status.state
        state = "failed" if view.failure is not None else state
        self._state.set_text(state)
        self._state.props(f"color={_STATES.get(state, 'grey-8')}")
        last = f"/{status.last_point}" if view.info is not None and view.info.stop_time is not None else ""
        parts = [
            f"t = {status.time:.6g} s",
            f"point {status.point}{last}",
            f"{status.points_per_second:.0f} points/s",
            f"real-time factor {status.real_time_factor:.3g}",
            *([f"{status.overruns} overruns"] if status.overruns else []),
        ]
        self._numbers.set_text(" · ".join(parts))
        error = status.error.message if status.error is not None else None
        self._trouble.set_text(view.failure or error or view.trouble or "")
        if not self._read_only:
            self._pausing.set_visibility(state != "paused")
            self._resuming.set_visibility(state == "paused")
            self._buttons.set_visibility(not view.ended)
        rows = [dict(zip(DEFECT_COLUMNS, row, strict=True)) for row in defect_rows(view.defects)]
        self._defects.set_visibility(bool(rows))
        if rows != self._defects.rows:
            self._defects.update_rows(rows)
        self._show_log()

    def _show_log(self) -> None:
        for line in self._follower.log:
            if line.number > self._last_line:
                self._last_line = line.number
                message = paragraph(line.message)
                self._log.push(f"{line.instance} at point {line.point}: {line.status.lower()}: {message}")

    async def _draw_picture(self) -> None:
        picture = await run.io_bound(self._follower.picture)
        if picture is not None and picture != self._picture.content:
            self._picture.set_content(picture)

    # --- what it does

    def _show_fields(self, names: Sequence[str]) -> None:
        settable = self._view.catalogue.settable
        self._fields = {}
        self._settings.clear()
        with self._settings:
            for name in names:
                self._fields[name] = SettingField(name, settable[name], self._set)

    async def _read_values(self) -> None:
        fields = dict(self._fields)
        if self._view.ended or not fields:
            return
        values = await run.io_bound(_values, self._follower, [*fields])
        for name, value in (values or {}).items():
            fields[name].show(value)

    async def _set(self, name: str, value: object) -> None:
        answer = await self._act(lambda mesh: mesh.set(name, value))
        if answer is not None and (field := self._fields.get(name)) is not None:
            field.say(f"from t = {answer.time:.6g} s")

    async def _step(self) -> None:
        points = int(self._points.value or 1)
        await self._act(lambda mesh: mesh.step(points))

    async def _stop(self) -> None:
        if await self._dialog:
            await self._act(Run.stop)

    async def _act(self, action: Callable[[Run], Any]) -> Any:  # noqa: ANN401  the answers of a Run
        """Do something to the mesh; None if it refuses, after saying why."""
        try:
            return await run.io_bound(self._follower.ask, action)
        except FmuMeshError as error:
            ui.notify(str(error), type="negative", close_button=True, timeout=10000)
            return None


def _card(title: str) -> Any:  # noqa: ANN401  an element of NiceGUI
    """A part of the page with a title; a landmark for screen readers."""
    with ui.card().classes("fm-card").props(f"flat bordered role=region aria-label='{title}'") as card:
        ui.label(title).classes("fm-title").props("role=heading aria-level=2")
    return card


def _button(text: str, icon: str, act: Callable[[], Any], color: str = "secondary") -> ui.button:
    """A button of the head, which on a narrow page has only its icon."""
    return ui.button(text, icon=icon, color=color, on_click=act).props(f"dense unelevated aria-label={text}")


def _show_span(event: Any) -> None:  # noqa: ANN401  an event of NiceGUI
    ui.run_javascript(f"fmuMeshPlots.span({event.value})")  # nobody awaits what it returns


def _values(follower: MeshFollower, names: Sequence[str]) -> Mapping[str, Any]:
    """The current values, as far as they are answered."""
    values = {}
    for name in names:
        try:
            values[name] = follower.ask(partial(Run.get, name=name))
        except FmuMeshError:
            break  # it does not run any more
    return values


class _InstanceTable:
    """A line for each instance, in the order of the mesh."""

    def __init__(self, *, has_hosts: bool) -> None:
        columns = [
            {"name": name, "label": label, "field": name, "align": "left", "sortable": name != "share"}
            for name, label in _COLUMNS.items()
            if has_hosts or name != "host"
        ]
        self._table = ui.table(rows=[], columns=columns, row_key="instance").classes("fm-instances fm-numbers")
        self._table.props("dense flat hide-pagination virtual-scroll :rows-per-page-options=[0]")
        self._table.add_slot("body-cell-share", _BAR)

    def show(self, view: MeshView) -> None:
        """Show what is known now."""
        names = [name for name in view.infos if name in view.instances]
        rows = [_row(view.instances[name], view.before.get(name)) for name in names]
        if rows != self._table.rows:
            self._table.update_rows(rows)


def _row(own: InstanceStatus, before: InstanceStatus | None) -> dict[str, Any]:
    """The row of an instance in the table; rates and shares are those of the last second."""
    rate, *shares = own.rates_since(before)
    computes, waits = (100.0 * share for share in shares)
    return {
        "instance": own.instance,
        "host": own.deploy_host,
        "state": own.state,
        "point": own.point,
        "rate": round(rate),
        "step": f"{1e6 * own.step_time:.3g} us",
        "share": [round(computes, 1), round(waits, 1)],
        "shares": f"{computes:.0f} % in its steps, {waits:.0f} % waiting",
        "restarts": own.restarts,
        "activity": own.activity.replace(f" at point {own.point}", "", 1),
    }


class _PlotCard:
    """One plot: a choice of variables above their curves, which `static/plots.js` draws."""

    def __init__(
        self,
        catalogue: Catalogue,
        names: list[str],
        changed: Callable[[], None],
        removed: Callable[[_PlotCard], None],
    ) -> None:
        self.names = names
        self._catalogue = catalogue
        self._changed = changed
        self._removed = removed
        with ui.card().classes("fm-card fm-plot-card").props("flat bordered") as self._card:
            with ui.row().classes("items-center no-wrap").style("width: 100%"):
                choice = ui.select(
                    [*catalogue.elements], value=names, multiple=True, label="variables", with_input=True
                )
                choice.props("dense outlined use-chips").classes("col").on_value_change(self._choose)
                ui.button(icon="close", on_click=self._remove).props(
                    "dense flat round aria-label='Remove this plot'"
                ).tooltip("Remove this plot")
            self._chart = ui.echart(_options(catalogue, names)).classes("fm-plot").props("role=img")
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


def _first_plots(catalogue: Catalogue) -> list[list[str]]:
    """The first outputs, those with the same unit in one plot."""
    groups: dict[str | None, list[str]] = {}
    for name, (variable, _) in catalogue.elements.items():
        own = catalogue.variables[variable]
        if own.causality == "output" and (len(groups) < _PLOTS or own.unit in groups):
            group = groups.setdefault(own.unit, [])
            if len(group) < _CURVES:
                group.append(name)
    return [*groups.values()]
