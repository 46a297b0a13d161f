"""Import and export again: what another tool wrote survives, or is named as lost; our annotation is read with care."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from lxml import etree

import fmu_mesh
from fmu_mesh.ssp.own_annotation import AnnotationRefused, chosen_names, merged, names_in, written
from fmu_mesh.ssp.ssd_writing import own_annotation_in, with_own_annotation
from fmu_mesh.ssp.system_reading import read_system
from tests.helpers import FMUS

MAIN = "SystemStructure.ssd"
OURS = "io.github.fmu-mesh"

DOCUMENT = """<?xml version='1.0' encoding="UTF-8"?>
<!-- written by another tool -->
<SystemStructureDescription xmlns="http://ssp-standard.org/SSP1/SystemStructureDescription"
    xmlns:c="http://ssp-standard.org/SSP1/SystemStructureCommon" version="1.0" name='two "gains"'
    author="Somebody" generationDateAndTime="2020-01-01T00:00:00Z">
\t<System name="root" description="The whole">
    <Connectors><Connector name="out" kind="output"><c:Real unit="furlong"/></Connector></Connectors>
    <Elements>
      <Component name="First one" source="resources/Gain.fmu" description="doubles &#233; &lt;it&gt;">
        <Connectors>
          <Connector name="u" kind="input"><c:Real/><ConnectorGeometry x="0" y="0.5"/></Connector>
          <Connector name="y" kind="output"><c:Real/></Connector>
        </Connectors>
        <ElementGeometry x1="0" y1="0" x2="10" y2="10"/>
        <ParameterBindings><ParameterBinding source="resources/first.ssv"/></ParameterBindings>
      </Component>
      <System name="inner">
        <Connectors><Connector name="in" kind="input"><c:Real/></Connector></Connectors>
        <Elements>
          <Component name="second" source="resources/Gain.fmu">
            <Connectors>
              <Connector name="u" kind="input"><c:Real/></Connector>
              <Connector name="y" kind="output"><c:Real/></Connector>
            </Connectors>
          </Component>
        </Elements>
        <Connections><Connection startConnector="in" endElement="second" endConnector="u"/></Connections>
      </System>
    </Elements>
    <Connections>
      <Connection startElement="First one" startConnector="y" endElement="inner" endConnector="in">
        <c:LinearTransformation factor="2" offset="0.5"/><ConnectionGeometry pointsX="1 2" pointsY="3 4"/>
      </Connection>
      <Connection startElement="First one" startConnector="y" endConnector="out"/>
    </Connections>
    <SystemGeometry x1="0" y1="0" x2="100" y2="100"/>
    <Annotations  ><c:Annotation type="com.example.layout"><x:color xmlns:x="urn:x">a/></x:color></c:Annotation
    ></Annotations>
  </System>
  <Units><c:Unit name="furlong"><c:BaseUnit m="1" factor="201.168"/></c:Unit></Units>
  <DefaultExperiment startTime="0" stopTime="1">
    <Annotations>
      <c:Annotation type="org.openmodelica"><o:SimulationInformation xmlns:o="urn:oms"><o:FixedStepMaster stepSize="0.1"
      /></o:SimulationInformation></c:Annotation>
    </Annotations>
  </DefaultExperiment>
