"""A small system of our own FMUs for each row of the table in docs/ssp.md that is supported, and what it means.

What it means: connections, start values with the lines that they come from, and warnings. `test_supported_systems`
also runs each of them.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tests.fmus.event_fmus import build_event_fmu
from tests.fmus.helpers import FMUS, find_fmu
from tests.fmus.packing import repacked
from tests.ssp.packages import (
    bound,
    component,
    connection,
    connector,
    description,
    element,
    fmus,
    mapped,
    mapping_file,
    parameter,
    parameter_file,
    parameter_set,
    system,
    unit,
)

__all__ = ["SUPPORTED", "Start", "Supported"]

SSD = "SystemStructure.ssd"
VALUES = "resources/values.ssv"
NAMES = "resources/names.ssm"
DEFINITION = "application/x-ssp-definition"
PACKAGE = "application/x-ssp-package"

Make = Callable[[Path], dict[str, str | bytes]]
"""The files of a package; the folder is for FMUs that are built or changed."""


class Start(NamedTuple):
    """A start value, the text of the line that it comes from, and the file if it is not the description."""

    value: Any
    line: str
    file: str = SSD


class Supported(msgspec.Struct, frozen=True):
    """A system.

    Attributes:
        name: what of SSP it is about.
        files: of the package.
        connections: `a.y -> b.u`, with ` * FACTOR + OFFSET` and ` MAP` where they have one.
        starts: start values by `instance.variable`.
        warnings: words of each warning, in their order.
        algorithms: those that it runs with.
        ssd: the description that is chosen.
        step_size: in s, where an option gives it.
        step_sizes: those of the instances that have their own, in s.
        in_reference: whether the independent reader understands it.
    """

    name: str
    files: Make
    connections: tuple[str, ...] = ()
    starts: Mapping[str, Start] = {}
    warnings: tuple[tuple[str, ...], ...] = ()
    algorithms: tuple[str, ...] = ("jacobi",)
    ssd: str | None = None
    step_size: float | None = 0.125
    step_sizes: Mapping[str, float] = {}
    in_reference: bool = True


U, Y, K = connector("u", "input"), connector("y", "output"), connector("k", "parameter")
A = connector("a", "output")
METRE, MILLIMETRE = unit("m", m=1), unit("mm", m=1, factor=0.001)


def gain(name: str, *more: str, **attributes: Any) -> str:  # noqa: ANN401  as `component`
    """A Gain, y = k u, with all its connectors."""
    return component(name, "Gain", U, Y, K, *more, **attributes)


def pendulum(**attributes: Any) -> str:  # noqa: ANN401  as `component`
    """The source of all signals."""
    return component("pendulum", "DampedPendulum", A, **attributes)


def with_gains(*elements: str, **attributes: Any) -> Make:  # noqa: ANN401  as `system`
    """A package with a description of these elements, a pendulum in front of them."""
    root = system("root", pendulum(), *elements, **attributes)
    return lambda _folder: {SSD: description(root), **fmus("DampedPendulum", "Gain")}


# --- packaging


def _variants(_folder: Path) -> dict[str, str | bytes]:
    def of(name: str, factor: float) -> str:
        binding = bound(parameter_set(parameter("gain.k", factor)))
        return description(
            system(
                "root", pendulum(), gain("gain"), connections=[connection("pendulum.a", "gain.u")], bindings=[binding]
            ),
            name=name,
        )

    return {SSD: of("usual", 1.0), "VarB.ssd": of("strong", 3.0), **fmus("DampedPendulum", "Gain")}


def _mixed_versions(_folder: Path) -> dict[str, str | bytes]:
    values = parameter_file(parameter("length", 1.5, "Float64"), version="2.0")
    names = mapping_file(mapped("length", "pendulum.l"), version="1.0")
    root = system("root", pendulum(), bindings=[bound(VALUES, NAMES)])
    return {SSD: description(root), VALUES: values, NAMES: names, **fmus("DampedPendulum")}


# --- connectors


def _kinds(_folder: Path) -> dict[str, str | bytes]:
    untyped = component("gain", "Gain", connector("u", "unspecified", ""), connector("y", "unspecified", ""))
    modelica = 'text/x-modelica; path="Modelica.Blocks.Interfaces.RealInput"'
    dymola = component(
        "sum",
        "Adder",
        connector("u1", "input", "Binary", **{"mime-type": modelica}),
        connector("u2", "input", ""),
        connector("y", "output", "Binary", **{"mime-type": modelica.replace("Input", "Output")}),
    )
    root = system(
        "root",
        pendulum(),
        untyped,
        dymola,
        connections=[
            connection("gain.u", "pendulum.a"),
            connection("sum.u1", "gain.y"),
            connection("sum.u2", "pendulum.a"),
        ],
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain", "Adder")}


def _without_connectors(_folder: Path) -> dict[str, str | bytes]:
    root = system("root", pendulum(), component("gain", "Gain"), connections=[connection("pendulum.a", "gain.u")])
    return {SSD: description(root), **fmus("DampedPendulum", "Gain")}


def _types_of_2(folder: Path) -> dict[str, str | bytes]:
    names = ["Float64", "Float32", *(f"{sign}Int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "U")), "Boolean"]
    connectors = [connector(f"{name.lower()}_{side}", f"{side}put", name) for name in names for side in ("in", "out")]
    values = parameter_set(
        parameter("float64_parameter", "1e-3", "Float64"),
        parameter("float32_parameter", "0.5", "Float32"),
        *(parameter(f"{name.lower()}_in", 7, name) for name in names[2:-1]),
        parameter("boolean_in", "true", "Boolean"),
        parameter("string_in", " two words ", "String"),
        parameter("binary_in", "00fF10", "Binary"),
        version="2.0",
    )
    root = system(
        "root",
        component("one", "AllTypes3", *connectors, bindings=[bound(values)]),
        component("two", "AllTypes3", *connectors),
        connections=[connection(f"one.{name.lower()}_out", f"two.{name.lower()}_in") for name in names],
    )
    return {SSD: description(root, version="2.0"), **_built("AllTypes3", folder)}


def _arrays(folder: Path) -> dict[str, str | bytes]:
    two_by_two = (element("ssc:Dimension", size=2), element("ssc:Dimension", sizeConnector="columns"))
    connectors = [
        connector("columns", "structuralParameter", "UInt64"),
        connector("float64_array_in", "input", "Float64", *two_by_two),
        connector("float64_array_out", "output", "Float64", *two_by_two),
        connector("float64_in", "input", "Float64"),
        connector("float64_out", "output", "Float64"),
    ]
    sizes = (element("ssc:Dimension", size=2), element("ssc:Dimension", size=2))
    values = parameter_set(
        parameter("columns", 2, "UInt64"),
        parameter("float64_array_in", "1 2.5 -3 4e1", "Float64", *sizes),
        version="2.0",
    )
    size = parameter_set(parameter("columns", 2, "UInt64"), version="2.0")
    root = system(
        "root",
        component("one", "AllTypes3", *connectors, bindings=[bound(values)]),
        component("two", "AllTypes3", *connectors, bindings=[bound(size)]),
        component("three", "AllTypes3", *connectors, bindings=[bound(size)]),
        connections=[
            connection("one.float64_array_out", "two.float64_array_in"),
            connection("two.float64_array_out", "three.float64_in", startIndices="1 2"),
            connection("three.float64_out", "three.float64_array_in", endIndices="2 1"),
        ],
    )
    return {SSD: description(root, version="2.0"), **_built("AllTypes3", folder)}


def _alias(folder: Path) -> dict[str, str | bytes]:
    def with_alias(text: str) -> str:
        old = 'initial="exact" start="0"/>\n    <Float32 name="float32_in"'
        assert text.count(old) == 1
        return text.replace(
            old, 'initial="exact" start="0"><Alias name="mass"/></Float64>\n    <Float32 name="float32_in"'
        )

    fmu = repacked(folder / "Alias.fmu", source=find_fmu("AllTypes3", folder), description=with_alias)
    binding = bound(parameter_set(parameter("mass", 4.5)))
    root = system("root", component("body", "Alias", connector("mass", "parameter"), bindings=[binding]))
    return {SSD: description(root), "resources/Alias.fmu": fmu.read_bytes()}


# --- elements


def _inner_ssd(_folder: Path) -> dict[str, str | bytes]:
    inner = description(
        system(
            "of another name",
            component("gain", "./Gain.fmu", U, Y, K),
            connectors=[U, Y],
            connections=[connection(".u", "gain.u"), connection("gain.y", ".y")],
            bindings=[bound(parameter_set(parameter("gain.k", 2.0)))],
        )
    )
    root = system(
        "root",
        pendulum(),
        component("first", "resources/inner.ssd", U, Y, type=DEFINITION),
        component(
            "second",
            "resources/inner.ssd",
            U,
            Y,
            type=DEFINITION,
            bindings=[bound(parameter_set(parameter("gain.k", 4.0)))],
        ),
        connections=[connection("pendulum.a", "first.u"), connection("first.y", "second.u")],
    )
    return {SSD: description(root), "resources/inner.ssd": inner, **fmus("DampedPendulum", "Gain")}


def _inner_ssp(_folder: Path) -> dict[str, str | bytes]:
    def of(factor: float) -> str:
        return description(
            system(
                "inner",
                gain("gain"),
                connectors=[U, Y],
                connections=[connection(".u", "gain.u"), connection("gain.y", ".y")],
                bindings=[bound(VALUES)] if factor == 2.0 else [bound(parameter_set(parameter("gain.k", factor)))],
            )
        )

    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(SSD, of(2.0))
        archive.writestr("VarB.ssd", of(3.0))
        archive.writestr(VALUES, parameter_file(parameter("gain.k", 2.0)))
        archive.writestr("resources/Gain.fmu", (FMUS / "Gain.fmu").read_bytes())
    root = system(
        "root",
        pendulum(),
        component("usual", "resources/inner.ssp", U, Y, type=PACKAGE),
        component("variant", "resources/inner.ssp#VarB.ssd", U, Y, type=PACKAGE),
        connections=[connection("pendulum.a", "usual.u"), connection("usual.y", "variant.u")],
    )
    return {SSD: description(root), "resources/inner.ssp": data.getvalue(), **fmus("DampedPendulum")}


def _same_document(_folder: Path) -> dict[str, str | bytes]:
    binding = bound(parameter_set(parameter("gain.k", 0.5)))
    inner = system(
        "pattern",
        gain("gain"),
        connectors=[U, Y],
        connections=[connection(".u", "gain.u"), connection("gain.y", ".y")],
        id="pattern",
    )
    root = system(
        "root",
        pendulum(),
        inner,
        component("copy", "#pattern", U, Y, type=DEFINITION, bindings=[binding]),
        connections=[connection("pendulum.a", "pattern.u"), connection("pattern.y", "copy.u")],
    )
    return {SSD: description(root, version="2.0"), **fmus("DampedPendulum", "Gain")}


def _implementation(folder: Path) -> dict[str, str | bytes]:
    fmu = build_event_fmu("Oscillator", 2, folder)
    x = connector("x", "output")
    root = system(
        "root",
        component("exchanged", "Oscillator", x, implementation="ModelExchange"),
        component("simulated", "Oscillator", x, implementation="CoSimulation"),
    )
    return {SSD: description(root), "resources/Oscillator.fmu": fmu.read_bytes()}


def _names(_folder: Path) -> dict[str, str | bytes]:
    root = system(
        "root",
        gain("DP Controller"),
        gain("2nd"),
        gain("_x"),
        system("A.B", gain("C"), gain("ü"), connections=[connection("C.y", "ü.u")]),
        system("A", gain("B.C"), gain("B-C")),
        connections=[connection("DP Controller.y", "2nd.u"), connection("2nd.y", "_x.u")],
    )
    return {SSD: description(root), **fmus("Gain")}


# --- connections


def _nested(_folder: Path) -> dict[str, str | bytes]:
    deep = system(
        "deep",
        gain("gain"),
        connectors=[U, Y, connector("w", "output")],
        connections=[connection("gain.u", ".u"), connection(".y", "gain.y"), connection(".u", ".w")],
    )
    middle = system(
        "middle",
        deep,
        connectors=[U, Y, connector("w", "output")],
        connections=[connection("deep.u", ".u"), connection(".y", "deep.y"), connection(".w", "deep.w")],
    )
    root = system(
        "root",
        pendulum(),
        middle,
        component("sum", "Adder", connector("u1", "input"), connector("u2", "input"), Y),
        connectors=[Y],
        connections=[
            connection("middle.u", "pendulum.a"),
            connection("sum.u1", "middle.y"),
            connection("sum.u2", "middle.w"),
            connection(".y", "sum.y"),
        ],
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain", "Adder")}


def _cycle(*, first: str) -> Make:
    """Two gains in a cycle; the connection that the document has last closes it."""
    lines = [connection("one.y", "two.u"), connection("two.y", "sum.u2"), connection("sum.y", "one.u")]
    at = {"one": 0, "two": 1, "sum": 2}[first]
    small = bound(parameter_set(parameter("k", 0.0625)))  # substitution alone settles a loop with this gain
    root = system(
        "root",
        pendulum(),
        gain("one", bindings=[small]),
        gain("two"),
        component("sum", "Adder", connector("u1", "input"), connector("u2", "input"), Y),
        connections=[connection("pendulum.a", "sum.u1"), *lines[at:], *lines[:at]],
    )
    return lambda _folder: {SSD: description(root), **fmus("DampedPendulum", "Gain", "Adder")}


def _two_cycles(_folder: Path) -> dict[str, str | bytes]:
    """Two cycles, of which the document has two other connections last than one that both of them have."""
    small = bound(parameter_set(parameter("k", 0.0625)))  # substitution alone settles a loop with this gain
    inputs = connector("u1", "input"), connector("u2", "input")
    root = system(
        "root",
        pendulum(),
        component("sum", "Adder", *inputs, Y),
        gain("one", bindings=[small]),
        gain("two", bindings=[small]),
        component("both", "Adder", *inputs, Y),
        connections=[
            connection("pendulum.a", "sum.u1"),
            connection("both.y", "sum.u2"),
            connection("sum.y", "one.u"),
            connection("one.y", "two.u"),
            connection("two.y", "both.u2"),
            connection("one.y", "both.u1"),
        ],
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain", "Adder")}


def _units(_folder: Path) -> dict[str, str | bytes]:
    def sized(name: str, unit_of_u: str | None, unit_of_y: str | None) -> str:
        return component(
            name, "Gain", connector("u", "input", unit=unit_of_u), connector("y", "output", unit=unit_of_y)
        )

    root = system(
        "root",
        sized("metres", None, "m"),
        sized("converted", "mm", "mm"),
        sized("transformed", "m", None),
        sized("suppressed", "mm", None),
        sized("none", "", None),
        sized("undefined", "furlong", None),
        connections=[
            connection("metres.y", "converted.u"),
            connection("converted.y", "transformed.u", element("ssc:LinearTransformation", factor="2", offset="1")),
            connection(
                "metres.y",
                "suppressed.u",
                element("ssc:LinearTransformation", factor="3"),
                suppressUnitConversion="true",
            ),
            connection("metres.y", "none.u"),
            connection("metres.y", "undefined.u"),
        ],
    )
    return {SSD: description(root, units=[METRE, MILLIMETRE]), **fmus("Gain")}


def _connected_values(_folder: Path) -> dict[str, str | bytes]:
    """Values of connectors of systems: one that is not connected inside gives its value to what it is connected to."""
    inner = system(
        "inner",
        gain("gain"),
        gain("other"),
        connectors=[connector("factor", "parameter"), connector("level", "input")],
        connections=[
            connection(".factor", "gain.k", element("ssc:LinearTransformation", factor="2", offset="0")),
            connection("other.k", ".factor"),
            connection(".level", "gain.u"),
        ],
    )
    root = system(
        "root",
        inner,
        connectors=[connector("factor", "parameter")],
        connections=[connection(".factor", "inner.factor")],
        bindings=[bound(parameter_set(parameter("factor", 3.0), parameter("inner.level", 0.25)))],
    )
    return {SSD: description(root), **fmus("Gain")}


# --- parameters


def _levels(_folder: Path) -> dict[str, str | bytes]:
    """A higher level beats a lower one; at one level the later binding wins."""

    def given(name: str, value: float) -> str:
        return bound(parameter_set(parameter(name, value)))

    inner = system(
        "inner",
        gain("lowest", bindings=[given("k", 1.5), given("k", 2.5)]),
        gain("higher", bindings=[given("k", 1.5)]),
        gain("highest", bindings=[given("k", 1.5)]),
        bindings=[given("higher.k", 3.5), given("highest.k", 4.5)],
    )
    root = system("root", inner, bindings=[given("inner.highest.k", 5.5), given("inner.highest.k", 6.5)])
    return {SSD: description(root), **fmus("Gain")}


def _prefix_and_mapping(_folder: Path) -> dict[str, str | bytes]:
    values = parameter_file(
        parameter("k", 2.0), parameter("length", 500, unit="mm"), parameter("not mapped", 7.0), units=[MILLIMETRE]
    )
    names = mapping_file(
        mapped("pendulum.length", "pendulum.l", element("ssc:LinearTransformation", factor="2", offset="0.25")),
        mapped("", "pendulum.g"),
    )
    root = system(
        "root",
        pendulum(),
        gain("gain"),
        bindings=[bound(VALUES, prefix="gain."), bound(VALUES, NAMES, prefix="pendulum.")],
    )
    return {SSD: description(root), VALUES: values, NAMES: names, **fmus("DampedPendulum", "Gain")}


def _punning(_folder: Path) -> dict[str, str | bytes]:
    root = system(
        "root",
        system("B", gain("C")),
        gain("B.C"),
        bindings=[bound(parameter_set(parameter("B.C.k", 2.0)))],
    )
    return {SSD: description(root), **fmus("Gain")}


def _inside_an_fmu(folder: Path) -> dict[str, str | bytes]:
    values = parameter_file(parameter("k", 8.0))
    fmu = repacked(folder / "Gain.fmu", add={"resources/start.ssv": values.encode()})
    binding = bound("resources/start.ssv", sourceBase="component")
    return {
        SSD: description(system("root", gain("gain", bindings=[binding]))),
        "resources/Gain.fmu": fmu.read_bytes(),
    }


def _without_effect(_folder: Path) -> dict[str, str | bytes]:
    binding = bound(parameter_set(parameter("gain.kk", 1.0), parameter("gain.u", 0.5)))
    root = system(
        "root", pendulum(), gain("gain"), connections=[connection("pendulum.a", "gain.u")], bindings=[binding]
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain")}


# --- annotations, and what changes nothing


def _open_simulation_platform(_folder: Path) -> dict[str, str | bytes]:
    def annotation(inside: str) -> str:
        return element("ssc:Annotation", inside, type="com.opensimulationplatform")

    algorithm = '<osp:FixedStepAlgorithm xmlns:osp="osp" baseStepSize="0.125"/>'
    hint = '<osp:StepSizeHint xmlns:osp="osp" value="0.3"/>'
    root = system(
        "root",
        pendulum(),
        gain("gain", annotations=[annotation(hint)]),
        connections=[connection("pendulum.a", "gain.u")],
        annotations=[annotation(f"<osp:Algorithm xmlns:osp='osp'>{algorithm}</osp:Algorithm>")],
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain")}


def _open_modelica(_folder: Path) -> dict[str, str | bytes]:
    settings = (
        '<oms:SimulationInformation xmlns:oms="oms"><oms:FixedStepMaster description="oms-ma" stepSize="0.125"/>'
        '<oms:VariableStepSolver description="cvode"/></oms:SimulationInformation>'
    )
    root = system(
        "root",
        pendulum(),
        gain("gain"),
        connections=[connection("pendulum.a", "gain.u")],
        annotations=[element("ssc:Annotation", settings, type="org.openmodelica")],
    )
    return {SSD: description(root), **fmus("DampedPendulum", "Gain")}


def _decorated(_folder: Path) -> dict[str, str | bytes]:
    geometry = '<ssd:ElementGeometry x1="0" y1="0" x2="10" y2="5"/>'
    meta = (
        '<ssc:MetaData kind="quality" type="application/x-stmd"><ssc:Content/>'
        '<ssc:Signature role="authenticity" type="application/x-pgp"><ssc:Content/></ssc:Signature></ssc:MetaData>'
    )
    signature = '<ssc:Signature role="authenticity" type="application/x-pgp"><ssc:Content/></ssc:Signature>'
    foreign = '<ssc:Annotation type="com.example.tool"><x xmlns="urn:x"/></ssc:Annotation>'
    decorated = element(
        "ssd:Component",
        element("ssd:Connectors", A.replace("/>", '/><ssd:ConnectorGeometry x="1" y="0.5"/>', 1)),
        geometry,
        meta,
        element("ssd:Annotations", foreign),
        name="pendulum",
        source="resources/DampedPendulum.fmu",
        description="swings",
        id="p",
    )
    line = connection("pendulum.a", "gain.u", '<ssd:ConnectionGeometry pointsX="1 2" pointsY="0 0"/>')
    root = element(
        "ssd:System",
        element("ssd:Elements", decorated, gain("gain")),
        element("ssd:Connections", line),
        '<ssd:SystemGeometry x1="0" y1="0" x2="100" y2="50"/>',
        '<ssd:GraphicalElements><ssd:Note x1="0" y1="0" x2="9" y2="9" text="see above"/></ssd:GraphicalElements>',
        signature,
        element("ssd:Annotations", foreign),
        name="root",
    )
    return {
        SSD: description(root, version="2.0"),
        "documentation/index.html": "<html/>",
        "extra/com.example/notes.txt": "mine",
        **fmus("DampedPendulum", "Gain"),
    }


def _built(name: str, folder: Path) -> dict[str, bytes]:
    return {f"resources/{name}.fmu": find_fmu(name, folder).read_bytes()}


_TYPE_NAMES = (
    "float64",
    "float32",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
    "boolean",
)

SUPPORTED = (
    Supported(
        "the default variant",
        _variants,
        ("pendulum.a -> gain.u",),
        {"gain.k": Start(1.0, "gain.k")},
    ),
    Supported(
        "a variant by its file",
        _variants,
        ("pendulum.a -> gain.u",),
        {"gain.k": Start(3.0, "gain.k", "VarB.ssd")},
        ssd="VarB.ssd",
    ),
    Supported(
        "a variant by its name",
        _variants,
        ("pendulum.a -> gain.u",),
        {"gain.k": Start(3.0, "gain.k", "VarB.ssd")},
        ssd="strong",
    ),
    Supported("files of both versions", _mixed_versions, (), {"pendulum.l": Start(1.5, "length", VALUES)}),
    Supported(
        "kinds and types that the FMU says",
        _kinds,
        ("pendulum.a -> gain.u", "gain.y -> sum.u1", "pendulum.a -> sum.u2"),
        algorithms=("jacobi", "gauss_seidel"),
    ),
    Supported(
        "connectors that are not listed",
        _without_connectors,
        ("pendulum.a -> gain.u",),
        warnings=(("'gain' has no connector 'u'",),),
    ),
    Supported(
        "the types of SSP 2.0",
        _types_of_2,
        tuple(f"one.{name}_out -> two.{name}_in" for name in _TYPE_NAMES),
        {
            "one.float64_parameter": Start(0.001, "float64_parameter"),
            "one.float32_parameter": Start(0.5, "float32_parameter"),
            **{f"one.{name}_in": Start(7, f'"{name}_in"') for name in _TYPE_NAMES[2:-1]},
            "one.boolean_in": Start(value=True, line="boolean_in"),
            "one.string_in": Start(" two words ", "string_in"),
            "one.binary_in": Start("AP8Q", "binary_in"),
        },
        in_reference=False,
    ),
    Supported(
        "arrays",
        _arrays,
        (
            "one.float64_array_out -> two.float64_array_in",
            "two.float64_array_out[1,2] -> three.float64_in",
            "three.float64_out -> three.float64_array_in[2,1]",
        ),
        {
            "one.columns": Start(2, "columns"),
            "one.float64_array_in": Start([[1.0, 2.5], [-3.0, 40.0]], "float64_array_in"),
            "two.columns": Start(2, "columns"),
            "three.columns": Start(2, "columns"),
        },
        in_reference=False,
    ),
    Supported("an alias of FMI 3.0", _alias, (), {"body.float64_parameter": Start(4.5, "mass")}, in_reference=False),
    Supported(
        "systems in other files",
        _inner_ssd,
        ("pendulum.a -> first-gain.u", "first-gain.y -> second-gain.u"),
        {
            "first-gain.k": Start(2.0, "gain.k", "resources/inner.ssd"),
            "second-gain.k": Start(4.0, "gain.k"),
        },
        in_reference=False,
    ),
    Supported(
        "a package inside a package",
        _inner_ssp,
        ("pendulum.a -> usual-gain.u", "usual-gain.y -> variant-gain.u"),
        {
            "usual-gain.k": Start(2.0, "gain.k", f"resources/inner.ssp/{VALUES}"),
            "variant-gain.k": Start(3.0, "gain.k", "resources/inner.ssp/VarB.ssd"),
        },
        in_reference=False,
    ),
    Supported(
        "a system of the same document again",
        _same_document,
        ("pendulum.a -> pattern-gain.u", "pattern-gain.y -> copy-gain.u"),
        {"copy-gain.k": Start(0.5, "gain.k")},
        in_reference=False,
    ),
    Supported("implementations", _implementation, ()),
    Supported(
        "names of any text",
        _names,
        (
            "A-46-B-C.y -> A-46-B--252-.u",
            "DP-32-Controller.y -> _-50-nd.u",
            "_-50-nd.y -> _x.u",
        ),
    ),
    Supported(
        "nested systems, written backwards",
        _nested,
        ("pendulum.a -> middle-deep-gain.u", "middle-deep-gain.y -> sum.u1", "pendulum.a -> sum.u2"),
        algorithms=("jacobi", "gauss_seidel"),
    ),
    Supported(
        "two cycles that share a connection",
        _two_cycles,
        (
            "pendulum.a -> sum.u1",
            "both.y -> sum.u2",
            "one.y -> two.u",
            "two.y -> both.u2",
            "one.y -> both.u1",
            "sum.y -> one.u",
        ),
        {"one.k": Start(0.0625, 'name="k"'), "two.k": Start(0.0625, 'name="k"')},
        warnings=(("a loop at every point", "sum.y -> one.u"),),
        algorithms=("jacobi", "gauss_seidel"),
    ),
    *(
        Supported(
            f"a cycle that is written from {first} on",
            _cycle(first=first),
            (
                "pendulum.a -> sum.u1",
                *lines,
            ),
            {"one.k": Start(0.0625, 'name="k"')},
            warnings=(("a loop at every point", *lines),),
            algorithms=("jacobi", "gauss_seidel"),
        )
        for first, lines in (
            ("one", ("one.y -> two.u", "two.y -> sum.u2", "sum.y -> one.u")),
            ("two", ("two.y -> sum.u2", "sum.y -> one.u", "one.y -> two.u")),
            ("sum", ("sum.y -> one.u", "one.y -> two.u", "two.y -> sum.u2")),
        )
    ),
    Supported(
        "units of connectors",
        _units,
        (
            "metres.y -> converted.u * 1000 + 0",
            "converted.y -> transformed.u * 0.002 + 1",
            "metres.y -> suppressed.u * 3 + 0",
            "metres.y -> none.u",
            "metres.y -> undefined.u",
        ),
        warnings=(("'furlong'", "does not define"), ("'m'", "'furlong'", "unconverted")),
    ),
    Supported(
        "values of connectors of systems",
        _connected_values,
        (),
        {
            "inner-gain.k": Start(6.0, '"factor"'),
            "inner-other.k": Start(3.0, '"factor"'),
            "inner-gain.u": Start(0.25, "inner.level"),
        },
    ),
    Supported(
        "levels of bindings",
        _levels,
        (),
        {
            "inner-lowest.k": Start(2.5, "k"),
            "inner-higher.k": Start(3.5, "higher.k"),
            "inner-highest.k": Start(6.5, "inner.highest.k"),
        },
    ),
    Supported(
        "a prefix, a mapping and units of values",
        _prefix_and_mapping,
        (),
        {"gain.k": Start(2.0, 'name="k"', VALUES), "pendulum.l": Start(1.25, "length", VALUES)},
        (
            ("'gain.length'",),
            ("'gain.not mapped'",),
            ("an empty source",),
        ),
    ),
    Supported(
        "two elements of one hierarchical name",
        _punning,
        (),
        {"B-C.k": Start(2.0, "B.C.k"), "B-46-C.k": Start(2.0, "B.C.k")},
    ),
    Supported(
        "values inside an FMU",
        _inside_an_fmu,
        (),
        {"gain.k": Start(8.0, "k", "resources/Gain.fmu/resources/start.ssv")},
        in_reference=False,
    ),
    Supported(
        "values without effect",
        _without_effect,
        ("pendulum.a -> gain.u",),
        {"gain.u": Start(0.5, "gain.u")},
        (("'gain.kk'", "'gain.k'"), ("a start value for 'u'", "it has no effect")),
    ),
    Supported(
        "step sizes of the Open Simulation Platform",
        _open_simulation_platform,
        ("pendulum.a -> gain.u",),
        warnings=(("the step size 0.3 s", "0.25 s is taken", "a whole multiple of 0.125 s"),),
        step_size=None,
        step_sizes={"gain": 0.25},
    ),
    Supported(
        "the step size of OMSimulator",
        _open_modelica,
        ("pendulum.a -> gain.u",),
        warnings=(("the VariableStepSolver for the whole system 'root' is not used",),),
        step_size=None,
    ),
    Supported(
        "what changes nothing",
        _decorated,
        ("pendulum.a -> gain.u",),
        warnings=(("signature", "application/x-pgp"), ("'com.example.tool'", "no effect")),
    ),
)
"""The systems."""
