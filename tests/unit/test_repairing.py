"""Model descriptions that break a rule of FMI: what is repaired and told, and that nothing else is half read."""

from __future__ import annotations

import copy
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from lxml import etree

from fmu_mesh.errors import LoadFailed
from fmu_mesh.instances.fmi.archive.reading import read_description
from fmu_mesh.variables.model_description import ModelDescription, Variable
from tests.fmus.helpers import FMUS, SOURCES

GAIN = zipfile.ZipFile(FMUS / "Gain.fmu").read("modelDescription.xml").decode()
EVENTS = (SOURCES / "Events3" / "modelDescription.xml").read_text()
STEPS = (SOURCES / "Steps1" / "modelDescription.xml").read_text()
TYPES = (SOURCES / "AllTypes3" / "modelDescription.xml").read_text()

K = 'causality="parameter" variability="tunable" initial="exact"'
Y = 'causality="output" variability="continuous" initial="calculated"'
MODE = '<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="a" value="1"/></Enumeration></SimpleType>'
UNIT = '<UnitDefinitions><Unit name="mm"><BaseUnit m="1" factor="0,001"/></Unit></UnitDefinitions>'
SCHEMA = ' xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:schemaLocation="a b"'
VENDOR = '<VendorAnnotations><Tool name="t"><a:b xmlns:a="urn:a"/></Tool></VendorAnnotations>'
STATE = (("CoSimulation", "ModelExchange"), ("Outputs>", "Derivatives>"), ('index="2" dependencies="1"', 'index="9"'))
WORDS = re.compile(
    r"NoneType|index out of|invalid literal|unexpected keyword|could not convert|has no attribute|by zero|iterable"
    r"|argument|object|Error|subscript|unpack|unhashable|keeps it from being read"
)
"""What Python says, and what we say where we do not know more."""


def read(folder: Path, xml: str | bytes) -> ModelDescription:
    """The description of an FMU that is nothing else."""
    (folder / "modelDescription.xml").write_bytes(xml if isinstance(xml, bytes) else xml.encode())
    return read_description(folder, to_run=False)


def named(description: ModelDescription, name: str) -> Variable:
    """One of its variables."""
    [found] = [one for one in description.variables if one.name == name]
    return found


def gain(*changes: tuple[str, str]) -> str:
    """The description of the gain with other parts."""
    text = GAIN
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def variable(causality: str, variability: str | None, type_: str = "Real") -> str:
    """The description of the gain with one more variable `v`."""
    written = "" if variability is None else f' variability="{variability}"'
    one = f'<ScalarVariable name="v" valueReference="9" causality="{causality}"{written}><{type_}/></ScalarVariable>'
    return gain(("</ModelVariables>", one + "</ModelVariables>"))


VARIABILITIES = [
    ("parameter", None, "Real", "fixed"),
    ("parameter", "constant", "Real", "fixed"),
    ("parameter", "discrete", "Integer", "fixed"),
    ("calculatedParameter", "continuous", "Real", "fixed"),
    ("output", "fixed", "Real", "discrete"),
    ("output", "tunable", "Integer", "discrete"),
    ("input", "constant", "Boolean", "discrete"),
    ("local", None, "Integer", "discrete"),
    ("independent", "discrete", "Real", "continuous"),
]


@pytest.mark.parametrize(("causality", "variability", "type_", "becomes"), VARIABILITIES)
def test_a_variability_that_fmi_forbids_becomes_a_legal_one_and_is_told(
    causality: str, variability: str | None, type_: str, becomes: str, tmp_path: Path
) -> None:
    description = read(tmp_path, variable(causality, variability, type_))

    assert named(description, "v").variability == becomes
    assert any(f"variable 'v' (line 40) is a {causality} of the type {type_}" in one for one in description.problems)
    assert any(f"it is read as '{becomes}'" in one for one in description.problems)


@pytest.mark.parametrize(("causality", "variability"), [("parameter", "tunable"), ("local", "fixed"), ("input", None)])
def test_a_legal_variability_stays_and_is_no_problem(causality: str, variability: str | None, tmp_path: Path) -> None:
    description = read(tmp_path, variable(causality, variability))

    assert named(description, "v").variability == (variability or "continuous")
    assert not any("it is read as" in one for one in description.problems)


