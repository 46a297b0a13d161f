"""A good package, and many that have one fault each: what a small edit makes of it, and what must be said about that.

What must be said: the file, the line (that of the text ``at``), the words for the element, and words of the message.
"""

from __future__ import annotations

import stat
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec

from tests.ssp.packages import Files, fmus

__all__ = ["BAD_ARCHIVES", "BAD_PACKAGES", "GOOD", "Edit", "Fault", "edited"]

SSD = "SystemStructure.ssd"
VALUES = "resources/values.ssv"
NAMES = "resources/names.ssm"
INNER = "inner.ssd"

GOOD_SSD = """\
<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription name="good" version="1.0"
    xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
    xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
    xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
    xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
  <ssd:System name="root">
    <ssd:Connectors>
      <ssd:Connector name="k" kind="parameter"><ssc:Real/></ssd:Connector>
      <ssd:Connector name="out" kind="output"><ssc:Real/></ssd:Connector>
    </ssd:Connectors>
    <ssd:ParameterBindings>
      <ssd:ParameterBinding source="resources/values.ssv">
        <ssd:ParameterMapping source="resources/names.ssm"/>
      </ssd:ParameterBinding>
    </ssd:ParameterBindings>
    <ssd:Elements>
      <ssd:Component name="pendulum" type="application/x-fmu-sharedlibrary" source="resources/DampedPendulum.fmu">
        <ssd:Connectors>
          <ssd:Connector name="a" kind="output"><ssc:Real unit="rad"/></ssd:Connector>
          <ssd:Connector name="l" kind="parameter"><ssc:Real unit="m"/></ssd:Connector>
        </ssd:Connectors>
      </ssd:Component>
      <ssd:System name="inner">
        <ssd:Connectors>
          <ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>
          <ssd:Connector name="y" kind="output"><ssc:Real/></ssd:Connector>
        </ssd:Connectors>
        <ssd:Elements>
          <ssd:Component name="gain" source="resources/Gain.fmu" implementation="CoSimulation">
            <ssd:Connectors>
              <ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>
              <ssd:Connector name="k" kind="parameter"><ssc:Real/></ssd:Connector>
              <ssd:Connector name="y" kind="output"><ssc:Real/></ssd:Connector>
            </ssd:Connectors>
          </ssd:Component>
        </ssd:Elements>
        <ssd:Connections>
          <ssd:Connection startConnector="u" endElement="gain" endConnector="u"/>
          <ssd:Connection startElement="gain" startConnector="y" endConnector="y"/>
        </ssd:Connections>
      </ssd:System>
      <ssd:Component name="delay" source="resources/TransportDelay.fmu">
        <ssd:Connectors>
          <ssd:Connector name="x" kind="input"><ssc:Real/></ssd:Connector>
          <ssd:Connector name="y" kind="output"><ssc:Real/></ssd:Connector>
        </ssd:Connectors>
        <ssd:ParameterBindings>
          <ssd:ParameterBinding>
            <ssd:ParameterValues>
              <ssv:ParameterSet version="1.0" name="of the delay">
                <ssv:Parameters>
                  <ssv:Parameter name="d"><ssv:Real value="0.25"/></ssv:Parameter>
                </ssv:Parameters>
              </ssv:ParameterSet>
            </ssd:ParameterValues>
          </ssd:ParameterBinding>
        </ssd:ParameterBindings>
      </ssd:Component>
    </ssd:Elements>
    <ssd:Connections>
      <ssd:Connection startElement="pendulum" startConnector="a" endElement="inner" endConnector="u">
        <ssc:LinearTransformation factor="2.0" offset="0.5"/>
      </ssd:Connection>
      <ssd:Connection startElement="inner" startConnector="y" endElement="delay" endConnector="x"/>
      <ssd:Connection startElement="delay" startConnector="y" endConnector="out"/>
    </ssd:Connections>
  </ssd:System>
  <ssd:Units>
    <ssc:Unit name="rad"><ssc:BaseUnit rad="1"/></ssc:Unit>
    <ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>
  </ssd:Units>
  <ssd:DefaultExperiment startTime="0.0" stopTime="1.0">
    <ssd:Annotations>
      <ssc:Annotation type="org.openmodelica">
        <oms:SimulationInformation xmlns:oms="oms">
          <oms:FixedStepMaster description="oms-ma" stepSize="0.01"/>
        </oms:SimulationInformation>
      </ssc:Annotation>
    </ssd:Annotations>
  </ssd:DefaultExperiment>
</ssd:SystemStructureDescription>
"""

