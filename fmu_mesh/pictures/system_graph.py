"""The graph of a mesh: instances, connections, processes and cycles, as a picture or as text.

Owns what the graph says; `graph_layout` has where things lie, and `graph_drawing` how they look.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from ..config.key_sections import KEY, KeyView
from ..config.ros_section import MeshTopic
from ..printing import page
from ..system.defect import Defect
from ..system.graph import strongly_connected, topological_order
from ..system.value_map import map_text
from ..text import counted
from .graph_drawing import Drawing, GraphEdge, GraphNode, GraphVariable, drawing_of
from .graph_layout import INITIAL, going_back
from .graph_pictures import figure_of_drawing, svg_of_drawing
from .tables import html_table, shortened, table, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..system.plan import Plan
    from ..wire.views import InstanceInfo, InstanceStatus

__all__ = ["SystemGraph", "graph_of", "graph_of_infos", "graph_of_plan"]

_COLUMNS = 80
_NAME = 30
_DRAWN = 60
"""Most instances that a notebook draws unasked, with up to three edges each."""


class SystemGraph(msgspec.Struct, frozen=True):
    """The graph of a mesh: its instances, and the connections between them.

    Example:
        >>> import fmu_mesh
        >>> graph = fmu_mesh.load("configs/cycle2.yaml").graph()
        >>> [node.instance for node in graph.nodes], graph.cycles
        (['position', 'velocity'], (('position', 'velocity'),))
        >>> [(edge.source, edge.target, edge.delay, edge.closes_cycle) for edge in graph.edges]
        [('velocity', 'position', 1, False), ('position', 'velocity', 1, True)]
        >>> print(graph.text())
        cycle2: 2 instances in 2 processes, 2 connections, 1 cycle
        <BLANKLINE>
        position  Integrator.fmu
          y -> velocity.u  closes a cycle
        velocity  Integrator.fmu
          y -> position.u  delay 1
        <BLANKLINE>
        cycle  position, velocity

    Attributes:
        mesh: name of the mesh.
        nodes: the instances, in the order in which they step.
        edges: the connections, those from one instance to another with the same delay together.
        cycles: the instances of each cycle.
        topics: those in ROS; a picture has none of them.
        keys: the Zenoh keys at ends of connections.
        defects: by connection, what is known of them; a wire shows them when somebody points at it.
    """

    mesh: str
    nodes: tuple[GraphNode, ...]
    edges: tuple[GraphEdge, ...]
    cycles: tuple[tuple[str, ...], ...] = ()
    topics: tuple[MeshTopic, ...] = ()
    keys: tuple[KeyView, ...] = ()
    defects: dict[str, Defect] = {}

    @property
    def title(self) -> str:
        """One line: how many instances, processes, hosts, connections and cycles there are."""
        hosts = {node.host for node in self.nodes}
        on_hosts = f" on {counted(len(hosts), 'host')}" if hosts - {""} else ""
        processes = counted(len({n.group for n in self.nodes}), "process")
        counts = [
            f"{counted(len(self.nodes), 'instance')} in {processes}{on_hosts}",
            counted(sum(len(edge.variables) for edge in self.edges), "connection"),
            *([counted(len(self.cycles), "cycle")] if self.cycles else []),
            *([counted(len(self.keys), "key")] if self.keys else []),
        ]
        return f"{self.mesh}: {', '.join(counts)}"

    def with_status(
        self,
        instances: Mapping[str, InstanceStatus],
        before: Mapping[str, InstanceStatus] | None = None,
        defects: Mapping[str, Defect] = {},
    ) -> SystemGraph:
        """The same graph with the state of each instance and key, as `Run.all_status` has it.

        Example:
            >>> mesh = fmu_mesh.load("configs/pendulum_delay.yaml")
            >>> with mesh.start(record="memory", paused=True) as run:
            ...     _ = run.wait_for("paused")
            ...     graph = run.graph()
            ...     [node.state for node in graph.with_status(run.all_status()[1]).nodes]
            ['running', 'running']

        Args:
            instances: the status of each instance; one that is missing gets no values.
            before: that of an earlier look, for the speed since then; None: the mean speed since the first point.
            defects: those of `MeshStatus` or of a `Result`, for the edges.
        """
        nodes = [_live(node, instances.get(node.instance), (before or {}).get(node.instance)) for node in self.nodes]
        keys = {own.ends: own for status in instances.values() for own in status.keys}
        own_keys = tuple(keys.get(own.ends, own) for own in self.keys)
        return replace(self, nodes=tuple(nodes), keys=own_keys, defects={**defects})

    def svg(self) -> str:
        """The picture as the text of an SVG file; needs no library.

        Example:
            >>> picture = fmu_mesh.load("configs/cycle2.yaml").graph().svg()
            >>> picture[:4], 'data-instance="velocity"' in picture
            ('<svg', True)

        Every instance is a group of the class `instance` with the attribute `data-instance`. Every edge is one of the
        class `edge` with `data-source` and `data-target`. A Zenoh key is drawn as an instance `key <key>`.
        """
        return svg_of_drawing(self._drawing)

    def figure(self) -> Figure:
        """The picture as a figure of matplotlib.

        Example:
            >>> fmu_mesh.load("configs/cycle2.yaml").graph().figure().savefig("cycle2.pdf")

        Raises:
            ConfigurationError: matplotlib is not installed.
        """
        return figure_of_drawing(self._drawing)

    def text(self) -> str:
        """The graph as text of at most 80 columns: below each instance, what its outputs are connected to."""
        groups: dict[str, list[GraphNode]] = {}
        for node in self.nodes:
            groups.setdefault(node.group, []).append(node)
        lines = [shortened(self.title, _COLUMNS), ""]
        for group, nodes in groups.items():
            indent = 2 if len(nodes) > 1 else 0
            if indent:
                lines.append(f"group {shortened(group, _COLUMNS - 30)}, one process")
            for node in nodes:
                lines += self._lines_of(node, indent)
        lines += [""] if self.cycles else []
        for cycle in self.cycles:
            lines += wrapped([shortened(name, _NAME) for name in cycle], _COLUMNS, "cycle  ")
        lines += [""] if self.keys else []
        for own in self.keys:
            lines += wrapped(own.cells, _COLUMNS, "key  ")
        lines += [""] if self.topics else []
        for topic in self.topics:
            lines += wrapped(topic.cells, _COLUMNS, "ROS  ")
        return page(line.rstrip() for line in lines)

    @property
    def _drawing(self) -> Drawing:
        """The shapes; a key is a box, whose ports are the encodings of its values."""
        boxes: dict[str, list[KeyView]] = {}
        edges = list(self.edges)
        for own in self.keys:
            boxes.setdefault(name := f"{KEY}{own.key}", []).append(own)
            ends = [(name, own.encoding), (own.instance, own.variable)]
            (source, output), (target, input_) = ends if own.direction == "in" else reversed(ends)
            edges.append(GraphEdge(source, target, 0, (GraphVariable(output, input_, rule=own.rule),)))
        nodes = {True: list[GraphNode](), False: list[GraphNode]()}  # whether values come by it
        for name, keys in boxes.items():
            rules, activities = (", ".join(dict.fromkeys(map(attrgetter(of), keys))) for of in ("rule", "activity"))
            nodes[keys[0].direction == "in"].append(GraphNode(name, rules, name, activities or None))
        return drawing_of(
            self.title, [*nodes[True], *self.nodes, *nodes[False]], tuple(edges), self.cycles, self.defects
        )

    def __repr__(self) -> str:
        return f"<SystemGraph of {self.title}>"

    def _repr_html_(self) -> str:
        if len(self.nodes) <= _DRAWN and len(self.edges) <= 3 * _DRAWN:
            return f'<div style="overflow-x: auto">{self.svg()}</div>'
        rows = ((node.instance, node.model, node.group, node.live) for node in self.nodes)
        return html_table(self.title, ["instance", "model", "process", "state"], rows, len(self.nodes))

    def _lines_of(self, node: GraphNode, indent: int) -> list[str]:
        where = f"on {shortened(node.host, _NAME)}" if node.host else ""
        heading = [shortened(node.instance, _NAME), shortened(node.model, _NAME), where, node.live]
        rows = []
        for edge in self.edges:
            delay = "closes a cycle" if edge.closes_cycle else ("", "delay 1", "at the start")[edge.delay]
            for own in edge.variables if edge.source == node.instance else ():
                remark = ", ".join(filter(None, [delay, "map" if own.map else "", own.way]))
                rows.append((own.source, f"{edge.target}.{own.target}", shortened(own.unit_text, 14), remark))
        first = shortened(" " * indent + "  ".join(filter(None, heading)), _COLUMNS)
        return [first, *_fitted(rows, indent + 2)]


def graph_of_plan(plan: Plan) -> SystemGraph:
    """The graph of a mesh that is planned."""
    nodes = [
        GraphNode(
            own.name,
            Path(own.fmu).name or own.description.model_name,
            own.node,
            host=plan.nodes[own.node].host or "",
        )
        for own in plan.system.instances.values()
    ]
    connections = [
        (
            (c.source_instance, c.target_instance, INITIAL if c.initial_only else c.delay or 0),
            GraphVariable(
                c.source_name,
                c.target_name,
                c.source.unit or "",
                c.target.unit or "",
                c.factor,
                c.offset,
                map_text(c.map, c.source, c.target),
            ),
        )
        for c in plan.connections
    ]
    return replace(
        graph_of(plan.system.config.mesh, nodes, connections), topics=plan.system.topics, keys=plan.system.keys
    )


def graph_of_infos(mesh: str, infos: Sequence[InstanceInfo]) -> SystemGraph:
    """The graph of a mesh that runs, from what its instances tell."""
    units = {f"{own.instance}.{v.name}": v.unit or "" for own in infos for v in own.variables}
    nodes = [
        GraphNode(own.instance, Path(own.fmu).name or own.model_name, own.node, host=own.deploy_host) for own in infos
    ]
    connections = []
    for own in infos:
        for c in own.connections:
            source, _, output = c.source.partition(".")
            target, _, input_ = c.target.partition(".")
            both = [units.get(end, units.get(end.partition("[")[0], "")) for end in (c.source, c.target)]
            mapped = ", ".join(f"{have} -> {want}" for have, want in c.map)
            variable = GraphVariable(output, input_, both[0], both[1], c.factor, c.offset, mapped, c.way_in_words)
            connections.append(((source, target, INITIAL if c.initial_only else c.delay), variable))
    return replace(graph_of(mesh, nodes, connections), keys=tuple(key for own in infos for key in own.keys))


def graph_of(
    mesh: str, nodes: Sequence[GraphNode], connections: Iterable[tuple[tuple[str, str, int], GraphVariable]]
) -> SystemGraph:
    """The graph of instances and connections, each as ((source, target, delay), variable).

    Raises:
        ValueError: the connections with delay 0 form a cycle.
    """
    edges: dict[tuple[str, str, int], list[GraphVariable]] = {}
    for key, variable in connections:
        edges.setdefault(key, []).append(variable)
    by_name = {node.instance: node for node in nodes}
    order = topological_order(by_name, [(source, target) for source, target, delay in edges if delay == 0])
    keys = list(edges)
    stepped = [key for key in keys if key[2] != INITIAL]
    back = {stepped[number] for number in going_back(order, stepped)}
    ends = [(source, target) for source, target, _ in stepped]
    parts = [part for part in strongly_connected(by_name, ends) if len(part) > 1 or (part[0], part[0]) in ends]
    cycles = sorted((tuple(sorted(part, key=order.index)) for part in parts), key=lambda cycle: order.index(cycle[0]))
    return SystemGraph(
        mesh,
        tuple(by_name[name] for name in order),
        tuple(
            GraphEdge(
                source=key[0],
                target=key[1],
                delay=key[2],
                variables=tuple(edges[key]),
                closes_cycle=key in back,
                cycle=next((n for n, c in enumerate(cycles) if key in stepped and key[0] in c and key[1] in c), None),
            )
            for key in keys
        ),
        tuple(cycles),
    )


def _live(node: GraphNode, status: InstanceStatus | None, before: InstanceStatus | None) -> GraphNode:
    if status is None:
        return replace(node, state=None, point=None, points_per_second=None, wait=None)
    rate, _, wait = status.rates_since(before)
    return replace(node, state=status.state, point=status.point, points_per_second=rate, wait=wait)


def _fitted(rows: Sequence[tuple[str, str, str, str]], indent: int) -> list[str]:
    """A table of connections in 80 columns: both ends, unit and remark; long names without their middle."""
    source, target, *others = (max((len(row[column]) for row in rows), default=0) for column in range(4))
    room = _COLUMNS - indent - sum(others) - 4 - len(" -> ")
    for_source = min(source, max(room // 2, room - target))
    ends = [
        f"{shortened(row[0], for_source)} -> {shortened(row[1], room - min(len(row[0]), for_source))}" for row in rows
    ]
    return table([(end, *row[2:]) for end, row in zip(ends, rows, strict=True)], indent=indent)
