"""The page: which elements it has, what they show, and what happens when somebody uses them.

Each open page has a `_MeshPage` for the mesh that it shows. It asks the follower four times a second, on the event
loop; what waits for a mesh is done on another thread. `static/plots.js` draws the curves.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from fastapi import Request
from nicegui import run, ui

from ..api.run_handle import Run
from ..errors import FmuMeshError
from ..wire.views import InstanceStatus, VariableView
from .mesh_directory import MeshDirectory
from .mesh_follower import MeshFollower, MeshView
from .setting_fields import SettingField

__all__ = ["LivePage"]

_LOOK_S: Final = 0.25
_PICTURE_S: Final = 1.0
_VALUES_S: Final = 2.0
_PLOTS: Final = 4
_CURVES: Final = 5
_FIELDS: Final = 8
_SPANS: Final = {0: "from the start", 1: "last 1 s", 10: "last 10 s", 60: "last 60 s", 600: "last 600 s"}
_COLORS: Final = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999"]
_STATES: Final = {"running": "positive", "paused": "warning", "failed": "negative"}
_COLUMNS: Final = {
    "instance": "instance",
    "state": "state",
    "point": "point",
    "rate": "points/s",
    "step": "step time",
    "share": "computes, waits",
    "restarts": "restarts",
    "activity": "activity",
}
_BAR: Final = """
<q-td :props="props"><div class="fm-bar" :title="props.row.shares">
<div :style="{width: props.row.share[0] + '%'}"></div><div :style="{width: props.row.share[1] + '%'}"></div>
</div></q-td>
"""


class LivePage:
    """The page at `/`, for any number of browsers.

    Args:
        directory: the meshes.
        read_only: whether nothing can be set or steered.
    """

    def __init__(self, directory: MeshDirectory, *, read_only: bool) -> None:
        self._directory = directory
        self._read_only = read_only

    def register(self) -> None:
        """Let NiceGUI serve it."""
        ui.page("/")(self._open)

    async def _open(self, request: Request) -> None:
        """A browser opens the page: `?mesh=KEY&curve=0:instance.variable` says what it shows."""
        ui.add_head_html('<link rel="stylesheet" href="/dashboard/static/dashboard.css">')
        ui.add_head_html('<script src="/dashboard/static/plots.js"></script>')
        wanted = request.query_params.get("mesh")
        chosen = [text.partition(":")[::2] for text in request.query_params.getlist("curve")]
        content = _Content(self._directory, wanted, _grouped(chosen), read_only=self._read_only)
        await ui.context.client.connected()
        content.look()
        ui.timer(_LOOK_S, content.look)


class _Content:
    """What is on one page: a choice of meshes above one of them.

    Args:
        directory: the meshes.
        wanted: key of the mesh to show first.
        plots: the curves of each plot; empty: the page chooses.
        read_only: whether nothing can be set or steered.
    """

    def __init__(
        self, directory: MeshDirectory, wanted: str | None, plots: list[list[str]], *, read_only: bool
    ) -> None:
        self._directory = directory
        self._plots = plots
        self._read_only = read_only
        self._page: _MeshPage | None = None
        with ui.header().classes("items-center q-py-sm"):
            ui.label("fmu_mesh").classes("text-h6")
            self._choice = ui.select({}, value=None, label="mesh", on_change=self._clear).props("dense dark outlined")
            self._choice.classes("fm-mesh").style("min-width: 180px")
            self._head = ui.row().classes("fm-line col")
        self._body = ui.column().classes("fm-content")
        with self._body:
            self._nothing = ui.label()
        self._wanted = wanted

    def look(self) -> None:
        """Show what is known now."""
        followers = self._directory.followers
        if [*followers] != [*self._choice.options]:
            names = _short_names([*followers])
            value = self._choice.value if self._choice.value in followers else None
            value = value or (self._wanted if self._wanted in followers else next(iter(followers), None))
            self._choice.set_options(names, value=value)
        follower = followers.get(self._choice.value) if self._choice.value is not None else None
        view = follower.view if follower is not None else None
        if follower is None or view is None or view.info is None or view.status is None:
            self._say(view)
            return
        if self._page is None or (self._page.key, self._page.run) != (view.key, view.run):
            self._clear()
            self._nothing.set_visibility(False)
            self._page = _MeshPage(follower, view, self._plots, read_only=self._read_only)
            self._page.build(self._head, self._body)
        self._page.look(view)

    def _say(self, view: MeshView | None) -> None:
        """No mesh can be shown: say why."""
        if view is None:
            text = "No mesh is running here. Start one with `fmu-mesh launch CONFIG`: it appears here."
        else:
            text = f"Mesh '{view.key}' is starting." if view.trouble is None else f"Not reached: {view.trouble}"
        self._nothing.set_text(text)
        self._nothing.set_visibility(True)

    def _clear(self) -> None:
        if self._page is not None:
            self._plots = self._page.plots if self._page.key == self._choice.value else []
            self._page.remove()
            self._page = None


class _MeshPage:
    """One run of a mesh on one page.

    Args:
        follower: of the mesh.
        view: what is known of it.
        plots: the curves of each plot; empty: the first outputs, by unit.
        read_only: whether nothing can be set or steered.
    """

    def __init__(self, follower: MeshFollower, view: MeshView, plots: list[list[str]], *, read_only: bool) -> None:
        self.key = view.key
        self.run = view.run
        self._follower = follower
        self._view = view
        self._read_only = read_only
        known = [[name for name in names if name in view.catalogue.elements] for names in plots]
        self._plots = [_Plot(self, names) for names in [names for names in known if names] or _first_plots(view)]
        self._fields: dict[str, SettingField] = {}
        self._last_line = 0
        self._parts: list[Any] = []

    @property
    def plots(self) -> list[list[str]]:
        """The curves of each plot."""
        return [plot.names for plot in self._plots]

    @property
    def view(self) -> MeshView:
        """What is known of the mesh."""
        return self._view

    def remove(self) -> None:
        """Take it from the page."""
        for part in self._parts:
            part.delete()

    # --- its elements

    def build(self, head: Any, body: Any) -> None:  # noqa: ANN401  elements of NiceGUI
        """Make the elements, in the head and in the body of the page."""
        ui.run_javascript(f"fmuMeshPlots.show({json.dumps(self.key)}, {self.run})")
        with head, ui.row().classes("fm-line col") as row:
            self._parts.append(row)
            self._state = ui.badge("").classes("text-body2 fm-state")
            self._numbers = ui.label().classes("fm-numbers")
            ui.space()
            if self._read_only:
                ui.badge("read only", color="grey").classes("text-body2")
            else:
                self._add_buttons()
        with body, ui.element("div").classes("fm-columns") as columns:
            self._parts.append(columns)
            with ui.element("div").classes("fm-column"):
                self._add_plots()
                self._add_instances()
            with ui.element("div").classes("fm-column"):
                if not self._read_only:
                    self._add_settings()
                self._add_picture()
                self._add_log()
        self._parts.append(ui.timer(_PICTURE_S, self._draw_picture))
        if not self._read_only:
            self._parts.append(ui.timer(_VALUES_S, self._read_values))

    def _add_buttons(self) -> None:
        self._pausing = ui.button("Pause", icon="pause", on_click=self._pause).props("dense unelevated color=secondary")
        self._resuming = ui.button("Resume", icon="play_arrow", on_click=self._resume)
        self._resuming.props("dense unelevated color=secondary")
        self._points = ui.number(value=1, min=1, precision=0, label="points").props("dense dark outlined")
        self._points.style("width: 90px")
        ui.button("Step", icon="skip_next", on_click=self._step).props("dense unelevated color=secondary")
        with ui.dialog() as dialog, ui.card():
            ui.label(f"Stop the run of '{self.key}'? Its result file keeps what was recorded.")
            with ui.row():
                ui.button("Stop the run", color="negative", on_click=lambda: dialog.submit(True))  # noqa: FBT003  its value
                ui.button("Cancel", on_click=lambda: dialog.submit(False)).props("flat")  # noqa: FBT003  its value
        self._dialog = dialog
        ui.button("Stop", icon="stop", color="negative", on_click=self._stop).props("dense unelevated")

    def _add_plots(self) -> None:
        with ui.row().classes("fm-line"):
            span = ui.select(_SPANS, value=0, label="time", on_change=lambda event: _show_span(event.value))
            span.props("dense outlined")
            ui.button("Add a plot", icon="add", on_click=self._add_plot).props("dense flat")
        self._charts = ui.element("div").classes("fm-column")
        with self._charts:
            for plot in self._plots:
                plot.build()
        self.remember()

    def _add_plot(self) -> None:
        plot = _Plot(self, [])
        self._plots.append(plot)
        with self._charts:
            plot.build()

    def drop_plot(self, plot: _Plot) -> None:
        """Remove a plot."""
        self._plots.remove(plot)
        self.remember()

    def remember(self) -> None:
        """Put the curves into the address of the page, so that it shows them again when it is loaded."""
        curves = [f"{number}:{name}" for number, plot in enumerate(self._plots) for name in plot.names]
        query = json.dumps([["mesh", self.key], *(["curve", curve] for curve in curves)])
        ui.run_javascript(f"history.replaceState(null, '', '/?' + new URLSearchParams({query}))")

    def _add_instances(self) -> None:
        with ui.card().classes("fm-card").props("flat bordered"):
            ui.label("Instances").classes("fm-title")
            columns = [
                {"name": name, "label": label, "field": name, "align": "left", "sortable": name != "share"}
                for name, label in _COLUMNS.items()
            ]
            self._table = ui.table(rows=[], columns=columns, row_key="instance").classes("fm-instances fm-numbers")
            self._table.props("dense flat hide-pagination virtual-scroll :rows-per-page-options=[0]")
            self._table.add_slot("body-cell-share", _BAR)

    def _add_picture(self) -> None:
        with ui.card().classes("fm-card").props("flat bordered"):
            with ui.row().classes("fm-line").style("width: 100%"):
                ui.label("Connections").classes("fm-title")
                ui.space()
                ui.switch("full size", on_change=self._enlarge).props("dense")
            self._picture = ui.html("", sanitize=False).classes("fm-graph")  # our own SVG, in which names are escaped

    def _add_settings(self) -> None:
        settable = self._view.catalogue.settable
        with ui.card().classes("fm-card").props("flat bordered"):
            ui.label("Values to set").classes("fm-title")
            if not settable:
                ui.label("This mesh has no unconnected input and no tunable parameter.")
                return
            first = [name for name, v in settable.items() if not v.shape][:_FIELDS] or [*settable][:_FIELDS]
            if len(settable) > len(first):
                choice = ui.select([*settable], value=first, multiple=True, label="variables", with_input=True)
                choice.props("dense outlined use-chips").style("width: 100%").on_value_change(self._choose_fields)
            self._settings = ui.element("div").classes("fm-column").style("gap: 4px")
            self._show_fields(first)

    def _add_log(self) -> None:
        with ui.card().classes("fm-card").props("flat bordered"):
            ui.label("Log").classes("fm-title")
            self._log = ui.log(max_lines=500).classes("fm-log")

    # --- what it shows

    def look(self, view: MeshView) -> None:
        """Show what is known now."""
        self._view = view
        status = view.status
        assert status is not None  # otherwise there is no page yet
        state = "ended" if view.ended and status.state not in ("done", "failed") else status.state
        self._state.set_text(state)
        self._state.props(f"color={_STATES.get(state, 'grey')}")
        last = f"/{status.last_point}" if view.info is not None and view.info.stop_time is not None else ""
        parts = [
            f"t = {status.time:.6g} s",
            f"point {status.point}{last}",
            f"{status.points_per_second:.0f} points/s",
            f"real-time factor {status.real_time_factor:.3g}",
            *([f"{status.overruns} overruns"] if status.overruns else []),
            *([status.error.message] if status.error is not None else []),
            *([view.trouble] if view.trouble is not None else []),
        ]
        self._numbers.set_text(" · ".join(parts))
        if not self._read_only:
            self._pausing.set_visibility(state != "paused")
            self._resuming.set_visibility(state == "paused")
        names = [name for name in view.infos if name in view.instances]
        rows = [_row(view.instances[name], view.before.get(name)) for name in names]
        if rows != self._table.rows:
            self._table.update_rows(rows)
        self._show_log()

    def _show_log(self) -> None:
        for line in self._follower.log:
            if line.number > self._last_line:
                self._last_line = line.number
                self._log.push(f"{line.instance} at point {line.point}: {line.status.lower()}: {line.message}")

    def _enlarge(self, event: Any) -> None:  # noqa: ANN401  an event of NiceGUI
        self._picture.classes(add="fm-full") if event.value else self._picture.classes(remove="fm-full")

    async def _draw_picture(self) -> None:
        picture = await run.io_bound(self._follower.picture)
        if picture is not None and picture != self._picture.content:
            self._picture.set_content(picture)

    # --- what it does

    def _choose_fields(self, event: Any) -> None:  # noqa: ANN401  an event of NiceGUI
        self._show_fields(event.value or [])

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

    async def _pause(self) -> None:
        await self._act(Run.pause)

    async def _resume(self) -> None:
        await self._act(Run.resume)

    async def _step(self) -> None:
        points = int(self._points.value or 1)
        await self._act(lambda mesh: mesh.step(points))

    async def _stop(self) -> None:
        if await self._dialog:
            await self._act(Run.stop)

    async def _act(self, action: Callable[[Run], Any]) -> Any:  # noqa: ANN401  the answers of a Run
        """Do something to the mesh; None if it refuses, after saying why."""
        try:
            return await run.io_bound(_act, self._follower, action)
        except FmuMeshError as error:
            ui.notify(str(error), type="negative", close_button=True, timeout=10000)
            return None


class _Plot:
    """One plot: a choice of variables above their curves."""

    def __init__(self, page: _MeshPage, names: list[str]) -> None:
        self.names = names
        self._page = page

    def build(self) -> None:
        """Make its elements."""
        elements = self._page.view.catalogue.elements
        with ui.card().classes("fm-card fm-plot-card").props("flat bordered") as self._card:
            with ui.row().classes("items-center no-wrap").style("width: 100%"):
                choice = ui.select([*elements], value=self.names, multiple=True, label="variables", with_input=True)
                choice.props("dense outlined use-chips").classes("col").on_value_change(self._choose)
                ui.button(icon="close", on_click=self._remove).props("dense flat round").tooltip("Remove this plot")
            self._chart = ui.echart(_options(self._page.view, self.names)).classes("fm-plot")
        self._tell()

    def _choose(self, event: Any) -> None:  # noqa: ANN401  an event of NiceGUI
        self.names = list(event.value or [])
        self._chart.options.clear()
        self._chart.options.update(_options(self._page.view, self.names))
        self._chart.update()
        self._tell()
        self._page.remember()

    def _tell(self) -> None:
        ui.run_javascript(f"fmuMeshPlots.plot({self._chart.id}, {json.dumps(self.names)})")

    def _remove(self) -> None:
        ui.run_javascript(f"fmuMeshPlots.drop({self._chart.id})")
        self._card.delete()
        self._page.drop_plot(self)


def _options(view: MeshView, names: Sequence[str]) -> dict[str, Any]:
    """The options of ECharts for these curves, which have no values yet."""
    variables = [view.catalogue.variables[view.catalogue.elements[name][0]] for name in names]
    units = {v.unit for v in variables}
    unit = next(iter(units)) if len(units) == 1 else None
    return {
        "animation": False,
        "color": _COLORS,
        "grid": {"left": 70, "right": 20, "top": 34, "bottom": 44},
        "legend": {"type": "scroll", "top": 0, "textStyle": {"color": "#888"}},
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
                "step": "end" if _holds(v) else False,
                "lineStyle": {"width": 1.5},
                "data": [],
            }
            for name, v in zip(names, variables, strict=True)
        ],
    }


def _holds(variable: VariableView) -> bool:
    """Whether a variable keeps its value until it gets another one."""
    return variable.variability != "continuous" or variable.causality in ("parameter", "calculatedParameter")


def _first_plots(view: MeshView) -> list[list[str]]:
    """The first outputs, those with the same unit in one plot."""
    groups: dict[str | None, list[str]] = {}
    for name, (variable, _) in view.catalogue.elements.items():
        own = view.catalogue.variables[variable]
        if own.causality == "output" and (len(groups) < _PLOTS or own.unit in groups):
            group = groups.setdefault(own.unit, [])
            if len(group) < _CURVES:
                group.append(name)
    return [*groups.values()]


def _grouped(chosen: Sequence[Sequence[str]]) -> list[list[str]]:
    """The curves of each plot, from pairs of the number of a plot and the name of a variable."""
    plots: dict[str, list[str]] = {}
    for number, name in chosen:
        plots.setdefault(number, []).append(name)
    return [*plots.values()]


def _short_names(keys: Sequence[str]) -> dict[str, str]:
    """By key the name of a mesh, and its key where two have the same name."""
    names = [key.rpartition("/")[2] for key in keys]
    return {key: name if names.count(name) == 1 else key for key, name in zip(keys, names, strict=True)}


def _row(own: InstanceStatus, before: InstanceStatus | None) -> dict[str, Any]:
    """The row of an instance in the table; rates and shares are those of the last second."""
    if before is None or before.running_time >= own.running_time or before.point > own.point:  # it was restarted
        before = InstanceStatus(own.instance, "", "", 0, 0.0, 0.0, 0.0)
    wall_s = own.running_time - before.running_time
    points = own.point - before.point
    rate = points / wall_s if wall_s > 0.0 else 0.0
    waits = min(100.0, 100.0 * max(0.0, own.wait_time - before.wait_time) / wall_s) if wall_s > 0.0 else 0.0
    steps_s = own.step_time * own.point - before.step_time * before.point
    computes = min(100.0 - waits, 100.0 * max(0.0, steps_s) / wall_s) if wall_s > 0.0 else 0.0
    return {
        "instance": own.instance,
        "state": own.state,
        "point": own.point,
        "rate": round(rate),
        "step": f"{1e6 * own.step_time:.3g} us",
        "share": [round(computes, 1), round(waits, 1)],
        "shares": f"{computes:.0f} % in its steps, {waits:.0f} % waiting",
        "restarts": own.restarts,
        "activity": own.activity.replace(f" at point {own.point}", "", 1),
    }


def _show_span(seconds: int) -> None:
    ui.run_javascript(f"fmuMeshPlots.span({seconds})")


def _act(follower: MeshFollower, action: Callable[[Run], Any]) -> Any:  # noqa: ANN401  the answers of a Run
    return follower.ask(action)


def _values(follower: MeshFollower, names: Sequence[str]) -> Mapping[str, Any]:
    """The current values, as far as they are answered."""
    values = {}
    for name in names:
        try:
            values[name] = follower.ask(partial(Run.get, name=name))
        except FmuMeshError:
            break  # it does not run any more
    return values