GOOD_SSV = """\
<?xml version="1.0" encoding="UTF-8"?>
<ssv:ParameterSet version="1.0" name="values"
    xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
    xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues">
  <ssv:Parameters>
    <ssv:Parameter name="length"><ssv:Real value="2.0" unit="m"/></ssv:Parameter>
    <ssv:Parameter name="factor"><ssv:Real value="1.5"/></ssv:Parameter>
  </ssv:Parameters>
  <ssv:Units>
    <ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>
  </ssv:Units>
</ssv:ParameterSet>
"""

GOOD_SSM = """\
<?xml version="1.0" encoding="UTF-8"?>
<ssm:ParameterMapping version="1.0"
    xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
    xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
  <ssm:MappingEntry source="length" target="pendulum.l"/>
  <ssm:MappingEntry source="factor" target="inner.gain.k"/>
</ssm:ParameterMapping>
"""

GOOD: Files = {SSD: GOOD_SSD, VALUES: GOOD_SSV, NAMES: GOOD_SSM, **fmus("DampedPendulum", "Gain", "TransportDelay")}
"""A package with a nested system, connectors of systems, a transformation, an external and an inline binding."""


class Edit(msgspec.Struct, frozen=True):
    """Another text for one that stands exactly once in a file; a file without ``old`` is new."""

    old: str
    new: str
    file: str = SSD


class Fault(msgspec.Struct, frozen=True):
    """A fault.

    Attributes:
        name: of the fault.
        edits: what makes it out of the good package.
        at: a text that stands once in ``file``, in the line that must be named; empty: no line is.
        element: the words for the element; empty: there is none.
        words: parts of the message.
        count: findings of the whole package.
        without: files that the package does not have.
    """

    name: str
    edits: tuple[Edit, ...]
    at: str
    element: str
    words: tuple[str, ...]
    file: str = SSD
    count: int = 1
    without: tuple[str, ...] = ()


def edited(*edits: Edit, without: tuple[str, ...] = ()) -> dict[str, str | bytes]:
    """The files of the good package with these edits."""
    files = {name: content for name, content in GOOD.items() if name not in without}
    for edit in edits:
        text = files.get(edit.file, "")
        assert isinstance(text, str)
        assert not edit.old or text.count(edit.old) == 1, f"{edit.old!r} is not once in {edit.file}"
        files[edit.file] = text.replace(edit.old, edit.new) if edit.old else edit.new
    return files


INNER_Y = '<ssd:Connection startElement="gain" startConnector="y" endConnector="y"/>'
INNER_U = '<ssd:Connection startConnector="u" endElement="gain" endConnector="u"/>'
INTO_INNER = '<ssd:Connection startElement="pendulum" startConnector="a" endElement="inner" endConnector="u">'
INTO_DELAY = '<ssd:Connection startElement="inner" startConnector="y" endElement="delay" endConnector="x"/>'
LAST = '<ssd:Connection startElement="delay" startConnector="y" endConnector="out"/>'
PENDULUM_A = '<ssd:Connector name="a" kind="output"><ssc:Real unit="rad"/></ssd:Connector>'
PENDULUM_L = '<ssd:Connector name="l" kind="parameter"><ssc:Real unit="m"/></ssd:Connector>'
DELAY_X = '<ssd:Connector name="x" kind="input"><ssc:Real/></ssd:Connector>'
LINEAR = '<ssc:LinearTransformation factor="2.0" offset="0.5"/>'
PENDULUM_FMU = "resources/DampedPendulum.fmu"
GAIN_FMU = "resources/Gain.fmu"
DELAY = '<ssd:Component name="delay" source="resources/TransportDelay.fmu">'
GAIN_K = '<ssd:Connector name="k" kind="parameter"><ssc:Real/></ssd:Connector>\n              <ssd'
D_VALUE = '<ssv:Parameter name="d"><ssv:Real value="0.25"/></ssv:Parameter>'
BINDING = '<ssd:ParameterBinding source="resources/values.ssv">'
MAPPING = '<ssd:ParameterMapping source="resources/names.ssm"/>'
FACTOR = '<ssv:Parameter name="factor"><ssv:Real value="1.5"/></ssv:Parameter>'
TO_GAIN = '<ssm:MappingEntry source="factor" target="inner.gain.k"/>'
ELEMENTS_END = "</ssd:Component>\n    </ssd:Elements>"
STEP_SIZE = 'stepSize="0.01"'


def fault(
    name: str,
    *edits: tuple[str, str] | tuple[str, str, str],
    file: str = SSD,
    at: str,
    element: str,
    words: tuple[str, ...],
    count: int = 1,
    without: tuple[str, ...] = (),
) -> Fault:
    """A fault; an edit without a file is one of ``file``."""
    written = tuple(Edit(*edit) if len(edit) == 3 else Edit(*edit, file) for edit in edits)
    return Fault(name, written, at, element, words, file, count, without)


def one_more(connection: str) -> tuple[str, str]:
    """The edit that adds a connection to the root system."""
    return LAST, f"{LAST}\n      {connection}"


