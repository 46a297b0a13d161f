"""XML that must not be read, descriptions that cannot run, and those that are odd but can."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from fmu_mesh.errors import ConfigurationError, LoadFailed
from fmu_mesh.instances.fmi.archive.archive import sha256_of
from fmu_mesh.instances.fmi.archive.reading import read_description
from tests.fmus.packing import repacked
from tests.planning import prepare


def with_document_type(declaration: str, inside: str) -> Callable[[str], str]:
    """A description with a document type, and something of it in an attribute."""

    def change(text: str) -> str:
        head, body = text.split("?>", 1)
        body = body.replace("author=", f'author="{inside}" x=')
        return f"{head}?><!DOCTYPE fmiModelDescription {declaration}>{body}"

    return change


LAUGHS = "".join(f"<!ENTITY l{n} '" + 10 * f"&l{n - 1};" + "'>" for n in range(1, 12))
HOSTILE_XML = [
    pytest.param(with_document_type(f'[<!ENTITY l0 "ha">{LAUGHS}]', "&l11;"), id="entities that expand without end"),
    pytest.param(
        with_document_type("[<!ENTITY a '" + 50_000 * "ha" + "'>]", "&a;" * 1000), id="one large entity, often"
    ),
    pytest.param(with_document_type('[<!ENTITY a SYSTEM "file:///etc/passwd">]', ""), id="an external entity"),
    pytest.param(with_document_type('SYSTEM "http://127.0.0.1:9/fmi.dtd"', ""), id="an external document type"),
]


@pytest.mark.timeout(30)
@pytest.mark.parametrize("change", HOSTILE_XML)
def test_a_description_with_a_document_type_is_refused_before_it_is_read(
    change: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "fmu_mesh.instances.fmi.archive.reading.read_model_description",
        lambda *_, **__: pytest.fail("FMPy read what is not safe"),
    )
    path = repacked(tmp_path / "hostile.fmu", description=change)

    with pytest.raises(LoadFailed, match=r"modelDescription.xml of '.*hostile.fmu' declares a document type"):
        read_description(path)


def test_a_build_description_with_a_document_type_is_refused(tmp_path: Path) -> None:
    xml = b'<!DOCTYPE x [<!ENTITY a "b">]><fmiBuildDescription fmiVersion="3.0"/>'
    path = repacked(tmp_path / "hostile.fmu", add={"sources/buildDescription.xml": xml})

    with pytest.raises(LoadFailed, match=r"sources/buildDescription.xml of '.*hostile.fmu' declares a document type"):
        read_description(path)


@pytest.mark.parametrize(
    "content", ["<a>" * 5000 + "</a>" * 5000, f"<a b='{'x' * 11_000_000}'/>"], ids=["deep", "a large attribute"]
)
def test_a_limit_that_a_description_exceeds_is_in_the_error(content: str, tmp_path: Path) -> None:
    path = repacked(tmp_path / "hostile.fmu", description=lambda text: text.replace("<ModelVariables>", content, 1))

    with pytest.raises(LoadFailed) as caught:
        read_description(path)

    assert "nested more than 255 deep, or a tag, an attribute or a text has more than 10 million" in str(caught.value)
    assert "XML_PARSE_HUGE" not in str(caught.value)


CANNOT_RUN = [
    pytest.param(("<?xml", "<<?xml"), "cannot be read: ", id="XML that is not well-formed"),
    pytest.param(
        ('fmiVersion="2.0"', 'fmiVersion="3.0-beta.2"'), "is for FMI 3.0-beta.2, a preliminary version", id="beta"
    ),
    pytest.param(
        ('fmiVersion="2.0"', 'fmiVersion="9"'), "is for FMI '9'; supported are FMI 1.0, 2.0 and 3.0", id="FMI 9"
    ),
    pytest.param(
        ('causality="input"', 'causality="inptu"'),
        "variable 'u' (line 27): causality: The value 'inptu' is not an element of the set",
        id="an illegal causality",
    ),
    pytest.param(
        ('valueReference="1"', 'valueReference="-1"'),
        "variable 'y' (line 32): valueReference: '-1' is not a valid value",
        id="an illegal value reference",
    ),
    pytest.param(
        ('canHandleVariableCommunicationStepSize="true"', 'canHandleVariableCommunicationStepSize="perhaps"'),
        "CoSimulation (line 8): canHandleVariableCommunicationStepSize: 'perhaps' is not",
        id="an illegal capability",
    ),
    pytest.param(
        ('modelIdentifier="Gain"', 'modelIdentifier="../../Gain"'),
        "which cannot be the name of a library",
        id="an identifier that leaves the folder",
    ),
]


@pytest.mark.parametrize(("change", "says"), CANNOT_RUN)
def test_what_cannot_run_is_refused_with_the_reason(change: tuple[str, str], says: str, tmp_path: Path) -> None:
    path = repacked(tmp_path / "odd.fmu", description=lambda text: text.replace(*change))

    with pytest.raises(LoadFailed) as caught:
        read_description(path)

    assert says in str(caught.value)
    assert "odd.fmu" in str(caught.value)


ODD = [
    pytest.param(('author="', 'colour="red" author="'), "attribute 'colour'", id="an unknown attribute"),
    pytest.param(("<DefaultExperiment", "<Vendor/><DefaultExperiment"), "Element 'Vendor'", id="an unknown element"),
    pytest.param(
        ('author="', 'generationDateAndTime="today" author="'), "generationDateAndTime", id="a date that is none"
    ),
    pytest.param(('<Real start="1"', '<Real start="1,0"'), "attribute 'start'", id="a start value that is none"),
    pytest.param(
        ('modelIdentifier="Gain"', 'modelIdentifier="Other"'),
        "the library 'binaries/linux64/Gain.so' is not named as FMI demands, 'binaries/linux64/Other.so'",
        id="a library with another name",
    ),
]


def config_with(path: Path, **more: object) -> Path:
    file = path.with_suffix(".yaml")
    content = {
        "mesh": "one",
        "simulation": {"stop_time": 1, "step_size": 0.1},
        "instances": {"gain": {"fmu": path.name, **more}},
    }
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


@pytest.mark.parametrize(("change", "says"), ODD)
def test_an_oddity_is_a_problem_and_an_error_in_a_strict_configuration(
    change: tuple[str, str], says: str, tmp_path: Path
) -> None:
    def changed(text: str) -> str:
        assert change[0] in text
        return text.replace(*change)

    path = repacked(tmp_path / "odd.fmu", description=changed)

    plan = prepare(config_with(path))

    problem, *consequences = plan.system.instances["gain"].description.problems
    assert says in problem
    assert consequences in ([], ['Variable "k" (line 37) has no start value.'])
    with pytest.raises(ConfigurationError, match="strict: false") as caught:
        prepare(config_with(path, strict=True))
    assert "instances.gain.fmu" in str(caught.value)
    assert says in str(caught.value)


def test_an_instance_may_be_bearable_where_the_whole_configuration_is_strict(tmp_path: Path) -> None:
    path = repacked(tmp_path / "odd.fmu", description=lambda text: text.replace('author="', 'colour="red" author="'))
    strict, bearable = config_with(path), config_with(path, strict=False)
    bearable.write_text(bearable.read_text() + "strict: true\n")

    prepare(bearable)

    strict.write_text(config_with(path).read_text() + "strict: true\n")
    with pytest.raises(ConfigurationError, match="colour"):
        prepare(strict)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sha256": "0" * 64}, "has the SHA-256 "),
        ({"sha256": "abc"}, "expected a SHA-256 as 64 hexadecimal digits"),
    ],
)
def test_a_checksum_in_the_configuration_is_checked(change: dict[str, str], says: str, tmp_path: Path) -> None:
    path = repacked(tmp_path / "gain.fmu")

    with pytest.raises(ConfigurationError) as caught:
        prepare(config_with(path, **change))

    assert says in str(caught.value)
    prepare(config_with(path, sha256=sha256_of(path)))


def test_the_limits_of_the_configuration_hold(tmp_path: Path) -> None:
    file = config_with(repacked(tmp_path / "gain.fmu"))
    file.write_text(file.read_text() + "limits: {entries: 3}\n")

    with pytest.raises(ConfigurationError, match=r"instances\.gain\.fmu: .* entries; the limit is 3"):
        prepare(file)


def test_a_model_for_the_other_kind_only_is_refused_with_way_out(tmp_path: Path) -> None:
    path = repacked(tmp_path / "odd.fmu", description=lambda text: text.replace("CoSimulation", "ModelExchange"))

    with pytest.raises(LoadFailed, match="is for model exchange only, not for co-simulation") as refused:
        read_description(path, kind="co_simulation")

    assert refused.value.hint == "`kind: auto` uses the kind that the FMU has."
