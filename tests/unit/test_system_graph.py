"""The graph of a mesh: what it has, where its boxes and wires lie, and what the command writes."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path

import msgspec
import pytest

from fmu_mesh.api.attaching import attach
from fmu_mesh.api.mesh_builder import load
from fmu_mesh.cli.main import main
from fmu_mesh.pictures.drawing import CYCLE_COLOURS
from fmu_mesh.pictures.graph_drawing import Box, Drawing, GraphEdge, GraphNode, GraphVariable, drawing_of
from fmu_mesh.pictures.graph_layout import Wire, arranged
from fmu_mesh.pictures.system_graph import SystemGraph, graph_of
from fmu_mesh.system.defect import Defect
from fmu_mesh.wire.views import InstanceStatus, KeyStatus
from tests.helpers import FMUS, Place

CONFIGS = Path(__file__).parents[2] / "configs"
SVG = "{http://www.w3.org/2000/svg}"

Edges = Sequence[tuple[int, int, int]]

CHAIN: Edges = [(number, number + 1, 0) for number in range(63)]
STAR: Edges = [edge for number in range(1, 64) for edge in ((number, 0, 0), (0, number, 1))]
MIXED: Edges = [(number % 37, 37 + (number * 11) % 27, 0) for number in range(50)]
MIXED = [*MIXED, *((number, number + 3 + number % 5, 0) for number in range(0, 56, 2))]
GROUPED: Edges = [
    (0, 1, 0), (1, 2, 0), (2, 0, 1), (2, 4, 0), (4, 5, 0), (5, 1, 1), (8, 0, 0), (5, 9, 0), (6, 7, 0), (9, 10, 0),
    (10, 8, 1), (3, 3, 1), (11, 6, 0),
]  # fmt: skip
CASES: dict[str, tuple[int, Edges, int]] = {
    "one instance": (1, [], 1),
    "no connections": (64, [], 1),
    "a chain": (64, CHAIN, 1),
    "a chain in groups": (64, [*CHAIN, (63, 0, 1)], 8),
    "a star": (64, STAR, 1),
    "a star in one group": (64, STAR, 64),
    "mixed": (64, MIXED, 1),
    "mixed in groups": (64, MIXED, 3),
    "cycles through groups": (12, GROUPED, 4),
    "an instance connected to itself": (1, [(0, 0, 1)], 1),
}
"""Number of instances, (source, target, delay) of the edges, and instances per process."""


def made(count: int, edges: Edges, together: int) -> SystemGraph:
    nodes = [
        GraphNode(f"i{number}", "Model.fmu", f"g{number // together}" if together > 1 else f"i{number}")
        for number in range(count)
    ]
    connections = [
        ((f"i{source}", f"i{target}", delay), GraphVariable("y", f"u{source}", "m", "m"))
        for source, target, delay in edges
    ]
    return graph_of("made", nodes, connections)


@pytest.fixture(params=CASES)
def graph(request: pytest.FixtureRequest) -> SystemGraph:
    return made(*CASES[request.param])


@pytest.fixture
def runtime(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody else's meshes are found from here."""
    for name in ("FMU_MESH_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.setenv(name, place.environment[name])


def shapes_of(graph: SystemGraph) -> Drawing:
    return drawing_of(graph.title, graph.nodes, graph.edges, graph.cycles)


def overlap(first: Box, second: Box) -> bool:
    return (
        first.x < second.x + second.width
        and second.x < first.x + first.width
        and first.y < second.y + second.height
        and second.y < first.y + first.height
    )


def is_inside(inner: Box, outer: Box) -> bool:
    return (
        outer.x <= inner.x
        and outer.y <= inner.y
        and inner.x + inner.width <= outer.x + outer.width
        and inner.y + inner.height <= outer.y + outer.height
    )


def test_no_box_overlaps_another_one_and_all_are_in_the_picture(graph: SystemGraph) -> None:
    shapes = shapes_of(graph)
    boxes = [instance.box for instance in shapes.instances]

    assert len(boxes) == len(graph.nodes)
    assert not [pair for pair in combinations(boxes, 2) if overlap(*pair)]
    assert all(is_inside(box, Box(0.0, 0.0, shapes.width, shapes.height)) for box in boxes)


def test_a_group_has_its_instances_inside_and_all_others_outside(graph: SystemGraph) -> None:
    shapes = shapes_of(graph)
    place = {instance.name: instance.box for instance in shapes.instances}
    for group, label in shapes.groups:
        own = re.fullmatch(r"group (.*): one process", label.text)
        assert own is not None
        for node in graph.nodes:
            if node.group == own[1]:
                assert is_inside(place[node.instance], group)
            else:
                assert not overlap(place[node.instance], group)


def defect(maximum: float, relative: float) -> Defect:
    return Defect(maximum, 3, 0.25, 0.5 * maximum, relative, 10)


def test_wires_say_their_defects_and_largest_has_a_ring() -> None:
    single, many = GraphVariable("y", "u", "m", "m"), [GraphVariable(f"y{n}", f"u{n}") for n in range(5)]
    array = GraphVariable("z", "w", "s", "s")
    connections = [(("a", "b", 0), single), (("b", "c", 1), array), *((("a", "c", 0), own) for own in many)]
    graph = graph_of("differs", [GraphNode(name, "M.fmu", name) for name in "abc"], connections)
    found = {
        "a.y -> b.u": defect(0.5, 0.01),
        "b.z[1,2] -> c.w[2]": defect(2.0, 0.3),
        "b.z[2,1] -> c.w[3]": defect(4.0, 0.2),
        "a.y3 -> c.u3": defect(1.0, 0.1),
        "other.y -> c.u": defect(9.0, 0.25),
    }

    picture = ET.fromstring(graph.with_status({}, defects=found).svg())  # noqa: S314  it was written here
    bare = graph.svg()

    wires = {own.get("data-source", "") + own.get("data-target", ""): own for own in picture.iter(f"{SVG}g")}
    last = {name: "".join(own.itertext()).splitlines()[-1] for name, own in wires.items() if len(name) == 2}
    assert last == {
        "ab": "assumed and came differ by at most 0.5 m (at t = 0.25 s), RMS 0.25 m",
        "bc": "b.z[1,2] -> c.w[2]: assumed and came differ by at most 2 s (at t = 0.25 s), RMS 1 s",
        "ac": "a.y3 -> c.u3: assumed and came differ by at most 1 (at t = 0.25 s), RMS 0.5",
    }
    assert [name for name, own in wires.items() if len(name) == 2 and own.find(f".//{SVG}circle") is not None] == ["bc"]
    assert "ring: " in "".join(picture.itertext())
    assert "assumed" not in bare
    assert "ring: " not in bare
    assert graph.with_status({}, defects=found).figure().axes[0].patches


def test_every_connection_is_a_wire_from_its_source_to_its_target(graph: SystemGraph) -> None:
    shapes = shapes_of(graph)
    place = {instance.name: instance.box for instance in shapes.instances}

    assert len(shapes.wires) == sum(len(edge.variables) for edge in graph.edges)
    for wire in shapes.wires:
        source, target = (place[name] for name in shapes.edges[wire.edge])
        (x, y), (end_x, end_y) = wire.path[0], wire.path[-1]
        assert x == pytest.approx(source.x + source.width)
        assert source.y < y < source.y + source.height
        assert end_x == pytest.approx(target.x)
        assert target.y < end_y < target.y + target.height


def test_no_wire_crosses_a_box(graph: SystemGraph) -> None:
    shapes = shapes_of(graph)
    boxes = [instance.box for instance in shapes.instances]
    for wire in shapes.wires:
        for (x, y), (next_x, next_y) in pairwise(wire.path):
            # A curve is a straight line here, which lies in the same rectangle.
            around = Box(min(x, next_x), min(y, next_y), abs(next_x - x), abs(next_y - y))
            inner = [Box(box.x + 0.1, box.y + 0.1, box.width - 0.2, box.height - 0.2) for box in boxes]
            assert not [box for box in inner if overlap(box, around)]


def test_without_the_edges_that_close_a_cycle_there_is_none(graph: SystemGraph) -> None:
    order = [node.instance for node in graph.nodes]
    kept = [edge for edge in graph.edges if not edge.closes_cycle]
    again = graph_of("again", graph.nodes, [((e.source, e.target, e.delay), v) for e in kept for v in e.variables])

    assert again.cycles == ()
    assert [edge for edge in kept if edge.delay == 0 and order.index(edge.source) > order.index(edge.target)] == []
    assert {edge.delay for edge in graph.edges if edge.closes_cycle} <= {1}


def test_the_text_names_all_instances_and_connections_in_80_columns(graph: SystemGraph) -> None:
    lines = graph.text().splitlines()

    assert max(map(len, lines)) <= 80
    assert {name for line in lines if (name := line.split()[0] if line else "") and "Model.fmu" in line} == {
        node.instance for node in graph.nodes
    }
    assert sum(" -> " in line for line in lines) == sum(len(edge.variables) for edge in graph.edges)


def test_long_names_are_shortened_in_80_columns() -> None:
    names = [f"{'long' * 10}_{number}" for number in range(2)]
    nodes = [GraphNode(name, f"{'Model' * 12}.fmu", "a_group" * 9) for name in names]
    variable = GraphVariable("structure.part." * 4 + "y", "structure.other." * 4 + "u", "kg.m2/(s3.A)", "kg.m2/(s3.A)")
    keys = [(names[0], names[1], 0), (names[1], names[0], 1)]
    graph = graph_of("mesh" * 30, nodes, [(key, variable) for key in keys])

    assert max(map(len, graph.text().splitlines())) <= 80
    assert "closes a cycle" in graph.text()
    assert not overlap(*(instance.box for instance in shapes_of(graph).instances))


def test_cycles_have_colours_of_their_own_and_thick_wires() -> None:
    shapes = shapes_of(made(*CASES["cycles through groups"]))
    graph = made(*CASES["cycles through groups"])
    colours = {instance.name: instance.border for instance in shapes.instances}

    assert graph.cycles == (("i3",), ("i8", "i0", "i1", "i2", "i4", "i5", "i9", "i10"))
    assert {colours[name] for name in graph.cycles[1]} == {CYCLE_COLOURS[1]}
    assert colours["i3"] == CYCLE_COLOURS[0]
    assert not {colours[name] for name in ("i6", "i7", "i11")} & {*CYCLE_COLOURS}
    for wire in shapes.wires:
        edge = graph.edges[wire.edge]
        assert (wire.colour in CYCLE_COLOURS) == (edge.cycle is not None)
        assert (wire.width > 2.0) == (edge.cycle is not None)
        assert wire.dashed == (edge.delay == 1)


def test_many_connections_of_two_instances_are_one_wire_that_names_their_number() -> None:
    nodes = [GraphNode(name, "M.fmu", name) for name in "ab"]
    graph = graph_of("many", nodes, [(("a", "b", 0), GraphVariable(f"y{n}", f"u{n}")) for n in range(30)])
    shapes = shapes_of(graph)

    assert len(shapes.wires) == 1
    assert [label.text for instance in shapes.instances for label in instance.labels].count("30 values") == 2
    assert graph.text().count(" -> ") == 30


def test_the_picture_shows_the_state_of_each_instance_without_another_layout() -> None:
    graph = made(3, [(0, 1, 0)], 1)
    look = {
        "i0": InstanceStatus("i0", "running", "", 2000, 2.0, 1e-6, 0.5, running_time=2.0),
        "i1": InstanceStatus("i1", "failed", "", 10, 0.0, 0.0, 0.0, running_time=1.0),
    }
    later = {"i0": InstanceStatus("i0", "running", "", 5000, 5.0, 1e-6, 0.75, running_time=3.0)}

    first, second = graph.with_status(look), graph.with_status(later, look)

    assert [(n.state, n.point, n.points_per_second, n.wait) for n in first.nodes] == [
        ("running", 2000, 1000.0, 0.25),
        ("failed", 10, 10.0, 0.0),
        (None, None, None, None),
    ]
    assert (second.nodes[0].points_per_second, second.nodes[0].wait) == (3000.0, 0.25)
    texts = [label.text for instance in shapes_of(first).instances for label in instance.labels]
    assert "1k points/s, waits 25 %" in texts
    assert "failed" in texts
    assert [i.box for i in shapes_of(first).instances] == [i.box for i in shapes_of(second).instances]
    assert "running, 1k points/s, waits 25 %" in first.text()


def with_keys() -> SystemGraph:
    """A graph in which one key feeds two instances, and another one goes out and comes back."""
    mesh = load(CONFIGS / "pendulum_delay.yaml")
    mesh.disconnect("pendulum.a", "delay.x")
    mesh.add("gain", fmu=FMUS / "Gain.fmu")
    mesh.subscribe("plant/in", "delay.x", time="timestamp", delay=0.5)
    mesh.subscribe("plant/in", "gain.u", encoding="text")
    mesh.publish("delay.y", "twin/out", every=0.1)
    mesh.subscribe("twin/out", "gain.k")
    return mesh.graph()


def boxes_of(graph: SystemGraph) -> dict[str | None, dict[str, str]]:
    """The box of each instance and key in the SVG."""
    root = ET.fromstring(graph.svg())  # noqa: S314  it was written here
    groups = [group for group in root.iter(f"{SVG}g") if group.get("class") == "instance"]
    return {group.get("data-instance"): dict(next(group.iter(f"{SVG}rect")).attrib) for group in groups}


def test_keys_are_boxes_with_wires_to_what_they_feed() -> None:
    graph = with_keys()
    root = ET.fromstring(graph.svg())  # noqa: S314  it was written here
    edges = [group for group in root.iter(f"{SVG}g") if group.get("class") == "edge"]

    assert graph.title == "pendulum_delay: 3 instances in 3 processes, 0 connections, 4 keys"
    assert {
        (own.get("data-source"), own.get("data-target"), *(tip.text for tip in own.iter(f"{SVG}title")))
        for own in edges
    } == {
        ("key plant/in", "delay", "key plant/in (auto) -> delay.x, at its timestamp, 0.5 s later"),
        ("delay", "key twin/out", "delay.y -> key twin/out (json), every 50 points"),
        ("key plant/in", "gain", "key plant/in (text) -> gain.u, on arrival"),
        ("key twin/out", "gain", "key twin/out (auto) -> gain.k, on arrival"),
    }
    assert len(edges) == 4
    assert sorted(map(str, boxes_of(graph))) == ["delay", "gain", "key plant/in", "key twin/out", "pendulum"]
    assert "key  delay.y -> twin/out, json, every 50 points\n" in f"{graph.text()}\n"


def test_the_picture_shows_what_came_by_keys_without_another_layout() -> None:
    graph = with_keys()
    first, *others = graph.keys
    live = KeyStatus(**msgspec.structs.asdict(first), received=12, refused=3, lost=2, rate=4.0, age=0.5)
    silent = KeyStatus(**msgspec.structs.asdict(first), received=12, rate=4.0, age=61.0)

    def shown(status: KeyStatus) -> SystemGraph:
        return graph.with_status({"delay": InstanceStatus("delay", "running", "", 1, 0.1, 0.0, 0.0, keys=(status,))})

    assert first.instance == "delay"
    assert shown(live).keys == (live, *others)
    assert "4/s, 3 refused, 2 lost" in shown(live).text()
    assert "4/s, silent for 61 s" in shown(silent).text()
    assert "4/s, 3 refused, 2 lost" in shown(live).svg()
    assert boxes_of(shown(live)) == boxes_of(shown(silent))


def test_an_svg_names_its_instances_and_edges_and_escapes_names() -> None:
    nodes = [GraphNode(name, 'a<b>&"c.fmu', name) for name in ("one", "two")]
    graph = graph_of("x<y", nodes, [(("one", "two", 0), GraphVariable('y<&"1', "u"))])

    root = ET.fromstring(graph.svg())  # noqa: S314  it was written here

    groups = {group.get("class"): dict(group.attrib) for group in root.iter(f"{SVG}g") if group.get("class")}
    assert groups["edge"] == {"class": "edge", "data-source": "one", "data-target": "two"}
    assert groups["instance"]["data-instance"] == "two"
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert 'a<b>&"c.fmu' in texts
    assert 'y<&"1' in texts


def test_the_same_graph_gives_the_same_picture(graph: SystemGraph) -> None:
    again = msgspec.json.decode(msgspec.json.encode(graph), type=SystemGraph)

    assert again == graph
    assert again.svg() == graph.svg()


def test_the_figure_has_every_text_of_the_svg() -> None:
    graph = load(CONFIGS / "path_filter.yaml").graph()
    root = ET.fromstring(graph.svg())  # noqa: S314  it was written here

    axes = graph.figure().axes[0]

    assert [text.get_text() for text in axes.texts] == [text.text for text in root.iter(f"{SVG}text")]


def test_a_wire_from_and_to_the_border_passes_what_is_between() -> None:
    layout = arranged(
        {"a": (100.0, 50.0), "b": (100.0, 50.0)},
        [Wire("a", "b", 20.0, 30.0), Wire(None, "b", 0.0, 40.0), Wire("a", None, 10.0, 0.0)],
    )

    assert [path[0][0] for path in layout.paths] == [layout.places["a"][0] + 100.0, 0.0, layout.places["a"][0] + 100.0]
    assert layout.paths[2][-1][0] == layout.width


# --- of a mesh


def test_the_graph_of_a_configuration_has_models_units_and_delays() -> None:
    graph = load(CONFIGS / "cycle2.yaml").graph(algorithm="gauss_seidel")

    assert [(node.instance, node.model, node.group) for node in graph.nodes] == [
        ("velocity", "Integrator.fmu", "velocity"),
        ("position", "Integrator.fmu", "position"),
    ]
    assert [(e.source, e.target, e.delay, e.closes_cycle, e.cycle) for e in graph.edges] == [
        ("velocity", "position", 0, False, 0),
        ("position", "velocity", 1, True, 0),
    ]


@pytest.mark.usefixtures("runtime")
def test_the_graph_of_a_running_mesh_is_that_of_its_configuration() -> None:
    mesh = load(CONFIGS / "chain8.yaml")
    planned = mesh.graph()
    with mesh.start(record="memory", paused=True) as run:
        run.wait_for("paused")
        own = run.graph()
        with attach(run.name) as attached:
            found = attached.graph()

    assert {node.state for node in own.nodes} == {"running"}
    assert own.with_status({}) == planned
    assert {node.instance: node.model for node in found.nodes} == {node.instance: node.model for node in planned.nodes}
    assert [node.state for node in found.nodes] == ["running"] * 8
    assert sorted(found.edges, key=edge_key) == sorted(planned.edges, key=edge_key)


def edge_key(edge: GraphEdge) -> tuple[str, str, int]:
    return edge.source, edge.target, edge.delay


def test_a_run_in_this_process_has_a_graph() -> None:
    with load(CONFIGS / "cycle2.yaml").start(record="memory", processes=False) as run:
        graph = run.graph()
        run.wait()

    assert [node.state for node in graph.nodes] == [None, None]


# --- the command


def test_the_command_prints_the_graph_of_a_configuration(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", str(CONFIGS / "pendulum_delay.yaml")]) == 0

    assert capsys.readouterr().out == (
        "pendulum_delay: 2 instances in 2 processes, 1 connection\n\n"
        "pendulum  DampedPendulum.fmu\n  a -> delay.x  rad\ndelay  TransportDelay.fmu\n"
    )


@pytest.mark.parametrize(
    ("suffix", "start"), [("svg", b"<svg"), ("png", b"\x89PNG"), ("pdf", b"%PDF"), ("txt", b"cyc")]
)
def test_the_ending_chooses_the_format(
    suffix: str, start: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "pictures" / f"graph.{suffix}"

    assert main(["graph", str(CONFIGS / "cycle2.yaml"), "--output", str(output)]) == 0

    assert output.read_bytes().startswith(start)
    assert capsys.readouterr().out == f"graph: {output}\n"
    assert [*output.parent.iterdir()] == [output]


def test_another_ending_is_refused_before_anything_is_read(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", "nothing.yaml", "--output", "graph.gif"]) == 2
    assert "a graph cannot be written as 'graph.gif'. Name it .svg, .png, .pdf or .txt." in capsys.readouterr().err


def test_a_folder_that_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert main(["graph", str(CONFIGS / "cycle2.yaml"), "--output", str(tmp_path / "file" / "graph.svg")]) == 2
    assert "graph.svg' cannot be written: " in capsys.readouterr().err


def test_the_command_answers_programs_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", str(CONFIGS / "cycle2.yaml"), "--json"]) == 0

    graph = msgspec.json.decode(capsys.readouterr().out, type=SystemGraph)
    assert graph == load(CONFIGS / "cycle2.yaml").graph()


@pytest.mark.usefixtures("runtime")
def test_a_mesh_that_does_not_run_is_refused_with_the_way_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["graph", "pendulum"]) == 2
    assert "no mesh" in capsys.readouterr().err