SECOND_SOURCE = '<ssd:Connection startElement="pendulum" startConnector="a" endElement="delay" endConnector="x"/>'
OUT_OUT = '<ssd:Connection startElement="pendulum" startConnector="a" endElement="inner" endConnector="y"/>'
IN_IN = '<ssd:Connection startElement="delay" startConnector="x" endElement="inner" endConnector="u"/>'
TO_ITSELF = '<ssd:Connection startElement="inner" startConnector="y" endElement="inner" endConnector="u">'
NUMBERS = """<ssc:IntegerMappingTransformation>
          <ssc:MapEntry source="1" target="2"/>
          <ssc:MapEntry source="01" target="3"/>
        </ssc:IntegerMappingTransformation>"""
AGAIN = '<ssd:Component name="again" type="application/x-ssp-definition" source="SystemStructure.ssd"/>'
INLINE = """
          <ssd:ParameterValues>
            <ssv:ParameterSet version="1.0" name="inline"><ssv:Parameters/></ssv:ParameterSet>
          </ssd:ParameterValues>"""

CONNECTIONS = (
    fault(
        "two sources",
        one_more(SECOND_SOURCE),
        at=SECOND_SOURCE,
        element="Connection 'pendulum.a - delay.x' of System 'root'",
        words=("a second source for 'delay.x'", "'pendulum.a', after 'inner.y'", "in line 65"),
    ),
    fault(
        "an output of an element to another",
        one_more(OUT_OUT),
        at=OUT_OUT,
        element="Connection 'pendulum.a - inner.y' of System 'root'",
        words=(
            "'pendulum.a' (output of an element) and 'inner.y' (output of an element)",
            "a source and a destination",
        ),
    ),
    fault(
        "an input of an element to another",
        one_more(IN_IN),
        at=IN_IN,
        element="Connection 'delay.x - inner.u' of System 'root'",
        words=("'delay.x' (input of an element) and 'inner.u' (input of an element)", "a source and a destination"),
    ),
    fault(
        "a system input from inside",
        (INNER_U, INNER_U.replace('endConnector="u"', 'endConnector="y"')),
        (INNER_Y, ""),
        at='endElement="gain" endConnector="y"',
        element="Connection 'u - gain.y' of System 'inner'",
        words=("'inner.u' (input of the system) and 'inner.gain.y' (output of an element)",),
    ),
    fault(
        "an element that does not exist",
        (INTO_DELAY, INTO_DELAY.replace('"inner"', '"iner"')),
        at='"iner"',
        element="Connection 'iner.y - delay.x' of System 'root'",
        words=("the unknown element 'iner' of the system 'root'", "pendulum, inner, delay", "Did you mean 'inner'?"),
    ),
    fault(
        "a connector that the FMU does not have",
        (INNER_U, INNER_U.replace('endConnector="u"', 'endConnector="U1"')),
        at='"U1"',
        element="Connection 'u - gain.U1' of System 'inner'",
        words=("the unknown connector 'U1' of 'gain'", "one of u, k, y", "Did you mean 'u'?"),
    ),
    fault(
        "a connector that the system does not have",
        (LAST, LAST.replace('"out"', '"outt"')),
        at='"outt"',
        element="Connection 'delay.y - outt' of System 'root'",
        words=("the unknown connector 'outt' of the system 'root'", "one of k, out", "Did you mean 'out'?"),
    ),
    fault(
        "units of other dimensions",
        (DELAY_X, DELAY_X.replace("<ssc:Real/>", '<ssc:Real unit="m"/>')),
        (
            INTO_DELAY,
            INTO_DELAY.replace('startElement="inner" startConnector="y"', 'startElement="pendulum" startConnector="a"'),
        ),
        at='startElement="pendulum" startConnector="a" endElement="delay"',
        element="Connection 'pendulum.a - delay.x' of System 'root'",
        words=("'pendulum.a' in 'rad'", "'delay.x' in 'm'", "units of one dimension", 'suppressUnitConversion="true"'),
    ),
    fault(
        "units of other dimensions on the way through a system",
        (
            '<ssd:Connector name="u" kind="input"><ssc:Real/></ssd:Connector>\n          <ssd',
            '<ssd:Connector name="u" kind="input"><ssc:Real unit="m"/></ssd:Connector>\n          <ssd',
        ),
        at=INTO_INNER,
        element="Connection 'pendulum.a - inner.u' of System 'root'",
        words=("'pendulum.a' in 'rad'", "'inner.u' in 'm'"),
    ),
    fault(
        "an index on a connector of a system",
        (INTO_DELAY, INTO_DELAY.replace("/>", ' startIndices="1"/>')),
        ('name="good" version="1.0"', 'name="good" version="2.0"'),
        at='startIndices="1"',
        element="Connection 'inner.y - delay.x' of System 'root'",
        words=("an element of the connector 'y' of a system", "elements of the arrays of components only"),
    ),
    fault(
        "a circle of connectors of systems",
        (INTO_INNER, TO_ITSELF),
        (INNER_Y, '<ssd:Connection startConnector="u" endConnector="y"/>'),
        (LINEAR, ""),
        at='<ssd:Connection startConnector="u" endConnector="y"/>',
        element="Connection 'u - y' of System 'inner'",
        words=("a circle of connectors of systems", "'inner.y'", "a source that computes the value"),
    ),
    fault(
        "a mapping with a source twice",
        (LINEAR, NUMBERS),
        at='source="01"',
        element="MapEntry",
        words=("a second entry for the source '1'", "one entry for each source", "line 64"),
        count=2,  # and numbers cannot be mapped
    ),
    fault(
        "a mapping of floating-point numbers",
        (LINEAR, NUMBERS.replace('"01"', '"2"')),
        at="<ssc:IntegerMappingTransformation>",
        element="connections[0].map",
        words=("a map from a Real to a Real", "between Boolean, integer types and Enumeration only"),
    ),
    fault(
        "two transformations",
        (LINEAR, f"{LINEAR}\n<ssc:BooleanMappingTransformation/>"),
        at="<ssc:BooleanMappingTransformation/>",
        element="BooleanMappingTransformation of Connection 'pendulum.a - inner.u'",
        words=("a second transformation", "one at most"),
        count=2,  # and the mapping has no entry
    ),
    fault(
        "a factor that is no number",
        ('factor="2.0"', 'factor="2,0"'),
        at='factor="2,0"',
        element="LinearTransformation of Connection 'pendulum.a - inner.u'",
        words=("factor '2,0'", "a number"),
    ),
)

