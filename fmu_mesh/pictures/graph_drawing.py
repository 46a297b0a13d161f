"""A system graph as shapes: boxes with ports, wires, groups, texts.

Owns how a graph looks; `graph_pictures` writes the shapes down.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import msgspec

from ..config.key_sections import KEY
from ..system.defect import Defect, DefectWords
from .drawing import CYCLE_COLOURS, FAINT, INK, STATE_COLOURS, WIRE
from .graph_layout import Arrangement, Dot, Wire, arranged
from .result_drawing import in_unit
from .tables import shortened

__all__ = [
    "Box",
    "Drawing",
    "DrawnWire",
    "GraphEdge",
    "GraphNode",
    "GraphVariable",
    "Label",
    "drawing_of",
]

_MARGIN, _TITLE, _PAD, _GROUP_TITLE = 20.0, 34.0, 16.0, 22.0
_HEAD, _LIVE, _ROW, _INSET = 42.0, 17.0, 17.0, 9.0
_NARROW, _LIVE_WIDTH, _BROAD = 120.0, 190.0, 250.0
_BUNDLE = 4
"""So many connections from one instance to another, or more, are drawn as one wire."""


class GraphVariable(msgspec.Struct, frozen=True):
    """One connection of an edge: the input is factor * output + offset.

    Attributes:
        source: the output; ``target``: the input. ``source_unit``, ``target_unit``: their units; empty without one.
        map: what the input gets instead of a value, such as `0 -> 2, 1 -> 5`; empty without a map.
        rule: of a Zenoh key, whose end has the encoding of the values: when one takes effect, or when there is one.
        way: `row stream` or `Zenoh` if its values come so from another process, in a mesh that runs; otherwise empty.
    """

    source: str
    target: str
    source_unit: str = ""
    target_unit: str = ""
    factor: float = 1.0
    offset: float = 0.0
    map: str = ""
    way: str = ""
    rule: str = ""

    @property
    def unit_text(self) -> str:
        """The unit, or both where they differ."""
        units = [unit for unit in (self.source_unit, self.target_unit) if unit]
        return " to ".join(dict.fromkeys(units))


class GraphEdge(msgspec.Struct, frozen=True):
    """All connections from one instance to another that have the same delay.

    Attributes:
        source: the instance with the outputs; ``target``: the one with the inputs.
        delay: 0 or 1 points; -1 (`INITIAL`) for values of parameters. ``variables``: the connections.
        closes_cycle: whether it goes back against the order of execution; without such edges there is no cycle.
        cycle: number of the cycle in `SystemGraph.cycles` that it belongs to; None if it belongs to none.
    """

    source: str
    target: str
    delay: int
    variables: tuple[GraphVariable, ...]
    closes_cycle: bool = False
    cycle: int | None = None


class GraphNode(msgspec.Struct, frozen=True):
    """One instance.

    Attributes:
        instance: its name.
        model: the file of its model, or the name of the model.
        group: name of its process; instances of a group share one.
        state: what it does: "running", "done", …; None where nothing is known, as before a run. So are the others.
        point: the last point it has reached.
        points_per_second: its speed.
        wait: the share of its time that it waits, from 0 to 1.
        host: the host of `deploy.hosts` on which it runs; empty for that of `launch`.
    """

    instance: str
    model: str
    group: str
    state: str | None = None
    point: int | None = None
    points_per_second: float | None = None
    wait: float | None = None
    host: str = ""

    @property
    def caption(self) -> str:
        """Its model, and its host."""
        return f"{self.model} on {self.host}" if self.host else self.model

    @property
    def live(self) -> str:
        """State, speed and waiting as text; empty where they are not known."""
        return ", ".join([self.state, *self.speed]) if self.state is not None else ""

    @property
    def brief(self) -> str:
        """The same as it fits into a box, whose colour says which ones run."""
        return ", ".join(self.speed) if self.speed and self.state == "running" else self.state or ""

    @property
    def speed(self) -> list[str]:
        """Speed and waiting in words; empty if it does not move."""
        if not (rate := self.points_per_second):
            return []
        limit, unit = next((own for own in ((1e6, "M"), (1e3, "k")) if rate >= own[0]), (1.0, ""))
        waits = [f"waits {100.0 * self.wait:.0f} %"] if self.wait is not None else []
        return [f"{rate / limit:.3g}{unit} points/s", *waits]


class Box(NamedTuple):
    """A rectangle."""

    x: float
    y: float
    width: float
    height: float


class Label(NamedTuple):
    """A text; ``y`` is its base line."""

    x: float
    y: float
    text: str
    size: float = 12.0
    colour: str = INK
    bold: bool = False
    anchor: Literal["start", "end"] = "start"


class DrawnInstance(NamedTuple):
    """The box of an instance with its texts."""

    name: str
    box: Box
    border: str
    is_in_cycle: bool
    labels: tuple[Label, ...]
    dot: tuple[float, float, str] | None


class DrawnWire(NamedTuple):
    """A wire from port to port; ``has_ring``: one of its connections has the largest defect."""

    edge: int
    path: tuple[Dot, ...]
    colour: str
    width: float
    dashed: bool
    tip: str
    has_ring: bool = False


class Drawing(NamedTuple):
    """All shapes of a picture."""

    width: float
    height: float
    groups: tuple[tuple[Box, Label], ...]  # the box of each process with several instances, and its title
    instances: tuple[DrawnInstance, ...]
    wires: tuple[DrawnWire, ...]  # the wires, those of cycles last, so that they are on top
    labels: tuple[Label, ...]  # the title and the legend
    edges: tuple[tuple[str, str], ...]  # source and target of each edge


class _Ports(NamedTuple):
    """The texts on both sides of a box, from the top."""

    inputs: dict[object, str]
    outputs: dict[object, str]


class _Port(NamedTuple):
    """A wire of an edge, and what stands at its ends."""

    edge: int
    source: object
    target: object
    tip: str


class _Plan(NamedTuple):
    """What does not change while a mesh runs: sizes and places."""

    width: float
    height: float
    boxes: dict[str, Box]
    groups: dict[str, Box]
    ports: dict[str, _Ports]
    wires: tuple[tuple[_Port, tuple[Dot, ...]], ...]


def drawing_of(
    title: str,
    nodes: Sequence[GraphNode],
    edges: tuple[GraphEdge, ...],
    cycles: Sequence[Sequence[str]],
    defects: Mapping[str, Defect] = {},
) -> Drawing:
    """The shapes of a graph."""
    is_live = any(node.state is not None for node in nodes)
    plan = _planned(tuple((node.instance, node.caption, node.group) for node in nodes), edges, is_live)
    cycle_of = {name: number for number, cycle in enumerate(cycles) for name in cycle}
    instances = [_drawn_instance(node, plan, cycle_of.get(node.instance), is_live=is_live) for node in nodes]
    known = DefectWords(defects)
    differences = [known.largest_among(_input_units(edges[port.edge], port)) for port, _ in plan.wires]
    wires = [
        DrawnWire(
            port.edge,
            path,
            WIRE if (cycle := edges[port.edge].cycle) is None else CYCLE_COLOURS[cycle % len(CYCLE_COLOURS)],
            1.4 if cycle is None else 2.1,
            edges[port.edge].delay > 0,
            port.tip + text,
            0.0 < relative == known.most,
        )
        for (port, path), (text, relative) in zip(plan.wires, differences, strict=True)
    ]
    groups = [
        (box, Label(box.x + _PAD, box.y + 16.0, f"group {shortened(name, 40)}: one process", 11.0, FAINT))
        for name, box in plan.groups.items()
    ]
    labels, height = [Label(_MARGIN, _MARGIN + 8.0, title, 14.0, bold=True)], plan.height
    dashed = "dashed: delay 1, the step uses the value at its start" if any(edge.delay > 0 for edge in edges) else ""
    thick = "thick and coloured: a cycle" if any(edge.cycle is not None for edge in edges) else ""
    ring = "ring: the largest defect relative to a range" if any(wire.has_ring for wire in wires) else ""
    if legend := "; ".join(filter(None, (dashed, thick, ring))):
        labels.append(Label(_MARGIN, height, legend, 11.0, FAINT))
        height += 18.0
    width = max(plan.width, *(_text_width(label) + 2.0 * _MARGIN for label in labels))
    return Drawing(
        width,
        height,
        tuple(groups),
        tuple(instances),
        tuple(sorted(wires, key=lambda wire: wire.width)),
        tuple(labels),
        tuple((edge.source, edge.target) for edge in edges),
    )


def _drawn_instance(node: GraphNode, plan: _Plan, cycle: int | None, *, is_live: bool) -> DrawnInstance:
    box, ports = plan.boxes[node.instance], plan.ports[node.instance]
    most = int(box.width / 7.2)
    labels = [
        Label(box.x + _INSET, box.y + 18.0, shortened(node.instance, int(most * 0.92)), 13.0, bold=True),
        Label(box.x + _INSET, box.y + 33.0, shortened(node.caption, most), 11.0, FAINT),
    ]
    dot = None
    if is_live and node.state is not None:
        colour = STATE_COLOURS.get(node.state, FAINT)
        dot = box.x + _INSET + 4.0, box.y + _HEAD + 4.0, colour
        labels.append(Label(box.x + _INSET + 12.0, box.y + _HEAD + 8.0, shortened(node.brief, most), 11.0, colour))
    for side, texts in enumerate(ports):
        for row, text in enumerate(texts.values()):
            y = box.y + _row_y(row, is_live=is_live) + 4.0
            x = box.x + box.width - _INSET if side else box.x + _INSET
            labels.append(Label(x, y, text, 11.0, anchor="end" if side else "start"))
    border = FAINT if cycle is None else CYCLE_COLOURS[cycle % len(CYCLE_COLOURS)]
    return DrawnInstance(node.instance, box, border, cycle is not None, tuple(labels), dot)


# --- places


@lru_cache(maxsize=16)
def _planned(nodes: tuple[tuple[str, str, str], ...], edges: tuple[GraphEdge, ...], is_live: bool) -> _Plan:  # noqa: FBT001  the cache has it as part of its key
    return _Planning(nodes, edges, is_live=is_live).plan()


class _Planning:
    """Places instances: first within each process with several of them, then all processes."""

    def __init__(self, nodes: Sequence[tuple[str, str, str]], edges: Sequence[GraphEdge], *, is_live: bool) -> None:
        self._ports, self._sides = _wired([name for name, _, _ in nodes], edges)
        self._sizes = {
            name: (
                _box_width(name, model, self._sides[name], is_live=is_live),
                _row_y(max(map(len, self._sides[name])), is_live=is_live) - 4.0,
            )
            for name, model, _ in nodes
        }
        members: dict[str, list[str]] = {}
        for name, _, group in nodes:
            members.setdefault(group, []).append(name)
        self._members = {group: names for group, names in members.items() if len(names) > 1}
        self._group_of = {name: group for group, names in self._members.items() for name in names}
        rows = {name: [{key: n for n, key in enumerate(side)} for side in own] for name, own in self._sides.items()}
        self._ends = [(edges[port.edge].source, edges[port.edge].target) for port in self._ports]
        self._wires = [
            Wire(
                source,
                target,
                _row_y(rows[source][1][port.source], is_live=is_live),
                _row_y(rows[target][0][port.target], is_live=is_live),
                abs(edges[port.edge].delay),
            )
            for port, (source, target) in zip(self._ports, self._ends, strict=True)
        ]

    def plan(self) -> _Plan:
        outer = list(self._wires)
        inner = {group: self._inside(group, outer) for group in self._members}
        sizes = {
            _outer_name(name, self._group_of): (
                (inner[group][0].width + 2.0 * _PAD, inner[group][0].height + _GROUP_TITLE + _PAD)
                if (group := self._group_of.get(name)) is not None
                else size
            )
            for name, size in self._sizes.items()
        }
        outside = [n for n, (source, target) in enumerate(self._ends) if self._are_apart(source, target)]
        whole = arranged(sizes, [outer[number] for number in outside])
        left, top = _MARGIN, _MARGIN + _TITLE
        places = {name: Box(x + left, y + top, *sizes[name]) for name, (x, y) in whole.places.items()}
        groups = {group: places[_outer_name(names[0], self._group_of)] for group, names in self._members.items()}
        boxes = {name: Box(*places[name][:2], *size) for name, size in self._sizes.items() if name in places}
        for group, (own, _) in inner.items():
            for name, place in own.places.items():
                boxes[name] = Box(*_moved([place], groups[group])[0], *self._sizes[name])
        between = {
            number: [(x + left, y + top) for x, y in path] for number, path in zip(outside, whole.paths, strict=True)
        }
        paths = []
        for number, port in enumerate(self._ports):
            first, last = (self._group_of.get(end) for end in self._ends[number])
            path = _moved(inner[first][1][number], groups[first]) if first is not None else []
            path += between.get(number, [])
            path += _moved(inner[last][1][number], groups[last]) if last is not None and number in between else []
            paths.append((port, tuple(_without_repeats(path))))
        height = top + whole.height + _MARGIN
        return _Plan(whole.width + 2.0 * _MARGIN, height, boxes, groups, self._sides, tuple(paths))

    def _are_apart(self, source: str, target: str) -> bool:
        return source not in self._group_of or self._group_of[source] != self._group_of.get(target)

    def _inside(self, group: str, outer: list[Wire]) -> tuple[Arrangement, dict[int, list[Dot]]]:
        """The places in a group, and the way of each wire in it; in ``outer`` such a wire ends at the group."""
        own = self._members[group]
        here = {}
        for number, wire in enumerate(self._wires):
            source, target = (end if end in own else None for end in (wire.source, wire.target))
            if source is not None or target is not None:
                here[number] = wire._replace(source=source, target=target)
        arrangement = arranged({name: self._sizes[name] for name in own}, [*here.values()])
        paths = dict(zip(here, arrangement.paths, strict=True))
        box = _outer_name(own[0], self._group_of)
        for number, wire in here.items():
            if wire.target is None:
                outer[number] = outer[number]._replace(source=box, source_y=paths[number][-1][1] + _GROUP_TITLE)
            if wire.source is None:
                outer[number] = outer[number]._replace(target=box, target_y=paths[number][0][1] + _GROUP_TITLE)
        return arrangement, paths


def _outer_name(name: str, group_of: Mapping[str, str]) -> str:
    """The box among processes that an instance is in; no instance has a name with a space."""
    return f"group {group_of[name]}" if name in group_of else name


def _moved(path: Sequence[Dot], group: Box) -> list[Dot]:
    return [(x + group.x + _PAD, y + group.y + _GROUP_TITLE) for x, y in path]


def _without_repeats(path: Sequence[Dot]) -> list[Dot]:
    kept: list[Dot] = []
    for dot, after in zip(path, [*path[1:], None], strict=True):
        if dot == after or (kept and after and kept[-1][1] == dot[1] == after[1] and kept[-1][0] <= dot[0] <= after[0]):
            continue
        kept.append(dot)
    return kept


def _wired(names: Sequence[str], edges: Sequence[GraphEdge]) -> tuple[list[_Port], dict[str, _Ports]]:
    """The wires, and the ports of each instance: a variable each, or the number of many."""
    wires: list[_Port] = []
    ports = {name: _Ports({}, {}) for name in names}
    for number, edge in enumerate(edges):
        if len(edge.variables) >= _BUNDLE:
            text = f"{len(edge.variables)} values"
            tips = "\n".join(_tip(edge, variable) for variable in edge.variables[:20])
            wires.append(_Port(number, number, number, tips))
            ports[edge.source].outputs[number] = ports[edge.target].inputs[number] = text
            continue
        for variable in edge.variables:
            wires.append(_Port(number, variable.source, variable.target, _tip(edge, variable)))
            ports[edge.source].outputs[variable.source] = _port_text(variable.source, variable.source_unit)
            ports[edge.target].inputs[variable.target] = _port_text(variable.target, variable.target_unit)
    return wires, ports


def _tip(edge: GraphEdge, variable: GraphVariable) -> str:
    end = f" ({variable.unit_text}), " if variable.unit_text else ", "
    end += variable.rule or (f"delay {edge.delay}" if edge.delay >= 0 else "in the initialization")
    end += (", closes a cycle" if edge.closes_cycle else "") + (f", map {variable.map}" if variable.map else "")
    ends = (edge.source, variable.source), (edge.target, variable.target)
    return " -> ".join(f"{name} ({own})" if name.startswith(KEY) else f"{name}.{own}" for name, own in ends) + end


def _input_units(edge: GraphEdge, port: _Port) -> dict[str, str]:
    """The connections of a wire, as `a.y -> b.u`, with the units of their inputs."""
    return {
        f"{edge.source}.{own.source} -> {edge.target}.{own.target}": own.target_unit
        for own in edge.variables
        if port.source in (port.edge, own.source) and port.target in (port.edge, own.target)
    }


def _port_text(name: str, unit: str) -> str:
    return in_unit(shortened(name, 24), shortened(unit, 12))


def _row_y(row: int, *, is_live: bool) -> float:
    """Where the middle of a row of ports is, below the upper edge of a box."""
    return _HEAD + (_LIVE if is_live else 0.0) + _ROW * row + 4.0


def _box_width(name: str, model: str, ports: _Ports, *, is_live: bool) -> float:
    """As wide as the texts in it; of the heading, at most so much."""
    sides = [max((_text_width(Label(0, 0, text, 11.0)) for text in side.values()), default=0.0) for side in ports]
    head = max(_text_width(Label(0, 0, name, 13.0, bold=True)), _text_width(Label(0, 0, model, 11.0)))
    least = _LIVE_WIDTH if is_live else _NARROW
    return max(least, sum(sides) + 4.0 * _INSET, min(head + 2.0 * _INSET, _BROAD))


def _text_width(label: Label) -> float:
    """About the width of a text, of a wide font."""
    return len(label.text) * label.size * (0.66 if label.bold else 0.6)