REPAIRED = [
    pytest.param(gain(('index="2" dependencies="1"', 'index="99"')), "(line 43) has the index '99'", id="index"),
    pytest.param(gain(('index="2" dependencies="1"', 'index="0"')), "has the index '0'", id="index 0"),
    pytest.param(gain(('dependencies="1 3"', 'dependencies="1  77"')), "has '77' in dependencies", id="dependencies"),
    pytest.param(gain(('<Real start="1"/>', '<Real derivative="8"/>')), "has '8' in derivative", id="derivative"),
    pytest.param(
        gain(('<Real start="1"/>', '<Integer declaredType="T"/>')), "the declaredType 'T', which", id="no such type"
    ),
    pytest.param(gain(('<Real start="1"/>', '<Boolean start="True"/>')), "it is read as 'true'", id="a word of Python"),
    pytest.param(gain(('StepSize="true"', 'StepSize="True"')), "it is read as 'true'", id="a capability"),
    pytest.param(gain(('<Real start="1"/>', '<Real start=""/>')), "attribute 'start': '' is not a valid", id="empty"),
    pytest.param(re.sub(r"(?s)<ModelVar.*Variables>", "", GAIN), "has no ModelVariables", id="no variables"),
    pytest.param(re.sub(r"(?s)<ModelS.*Structure>", "", GAIN), "Expected is ( ModelStructure )", id="no structure"),
    pytest.param(gain(("guid=", "id=")), "The attribute 'guid' is required but missing", id="no GUID"),
    pytest.param(gain(('fmiVersion="2.0"', 'fmiVersion="2.0.3"')), "it is read as FMI 2.0", id="a patch version"),
    pytest.param(gain(("<LogC", MODE.replace("</S", "<Item/></S") + "</TypeDefinitions><LogC")), "Item", id="an item"),
    pytest.param(
        gain(("<LogC", MODE.replace("name=", 'size="1" name=', 1) + "</TypeDefinitions><LogC")), "size", id="a type"
    ),
    pytest.param(gain(("<LogC", UNIT.replace('factor="0,001"', 'm2="1"') + "<LogC")),
                 "the unit is left undefined", id="a unit"),
    pytest.param(gain(("<CoSim", "<Extra><A/></Extra><CoSim")), "Element 'Extra': This element is not", id="unknown"),
    pytest.param(gain(("<Real/>", '<Real xmlns:a="urn:a"><a:b/></Real>')), "the XML namespace 'urn:a'", id="foreign"),
    pytest.param(gain((" fmiVersion", ' xmlns="urn:x" fmiVersion')), "namespace 'urn:x'", id="namespace"),
    pytest.param(
        re.sub(r"(?s)(<LogC.*Categories>)(.*Structure>)", r"\2\1", GAIN), "it is read in the right order", id="order"
    ),
]  # fmt: skip


@pytest.mark.parametrize(("xml", "says"), REPAIRED)
def test_what_needs_no_guess_is_repaired_and_told(xml: str, says: str, tmp_path: Path) -> None:
    description = read(tmp_path, xml)

    assert any(says in one for one in description.problems)
    assert [one.name for one in description.variables] in (["u", "y", "k"], [])
    assert not WORDS.search(" ".join(description.problems))


def test_a_unit_with_a_broken_definition_is_not_another_unit(tmp_path: Path) -> None:
    description = read(tmp_path, gain(("<LogC", UNIT + "<LogC"), ('<Real start="0"/>', '<Real start="0" unit="mm"/>')))

    assert named(description, "u").base_unit is None


def test_dependencies_that_are_broken_count_as_all(tmp_path: Path) -> None:
    description = read(tmp_path, gain(('dependencies="1 3"', 'dependencies="1 77"')))

    assert named(description, "y").dependencies is None


LEGAL = [
    pytest.param(GAIN.replace("<Real", "<!-- c --><?p i?><Real").encode(), id="comments"),
    pytest.param(GAIN.replace("UTF-8", "ISO-8859-1").replace("Gain<", "Gäin<").encode("latin-1"), id="Latin-1"),
    pytest.param(GAIN.replace("UTF-8", "UTF-16").encode("utf-16"), id="UTF-16"),
    pytest.param(GAIN.replace("UTF-8", "GB2312").encode("gb2312"), id="more bytes for a character"),
    pytest.param(("\ufeff" + GAIN).encode(), id="a byte order mark"),
    pytest.param(gain(('dependencies="1 3"', 'dependencies=" 1  3 "')).encode(), id="blanks"),
    pytest.param(gain((" fmiVersion", SCHEMA + " fmiVersion")).encode(), id="the place of a schema"),
    pytest.param(gain(("<ModelVar", VENDOR + "<ModelVar")).encode(), id="vendor annotations"),
]  # fmt: skip