ELEMENTS = (
    fault(
        "a kind that is not the causality of the FMU",
        (PENDULUM_L, PENDULUM_L.replace('"parameter"', '"input"')),
        at='name="l" kind="input"',
        element="Connector 'l' of Component 'pendulum'",
        words=("the kind 'input'", "causality 'parameter'", "expected the kind 'parameter'"),
    ),
    fault(
        "a connector of a variable that the FMU does not have",
        (DELAY_X, DELAY_X.replace('name="x"', 'name="xx"')),
        (INTO_DELAY, INTO_DELAY.replace('"x"', '"xx"')),
        at='endConnector="xx"',
        element="Connection 'inner.y - delay.xx' of System 'root'",
        words=("the variable 'xx', which the FMU of 'delay' does not have",),
    ),
    fault(
        "a kind that does not exist",
        (PENDULUM_L, PENDULUM_L.replace('"parameter"', '"parametr"')),
        at='kind="parametr"',
        element="Connector 'l' of Component 'pendulum'",
        words=("kind 'parametr'", "one of input, output", "Did you mean 'parameter'?"),
    ),
    fault(
        "two elements of one name",
        (
            '<ssd:System name="inner">',
            '<ssd:Component name="pendulum" source="resources/Gain.fmu"/>\n<ssd:System name="inner">',
        ),
        at='<ssd:Component name="pendulum" source="resources/Gain.fmu"/>',
        element="Component 'pendulum' of System 'root'",
        words=("a second element 'pendulum', first in line 18",),
    ),
    fault(
        "two connectors of one name",
        (PENDULUM_L, f"{PENDULUM_A}"),
        at="",  # the line after that of the first one; both lines have one text
        element="Connector 'a' of Component 'pendulum'",
        words=(":21:", "a second connector 'a', first in line 20"),
    ),
    fault(
        "a component without a source",
        (DELAY, '<ssd:Component name="delay">'),
        at='<ssd:Component name="delay">',
        element="Component 'delay' of System 'root'",
        words=("no source: nothing computes it", "an FMU as its source"),
    ),
    fault(
        "scheduled execution",
        ('implementation="CoSimulation"', 'implementation="ScheduledExecution"'),
        at="ScheduledExecution",
        element="Component 'gain' of System 'inner'",
        words=("the implementation 'ScheduledExecution'", "CoSimulation or ModelExchange"),
    ),
    fault(
        "an implementation that does not exist",
        ('implementation="CoSimulation"', 'implementation="Cosimulation"'),
        at='"Cosimulation"',
        element="Component 'gain' of System 'inner'",
        words=("implementation 'Cosimulation'", "Did you mean 'CoSimulation'?"),
    ),
    fault(
        "a kind that the FMU does not have",
        ('implementation="CoSimulation"', 'implementation="ModelExchange"'),
        at='implementation="ModelExchange"',
        element="instances.inner-gain",
        words=("bad.ssp/resources/Gain.fmu", "is for co-simulation only, not for model exchange"),
    ),
    fault(
        "a component in Modelica",
        ('type="application/x-fmu-sharedlibrary"', 'type="text/x-modelica"'),
        at='type="text/x-modelica"',
        element="Component 'pendulum' of System 'root'",
        words=("the type 'text/x-modelica'", "application/x-fmu-sharedlibrary"),
    ),
    fault(
        "a reference to a signal dictionary",
        (
            ELEMENTS_END,
            ELEMENTS_END.replace("\n", '\n<ssd:SignalDictionaryReference name="bus" dictionary="signals"/>\n'),
        ),
        at="SignalDictionaryReference",
        element="SignalDictionaryReference 'bus' of System 'root'",
        words=("a reference to a signal dictionary", "connections between the connectors themselves"),
    ),
    fault(
        "a system that contains itself",
        (ELEMENTS_END, ELEMENTS_END.replace("\n", f"\n{AGAIN}\n")),
        at=AGAIN,
        element="Component 'again' of System 'root'",
        words=("inside", "itself"),
    ),
    fault(
        "an id that no system has",
        (
            DELAY,
            DELAY.replace(
                'source="resources/TransportDelay.fmu"', 'type="application/x-ssp-definition" source="#pump"'
            ),
        ),
        at='source="#pump"',
        element="Component 'delay' of System 'root'",
        words=("the source '#pump'", "the id of a System in SystemStructure.ssd"),
    ),
)