</SystemStructureDescription>
<!-- the end -->
"""
VALUES = """<ParameterSet version="1.0" name="first"
xmlns="http://ssp-standard.org/SSP1/SystemStructureParameterValues"><Parameters>
<Parameter name="k"><Real value="2"/></Parameter><Parameter name="u"><Real value="3"/></Parameter>
</Parameters>
</ParameterSet>
"""


def files_of_package(document: str = DOCUMENT) -> dict[str, bytes]:
    return {
        "documentation/read me.txt": b"A text.",
        MAIN: document.encode(),
        "resources/first.ssv": VALUES.encode(),
        "resources/Gain.fmu": (FMUS / "Gain.fmu").read_bytes(),
        "extra/com.example/state.bin": bytes(range(256)),
        "VarB.ssd": document.replace('two "gains"', "variant").encode(),
    }


def packed(path: Path, files: Mapping[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    return packed(tmp_path / "foreign.ssp", files_of_package())


def loaded(path: Path, ssd: str | None = None) -> fmu_mesh.Mesh:
    return fmu_mesh.Mesh.from_configuration(read_system(path, ssd))


def content_of(package: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(package) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def annotation_of(package: Path, name: str = MAIN) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(own_annotation_in(content_of(package)[name]) or "null")
    return content


def rows_of(mesh: fmu_mesh.Mesh, file: Path) -> bytes:
    mesh.run(output=str(file), processes=False)
    return file.read_bytes()


def canonical(document: bytes) -> bytes:
    """What a document says, comments and blanks between elements included; not its quotes and character references."""
    return bytes(etree.tostring(etree.fromstring(document).getroottree(), method="c14n", with_comments=True))


# --- copies


def test_a_package_that_is_exported_unchanged_is_the_same(foreign: Path, tmp_path: Path) -> None:
    lost = loaded(foreign).to_ssp(tmp_path / "copy.ssp")

    assert lost == ()
    assert list(content_of(tmp_path / "copy.ssp").items()) == list(content_of(foreign).items())


def test_only_our_annotation_comes_to_a_package_that_was_configured(foreign: Path, tmp_path: Path) -> None:
    mesh = loaded(foreign)
    mesh.configure(simulation={"algorithm": "gauss_seidel", "stop_time": 2.0}, group="auto")
    mesh.record("First-32-one.y", file="../rows.csv")

    lost = mesh.to_ssp(tmp_path / "copy.ssp")

    assert lost == ()
    before, after = content_of(foreign), content_of(tmp_path / "copy.ssp")
    changed, original = after.pop(MAIN), before.pop(MAIN)
    assert after == before
    assert canonical(with_own_annotation(changed, None)) == canonical(original)
    assert annotation_of(tmp_path / "copy.ssp") == {
        "version": 1,
        "simulation": {"algorithm": "gauss_seidel", "stop_time": 2.0},
        "group": "auto",
        "record": {"file": "rows.csv", "variables": ["First-32-one.y"]},
    }
    same = loaded(tmp_path / "copy.ssp")
    assert rows_of(same, tmp_path / "same.csv") == rows_of(mesh, tmp_path / "first.csv")
    assert same.plan().plan.system.result_file == str(foreign.parent / "rows.csv")


def test_a_copy_of_a_copy_has_one_annotation_of_ours(foreign: Path, tmp_path: Path) -> None:
    first = loaded(foreign)
    first.configure(simulation={"window": 4})
    first.to_ssp(tmp_path / "first.ssp")
    second = loaded(tmp_path / "first.ssp")
    second.configure(simulation={"window": 8}, strict=True)

    second.to_ssp(tmp_path / "second.ssp")
    loaded(tmp_path / "second.ssp").to_ssp(tmp_path / "third.ssp")

    assert annotation_of(tmp_path / "second.ssp") == {"version": 1, "simulation": {"window": 8}, "strict": True}
    assert content_of(tmp_path / "second.ssp")[MAIN].count(OURS.encode()) == 1
    assert (tmp_path / "third.ssp").read_bytes() == (tmp_path / "second.ssp").read_bytes()


def test_a_package_can_be_exported_over_itself(foreign: Path) -> None:
    mesh = loaded(foreign)
    mesh.configure(simulation={"window": 4})
    before = content_of(foreign)

    mesh.to_ssp(foreign)

    after = content_of(foreign)
    assert annotation_of(foreign)["simulation"] == {"window": 4}
    assert {**after, MAIN: b""} == {**before, MAIN: b""}


def test_keys_of_instances_and_connections_go_into_the_annotation_of_a_copy(foreign: Path, tmp_path: Path) -> None:
    mesh = loaded(foreign)
    data: Any = mesh.configuration.data
    data["instances"]["inner-second"] |= {"step_size": 0.2, "group": "g"}
    data["connections"][0]["delay"] = 1

    assert mesh.to_ssp(tmp_path / "copy.ssp") == ()

    assert annotation_of(tmp_path / "copy.ssp") == {
        "version": 1,
        "instances": {"inner-second": {"step_size": 0.2, "group": "g"}},
        "connections": [{"from": "First-32-one.y", "to": "inner-second.u", "delay": 1}],
    }
    assert loaded(tmp_path / "copy.ssp").configuration.data == data


def test_another_description_of_a_package_is_copied_with_way_to_run_it(foreign: Path, tmp_path: Path) -> None:
    mesh = loaded(foreign, "variant")
    mesh.configure(simulation={"window": 4})

    (lost,) = mesh.to_ssp(tmp_path / "copy.ssp")

    assert (lost.found, lost.expected) == (
        "'VarB.ssd' is not the default description of the package",
        "`ssd='VarB.ssd'` to run it",
    )
    assert annotation_of(tmp_path / "copy.ssp", "VarB.ssd")["simulation"] == {"window": 4}
    assert content_of(tmp_path / "copy.ssp")[MAIN] == content_of(foreign)[MAIN]


def test_a_folder_becomes_a_package_of_the_files_that_belong_to_it(tmp_path: Path) -> None:
    folder = tmp_path / "open"
    for name, content in {**files_of_package(), "models/Gain.fmu": b"", "secret.txt": b"", "x/y.ssd": b""}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "models/Gain.fmu").write_bytes((FMUS / "Gain.fmu").read_bytes())
    text = (folder / MAIN).read_text(encoding="utf-8").replace("resources/Gain.fmu", "models/Gain%2Efmu", 1)
    (folder / MAIN).write_text(text, encoding="utf-8")
    mesh = loaded(folder)

    assert mesh.to_ssp(tmp_path / "copy.ssp") == ()

    assert sorted(content_of(tmp_path / "copy.ssp")) == sorted([*files_of_package(), "models/Gain.fmu"])
    assert content_of(tmp_path / "copy.ssp")[MAIN] == (folder / MAIN).read_bytes()
    assert rows_of(loaded(tmp_path / "copy.ssp"), tmp_path / "b.csv") == rows_of(mesh, tmp_path / "a.csv")


def test_a_link_out_of_a_folder_is_not_packed(tmp_path: Path) -> None:
    folder, secret = tmp_path / "open", tmp_path / "secret.txt"
    secret.write_text("mine")
    for name, content in files_of_package().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "resources/notes.txt").symlink_to(secret)

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"notes\.txt' is a link out of the folder of the package"):
        loaded(folder).to_ssp(tmp_path / "copy.ssp")

    assert not (tmp_path / "copy.ssp").exists()


def test_where_a_package_connects_is_a_warning(own: Path, tmp_path: Path) -> None:
    mesh = loaded(own)
    mesh.configure(zenoh={"listen": ["tcp/127.0.0.1:7447"]})
    mesh.to_ssp(tmp_path / "open.ssp")

    (warning,) = loaded(tmp_path / "open.ssp").configuration.warnings

    assert warning.found == "the package says how the mesh connects: {'listen': ['tcp/127.0.0.1:7447']}"


def test_a_single_description_becomes_the_default_one_of_its_package(tmp_path: Path) -> None:
    for name, content in files_of_package().items():
        if name != MAIN:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_bytes(content)

    loaded(tmp_path / "VarB.ssd").to_ssp(tmp_path / "copy.ssp")

    copied = content_of(tmp_path / "copy.ssp")
    assert copied[MAIN] == (tmp_path / "VarB.ssd").read_bytes()
    assert "VarB.ssd" not in copied


def test_a_package_that_is_wrong_meanwhile_is_refused(foreign: Path, tmp_path: Path) -> None:
    mesh = loaded(foreign)
    packed(foreign, {**files_of_package(), MAIN: DOCUMENT.replace('endElement="inner"', 'endElement="iner"').encode()})

    with pytest.raises(fmu_mesh.ConfigurationError, match=r"unknown element 'iner'"):
        mesh.to_ssp(tmp_path / "copy.ssp")

    foreign.unlink()
    with pytest.raises(fmu_mesh.ConfigurationError, match=r"foreign\.ssp"):
        mesh.to_ssp(tmp_path / "copy.ssp")
    assert not (tmp_path / "copy.ssp").exists()


# --- new descriptions


def test_what_a_new_description_does_not_have_is_named(foreign: Path, tmp_path: Path) -> None:
    mesh = loaded(foreign)
    mesh.add("third", fmu="resources/Gain.fmu")

    lost = mesh.to_ssp(tmp_path / "new.ssp")

    assert {finding.file for finding in lost} == {str(foreign / MAIN)}
    lines = DOCUMENT.splitlines()
    head = "author 'Somebody', generationDateAndTime '2020-01-01T00:00:00Z'"
    others = "documentation/read me.txt, extra/com.example/state.bin, resources/first.ssv"
    assert [(lines[one.line - 1].strip()[:12] if one.line else None, one.found) for one in lost] == [
        ("<System name", "not in the new package: descriptions (2)"),
        ("<Connectors>", "not in the new package: lists of connectors of systems (2)"),
        ("<Connector n", "not in the new package: elements with geometry (4)"),
        ("<System name", "not in the new package: nested systems (1)"),
        ("<Annotations", "not in the new package: annotations 'com.example.layout' (1)"),
        ("<Units><c:Un", "not in the new package: the unit 'furlong', which no FMU defines (1)"),
        ("<c:Annotatio", "not in the new package: annotations 'org.openmodelica' (1)"),
        ('author="Some', f"not in the new package: {head}"),
        (None, f"not in the new package: files (4): VarB.ssd, {others}"),
    ]
    assert [*content_of(tmp_path / "new.ssp")] == [MAIN, "resources/Gain.fmu"]
    same = loaded(tmp_path / "new.ssp")
    assert same.instances == ["First-32-one", "inner-second", "third"]
    assert rows_of(same, tmp_path / "b.csv") == rows_of(mesh, tmp_path / "a.csv")


def changed_value(data: Any) -> None:  # noqa: ANN401  values of a file
    data["instances"]["First-32-one"]["start_values"]["k"] = 4.0


def changed_factor(data: Any) -> None:  # noqa: ANN401  as above
    data["connections"][0]["factor"] = 3.0


def changed_order(data: Any) -> None:  # noqa: ANN401  as above
    data["instances"] = dict(reversed(data["instances"].items()))


def without_connections(data: Any) -> None:  # noqa: ANN401  as above
    data["connections"] = []


def changed_kind(data: Any) -> None:  # noqa: ANN401  as above
    data["instances"]["First-32-one"]["kind"] = "co_simulation"


@pytest.mark.parametrize("change", [changed_value, changed_factor, changed_order, without_connections, changed_kind])
def test_a_change_that_ssp_can_say_leads_to_a_new_description(
    change: Callable[[Any], None], foreign: Path, tmp_path: Path
) -> None:
    mesh = loaded(foreign)
    change(mesh.configuration.data)

    assert mesh.to_ssp(tmp_path / "new.ssp")

    same = loaded(tmp_path / "new.ssp")
    assert list(same.configuration.data["instances"]) == mesh.instances  # type: ignore[arg-type, call-overload, index]  # a mapping
    assert rows_of(same, tmp_path / "b.csv") == rows_of(mesh, tmp_path / "a.csv")


def test_another_version_of_ssp_is_a_new_description(foreign: Path, tmp_path: Path) -> None:
    assert loaded(foreign).to_ssp(tmp_path / "new.ssp", version="2.0")

    assert b'version="2.0"' in content_of(tmp_path / "new.ssp")[MAIN]
    assert loaded(foreign).to_ssp(tmp_path / "copy.ssp", version="1.0") == ()


def test_a_version_that_one_document_lacks_is_a_new_description(tmp_path: Path) -> None:
    files = files_of_package()
    files["resources/first.ssv"] = files["resources/first.ssv"].replace(b'version="1.0"', b'version="2.0"')
    package = packed(tmp_path / "mixed.ssp", files)

    assert loaded(package).to_ssp(tmp_path / "copy.ssp") == ()
    assert loaded(package).to_ssp(tmp_path / "new.ssp", version="1.0")

    assert "resources/first.ssv" in content_of(tmp_path / "copy.ssp")
    documents = [text for name, text in content_of(tmp_path / "new.ssp").items() if not name.endswith(".fmu")]
    assert not any(b'version="2.0"' in text for text in documents)
    # What comes from a package of 2.0 stays one of 2.0.
    assert loaded(tmp_path / "new.ssp").to_ssp(tmp_path / "again.ssp") == ()
    assert (tmp_path / "again.ssp").read_bytes() == (tmp_path / "new.ssp").read_bytes()


# --- packages of ours that another tool has changed


def edited(package: Path, change: Callable[[str], str]) -> Path:
    files = content_of(package)
    return packed(package, {**files, MAIN: change(files[MAIN].decode()).encode()})


@pytest.fixture
def own(tmp_path: Path) -> Path:
    mesh = fmu_mesh.Mesh("own", step_size=0.1, stop_time=1.0)
    mesh.add("left-gain", fmu=FMUS / "Gain.fmu", start_values={"k": 2.0}, group="both")
    mesh.add("right", fmu=FMUS / "Integrator.fmu", group="both")
    mesh.connect("left-gain.y", "right.u", delay=1)
    mesh.to_ssp(tmp_path / "own.ssp")
    return tmp_path / "own.ssp"


def test_what_another_tool_has_changed_in_the_description_counts(own: Path) -> None:
    edited(own, lambda text: text.replace('value="2.0"', 'value="7"').replace('stopTime="1.0"', 'stopTime="3"'))

    data: Any = loaded(own).configuration.data

    assert data["simulation"] == {"start_time": 0.0, "stop_time": 3.0, "step_size": 0.1, "algorithm": "gauss_seidel"}
    assert data["instances"]["left-gain"] == {"fmu": "resources/Gain.fmu", "start_values": {"k": 7.0}, "group": "both"}


def test_what_our_annotation_says_about_things_that_are_gone_is_a_warning(own: Path) -> None:
    edited(own, lambda text: text.replace('name="right"', 'name="other"').replace('t="right"', 't="other"'))

    mesh = loaded(own)

    assert mesh.instances == ["left-gain", "other"]
    assert [(one.found, one.line is not None) for one in mesh.configuration.warnings] == [
        ("the instance 'right', which the annotation has group for is not there any more", True),
        ("the connection left-gain.y -> right.u, which the annotation has delay for is not there any more", True),
    ]
    assert mesh.check().findings == ()


def test_keys_of_connections_are_kept_unless_their_instance_is_gone(own: Path, tmp_path: Path) -> None:
    mesh = loaded(own)
    mesh.subscribe("plant/flow", "left-gain.u", time="timestamp", delay=0.2)
    mesh.publish("right.y", "twin/y")
    assert mesh.to_ssp(tmp_path / "keys.ssp") == ()
    same = loaded(tmp_path / "keys.ssp")
    edited(
        tmp_path / "keys.ssp",
        lambda text: text.replace('name="right"', 'name="other"').replace('t="right"', 't="other"'),
    )
    without = loaded(tmp_path / "keys.ssp")

    assert [key.cells for key in same.plan().plan.system.keys] == [
        ["plant/flow -> left-gain.u", "auto", "at its timestamp, 0.2 s later"],
        ["right.y -> twin/y", "json", "at each point"],
    ]
    assert same.to_ssp(tmp_path / "again.ssp") == ()
    assert content_of(tmp_path / "again.ssp")[MAIN].count(b"twin/y") == 1
    assert [key.ends for key in without.plan().plan.system.keys] == ["plant/flow -> left-gain.u"]
    gone = "the instance of 'right.y', which the annotation has the key 'twin/y' for is not there any more"
    assert gone in [one.found for one in without.configuration.warnings]


@pytest.mark.parametrize(
    ("content", "found", "expected"),
    [
        ('{"version": 1, "keys": [{"to": "right.u"}]}', "no list of connections with a key in 'keys'", "such a list"),
        ('{"version": 1, "keys": {}}', "no list of connections with a key in 'keys'", "such a list"),
        ("{", "no JSON: Expecting property name enclosed in double quotes", "the JSON that fmu_mesh writes"),
        ("[1]", "no mapping", "the JSON that fmu_mesh writes"),
        ('{"version": 2}', "version 2", "version 1"),
        ('{"version": 1, "simulation": {"step_size": NaN}}', "no JSON: 'NaN' is no number of JSON", ""),
        ('{"version": 1, "python": "x.py"}', "the key 'python'", "one of version, mesh, names"),
        ('{"version": 1, "names": {"right": 3}}', "a name in 'names' that is no text", "the name of an instance"),
        ('{"version": 1, "names": ["right"]}', "no mapping in 'names'", "a mapping"),
        (
            '{"version": 1, "names": {"right": "left-45-gain"}}',
            "the name 'left-45-gain' of the elements 'left-45-gain' and 'right'",
            "a name of its own for each of them",
        ),
        (
            '{"version": 1, "instances": {"right": {"python": "x.py:X"}}}',
            "the key 'python' of 'right'",
            "one of deep_binding, group, host",
        ),
        ('{"version": 1, "instances": {"right": 1}}', "no mapping for the instance 'right'", "a mapping"),
        ('{"version": 1, "connections": [{"factor": 2}]}', "the key 'factor' of a connection", "one of delay"),
        (
            '{"version": 1, "record": {"file": "../../rows.csv"}}',
            "the result file '../../rows.csv'",
            "a path into the folder of the package",
        ),
        ('{"version": 1, "record": [{"file": "/tmp/rows.csv"}]}', "the result file '/tmp/rows.csv'", "a path into"),
        ('{"version": 1, "connections": {}}', "no list of mappings in 'connections'", "a list of mappings"),
        (f'{{"version": 1, "x": {"[" * 100_000}', "no JSON: maximum recursion depth", "the JSON that fmu_mesh"),
    ],
)
def test_an_annotation_that_is_wrong_is_a_finding_with_its_line(
    content: str, found: str, expected: str, own: Path
) -> None:
    edited(
        own, lambda text: re.sub(r"(?s)(<Mesh [^>]*>).*(</Mesh>)", lambda match: match[1] + content + match[2], text)
    )

    (finding,) = loaded(own).configuration.findings

    assert finding.found.startswith(found)
    assert finding.expected.startswith(expected)
    assert finding.path == f"Annotation '{OURS}' of System 'own'"
    assert finding.line is not None


def test_value_of_annotation_is_checked_as_any_other_with_line_of_annotation(own: Path) -> None:
    edited(own, lambda text: text.replace('"step_size": 0.1', '"step_size": "fast"'))

    (finding,) = loaded(own).check().findings

    assert finding.path == "simulation.step_size"
    assert finding.file == str(own / MAIN)
    lines = content_of(own)[MAIN].decode().splitlines()
    assert finding.line is not None
    assert OURS in lines[finding.line - 1]


# --- the text of a document


def simple(annotations: str, *, before: str = "") -> bytes:
    ssd, ssc = (f"http://ssp-standard.org/SSP1/SystemStructure{name}" for name in ("Description", "Common"))
    text = (
        f'<s:D xmlns:s="{ssd}" xmlns:c="{ssc}">{before}<s:System name="x"><s:Elements/>{annotations}</s:System></s:D>'
    )
    return text.encode()


ANOTHER = '<c:Annotation type="a.b"><x>&#10;a/></x></c:Annotation>'
MINE = f'<c:Annotation type="{OURS}"><m:Mesh xmlns:m="urn:m">{{"old": 1}}</m:Mesh></c:Annotation>'


@pytest.mark.parametrize(
    ("annotations", "rest"),
    [
        ("", "<s:Annotations></s:Annotations>"),
        ("<s:Annotations/>", "<s:Annotations></s:Annotations>"),
        ("<s:Annotations  ></s:Annotations >", "<s:Annotations/>"),
        (f"<s:Annotations>{ANOTHER}</s:Annotations>", f"<s:Annotations>{ANOTHER}</s:Annotations>"),
        (f"<s:Annotations>{ANOTHER}{MINE}</s:Annotations>", f"<s:Annotations>{ANOTHER}</s:Annotations>"),
        (
            f"<s:Annotations>{MINE}<!-- {MINE} -->{ANOTHER}{MINE}</s:Annotations>",
            f"<s:Annotations><!-- {MINE} -->{ANOTHER}</s:Annotations>",
        ),
        (
            f'<s:Annotations><c:Annotation type="{OURS}"/>{ANOTHER}</s:Annotations>',
            f"<s:Annotations>{ANOTHER}</s:Annotations>",
        ),
    ],
)
def test_an_annotation_is_put_into_a_document_that_says_the_same(annotations: str, rest: str) -> None:
    nested = f"<s:System><s:Annotations>{MINE}</s:Annotations></s:System>"
    document = simple(annotations, before=f"<s:Elements>{nested}</s:Elements>")
    text = '{"new": "é < & ]]> \\n"}'

    changed = with_own_annotation(document, text)

    assert own_annotation_in(changed) == text
    assert len(re.findall(rb"https://fmu-mesh.github.io/ssp/1", changed)) == 1
    bare = with_own_annotation(changed, None)
    assert own_annotation_in(bare) is None
    assert canonical(bare) == canonical(simple(rest, before=f"<s:Elements>{nested}</s:Elements>"))


def test_a_document_in_another_encoding_keeps_it() -> None:
    document = f"<?xml version='1.0' encoding='UTF-16'?>{simple('').decode()}".encode("utf-16")

    changed = with_own_annotation(document, "{}")

    assert own_annotation_in(changed) == "{}"
    assert changed.decode("utf-16").startswith("<?xml version='1.0' encoding='UTF-16'?>")


# --- the text of the annotation


def test_an_annotation_gives_back_what_was_written() -> None:
    described = {
        "mesh": "m",
        "simulation": {"stop_time": 1.0, "step_size": 0.5},
        "instances": {"a": {"fmu": "a.fmu", "step_size": 1.0}, "b": {"fmu": "b.fmu"}},
        "connections": [{"from": "a.y", "to": "b.u", "factor": 2.0}],
        "record": {"file": "../results/{mesh}.csv"},
    }
    data = {
        "mesh": "other",
        "simulation": {"stop_time": None, "step_size": 0.5, "window": 3},
        "instances": {"a": {"fmu": "a.fmu"}, "b": {"fmu": "b.fmu", "solver": {"name": "euler"}}},
        "connections": [{"from": "a.y", "to": "b.u", "factor": 2.0, "extrapolation": "linear"}],
        "record": {"file": "../results/{mesh}.csv"},
        "scenario": {"values": {"b.z": 1.0}},
    }

    text = written(data, described, names={"b-45-x": "b"})

    assert text is not None
    assert names_in(text) == {"b-45-x": "b"}
    assert chosen_names(["a", "b-45-x", "c"], text) == {"a": "a", "b-45-x": "b", "c": "c"}
    result = merged(described, text)
    expected = {**data, "instances": {"a": {"fmu": "a.fmu", "step_size": None}, "b": data["instances"]["b"]}}  # type: ignore[index]  # a mapping
    assert result.data == expected
    assert result.paths == [
        "simulation.stop_time",
        "simulation.window",
        "mesh",
        "instances.a.step_size",
        "instances.b.solver",
        "connections[0].extrapolation",
        "scenario",
    ]


def test_there_is_no_annotation_if_ssp_can_say_everything() -> None:
    data = {"mesh": "m", "simulation": {"stop_time": 1.0}, "instances": {"a": {"fmu": "a.fmu", "start_values": {}}}}

    assert written(data, {"mesh": "m", "simulation": {"stop_time": 1.0}}) is None


def test_a_text_that_is_too_long_is_refused() -> None:
    with pytest.raises(AnnotationRefused, match="characters at most"):
        names_in(" " * (4 * 2**20 + 1))