@pytest.mark.parametrize("xml", LEGAL)
def test_what_is_legal_is_read_without_a_problem(xml: bytes, tmp_path: Path) -> None:
    description = read(tmp_path, xml)

    assert description == read(tmp_path, GAIN)
    assert description.problems == ()


def test_types_of_fmi_3_that_fmpy_does_not_know_are_read(tmp_path: Path) -> None:
    types = '<TypeDefinitions><BinaryType name="B" maxSize="5" mimeType="x"/></TypeDefinitions><ModelVar'
    binary = '<Binary name="b" valueReference="99" causality="output" declaredType="B"/></ModelVar'

    description = read(tmp_path, EVENTS.replace("<ModelVar", types).replace("</ModelVar", binary))

    assert named(description, "b").max_size == 5


REFUSED = [
    pytest.param(gain(("<Real/>", "")), "variable 'y' (line 32): Missing child element", id="no type"),
    pytest.param(gain((' name="y"', "")), "(line 32): The attribute 'name' is required", id="no name"),
    pytest.param(gain((' valueReference="1"', "")), "variable 'y' (line 32): The attribute 'valueR", id="no reference"),
    pytest.param(gain(*STATE), "index: there is no variable '9'", id="a state that is no variable"),
    pytest.param(
        re.sub(r"(?s)<ModelS.*Structure>", "", GAIN.replace("CoSimulation", "ModelExchange")), "no ModelStructure",
        id="no states"),
    pytest.param(re.sub(r'(?s)numberOfContinuousStates="\d+"|<Imple.*tation>', "", STEPS), "States is missing", id="1"),
    pytest.param(STEPS.replace('numberOfContinuousStates="0"', 'numberOfContinuousStates="x"'), "'x' is", id="text"),
    pytest.param(re.sub(r"<Dimension [^>]*>", '<Dimension valueReference="77777"/>', TYPES), "the size of", id="size"),
    pytest.param(re.sub(r"<Dimension [^>]*>", '<Dimension start="99999999"/>', TYPES), "the limit is", id="large"),
    pytest.param(gain(('fmiVersion="2.0"', 'fmiVersion="1,0"')), "is for FMI '1,0'; supported", id="a version"),
]  # fmt: skip


@pytest.mark.parametrize(("xml", "says"), REFUSED)
def test_what_would_be_a_guess_is_refused_with_its_place(xml: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(LoadFailed) as refused:
        read(tmp_path, xml)

    assert says in str(refused.value)
    assert not WORDS.search(str(refused.value))


def mutations(xml: str) -> Iterator[tuple[str, bytes]]:
    """Descriptions with one fault each: elements dropped, renamed, doubled, emptied; attributes with other values."""
    root = etree.fromstring(xml.encode())
    for place, element in enumerate(root.iter("*")):
        for fault in ("drop", "rename", "double", "empty") if place else ():
            changed, one = copied(root, place)
            match fault:
                case "drop":
                    one.getparent().remove(one)
                case "rename":
                    one.tag = "Other"
                case "double":
                    one.addprevious(copy.deepcopy(one))
                case _:
                    one[:] = []
            yield f"{fault} {element.tag} {place}", etree.tostring(changed)
        for name in element.keys():  # noqa: SIM118 an element of lxml iterates over its children
            for value in (None, "", "x", "999999"):
                changed, one = copied(root, place)
                one.attrib.pop(name) if value is None else one.set(name, value)
                yield f"{element.tag} {place}: {name} = {value}", etree.tostring(changed)


def copied(root: Any, place: int) -> tuple[Any, Any]:  # noqa: ANN401 lxml ships no types
    """A copy, and the element at a place of it."""
    changed = copy.deepcopy(root)
    return changed, list(changed.iter("*"))[place]


@pytest.mark.parametrize("xml", [STEPS, GAIN, EVENTS], ids=["FMI 1", "FMI 2", "FMI 3"])
def test_no_fault_of_a_description_ends_in_words_of_python(xml: str, tmp_path: Path) -> None:
    wrong = []
    for fault, changed in mutations(xml):
        try:
            told = " ".join(read(tmp_path, changed).problems)
        except LoadFailed as error:
            told = str(error).replace(str(tmp_path), "")
        if WORDS.search(told):
            wrong.append((fault, told))

    assert wrong == []