SOURCES = tuple(
    fault(
        name,
        (GAIN_FMU, source),
        at=source,
        element="Component 'gain' of System 'inner'",
        words=words,
    )
    for name, source, words in (
        ("a path out of the package", "../Gain.fmu", ("the source '../Gain.fmu', which leads out of the package",)),
        ("a path out of the package, coded", "resources/%2E%2E/../../Gain.fmu", ("which leads out of the package",)),
        ("an absolute path", "/etc/Gain.fmu", ("the source '/etc/Gain.fmu', which leads out of the package",)),
        (
            "a backslash",
            "resources\\Gain.fmu",
            (
                "with a backslash",
                "resources/Gain.fmu",
            ),
        ),
        (
            "an FMU that is not there",
            "resources/Gian.fmu",
            ("no such file 'resources/Gian.fmu'", "'resources/Gain.fmu'?"),
        ),
        (
            "an FMU behind proxyfmu",
            "proxyfmu://localhost?file=Gain.fmu",
            ("scheme 'proxyfmu'", "a path inside the package"),
        ),
        ("an FMU behind http", "http://example.com/Gain.fmu", ("the scheme 'http'", "a path inside the package")),
        ("a file URI", "file:///tmp/Gain.fmu", ("the scheme 'file'", "a path inside the package")),
        ("a URI of a drive", "C:/models/Gain.fmu", ("no such file 'C:/models/Gain.fmu'", "'resources/Gain.fmu'?")),
    )
)

EXPERIMENT = (
    fault(
        "a stop time that is no number",
        ('stopTime="1.0"', 'stopTime="one"'),
        at='stopTime="one"',
        element="DefaultExperiment",
        words=("stopTime 'one'", "a number"),
        count=2,  # and an option could give it
    ),
    fault(
        "a stop time before the start time",
        ('startTime="0.0"', 'startTime="2.0"'),
        at="",
        element="simulation.stop_time",
        words=("1", "2"),
    ),
    fault(
        "no stop time",
        (' stopTime="1.0"', ""),
        at="",
        element="simulation.stop_time",
        words=("`stop_time`",),
    ),
    fault(
        "no step size and no algorithm",
        ("FixedStepMaster", "VariableStepMaster"),
        at="",
        element="simulation.step_size",
        words=("`step_size`",),
        count=2,
    ),
    fault(
        "no algorithm and no step size",
        ("org.openmodelica", "org.example"),
        at="",
        element="simulation.algorithm",
        words=("`algorithm=",),
        count=2,
    ),
    fault(
        "a step size that is none",
        (STEP_SIZE, 'stepSize="-0.01"'),
        at='<ssc:Annotation type="org.openmodelica">',
        element="Annotation 'org.openmodelica'",
        words=("FixedStepMaster with stepSize '-0.01'", "a step size > 0 in s"),
    ),
)

