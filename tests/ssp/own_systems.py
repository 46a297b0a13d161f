"""Small systems of our own FMUs: each of them is about one thing that a system structure can say."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from tests.fmus.event_fmus import build_event_fmu
from tests.fmus.helpers import find_fmu

__all__ = ["SYSTEMS", "OwnSystem", "make_folder", "make_package"]

_NAMESPACES = " ".join(
    f'xmlns:{prefix}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for prefix, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
    )
)


class OwnSystem(NamedTuple):
    """A system that runs.

    Attributes:
        system: the element `System`.
        fmus: names of our FMUs; `Rotor2` is the model `Rotor` of the event FMUs for FMI 2.0.
        files: other files by name.
        more: elements after the system.
        version: of SSP.
        step_size: in s; ``stop_time`` likewise.
    """

    system: str
    fmus: tuple[str, ...]
    files: Mapping[str, str] = {}
    more: str = ""
    version: str = "1.0"
    step_size: float = 0.125
    stop_time: float = 2.0


def make_folder(own: OwnSystem, folder: Path) -> Path:
    """Write a system as an unpacked package."""
    resources = folder / "resources"
    resources.mkdir(parents=True)
    for name in own.fmus:
        model, version = name.rstrip("123"), name[-1]
        if model in _EVENT_FMUS:
            simple = {"only": "co_simulation", "hasEventMode": "false"} if version == "3" else {}
            fmu = build_event_fmu(model, int(version), folder.parent / "built", **simple)  # type: ignore[arg-type]  # 1, 2 or 3
        else:
            fmu = find_fmu(name, folder.parent / "built")
        shutil.copyfile(fmu, resources / f"{name}.fmu")
    for name, text in own.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    text = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<ssd:SystemStructureDescription {_NAMESPACES} name="own" '
        f'version="{own.version}">\n{own.system}\n{own.more}'
        f'<ssd:DefaultExperiment startTime="0" stopTime="{own.stop_time}"/>\n</ssd:SystemStructureDescription>\n'
    )
    (folder / "SystemStructure.ssd").write_text(text, encoding="utf-8")
    return folder


def make_package(own: OwnSystem, folder: Path, name: str = "own") -> Path:
    """Write a system as an .ssp."""
    unpacked = make_folder(own, folder / f"{name}_unpacked")
    package = folder / f"{name}.ssp"
    with zipfile.ZipFile(package, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(unpacked.rglob("*")):
            if file.is_file():
                archive.write(file, file.relative_to(unpacked).as_posix())
    return package


_EVENT_FMUS = ("Integral", "Oscillator", "Rotor", "Stairs", "Winding")


# --- the words of a system structure


def _attributes(**values: str) -> str:
    return "".join(f" {key}={quoteattr(value)}" for key, value in values.items())


def _connectors(spec: str) -> str:
    """Connectors from `u:input y:output:Real:unit=K`; a `%20` in a name is a blank."""
    texts = []
    for part in spec.split():
        name, kind, *rest = part.split(":")
        type_, *attributes = rest or ["Real"]
        own = "".join(f' {key}="{value}"' for key, _, value in (one.partition("=") for one in attributes))
        texts.append(
            f'<ssd:Connector name="{name.replace("%20", " ")}" kind="{kind}"><ssc:{type_}{own}/></ssd:Connector>'
        )
    return f"<ssd:Connectors>{''.join(texts)}</ssd:Connectors>" if texts else ""


def _component(name: str, fmu: str, connectors: str = "", bindings: str = "", **attributes: str) -> str:
    own = _attributes(name=name, source=f"resources/{fmu}.fmu", **attributes)
    return f"<ssd:Component{own}>{_connectors(connectors)}{_bound(bindings)}</ssd:Component>\n"


def _system(name: str, elements: str, *connections: str, connectors: str = "", bindings: str = "") -> str:
    inside = f"<ssd:Elements>\n{elements}</ssd:Elements>" if elements else ""
    wires = f"<ssd:Connections>{''.join(connections)}</ssd:Connections>" if connections else ""
    return f'<ssd:System name="{name}">{_connectors(connectors)}{_bound(bindings)}{inside}{wires}</ssd:System>\n'


def _bound(bindings: str) -> str:
    return f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else ""


def _wire(start: tuple[str, str] | str, end: tuple[str, str] | str, change: str = "", **attributes: str) -> str:
    """A connection; an end is (element, connector), or a connector of the system itself."""
    names = {}
    for side, own in (("start", start), ("end", end)):
        if isinstance(own, tuple):
            names[f"{side}Element"] = own[0]
        names[f"{side}Connector"] = own if isinstance(own, str) else own[1]
    return f"<ssd:Connection{_attributes(**names, **attributes)}>{change}</ssd:Connection>\n"


def _linear(factor: float = 1.0, offset: float = 0.0) -> str:
    return f'<ssc:LinearTransformation factor="{factor}" offset="{offset}"/>'


def _mapped(kind: str, **entries: str) -> str:
    texts = "".join(f'<ssc:MapEntry source="{key.strip("_")}" target="{value}"/>' for key, value in entries.items())
    return f"<ssc:{kind}MappingTransformation>{texts}</ssc:{kind}MappingTransformation>"


def _set(*parameters: str, units: str = "", version: str = "1.0") -> str:
    """A parameter set of `name=1.5`, `name=1.5 unit` or `name=Integer:3`."""
    texts = []
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        type_, colon, text = value.partition(":")
        if not colon:
            type_, text = "Real", value
        text, _, unit = text.partition(" ")
        unit_text = f' unit="{unit}"' if unit else ""
        texts.append(f'<ssv:Parameter name="{name}"><ssv:{type_} value="{text}"{unit_text}/></ssv:Parameter>')
    return (
        f'<ssv:ParameterSet {_NAMESPACES} version="{version}" name="set"><ssv:Parameters>{"".join(texts)}'
        f"</ssv:Parameters>{f'<ssv:Units>{units}</ssv:Units>' if units else ''}</ssv:ParameterSet>"
    )


def _mapping(*entries: str, version: str = "1.0") -> str:
    return f'<ssm:ParameterMapping {_NAMESPACES} version="{version}">{"".join(entries)}</ssm:ParameterMapping>'


def _entry(source: str, target: str, change: str = "", **attributes: str) -> str:
    return f"<ssm:MappingEntry{_attributes(source=source, target=target, **attributes)}>{change}</ssm:MappingEntry>"


def _binding(values: str, mapping: str = "", **attributes: str) -> str:
    """A binding; an .ssv or .ssm is the name of a file, everything else is inline."""
    own = _attributes(source=values, **attributes) if values.endswith(".ssv") else _attributes(**attributes)
    inline = "" if values.endswith(".ssv") else f"<ssd:ParameterValues>{values}</ssd:ParameterValues>"
    if mapping.endswith(".ssm"):
        inline += f'<ssd:ParameterMapping source="{mapping}"/>'
    elif mapping:
        inline += f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping>"
    return f"<ssd:ParameterBinding{own}>{inline}</ssd:ParameterBinding>"


def _unit(name: str, **base: float) -> str:
    return f'<ssc:Unit name="{name}"><ssc:BaseUnit{_attributes(**{k: str(v) for k, v in base.items()})}/></ssc:Unit>'


_TEMPERATURES = _unit("K", K=1) + _unit("degC", K=1, offset=273.15) + _unit("degF", K=1, factor=0.5555, offset=255.37)
_WIRED = "u:input y:output"
_TYPES = (
    "real_in:input real_out:output integer_in:input:Integer integer_out:output:Integer boolean_in:input:Boolean "
    "boolean_out:output:Boolean string_in:input:String string_out:output:String "
    "enumeration_in:input:Enumeration:name=Gear enumeration_out:output:Enumeration:name=Gear"
)
_GEARS = (
    '<ssd:Enumerations><ssc:Enumeration name="Gear"><ssc:Item name="low" value="1"/><ssc:Item name="middle" value="2"/>'
    '<ssc:Item name="high" value="3"/></ssc:Enumeration></ssd:Enumerations>\n'
)


# --- the systems


def _nested() -> OwnSystem:
    """Systems in systems, one input for two components, connections backwards, names that are any text."""
    inner = _system(
        "3rd level",
        _component("gain.a", "Gain", _WIRED, _binding(_set("k=3.0"))) + _component("1 gain", "Gain", _WIRED),
        _wire(("gain.a", "u"), "x"),
        _wire("x", ("1 gain", "u")),
        _wire("left", ("gain.a", "y")),
        _wire(("1 gain", "y"), "right"),
        connectors="x:input left:output right:output",
    )
    outer = _system(
        "outer",
        _component("sum", "Adder", "u1:input u2:input y:output") + inner,
        _wire(("3rd level", "x"), "in"),
        _wire(("sum", "u1"), ("3rd level", "left")),
        _wire(("3rd level", "right"), ("sum", "u2")),
        _wire("total", ("sum", "y")),
        connectors="in:input total:output",
    )
    return OwnSystem(
        _system(
            "root",
            _component("DP Controller", "DampedPendulum", "a:output")
            + outer
            + _component("tank", "Integrator", _WIRED),
            _wire(("outer", "in"), ("DP Controller", "a")),
            _wire(("tank", "u"), ("outer", "total")),
            _wire(("tank", "y"), "level"),
            connectors="level:output",
        ),
        ("DampedPendulum", "Gain", "Adder", "Integrator"),
    )


def _cycle(*, last: str) -> OwnSystem:
    """A cycle of three: with Gauss-Seidel the connection that comes last gets the delay."""
    wires = {
        "a": _wire(("first", "y"), ("second", "u")),
        "b": _wire(("second", "y"), ("third", "u")),
        "c": _wire(("third", "y"), ("first", "u")),
    }
    order = [wire for name, wire in wires.items() if name != last] + [wires[last]]
    elements = "".join(
        _component(name, "Integrator", _WIRED, _binding(_set(f"y={start}", f"k={k}")))
        for name, start, k in (("first", 1.0, -0.7), ("second", 0.5, 1.1), ("third", -0.25, 0.9))
    )
    return OwnSystem(_system("root", elements, *order), ("Integrator",))


def _units() -> OwnSystem:
    """Units of connectors where the FMU has none; on each part of a chain, first the conversion of units."""
    inner = _system(
        "inner",
        _component("kelvin", "Gain", "u:input:Real:unit=K y:output:Real:unit=K"),
        _wire("t", ("kelvin", "u"), _linear(2.0, 1.0)),
        connectors="t:input:Real:unit=degF",
    )
    return OwnSystem(
        _system(
            "root",
            _component("source", "Integrator", "u:input y:output:Real:unit=degC", _binding(_set("y=20.0", "u=0.5")))
            + inner
            + _component("none", "Gain", "u:input:Real:unit= y:output")
            + _component("plain", "Gain", "u:input:Real:unit=K y:output")
            + _component("unknown", "Gain", "u:input:Real:unit=furlong y:output")
            + _component("passed", "Gain", "u:input:Real:unit=K y:output"),
            _wire(("source", "y"), ("inner", "t"), _linear(1.5)),
            _wire(("source", "y"), ("none", "u")),
            _wire(("source", "y"), ("plain", "u"), _linear(offset=4.0), suppressUnitConversion="true"),
            _wire(("source", "y"), ("unknown", "u")),
            _wire(("source", "y"), ("passed", "u")),
        ),
        ("Integrator", "Gain"),
        more=f"<ssd:Units>{_TEMPERATURES}</ssd:Units>\n",
    )


def _chain() -> OwnSystem:
    """What FMPy can run, too: outputs that are 0 at the start, and connections from start to end."""
    outer = _system(
        "outer",
        _component("gain", "Gain", _WIRED),
        _wire("u", ("gain", "u")),
        _wire(("gain", "y"), "y"),
        connectors="u:input y:output",
    )
    return OwnSystem(
        _system(
            "root",
            _component("source", "DriveProfile", "linearVelocity:output")
            + outer
            + _component("sum", "Adder", "u1:input u2:input y:output")
            + _component("tank", "Integrator", _WIRED),
            _wire(("source", "linearVelocity"), ("outer", "u")),
            _wire(("outer", "y"), ("sum", "u1")),
            _wire(("source", "linearVelocity"), ("sum", "u2")),
            _wire(("sum", "y"), ("tank", "u")),
        ),
        ("DriveProfile", "Gain", "Adder", "Integrator"),
    )


def _parameters() -> OwnSystem:
    """Bindings of three levels, inline and in files, with prefixes, mappings and units."""
    inner = _system(
        "inner",
        _component("low", "Gain", _WIRED, _binding(_set("k=2.0", "u=1.0", "nothing=5.0")))
        + _component("twice", "Gain", _WIRED, _binding(_set("k=2.0", "u=1.0")) + _binding(_set("k=3.0")))
        + _component("higher", "Gain", _WIRED, _binding(_set("k=2.0", "u=1.0"))),
        bindings=_binding(_set("k=10.0"), prefix="higher.") + _binding(_set("low.u=-1.5")),
    )
    transformed = _mapping(
        _entry("temperature", "hot.u", _linear(2.0, 1.0)),
        _entry("temperature", "raw.u", _linear(2.0, 1.0), suppressUnitConversion="true"),
        _entry("temperature", "hot.k", suppressUnitConversion="1"),
        _entry("", "raw.k"),
        _entry("missing", "raw.k"),
    )
    return OwnSystem(
        _system(
            "root",
            inner
            + _component("hot", "Gain", "u:input:Real:unit=K k:parameter y:output")
            + _component("raw", "Gain", "u:input:Real:unit=K y:output")
            + _component("file", "Integrator", _WIRED),
            bindings=_binding("top.ssv", "top.ssm")
            + _binding(_set("temperature=20.0 degC", units=_TEMPERATURES), transformed)
            + _binding(_set("file.y=5.0", "inner.higher.u=7.0", "tank.y=1.0"))
            + _binding("file.ssv", prefix="file."),
        ),
        ("Gain", "Integrator"),
        files={
            "top.ssv": _set("gain=4.0", "inner.low.k=99.0", "inner.twice.u=0.25", version="2.0"),
            "top.ssm": _mapping(_entry("gain", "inner.low.k"), _entry("inner.twice.u", "inner.twice.u"), version="2.0"),
            "file.ssv": _set("k=0.5", "u=8.0"),
        },
        more=f"<ssd:Units>{_TEMPERATURES}</ssd:Units>\n",
    )


def _connected_parameters() -> OwnSystem:
    """A parameter of a system that is connected to those of components: they take its value, whoever else gives one."""
    inner = _system(
        "inner",
        _component("a", "Gain", "u:input k:parameter y:output", _binding(_set("k=1.25", "u=1.0")))
        + _component("b", "Gain", "u:input k:parameter y:output", _binding(_set("k=1.25", "u=1.0")))
        + _component("c", "Gain", "u:input k:parameter y:output", _binding(_set("k=1.25"))),
        _wire("factor", ("a", "k")),
        _wire(("b", "k"), "factor", _linear(10.0, 0.5)),
        _wire("unset", ("c", "k")),
        _wire("drive", ("c", "u")),
        connectors="factor:parameter unset:parameter drive:input",
        bindings=_binding(_set("factor=-1.0", "a.k=77.0", "drive=6.0")),
    )
    return OwnSystem(
        _system(
            "root",
            inner + _component("d", "Gain", "u:input k:parameter:Real:unit=K y:output", _binding(_set("u=1.0"))),
            _wire("gain", ("inner", "factor")),
            _wire(("d", "k"), "gain"),
            connectors="gain:parameter:Real:unit=degC",
            bindings=_binding(_set("gain=3.0", "inner.a.k=55.0")),
        ),
        ("Gain",),
        more=f"<ssd:Units>{_TEMPERATURES}</ssd:Units>\n",
    )


def _types() -> OwnSystem:
    """All types of FMI 2.0, with mappings of Boolean, Integer and Enumeration, and an Integer for an Enumeration."""
    given = _set(
        "boolean_in=Boolean:true",
        "integer_in=Integer:3",
        "enumeration_in=Enumeration:high",
        "string_in=String:text",
        "real_in=0.5",
    )
    return OwnSystem(
        _system(
            "root",
            _component("source", "AllTypes", _TYPES, _binding(given))
            + _component("same", "AllTypes", _TYPES)
            + _component("mapped", "AllTypes", _TYPES)
            + _component("mixed", "AllTypes", _TYPES),
            *(
                _wire(("source", f"{type_}_out"), ("same", f"{type_}_in"))
                for type_ in ("boolean", "integer", "enumeration", "string", "real")
            ),
            _wire(("source", "boolean_out"), ("mapped", "boolean_in"), _mapped("Boolean", true="false", false="true")),
            _wire(("source", "integer_out"), ("mapped", "integer_in"), _mapped("Integer", _3="30", _0="7")),
            _wire(
                ("source", "enumeration_out"),
                ("mapped", "enumeration_in"),
                _mapped("Enumeration", high="low", low="middle"),
            ),
            _wire(("mixed", "enumeration_in"), ("source", "integer_out"), _mapped("Integer", _0="2")),
            _wire(("mixed", "real_in"), ("source", "integer_out")),
        ),
        ("AllTypes",),
        more=_GEARS,
    )


def _dc_motor() -> OwnSystem:
    """A DC motor of two models for model exchange, its source and load beside them, and units of the files only."""
    motor = _system(
        "SuT",
        _component(
            "rotor",
            "Rotor2",
            "M_A:input:Real:unit=N.m M_B:input:Real:unit=N.m w:output:Real:unit=rad/s J:parameter d:parameter",
            _binding(_set("J=0.002", "d=0.001")),
            implementation="ModelExchange",
        )
        + _component(
            "winding",
            "Winding2",
            "U:input:Real:unit=V w:input:Real:unit=rad/s I:output:Real:unit=A M:output:Real:unit=N.m "
            "R:parameter:Real:unit=Ohm L:parameter k:parameter",
            _binding("winding.ssv"),
            implementation="ModelExchange",
        ),
        _wire(("rotor", "w"), "w"),
        _wire("M_load", ("rotor", "M_B")),
        _wire("U", ("winding", "U")),
        _wire(("rotor", "M_A"), ("winding", "M")),
        _wire(("winding", "w"), ("rotor", "w")),
        _wire(("winding", "I"), "I"),
        connectors="U:input:Real:unit=V M_load:input:Real:unit=N.m w:output:Real:unit=rad/s I:output:Real:unit=A",
    )
    return OwnSystem(
        _system(
            "motor",
            motor
            + _component("voltage", "Gain", "y:output:Real:unit=V", _binding(_set("u=12.0")))
            + _component("load", "Gain", "y:output:Real:unit=N.m", _binding(_set("u=-0.5"))),
            _wire(("SuT", "w"), "w"),
            _wire(("voltage", "y"), ("SuT", "U")),
            _wire(("SuT", "M_load"), ("load", "y")),
            _wire("U", ("voltage", "y")),
            connectors="w:output U:output:Real",
        ),
        ("Rotor2", "Winding2", "Gain"),
        files={
            "winding.ssv": _set(
                "R=500.0 mOhm", "L=0.001", "k=0.1", units=_unit("mOhm", **_OHM, factor=0.001), version="2.0"
            )
        },
        more=f"<ssd:Units>{_MOTOR_UNITS}</ssd:Units>\n",
        version="2.0",
        step_size=0.001,
        stop_time=3.0,
    )


_OHM = {"kg": 1, "m": 2, "s": -3, "A": -2}
_MOTOR_UNITS = (
    _unit("V", kg=1, m=2, s=-3, A=-1)
    + _unit("N.m", kg=1, m=2, s=-2)
    + _unit("rad/s", rad=1, s=-1)
    + _unit("A", A=1)
    + _unit("Ohm", **_OHM)
)


def _versions() -> OwnSystem:
    """FMI 1.0, 2.0 and 3.0, co-simulation and model exchange, in a system of SSP 2.0."""
    return OwnSystem(
        _system(
            "root",
            _component("source", "DampedPendulum", "a:output")
            + _component("old", "AllTypes1", "real_in:input real_out:output")
            + _component("new", "Oscillator3", "u:input:Float64 x:output:Float64 y:output")
            + _component("model", "Oscillator2", "x:output u:input", implementation="ModelExchange")
            + _component("both", "Integral2", "s:output u:input", implementation="CoSimulation"),
            _wire(("source", "a"), ("old", "real_in")),
            _wire(("old", "real_out"), ("new", "u")),
            _wire(("new", "x"), ("model", "u")),
            _wire(("model", "x"), ("both", "u")),
        ),
        ("DampedPendulum", "AllTypes1", "Oscillator3", "Oscillator2", "Integral2"),
        version="2.0",
        step_size=0.0625,
    )


SYSTEMS: Mapping[str, Callable[[], OwnSystem]] = {
    "nested": _nested,
    "cycle a": lambda: _cycle(last="a"),
    "cycle b": lambda: _cycle(last="b"),
    "cycle c": lambda: _cycle(last="c"),
    "chain": _chain,
    "units": _units,
    "parameters": _parameters,
    "connected parameters": _connected_parameters,
    "types": _types,
    "versions": _versions,
    "dc motor": _dc_motor,
}