XML = (
    fault(
        "a root in another namespace",
        (
            "http://ssp-standard.org/SSP1/SystemStructureDescription",
            "http://www.pmsf.net/xsd/SystemStructureDescriptionDraft",
        ),
        at="xmlns:ssm=",
        element="SystemStructureDescription",
        words=("SystemStructureDescriptionDraft", "'http://ssp-standard.org/SSP1/SystemStructureDescription'"),
    ),
    fault(
        "a child in another namespace",
        (DELAY_X, DELAY_X.replace("<ssc:Real/>", "<ssd:Real/>")),
        at="<ssd:Real/>",
        element="Real of Connector 'x'",
        words=("the element Real of the namespace", "SystemStructureDescription", "in Connector"),
    ),
    fault(
        "a child without a namespace",
        (DELAY_X, DELAY_X.replace("<ssc:Real/>", '<Real xmlns=""/>')),
        at='<Real xmlns=""/>',
        element="Real of Connector 'x'",
        words=("the element Real without a namespace in Connector",),
    ),
    fault(
        "a prefix that is bound to no namespace",
        (LAST, f'{LAST}<osp:Bond name="b"/>'),
        at="<osp:Bond",
        element="",
        words=("the prefix 'osp' of osp:Bond, which is bound to no namespace", 'xmlns:osp="..."'),
    ),
    fault(
        "a version that does not exist",
        ('name="good" version="1.0"', 'name="good" version="3.0"'),
        at="xmlns:ssm=",
        element="SystemStructureDescription 'good'",
        words=("the version '3.0'", "1.0 or 2.0"),
    ),
    fault(
        "no version",
        ('name="good" version="1.0"', 'name="good"'),
        at="xmlns:ssm=",
        element="SystemStructureDescription 'good'",
        words=("no attribute 'version'",),
    ),
    fault(
        "an element that does not exist",
        ("<ssd:Units>", "<ssd:Units/><ssd:DefaultExperimant/>\n  <!-- <ssd:Units>"),
        ("</ssd:Units>", "-->"),
        at="DefaultExperimant",
        element="DefaultExperimant",
        words=("the element DefaultExperimant in SystemStructureDescription", "Did you mean 'DefaultExperiment'?"),
    ),
    fault(
        "an attribute that does not exist",
        (LAST, LAST.replace("/>", ' suppressUnitConversions="true"/>')),
        at="suppressUnitConversions",
        element="Connection 'delay.y - out' of System 'root'",
        words=("the attribute 'suppressUnitConversions'", "Did you mean 'suppressUnitConversion'?"),
    ),
    fault(
        "an attribute that is missing",
        (LAST, LAST.replace(' endConnector="out"', "")),
        at='<ssd:Connection startElement="delay" startConnector="y"/>',
        element="Connection",
        words=("no attribute 'endConnector'", "a name that is not empty"),
    ),
    fault(
        "an empty name",
        (f"{INTO_DELAY}\n      {LAST}", ""),
        (DELAY, DELAY.replace('name="delay"', 'name=""')),
        at='name=""',
        element="Component 'resources/TransportDelay.fmu' of System 'root'",
        words=("name ''", "a name that is not empty"),
    ),
    fault(
        "a Boolean that is none",
        (LAST, LAST.replace("/>", ' suppressUnitConversion="yes"/>')),
        at='suppressUnitConversion="yes"',
        element="Connection 'delay.y - out'",
        words=("suppressUnitConversion 'yes'", "true or false"),
    ),
    fault(
        "two lists of bindings",
        (
            "</ssd:ParameterBindings>\n    <ssd:Elements>",
            "</ssd:ParameterBindings>\n<ssd:ParameterBindings/>\n<ssd:Elements>",
        ),
        at="<ssd:ParameterBindings/>",
        element="ParameterBindings of System 'root'",
        words=("a second ParameterBindings in System 'root'", "one at most"),
    ),
    fault(
        "XML that is not well-formed",
        ("</ssd:Elements>\n    <ssd:Connections>", "<ssd:Connections>"),
        at="</ssd:System>\n  <ssd:Units>",
        element="",
        words=("no well-formed XML", "Elements"),
    ),
    fault(
        "a system inside it that refers to it",
        (
            ELEMENTS_END,
            ELEMENTS_END.replace(
                "\n", '\n<ssd:Component name="again" source="#top" type="application/x-ssp-definition"/>\n'
            ),
        ),
        ('<ssd:System name="root">', '<ssd:System name="root" id="top">'),
        at='source="#top"',
        element="Component 'again' of System 'root'",
        words=("the system '#top' inside itself",),
    ),
    fault(
        "a document type",
        (
            "<ssd:SystemStructureDescription name",
            '<!DOCTYPE ssd [<!ENTITY a "aaaa">]>\n<ssd:SystemStructureDescription name',
        ),
        at="<!DOCTYPE",
        element="",
        words=("a document type", "expand without limit"),
    ),
    fault(
        "an encoding that the text does not have",
        ('encoding="UTF-8"', 'encoding="UTF-16"'),
        at="<?xml",
        element="",
        words=("no well-formed XML",),
    ),
    fault(
        "a parameter mapping instead of a system",
        ("<ssd:SystemStructureDescription name", "<ssm:ParameterMapping name"),
        ("</ssd:SystemStructureDescription>", "</ssm:ParameterMapping>"),
        at="xmlns:ssm=",
        element="ParameterMapping 'good'",
        words=("the root element ParameterMapping", "SystemStructureDescription"),
    ),
    fault(
        "a unit without base units",
        ('<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>', '<ssc:Unit name="m"/>'),
        at='<ssc:Unit name="m"/>',
        element="Unit 'm'",
        words=("no BaseUnit", "one"),
    ),
    fault(
        "two units of one name",
        (
            '<ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>',
            '<ssc:Unit name="rad"><ssc:BaseUnit m="1"/></ssc:Unit>',
        ),
        at='<ssc:Unit name="rad"><ssc:BaseUnit m="1"/></ssc:Unit>',
        element="Unit 'rad'",
        words=("a second unit 'rad'",),
    ),
    fault(
        "a unit that makes everything 0",
        ('<ssc:BaseUnit m="1"/>', '<ssc:BaseUnit m="1" factor="0"/>'),
        at='factor="0"',
        element="BaseUnit of Unit 'm'",
        words=("factor 0", "a finite factor that is not 0"),
    ),
)

BINDINGS = (
    fault(
        "an SSV file that is not there",
        (BINDING, BINDING.replace("values", "value")),
        at="resources/value.ssv",
        element="ParameterBinding 'resources/value.ssv'",
        words=("no such file 'resources/value.ssv'", "Did you mean 'resources/values.ssv'?"),
    ),
    fault(
        "an SSM file that is not there",
        (MAPPING, MAPPING.replace("names", "name")),
        at="resources/name.ssm",
        element="ParameterMapping 'resources/name.ssm'",
        words=("no such file 'resources/name.ssm'", "Did you mean 'resources/names.ssm'?"),
    ),
    fault(
        "values in a file and beside it",
        (BINDING, f"{BINDING}{INLINE}"),
        at=BINDING,
        element="ParameterBinding 'resources/values.ssv' of System 'root'",
        words=("a source and a ParameterSet inside it", "one of the two"),
    ),
    fault(
        "a binding without values",
        (BINDING, "<ssd:ParameterBinding>\n<!-- no source -->"),
        at="<ssd:ParameterBinding>\n<!--",
        element="ParameterBinding of System 'root'",
        words=("neither a source nor a ParameterSet", "one of the two"),
    ),
    fault(
        "a binding of another type",
        (BINDING, BINDING.replace(" source", ' type="text/csv" source')),
        at="text/csv",
        element="ParameterBinding 'resources/values.ssv'",
        words=("the type 'text/csv'", "application/x-ssp-parameter-set"),
    ),
    fault(
        "a source in the component of a system",
        (BINDING, BINDING.replace(" source", ' sourceBase="component" source')),
        at="sourceBase",
        element="ParameterBinding 'resources/values.ssv'",
        words=("sourceBase 'component'", "SSD"),
    ),
    fault(
        "a file of the wrong kind",
        (MAPPING, MAPPING.replace("names.ssm", "values.ssv")),
        file=SSD,
        at="",
        element="ParameterSet 'values'",
        words=("resources/values.ssv:4", "the root element ParameterSet", "expected ParameterMapping"),
    ),
    fault(
        "an inline value of another type",
        (D_VALUE, D_VALUE.replace('Real value="0.25"', 'String value="short"')),
        at='String value="short"',
        element="Parameter 'd'",
        words=("the String value 'short' for the Real 'd'",),
    ),
    fault(
        "an inline value of a unit with another dimension",
        (D_VALUE, D_VALUE.replace('value="0.25"', 'value="0.25" unit="m"')),
        at='unit="m"/></ssv:Parameter>',
        element="Parameter 'd'",
        words=("'m'", "'s'"),
    ),
    fault(
        "an SSV in another namespace",
        (
            "http://ssp-standard.org/SSP1/SystemStructureParameterValues",
            "http://www.pmsf.net/xsd/SystemStructureParameterValuesDraft",
        ),
        file=VALUES,
        at="xmlns:ssv=",
        element="ParameterSet",
        words=("SystemStructureParameterValuesDraft", "'http://ssp-standard.org/SSP1/SystemStructureParameterValues'"),
    ),
    fault(
        "an SSV with a number that is none",
        (FACTOR, FACTOR.replace("1.5", "1,5")),
        file=VALUES,
        at="1,5",
        element="Real of Parameter 'factor'",
        words=("the value '1,5'", "a number such as 2.5"),
    ),
    fault(
        "an SSV with a parameter twice",
        (FACTOR, FACTOR.replace("factor", "length")),
        file=VALUES,
        at='<ssv:Parameter name="length"><ssv:Real value="1.5"/>',
        element="Parameter 'length'",
        words=("a second parameter 'length'", "line 6"),
    ),
    fault(
        "an SSV with a parameter without a type",
        (FACTOR, '<ssv:Parameter name="factor"/>'),
        file=VALUES,
        at='<ssv:Parameter name="factor"/>',
        element="Parameter 'factor'",
        words=("no type", "one of Real"),
    ),
    fault(
        "an SSV with an element that does not exist",
        (FACTOR, FACTOR.replace("ssv:Real", "ssv:Reel")),
        file=VALUES,
        at="ssv:Reel",
        element="Reel of Parameter 'factor'",
        words=("the element Reel in Parameter", "Did you mean 'Real'?"),
        count=2,  # and the parameter has no type
    ),
    fault(
        "an SSM with two entries for one target",
        (TO_GAIN, TO_GAIN.replace("inner.gain.k", "pendulum.l")),
        file=NAMES,
        at='source="factor" target="pendulum.l"',
        element="MappingEntry 'factor to pendulum.l'",
        words=("a second entry for the target 'pendulum.l'", "line 5"),
    ),
    fault(
        "an SSM with a mapping of Boolean values for a number",
        (
            TO_GAIN,
            TO_GAIN.replace(
                "/>",
                '><ssc:BooleanMappingTransformation><ssc:MapEntry source="true" target="false"/>'
                "</ssc:BooleanMappingTransformation></ssm:MappingEntry>",
            ),
            NAMES,
        ),
        file=VALUES,
        at=FACTOR,
        element="Parameter 'factor'",
        words=("the Real value 1.5 for the Real 'k' of 'inner.gain'", "BooleanMappingTransformation"),
    ),
    fault(
        "an SSM of another version",
        ('ParameterMapping version="1.0"', 'ParameterMapping version="1.1"'),
        file=NAMES,
        at="xmlns:ssm=",
        element="ParameterMapping",
        words=("the version '1.1'", "1.0 or 2.0"),
    ),
)

BAD_PACKAGES = (*CONNECTIONS, *ELEMENTS, *SOURCES, *EXPERIMENT, *XML, *BINDINGS)
"""Faults in the XML files of a package."""


def _zipped(path: Path, files: Files = GOOD) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def _without_a_description(path: Path) -> None:
    _zipped(path, edited(without=(SSD,)))


def _with_another_description(path: Path) -> None:
    _zipped(path, {**edited(without=(SSD,)), "VarA.ssd": GOOD_SSD})


def _with_a_folder_around(path: Path) -> None:
    _zipped(path, {f"good/{name}": content for name, content in GOOD.items()})


def _with_a_bomb(path: Path) -> None:
    _zipped(path, {**GOOD, "extra/zeros.bin": bytes(200_000_000)})


def _encrypted(path: Path) -> None:
    _zipped(path)
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)


def _with_a_way_out(path: Path) -> None:
    _zipped(path, {**GOOD, "../evil.txt": "evil"})


def _with_a_file_twice(path: Path) -> None:
    _zipped(path)
    with zipfile.ZipFile(path, "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr(SSD, GOOD_SSD.replace("inner", "other"))


def _with_a_link(path: Path) -> None:
    _zipped(path)
    link = zipfile.ZipInfo("resources/passwd.ssv")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    link.create_system = 3
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc/passwd")


def _cut_off(path: Path) -> None:
    _zipped(path)
    path.write_bytes(path.read_bytes()[:5000])


def _no_archive(path: Path) -> None:
    path.write_text(GOOD_SSD, encoding="utf-8")


def _with_a_text_for_an_fmu(path: Path) -> None:
    _zipped(path, {**GOOD, GAIN_FMU: "no FMU"})


BAD_ARCHIVES: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no description": (_without_a_description, ("has no SystemStructure.ssd at its root", "Is it a package of SSP?")),
    "another description": (_with_another_description, ("has no SystemStructure.ssd", "VarA.ssd", "`ssd=...`")),
    "a folder around": (_with_a_folder_around, ("has no SystemStructure.ssd", "zip what is inside that folder")),
    "a bomb": (_with_a_bomb, ("bad.ssp", "times as large when it is unpacked; the limit is 200")),
    "encrypted": (_encrypted, ("bad.ssp", "encrypted")),
    "a way out": (_with_a_way_out, ("bad.ssp", "'../evil.txt'")),
    "a file twice": (_with_a_file_twice, ("bad.ssp", "two entries with one name", SSD)),
    "a link": (_with_a_link, ("bad.ssp", "link")),
    "cut off": (_cut_off, ("bad.ssp",)),
    "no archive": (_no_archive, ("bad.ssp",)),
    "a text for an FMU": (_with_a_text_for_an_fmu, ("resources/Gain.fmu",)),
}
"""Faults of archives: what writes one, and words of the message."""
